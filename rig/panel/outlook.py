"""What the scene and the plan let one expect of a run: limits, steps with their times, the model's curves.

Computed once, in a process of its own that ends (``python -m rig.panel.outlook``): the panel's server stays small, and
the model's time is not taken from the run. Text in, JSON out.
"""

from __future__ import annotations

import json
import math
import os
import sys
from contextlib import suppress
from typing import Any

import numpy as np

from model.membrane.solve import profiles, solve_many
from rig.base.errors import RigError
from rig.base.toml_file import parse_table
from rig.protocol.plan import plan
from rig.protocol.protocol import Protocol
from rig.safety.limits import Limits
from rig.scene.scene import Scene

PLACES = 25  # displacements of a curve
MOST_LEVELS = 6
POINTS = 25  # of a drawn shape


def outlook(scene_text: str, protocol_text: str) -> dict[str, Any]:
    """Limits, steps and curves, in the units in the names.

    Raises
    ------
    RigError
        The texts are not a scene and a protocol of this version.
    """
    scene = parse_table(scene_text, Scene, "scene", "scene.toml inside the log")
    protocol = parse_table(protocol_text, Protocol, "protocol", "protocol.toml inside the log")
    actions = plan(protocol, scene)
    starts = np.cumsum([0.0, *(action.duration for action in actions)])
    steps = [
        {
            "step": action.step,
            "kind": action.kind,
            "label": action.label,
            "start_s": float(start),
            "duration_s": action.duration,
        }
        for action, start in zip(actions, starts[:-1], strict=True)
    ]
    levels = sorted({level for action in actions for level in action.levels})
    if len(levels) > MOST_LEVELS:
        levels = [levels[k] for k in np.linspace(0, len(levels) - 1, MOST_LEVELS).round().astype(int)]
    deepest = max((end for action in actions for end in action.ends), default=0.0)
    return {
        "title": protocol.title,
        "steps": steps,
        "duration_s": float(starts[-1]),
        "limits": _limits(scene),
        "film": _film(scene, levels, deepest) if deepest > 0.0 else None,
    }


def _limits(scene: Scene) -> dict[str, float | None]:
    limits = Limits.of(scene)
    hv = scene.hv is not None
    found = {
        "force_mN": limits.force.high * 1e3,
        "displacement_mm": limits.displacement.high * 1e3,
        "voltage_V": limits.voltage.high if hv else math.inf,
        "current_uA": limits.current.high * 1e6 if hv and limits.current.high > 0 else math.inf,
        "field_V_per_um": limits.field.high * 1e-6 if hv else math.inf,
        "hoop_stress_kPa": limits.hoop_stress.low * 1e-3,
    }
    return {name: value if math.isfinite(value) else None for name, value in found.items()}


def _film(scene: Scene, levels: list[float], deepest: float) -> dict[str, Any]:
    """Force, field, least hoop stress and shape over displacement, at each voltage of the plan."""
    specimen = scene.specimen.specimen()
    h = np.linspace(0.0, deepest, PLACES)
    volts = np.array(levels)
    states = solve_many(specimen, h[None, :], volts[:, None], tolerance=1e-4, wrinkling="tension_field")
    shape = profiles(specimen, h, 0.0, POINTS)
    return {
        "h_mm": _numbers(h * 1e3),
        "voltages_V": levels,
        "force_mN": [_numbers(row * 1e3) for row in states.force],
        "field_V_per_um": [_numbers(row * 1e-6) for row in states.peak_field],
        "hoop_stress_kPa": [_numbers(row * 1e-3) for row in states.min_hoop_stress],
        "shape_r_mm": [_numbers(row * 1e3) for row in shape.r],
        "shape_z_mm": [_numbers(row * 1e3) for row in shape.z],
        "disk_radius_mm": specimen.disk_radius * 1e3,
        "ring_radius_mm": specimen.ring_radius * 1e3,
    }


def _numbers(values: Any) -> list[float | None]:
    return [float(f"{value:.5g}") if math.isfinite(value) else None for value in np.asarray(values).tolist()]


def main() -> None:
    """Read ``{"scene": ..., "protocol": ...}`` from standard input and write the outlook to standard output."""
    if hasattr(os, "nice"):
        with suppress(OSError):
            os.nice(10)
    texts = json.load(sys.stdin)
    try:
        found = outlook(texts["scene"], texts["protocol"])
    except RigError as error:
        found = {"error": str(error)}
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
