"""``do = "precondition"``: load and unload until the film's softening has settled."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from rig.base.errors import LimitError
from rig.scene.scene import Scene
from rig.steps.base import Action, NotNegative, OnResume, Positive, State, Step
from rig.steps.moves import move_to


class Precondition(Step):
    """Load and unload without voltage until the film's softening has settled."""

    needs_contact: ClassVar[bool] = True
    on_resume: ClassVar[OnResume] = OnResume.IN_CONTACT

    do: Literal["precondition"] = Field(description="The kind of step.")
    displacement_mm: Positive = Field(
        description="Displacement of the disk out of the film's plane to which to load (mm): at least the largest that "
        "is measured afterwards.",
        json_schema_extra={"usual": [0.02, 200]},
    )
    speed_mm_per_s: Positive = Field(description="Speed of the disk, both ways (mm/s). Typical: 0.5 to 2.")
    cycles: Annotated[int, Field(ge=1, le=1000)] = Field(default=3, description="Times up and back. Typical: 3 to 5.")
    valid_for_min: NotNegative = Field(
        default=60.0,
        description="How long the film stays softened (min): a run resumed within this time does not precondition "
        "again. Depends on the material.",
    )

    @property
    def valid_for_s(self) -> float:
        return self.valid_for_min * 60.0

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        if state.voltage > 0:
            raise LimitError(
                f"{self.where(state.number)} comes with {state.voltage:g} V on; put the voltage to 0 first."
            )
        speed = self.speed_mm_per_s * 1e-3
        for cycle in range(1, self.cycles + 1):
            for target in (self.displacement_mm * 1e-3, 0.0):
                yield move_to(self, state, target, speed, cycle=cycle)
