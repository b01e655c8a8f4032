"""``do = "voltage"``: the voltage goes to one level, at the displacement where the disk is."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Literal

from pydantic import Field

from rig.scene.scene import Scene
from rig.steps.base import Action, NotNegative, State, Step
from rig.steps.moves import voltage_to


class Voltage(Step):
    """Ramp the voltage and wait; at the displacement where we are."""

    needs_contact: ClassVar[bool] = True

    do: Literal["voltage"] = Field(description="The kind of step.")
    voltage_V: NotNegative = Field(
        description="Voltage to which to ramp (V), at the scene's hv.ramp_V_per_s. What it means for the film's field "
        "depends on the stretch there; `dea-rig check` shows it.",
        json_schema_extra={"usual": [5, 30000]},
    )
    settle_s: NotNegative = Field(
        default=1.0,
        description="Wait once the voltage is measured (s). Typical: 1 to 10; longer for a viscous film.",
    )

    @property
    def highest_voltage(self) -> float:
        return self.voltage_V

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        yield voltage_to(self, state, scene, self.voltage_V, self.settle_s)
