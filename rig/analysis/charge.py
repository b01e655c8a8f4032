"""The permittivity and the leakage of a film from the currents in its logs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.electrical.charge import Charging, Known, NotResolved, Permittivity, permittivity
from calibration.film.assumed import assumed_uncertainties
from calibration.rounding import percent
from drivers.roles import HVFlag
from rig.base.errors import DataError
from rig.log.contents import certificates_in, scene_in
from rig.log.dataset import interpolate
from rig.log.reader import Log, read_log
from rig.scene.scene import Scene

if TYPE_CHECKING:
    from rich.console import Group


def permittivity_of(paths: Sequence[Path]) -> Permittivity:
    """The permittivity of the film in the logs, which must be of one specimen on one supply.

    Raises
    ------
    rig.log.errors.LogError
        A file that is no log.
    DataError
        No supply, several specimens, or currents that cannot resolve it; says which.
    """
    data, known = charging_of(paths)
    try:
        return permittivity(data, known)
    except NotResolved as error:
        raise DataError(f"{paths[0]}: {error}.") from None


def charging_of(paths: Sequence[Path]) -> tuple[list[Charging], Known]:
    """Currents in the logs of one specimen, and what is known beside them; errors as of `permittivity_of`."""
    logs = [read_log(path) for path in paths]
    scenes = [scene_in(log) for log in logs]
    names = sorted({scene.specimen.name for scene in scenes})
    if len(names) > 1:
        raise DataError(f"These logs are of {len(names)} specimens ({', '.join(names)}): name those of one.")
    for log, scene in zip(logs, scenes, strict=True):
        if scene.hv is None or "/hv/sample" not in log.topics:
            raise DataError(f"{log.path}: its scene has no [hv] instrument, so there is no current.")
    return [_charging(*one) for one in zip(logs, scenes, strict=True)], _known(logs[0], scenes[0])


def _charging(log: Log, scene: Scene) -> Charging:
    table = log.columns("/hv/sample")
    order = np.argsort(table["t_s"], kind="stable")
    t = table["t_s"][order]
    flags = table["flags"][order]
    return Charging(
        scene.specimen.specimen(),
        t,
        table["voltage_V"][order],
        np.where(flags & HVFlag.ON.value, table["current_A"][order], np.nan),
        _displacement(log, t),
        (flags & HVFlag.RAMPING.value) != 0,
        run=log.path.name,
    )


def _displacement(log: Log, t: np.ndarray[Any, np.dtype[np.float64]]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Displacement (m) at times ``t``: by the laser, else the stage's way from contact; NaN before contact is known."""
    contacts = [m.fields["value"] for m in log.messages("/reference") if m.fields["name"] == "contact_position"]
    since = [m.fields["t_s"] for m in log.messages("/reference") if m.fields["name"] == "contact_position"]
    if not contacts:
        return np.full(t.shape, np.nan)
    if "/displacement/sample" in log.topics:
        laser = log.columns("/displacement/sample")
        h = interpolate(t, laser["t_s"], np.where(laser["flags"] == 0, laser["displacement_m"], np.nan))
    else:
        stage = log.columns("/stage/sample")
        h = interpolate(t, stage["t_s"], stage["position_m"]) - contacts[-1]
    return np.where(t >= since[-1], np.maximum(h, 0.0), np.nan)


def _known(log: Log, scene: Scene) -> Known:
    specimen, table, hv = scene.specimen.specimen(), scene.specimen, scene.hv
    assert hv is not None
    assumed = assumed_uncertainties(specimen)
    certificates = certificates_in(log)
    supply, laser = certificates.get("hv"), certificates.get("displacement")

    def relative(stated: float | None, of: float, name: str) -> float:
        return assumed[name] if stated is None else stated / of

    volts = table.voltage_at_film_uncertainty_percent
    at_film = assumed["voltage_at_film"] if volts is None else volts / 100.0
    return Known(
        thickness=relative(table.thickness_uncertainty_um, table.thickness_um, "thickness_uncertainty"),
        prestretch=relative(table.prestretch_uncertainty, table.prestretch, "prestretch_uncertainty"),
        disk_radius=relative(table.disk_radius_uncertainty_mm, table.disk_radius_mm, "disk_radius_uncertainty"),
        ring_radius=relative(table.ring_radius_uncertainty_mm, table.ring_radius_mm, "ring_radius_uncertainty"),
        voltage_gain=math.hypot(at_film, 0.0 if supply is None else supply.gain_uncertainty),
        displacement_m=0.0 if laser is None else laser.zero_uncertainty,
        current_gain=None if hv.current_uncertainty_percent is None else hv.current_uncertainty_percent / 100.0,
        cable_F=hv.parallel_capacitance_nF * 1e-9,
        cable_uncertainty_F=None
        if hv.parallel_capacitance_uncertainty_nF is None
        else hv.parallel_capacitance_uncertainty_nF * 1e-9,
    )


def as_tables(found: Permittivity) -> Group:
    """Permittivity with its budget, capacitances and leakages, for the terminal."""
    from rich.console import Group
    from rich.table import Table

    budget = Table(title=f"Relative permittivity {found.value:.4g} +- {found.standard_uncertainty:.2g} by the charge")
    budget.add_column("part of the uncertainty")
    budget.add_column("relative", justify="right")
    for name, part in sorted(found.budget.items(), key=lambda item: -item[1]):
        words = f"{name} (assumed, not stated)" if name in found.assumed else name
        budget.add_row(words, percent(part / found.value))
    capacitances = Table(title=f"d(CV)/dV of film and cable ({found.cable * 1e12:.3g} pF)")
    for heading in ("at / mm", "mean voltage / V", "measured / pF", "model with this permittivity / pF"):
        capacitances.add_column(heading, justify="right")
    for c in found.capacitances:
        measured = f"{c.measured * 1e12:.4g} +- {c.standard_uncertainty * 1e12:.2g}"
        capacitances.add_row(f"{c.h * 1e3:.3f}", f"{c.voltage:.0f}", measured, f"{c.fitted * 1e12:.4g}")
    leakages = Table(title="Leakage: what is left of the current at rest")
    for heading in ("at / mm", "voltage / V", "field / V/um", "current / nA", "rest / s"):
        leakages.add_column(heading, justify="right")
    for leak in found.leakages:
        current = f"{leak.current * 1e9:.3g} +- {leak.standard_uncertainty * 1e9:.2g}"
        cells = (f"{leak.h * 1e3:.3f}", f"{leak.voltage:.0f}", f"{leak.field * 1e-6:.3g}", current)
        leakages.add_row(*cells, f"{leak.duration:.1f}")
    noise = f"{found.samples} samples on rises; noise of a reading {found.noise * 1e9:.3g} nA"
    steps = f", read in steps of {found.resolution * 1e9:.3g} nA" if found.resolution > 0 else ""
    return Group(budget, capacitances, leakages, f"{noise}{steps}.")
