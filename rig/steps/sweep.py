"""``do = "sweep"``: displacement up and back at each of several voltages."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from rig.base.errors import LimitError
from rig.scene.scene import Scene
from rig.steps.base import Action, NotNegative, Positive, State, Step
from rig.steps.moves import move_to, voltage_to


class Sweep(Step):
    """Displacement up and back at each voltage in turn; the voltage ends at zero."""

    needs_contact: ClassVar[bool] = True
    records: ClassVar[bool] = True

    do: Literal["sweep"] = Field(description="The kind of step.")
    displacement_mm: Positive = Field(
        description="Largest displacement of the disk out of the film's plane (mm).",
        json_schema_extra={"usual": [0.02, 200]},
    )
    from_mm: NotNegative = Field(
        default=0.0, description="Displacement at which each cycle begins and ends (mm); smaller than displacement_mm."
    )
    speed_mm_per_s: Positive = Field(
        description="Speed of the disk, both ways (mm/s). Typical: 0.1 to 2.",
        json_schema_extra={"usual": [0.0005, 200]},
    )
    voltages_V: list[NotNegative] = Field(
        default=[0.0],
        min_length=1,
        max_length=100,
        description="Voltages in turn (V). One that comes again goes on counting its cycles.",
        json_schema_extra={"usual": [5, 30000]},
    )
    cycles: Annotated[int, Field(ge=1, le=1000)] = Field(
        default=1, description="How often at each voltage, up and back. Typical: 1 to 3."
    )
    settle_s: NotNegative = Field(
        default=1.0,
        description="Wait after each measured voltage has arrived (s).",
        json_schema_extra={"usual": [0.01, 10000]},
    )

    @property
    def highest_voltage(self) -> float:
        return max(self.voltages_V)

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        start, top, speed = self.from_mm * 1e-3, self.displacement_mm * 1e-3, self.speed_mm_per_s * 1e-3
        if not start < top:
            raise LimitError(f"{self.where(state.number)}: from_mm must be smaller than displacement_mm.")
        passes: dict[float, int] = {}
        for level in self.voltages_V:
            if state.h != start:
                yield move_to(self, state, start, speed)
            if level != state.voltage:
                yield voltage_to(self, state, scene, level, self.settle_s)
            # A level that comes again goes on counting its cycles.
            first = passes.get(level, 0) + 1
            passes[level] = first + self.cycles - 1
            for cycle in range(first, first + self.cycles):
                for target in (top, start):
                    yield move_to(self, state, target, speed, cycle=cycle, record=True)
        if state.voltage > 0:
            yield voltage_to(self, state, scene, 0.0, self.settle_s)
