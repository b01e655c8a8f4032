"""``do = "visit"``: the laser read at positions of the stage."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from rig.scene.scene import Scene
from rig.steps.base import Action, NotNegative, Positive, State, Turns
from rig.steps.rig import Rig
from rig.steps.standards import Averaged, Standstill, check_place, check_speed, series
from rig.steps.turns import pause, stand_still


class Visit(Averaged):
    """Drive the stage to positions and read the laser there."""

    calibrates: ClassVar[str] = "displacement"

    do: Literal["visit"] = Field(description="The kind of step.")
    positions_mm: Annotated[list[NotNegative], Field(min_length=1, max_length=50)] = Field(
        description="Positions of the stage, on its own scale (mm). Typical: seven over the range that will be used.",
        json_schema_extra={"usual": [0.01, 1000]},
    )
    speed_mm_per_s: Positive = Field(default=5.0, description="Speed of the stage between them (mm/s).")
    accuracy_um: NotNegative = Field(
        default=5.0,
        description="Standard uncertainty of the stage's positions (um); see its data sheet.",
    )

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        check_place(self, state, homed=True)
        check_speed(self.where(state.number), self.speed_mm_per_s, scene)
        before = 0.0
        for cycle, way, position in series(self.positions_mm, self.cycles):
            yield Visiting(
                by=self,
                step=state.number,
                label=f"{position:g} mm",
                duration=abs(position - before) / self.speed_mm_per_s + self.settle_s + self.average_s,
                speed=self.speed_mm_per_s * 1e-3,
                cycle=cycle,
                way=way,
                settle=self.settle_s,
                average=self.average_s,
                applied_error=self.accuracy_um * 1e-6,
                position=position * 1e-3,
            )
            before = position


@dataclass(frozen=True, kw_only=True)
class Visiting(Standstill):
    """One position (m of the stage)."""

    position: float

    def carry_out(self, rig: Rig) -> Turns:
        rig.move_stage(self.position, self.speed)
        yield from stand_still(rig, self.allowed_s)
        yield from pause(rig, self.settle)
        self.begin(rig)
        rig.recorder.reference("applied", rig.position, self.applied_error, "m")
        yield from pause(rig, self.average)
        self.end(rig)
