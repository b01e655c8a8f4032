"""``do = "relax"``: quick moves to one displacement after the other, each held while the film relaxes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from rig.base.errors import LimitError
from rig.scene.scene import Scene
from rig.steps.base import Action, NotNegative, Positive, State, Step
from rig.steps.hold import Holding
from rig.steps.moves import move_to, voltage_to


class Relax(Step):
    """Stress relaxation: move fast, hold, move on; with a voltage step within each hold if one is asked for.

    The force in the holds over time gives the film's relaxation times, from some samples' time to the length of the
    hold: a slower one looks like stiffness, a faster one like a softer film.
    """

    needs_contact: ClassVar[bool] = True
    records: ClassVar[bool] = True

    do: Literal["relax"] = Field(description="The kind of step.")
    displacements_mm: Annotated[list[NotNegative], Field(min_length=1, max_length=50)] = Field(
        description="Where to hold, in turn (mm). One: a single relaxation; more: steps up, and down if they fall.",
        json_schema_extra={"usual": [0.02, 200]},
    )
    speed_mm_per_s: Positive = Field(
        description="Speed of the disk between them (mm/s). Typical: 2 to 20: the shortest times that show are those "
        "of the moves.",
        json_schema_extra={"usual": [0.0005, 200]},
    )
    hold_s: Positive = Field(
        description="How long each is held (s). Typical: three times the longest relaxation time that matters.",
        json_schema_extra={"usual": [1, 100000]},
    )
    voltage_V: NotNegative = Field(
        default=0.0,
        description="Voltage in the later part of each hold (V), on at the scene's hv.ramp_V_per_s; 0: none.",
        json_schema_extra={"usual": [5, 30000]},
    )
    voltage_after: Annotated[float, Field(gt=0, lt=1)] = Field(
        default=0.5, description="Share of the hold after which the voltage comes. Typical: 0.5."
    )

    @model_validator(mode="after")
    def _moves(self) -> Self:
        if any(one == other for one, other in zip(self.displacements_mm, self.displacements_mm[1:], strict=False)):
            raise ValueError("displacements_mm has the same value twice running; give hold_s the time of both")
        return self

    @property
    def highest_voltage(self) -> float:
        return self.voltage_V

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        if self.displacements_mm[0] * 1e-3 == state.h:
            raise LimitError(
                f"{self.where(state.number)}: the disk is at {self.displacements_mm[0]:g} mm already; nothing would "
                "relax. Put another displacement first."
            )
        for target in self.displacements_mm:
            yield move_to(self, state, target * 1e-3, self.speed_mm_per_s * 1e-3, record=True)
            if self.voltage_V == 0.0:
                yield self._hold(state, self.hold_s)
                continue
            yield self._hold(state, self.voltage_after * self.hold_s)
            before = state.voltage
            yield voltage_to(self, state, scene, self.voltage_V, 0.0)
            yield self._hold(state, (1.0 - self.voltage_after) * self.hold_s)
            yield voltage_to(self, state, scene, before, 0.0)

    def _hold(self, state: State, seconds: float) -> Holding:
        return Holding(
            by=self,
            step=state.number,
            label=f"relax at {state.h * 1e3:g} mm, {state.voltage:g} V",
            h=(state.h, state.h),
            voltage=(state.voltage, state.voltage),
            duration=seconds,
            record=True,
        )
