"""``do = "glide"``: to and fro at several speeds, for the sensors' lags."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from rig.base.errors import LimitError
from rig.scene.scene import Scene
from rig.steps.base import Action, NotNegative, Positive, State, Step, Turns, write_phase
from rig.steps.rig import Rig
from rig.steps.standards import Cycles, check_place, check_speed, end_phase
from rig.steps.turns import stand_still


class Glide(Step):
    """Move to and fro at several constant speeds: what lags behind shows as a difference between the ways.

    Displacements of the disk when in contact with a film, else positions of the stage.
    """

    calibrates: ClassVar[str] = "timing"

    do: Literal["glide"] = Field(description="The kind of step.")
    from_mm: NotNegative = Field(
        description="Where each way up begins (mm): displacement of the disk in contact, else position of the stage."
    )
    to_mm: NotNegative = Field(description="Where each way up ends (mm); larger than from_mm.")
    speeds_mm_per_s: Annotated[list[Positive], Field(min_length=2, max_length=20)] = Field(
        description="Speeds in turn (mm/s). Typical: three, of which the fastest is ten times the slowest."
    )
    cycles: Cycles = Field(default=2, description="How often to and fro at each speed. Typical: 2 to 5.")

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if not self.from_mm < self.to_mm:
            raise ValueError("from_mm must be smaller than to_mm")
        return self

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        check_place(self, state, homed=True, contact=True)
        where = self.where(state.number)
        if state.contact and not self.to_mm <= scene.limits.displacement_mm:
            raise LimitError(f"{where}: {self.to_mm:g} mm is beyond limits.displacement_mm.")
        for speed in self.speeds_mm_per_s:
            check_speed(where, speed, scene)
            for cycle in range(1, self.cycles + 1):
                for start, goal, way in ((self.from_mm, self.to_mm, 1), (self.to_mm, self.from_mm, -1)):
                    yield Gliding(
                        by=self,
                        step=state.number,
                        label=f"{speed:g} mm/s to {goal:g} mm",
                        duration=(self.to_mm - self.from_mm) / speed,
                        speed=speed * 1e-3,
                        cycle=cycle,
                        start=start * 1e-3,
                        goal=goal * 1e-3,
                        way=way,
                        in_contact=state.contact,
                    )


@dataclass(frozen=True, kw_only=True)
class Gliding(Action):
    """One way.

    Attributes
    ----------
    start, goal : float
        m; of the disk in contact, else of the stage.
    way : int
        +1 up, -1 back.
    in_contact : bool
        Whether the disk is in contact with a film.
    """

    start: float
    goal: float
    way: int
    in_contact: bool

    def carry_out(self, rig: Rig) -> Turns:
        go: Callable[[float, float], None] = rig.move_to if self.in_contact else rig.move_stage
        if self.way > 0:
            go(self.start, self.speed)
            yield from stand_still(rig, self.allowed_s)
        write_phase(rig, self, "way", self.label, direction=self.way, cycle=self.cycle)
        go(self.goal, self.speed)
        yield from stand_still(rig, self.allowed_s)
        end_phase(rig, self)
