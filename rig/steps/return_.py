"""``do = "return"``: the way back from the film."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal

from pydantic import Field

from rig.scene.scene import Scene
from rig.steps.base import Action, NotNegative, OnResume, Positive, State, Step, Turns
from rig.steps.moves import voltage_to
from rig.steps.rig import Rig
from rig.steps.turns import go


class Return(Step):
    """Voltage to zero, then the pusher back from the film."""

    on_resume: ClassVar[OnResume] = OnResume.ENDS_CONTACT

    do: Literal["return"] = Field(description="The kind of step.")
    speed_mm_per_s: Positive = Field(
        default=2.0,
        description="Speed of the stage (mm/s). Typical: 1 to 5.",
        json_schema_extra={"usual": [0.0005, 200]},
    )
    clearance_mm: NotNegative = Field(
        default=2.0, description="How far behind the flat film the pusher stands at the end (mm). Typical: 1 to 5."
    )

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        if state.voltage > 0:
            yield voltage_to(self, state, scene, 0.0, 0.0)
        if state.contact:
            target, speed = -self.clearance_mm * 1e-3, self.speed_mm_per_s * 1e-3
            yield BackOff(
                by=self,
                step=state.number,
                label="back from the film",
                h=(state.h, target),
                duration=abs(target - state.h) / speed,
                speed=speed,
            )
        state.h, state.contact = 0.0, False


@dataclass(frozen=True, kw_only=True)
class BackOff(Action):
    """From wherever the disk is to behind the film; afterwards nobody knows where contact is."""

    begins_anywhere: ClassVar[bool] = True

    def carry_out(self, rig: Rig) -> Turns:
        yield from go(rig, self.h[1], self.speed, self.allowed_s)
        rig.recorder.contact = math.nan
