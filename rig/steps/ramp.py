"""``do = "ramp"``: the disk goes to one displacement at constant speed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Literal

from pydantic import Field

from rig.scene.scene import Scene
from rig.steps.base import Action, NotNegative, Positive, State, Step
from rig.steps.moves import move_to


class Ramp(Step):
    """Move to one displacement at constant speed, at the voltage that is on."""

    needs_contact: ClassVar[bool] = True
    records: ClassVar[bool] = True
    joins: ClassVar[bool] = True

    do: Literal["ramp"] = Field(description="The kind of step.")
    displacement_mm: NotNegative = Field(
        description="Displacement of the disk at the end (mm), from where it met the flat film.",
        json_schema_extra={"usual": [0.02, 200]},
    )
    speed_mm_per_s: Positive = Field(description="Speed of the disk (mm/s). Typical: 0.1 to 2.")

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        yield move_to(self, state, self.displacement_mm * 1e-3, self.speed_mm_per_s * 1e-3, record=True)
