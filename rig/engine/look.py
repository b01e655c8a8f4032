"""One look at a run for its status line: what is measured, the nearest limit, and what the plan has left."""

from __future__ import annotations

import math
from collections.abc import Sequence

from model.membrane.solve import solve
from rig.operator.status import Status
from rig.safety.limits import FLAT_M, Limit
from rig.steps.base import Action
from rig.steps.rig import Rig


class Outlook:
    """The plan's times, and the model's field of the film as it is measured.

    Parameters
    ----------
    rig : Rig
    actions : sequence of Action
        The whole plan.
    steps : int
        How many steps the protocol has.
    """

    def __init__(self, rig: Rig, actions: Sequence[Action], steps: int) -> None:
        self._rig = rig
        self._steps = steps
        self._specimen = rig.scene.specimen.specimen()
        self._after = [0.0]  # seconds that the plan has left after each action, from the last one on
        for action in reversed(actions):
            self._after.append(self._after[-1] + action.likely)
        self._after.reverse()

    def look(self, number: int, action: Action, elapsed: float, label: str) -> Status:
        """The status in the midst of action ``number`` of the plan, ``elapsed`` seconds after it began."""
        left = self._after[number + 1] + max(action.likely - elapsed, 0.0)
        total = self._after[0]
        recorder, limits = self._rig.recorder, self._rig.limits
        hv = recorder.hv
        voltage = math.nan if hv is None else hv.voltage
        current = math.nan if hv is None else hv.current
        displacement = recorder.displacement if math.isfinite(recorder.contact) else math.nan
        field = self._field(displacement, voltage)
        used = {
            limits.force.name: _part(limits.force, recorder.force),
            limits.displacement.name: _part(limits.displacement, displacement),
            limits.voltage.name: _part(limits.voltage, voltage),
            limits.current.name: _part(limits.current, current),
            limits.field.name: _part(limits.field, field),
        }
        known = {name: part for name, part in used.items() if math.isfinite(part)}
        nearest = max(known, key=lambda name: known[name], default="")
        return Status(
            step=action.step,
            steps=self._steps,
            done=1.0 - left / total if total > 0 else 1.0,
            left=left,
            label=label,
            force=recorder.force,
            displacement=displacement,
            voltage=voltage,
            current=current,
            field=field,
            nearest=nearest,
            nearest_part=known.get(nearest, math.nan),
            second=recorder.monitors["voltage"].value if "voltage" in recorder.monitors else math.nan,
        )

    def _field(self, displacement: float, voltage: float) -> float:
        """The film's peak field (V/m) by the model; NaN where it has no answer, or nothing is measured."""
        if not (math.isfinite(displacement) and math.isfinite(voltage)):
            return math.nan
        state = solve(self._specimen, max(displacement, FLAT_M), max(voltage, 0.0))
        return float(state.peak_field) if state.answered else math.nan


def _part(limit: Limit, value: float) -> float:
    """What part of a limit is used up; NaN for a value that is not known, or a limit that allows everything."""
    if not (math.isfinite(value) and math.isfinite(limit.high) and limit.high > 0):
        return math.nan
    return abs(value) / limit.high
