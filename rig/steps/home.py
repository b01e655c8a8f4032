"""``do = "home"``: the stage finds its reference position."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal

from pydantic import Field

from rig.base.errors import FaultError, LimitError
from rig.scene.scene import Scene
from rig.steps.base import Action, OnResume, State, Step, Turns
from rig.steps.rig import Rig
from rig.steps.turns import wait

HOMING_S = 20.0  # only for the estimate: a long-travel stage at its homing speed
HOMING_LIMIT_S = 90.0


class Home(Step):
    """Let the stage find its reference position, before anything is in contact."""

    on_resume: ClassVar[OnResume] = OnResume.LAST_ONE

    do: Literal["home"] = Field(description="The kind of step.")

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        if state.contact:
            raise LimitError(f"{self.where(state.number)} would drive the stage with the specimen in contact.")
        state.homed = True
        yield Homing(by=self, step=state.number, label="find the reference position", duration=HOMING_S)


@dataclass(frozen=True, kw_only=True)
class Homing(Action):
    """The stage's own search for its reference."""

    def carry_out(self, rig: Rig) -> Turns:
        yield from find_reference(rig)


def find_reference(rig: Rig) -> Turns:
    """Let the stage look for its reference position, and wait until it says that it has one."""
    stage = rig.bench.stage
    rig.command("stage", "home", "")
    rig.recorder.speed = 0.0  # the device's own, not known here
    stage.home()
    yield from wait(rig, lambda: not stage.moving, HOMING_LIMIT_S, "The end of the stage's homing")
    if not stage.referenced:
        raise FaultError("stage: homing ended, but the stage still reports no reference position.")
