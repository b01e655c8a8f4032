"""``do = "hold"``: displacement and voltage stay as they are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal

from pydantic import Field

from rig.scene.scene import Scene
from rig.steps.base import Action, Positive, State, Step, Turns
from rig.steps.rig import Rig
from rig.steps.turns import pause


class Hold(Step):
    """Stay where we are, at the voltage that is on."""

    records: ClassVar[bool] = True
    joins: ClassVar[bool] = True

    do: Literal["hold"] = Field(description="The kind of step.")
    duration_s: Positive = Field(
        description="How long (s). In contact with the film what is measured is data.",
        json_schema_extra={"usual": [0.01, 100000]},
    )

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        yield Holding(
            by=self,
            step=state.number,
            label=f"hold {state.h * 1e3:g} mm, {state.voltage:g} V",
            h=(state.h, state.h),
            voltage=(state.voltage, state.voltage),
            duration=self.duration_s,
            record=state.contact,
        )


@dataclass(frozen=True, kw_only=True)
class Holding(Action):
    """Nothing is commanded."""

    def carry_out(self, rig: Rig) -> Turns:
        yield from pause(rig, self.duration)
