"""``do = "weigh"``: weights on the force sensor."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from rig.base.errors import LimitError
from rig.operator.control import Question
from rig.scene.scene import Scene
from rig.steps.base import Action, NotNegative, Positive, State, Turns, write_phase
from rig.steps.output import take_down
from rig.steps.rig import Rig
from rig.steps.standards import OPERATOR_S, Averaged, Standards, Standstill, check_place, series
from rig.steps.turns import pause


class Weigh(Averaged):
    """Hang weights on the force sensor; 0 means none. ``m g (1 - air/density)`` is what each applies."""

    hands: ClassVar[bool] = True
    calibrates: ClassVar[str] = "force"

    do: Literal["weigh"] = Field(description="The kind of step.")
    weights_g: Standards = Field(
        description="Masses to hang (g); 0 for none, which must be among them for the zero. Typical: five, evenly "
        "spread up to the largest force that will be measured."
    )
    weight_uncertainty_mg: NotNegative = Field(
        default=1.0, description="Standard uncertainty of each mass (mg), from the weights' certificate."
    )
    density_kg_per_m3: Positive = Field(
        default=8000.0, description="Density of the weights (kg/m^3), for the air's buoyancy. Steel: 8000; brass: 8400."
    )
    air_density_kg_per_m3: NotNegative = Field(default=1.2, description="Density of the air (kg/m^3).")
    gravity_m_per_s2: Positive = Field(
        default=9.80665, description="Gravity at this place (m/s^2). On Earth's surface: 9.78 to 9.83."
    )
    gravity_uncertainty_m_per_s2: NotNegative = Field(
        default=0.005,
        description="Standard uncertainty of the gravity (m/s^2). If only the latitude is known: 0.005.",
    )
    preloads: Annotated[int, Field(ge=0, le=10)] = Field(
        default=1, description="How often to hang the heaviest weight before the series, unread. Typical: 1 to 3."
    )
    creep_s: NotNegative = Field(
        default=0.0,
        description="How long to watch the creep under the heaviest weight at the end (s); 0: not at all.",
    )

    def plan(self, state: State, scene: Scene) -> Iterator[Action]:
        check_place(self, state)
        heaviest = max(self.weights_g)
        force = self.force_of(heaviest)
        if not force <= scene.limits.force_N:
            raise LimitError(
                f"{self.where(state.number)}: {heaviest:g} g pull with {force:.3g} N, and limits.force_N is less."
            )
        for _ in range(self.preloads):
            yield self._hang(state, heaviest)
            yield self._hang(state, 0.0)
        for cycle, way, mass in series(self.weights_g, self.cycles):
            yield self._hang(state, mass, cycle, way)
        if self.creep_s > 0:
            yield self._hang(state, heaviest, creep=True)
            yield self._hang(state, 0.0)

    def force_of(self, mass_g: float) -> float:
        """What a mass in grams pulls with (N)."""
        return mass_g * 1e-3 * self._newtons_per_kg

    @property
    def _newtons_per_kg(self) -> float:
        return self.gravity_m_per_s2 * (1 - self.air_density_kg_per_m3 / self.density_kg_per_m3)

    def _hang(self, state: State, mass: float, cycle: int = 0, way: int = 0, *, creep: bool = False) -> Hanging:
        average = self.creep_s if creep else self.average_s
        return Hanging(
            by=self,
            step=state.number,
            kind="creep" if creep else "weigh",
            label=f"{mass:g} g",
            duration=OPERATOR_S + (average if creep else self.settle_s + average),
            cycle=cycle,
            way=way,
            settle=self.settle_s,
            average=average,
            applied=self.force_of(mass),
            applied_error=self.weight_uncertainty_mg * 1e-6 * self._newtons_per_kg if mass > 0 else 0.0,
            creep=creep,
        )


@dataclass(frozen=True, kw_only=True)
class Hanging(Standstill):
    """One weight, or none: read at rest, or how the reading creeps from the moment it hangs.

    Attributes
    ----------
    applied : float
        N.
    creep : bool
        Whether it is the creep that is looked at.
    """

    applied: float
    creep: bool

    @property
    def asks(self) -> bool:
        return True

    def carry_out(self, rig: Rig) -> Turns:
        yield from take_down(rig, "the operator's hands come near")
        text = f"Hang {self.label} on the force sensor." if self.applied else "Take all weights off the force sensor."
        yield from rig.ask(Question(text), lambda hands: hands.hang(self.applied, self.applied_error, self.label))
        if self.creep:
            write_phase(rig, self, "creeping", self.label, cycle=self.cycle)
        else:
            yield from pause(rig, self.settle)
            self.begin(rig)
            rig.recorder.reference("applied", self.applied, self.applied_error, "N")
        yield from pause(rig, self.average)
        self.end(rig)
