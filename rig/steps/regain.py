"""Back to where an interrupted action or a resumed step begins."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from rig.scene.scene import Scene
from rig.steps.base import Action, State, Step, Turns, allowed
from rig.steps.moves import move_to, ramp_duration, voltage_to
from rig.steps.output import ramp_to
from rig.steps.rig import Rig
from rig.steps.turns import go

SETTLE_S = 1.0
SPEED = 2e-3  # m/s, on the way back to where a resumed step begins


class Regain(Step):
    """To the displacement (m) and the voltage with which a resumed step begins. No protocol names it."""

    do: Literal["resume"] = "resume"
    h: float
    voltage: float

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        if self.h != state.h:
            yield move_to(self, state, self.h, min(SPEED, scene.limits.speed_mm_per_s * 1e-3))
        if self.voltage > 0:
            yield voltage_to(self, state, scene, self.voltage, SETTLE_S)


def regain_duration(rig: Rig, action: Action) -> float:
    """How long (s) `regain` would probably take from where the rig is now."""
    seconds, voltage = 0.0, action.voltage[0]
    if voltage > 0 and (action.voltage[1] > 0 or action.moves):
        now = 0.0 if rig.recorder.hv is None else rig.recorder.hv.voltage
        seconds += ramp_duration(rig.scene, now, voltage)
    if action.moves and not action.begins_anywhere:
        seconds += abs(action.h[0] - rig.recorder.displacement) / action.speed
    return seconds


def regain(rig: Rig, action: Action) -> Turns:
    """After a pause: voltage and displacement with which ``action`` begins, so that it can be carried out anew."""
    voltage = action.voltage[0]
    if rig.scene.hv is not None and voltage > 0 and (action.voltage[1] > 0 or action.moves):
        yield from ramp_to(rig, voltage, allowed(ramp_duration(rig.scene, 0.0, voltage)))
    if action.moves and not action.begins_anywhere:
        way = abs(action.h[0] - rig.recorder.displacement)
        yield from go(rig, action.h[0], action.speed, allowed(way / action.speed))
