"""Experiments of the independent cone written as a table of another rig, and read by the road that such tables go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from calibration.film.curve import Curve
from rig.analysis.imported import read_cones
from rig.importing.options import ImportOptions

MATERIAL = "[specimen.material]\nmu_Pa = [2e4]\nalpha = [3.0]\neps_r = 3.0\n"


def through_table(curves: Sequence[Curve], stated: Mapping[str, float], folder: Path) -> list[Curve]:
    """The curves as `dea-rig fit table.csv --scene scene.toml` has them; ``stated`` goes into the scene."""
    table, scene = folder / "table.csv", folder / "scene.toml"
    columns = np.concatenate(
        [np.stack((one.time, one.h * 1e3, one.force, one.voltage)) for one in curves if one.time is not None], axis=1
    )
    np.savetxt(table, columns.T, fmt="%.9f", delimiter=",", header="t_s,displacement_mm,force_N,voltage_V", comments="")
    scene.write_text(scene_of(curves[0], stated), encoding="utf-8")
    return read_cones([table], scene, ImportOptions()).curves


def scene_of(curve: Curve, stated: Mapping[str, float]) -> str:
    """A scene that has the specimen only."""
    film = curve.specimen
    a, b, thickness = 1e3 * film.disk_radius, 1e3 * film.ring_radius, 1e6 * film.thickness
    sizes = {
        "thickness_uncertainty_um": stated["thickness_uncertainty"] * thickness,
        "prestretch_uncertainty": stated["prestretch_uncertainty"] * film.prestretch,
        "disk_radius_uncertainty_mm": stated["disk_radius_uncertainty"] * a,
        "ring_radius_uncertainty_mm": stated["ring_radius_uncertainty"] * b,
        "displacement_axis_uncertainty_percent": 100.0 * stated["displacement_axis"],
        "voltage_at_film_uncertainty_percent": 100.0 * stated["voltage_at_film"],
    }
    lines = [
        'title = "another rig"',
        "[specimen]",
        'name = "cone"',
        f"disk_radius_mm = {a:.9g}",
        f"ring_radius_mm = {b:.9g}",
        f"thickness_um = {thickness:.9g}",
        f"prestretch = {film.prestretch:.9g}",
        *(f"{key} = {size:.9g}" for key, size in sizes.items()),
    ]
    return "\n".join(lines) + "\n" + MATERIAL
