"""What the model expects of a plan, held against the scene's limits before anything moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.membrane.solve import Status, solve, solve_many
from model.specimen import Specimen
from rig.base.errors import LimitError
from rig.safety.limits import Limits
from rig.scene.scene import Scene
from rig.steps.base import Action

POINTS = 13  # displacements per action at which the prediction is made


@dataclass(frozen=True)
class Prediction:
    """The extremes that the model expects during one action, with the scene's guess of the material."""

    peak_force: float
    peak_field: float
    minimum_hoop_stress: float
    stored_energy: float
    peak_stretch: float
    status: Status


def predict(action: Action, specimen: Specimen, parallel_capacitance: float = 0.0) -> Prediction:
    """What the model expects during ``action``: extremes over its displacements at both of its voltages.

    The force of a film that takes time is the larger of that relaxed and that at once.
    """
    h = np.linspace(max(action.h[0], 0.0), max(action.h[1], 0.0), POINTS if action.moves else 1)
    voltage = np.array(sorted(set(action.voltage)))[:, None]
    states = solve_many(specimen, h, voltage)
    force = states.force
    if specimen.material.branches:  # pushed in no time it is stiffer; NaN, where it has no state then, fails the limit
        from model.membrane.history import at_once

        force = np.maximum(force, at_once(specimen, h, voltage, tolerance=1e-4))
    return Prediction(
        peak_force=float(np.max(force)),
        peak_field=float(np.max(states.peak_field)),
        minimum_hoop_stress=float(np.min(states.min_hoop_stress)),
        stored_energy=_stored_energy(specimen, float(h.max()), max(action.voltage), parallel_capacitance),
        peak_stretch=float(np.max(states.max_stretch)),
        status=Status(int(np.max(states.status))),
    )


def _stored_energy(specimen: Specimen, h: float, voltage: float, beside: float) -> float:
    """0.5 C V^2 (J) where the film is stretched the most; NaN where the model has no state."""
    if voltage == 0.0:
        return 0.0
    state = solve(specimen, h, voltage)
    return 0.5 * (state.capacitance() + beside) * voltage**2 if state.answered else math.nan


def check_plan(actions: Sequence[Action], scene: Scene, force_noise: float = 0.0) -> list[Prediction]:
    """Predict every action and hold it against the scene's limits.

    ``force_noise`` is the standard deviation of one force sample (N), by the certificate.

    Raises
    ------
    LimitError
        Naming the step, the quantity, its value and its limit; NaN fails every limit.
    """
    limits = Limits.of(scene)
    specimen = scene.specimen.specimen()
    known: dict[object, Prediction] = {}  # a cycle is predicted once

    def hold(action: Action) -> Prediction:
        where = f"Step {action.step} ({action.kind}, {action.label})"
        action.check(specimen, limits, force_noise)
        limits.displacement.check(max(action.h), where)
        limits.speed.check(action.speed, where)
        for level in action.voltage:
            limits.voltage.check(level, where)
            if scene.hv is not None and scene.hv.whole_volts and level != round(level):
                raise LimitError(f"{where}: the {scene.hv.driver} supply takes whole volts only.")
        path = (frozenset(action.h), frozenset(action.voltage), action.moves)
        if path not in known:
            known[path] = predict(action, specimen, limits.parallel_capacitance)
        prediction = known[path]
        no_taut_state = f"{where}: the model has no taut state there. {prediction.status.message}"
        if prediction.status not in (Status.TAUT, Status.WRINKLED):
            raise LimitError(no_taut_state)
        limits.force.check(prediction.peak_force, f"{where}, predicted")
        limits.field.check(prediction.peak_field, f"{where}, predicted")
        limits.hoop_stress.check(prediction.minimum_hoop_stress, f"{where}, predicted")
        limits.energy.check(prediction.stored_energy, f"{where}, predicted")
        limits.stretch.check(prediction.peak_stretch, f"{where}, predicted")
        if prediction.status is Status.WRINKLED:
            raise LimitError(no_taut_state)
        return worst([prediction, *map(hold, action.may)])

    return [hold(action) for action in actions]


def worst(found: Sequence[Prediction]) -> Prediction:
    """The extremes of several."""
    return Prediction(
        peak_force=max(one.peak_force for one in found),
        peak_field=max(one.peak_field for one in found),
        minimum_hoop_stress=min(one.minimum_hoop_stress for one in found),
        stored_energy=max(one.stored_energy for one in found),
        peak_stretch=max(one.peak_stretch for one in found),
        status=max(one.status for one in found),
    )
