"""The laws that a follow step lets the stage play: force of the bias against displacement of the disk."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from model.actuator.bias import Antagonist, Bias, Bistable, Mass, Spring, Tabulated
from model.specimen import Specimen
from rig.base.choice import Choice
from rig.base.table import Table
from rig.steps.base import NotNegative, Positive

_KIND = "The kind of bias."


class BiasTable(Table):
    """Base of all of them."""

    kind: str

    @abstractmethod
    def bias(self, film: Specimen) -> Bias:
        """The law, around ``film`` where it depends on it."""


class SpringLaw(BiasTable):
    """A compression spring, ``B = F0 - K h``."""

    kind: Literal["spring"] = Field(description=_KIND)
    preload_N: Positive = Field(description="Force of the spring with the disk in the film's plane, F0 (N).")
    stiffness_N_per_mm: Positive = Field(description="Stiffness of the spring, K (N/mm).")

    def bias(self, film: Specimen) -> Bias:
        return Spring(self.preload_N, self.stiffness_N_per_mm * 1e3)


class MassLaw(BiasTable):
    """A hanging mass, ``B = M g``."""

    kind: Literal["mass"] = Field(description=_KIND)
    weight_N: Positive = Field(description="Weight of the mass, M g (N).")

    def bias(self, film: Specimen) -> Bias:
        return Mass(self.weight_N)


class AntagonistLaw(BiasTable):
    """A second cone like the specimen at the other end of a spacer, ``B = F(L - h, V2)``."""

    kind: Literal["antagonist"] = Field(description=_KIND)
    spacer_mm: Positive = Field(description="Length of the spacer between both disks, L (mm).")
    voltage_V: NotNegative = Field(
        default=0.0,
        description="Voltage on the second cone, V2 (V).",
        json_schema_extra={"usual": [5, 30000]},
    )

    def bias(self, film: Specimen) -> Bias:
        return Antagonist(film, self.spacer_mm * 1e-3, self.voltage_V)


class BistableLaw(BiasTable):
    """A mechanism that snaps, ``B = F_m + k1 (h - h_m) - k3 (h - h_m)^3``."""

    kind: Literal["bistable"] = Field(description=_KIND)
    middle_mm: float = Field(description="Displacement at the middle of the mechanism's way, h_m (mm).")
    offset_N: float = Field(description="Force at the middle, F_m (N).")
    rate_N_per_mm: Positive = Field(description="Negative stiffness at the middle, k1 (N/mm).")
    cubic_N_per_mm3: Positive = Field(description="Cubic coefficient, k3 (N/mm^3).")

    def bias(self, film: Specimen) -> Bias:
        return Bistable(self.middle_mm * 1e-3, self.offset_N, self.rate_N_per_mm * 1e3, self.cubic_N_per_mm3 * 1e9)


class TabulatedLaw(BiasTable):
    """A measured law; a smooth curve through its points."""

    kind: Literal["tabulated"] = Field(description=_KIND)
    displacement_mm: list[float] = Field(min_length=4, max_length=1000, description="Displacements, rising (mm).")
    force_N: list[float] = Field(min_length=4, max_length=1000, description="Force of the bias at each (N).")

    @model_validator(mode="after")
    def _usable(self) -> Self:
        self.bias(None)
        return self

    def bias(self, film: Specimen | None) -> Bias:  # the film plays no part
        return Tabulated(tuple(h * 1e-3 for h in self.displacement_mm), tuple(self.force_N))


KINDS: dict[str, type[BiasTable]] = {
    "spring": SpringLaw,
    "mass": MassLaw,
    "antagonist": AntagonistLaw,
    "bistable": BistableLaw,
    "tabulated": TabulatedLaw,
}

BiasLaw = Annotated[BiasTable, Choice("kind", KINDS.get, lambda: list(KINDS))]
