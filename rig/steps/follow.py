"""The protocol step in which the stage follows a bias law, and the laws."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from model.actuator.bias import Antagonist, Bias, Bistable, Mass, Spring, Tabulated
from model.specimen import Specimen
from rig.base.table import Table

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


class SpringLaw(Table):
    """A compression spring, ``B = F0 - K h``."""

    kind: Literal["spring"]
    preload_N: Positive
    stiffness_N_per_mm: Positive

    def bias(self, film: Specimen) -> Bias:
        return Spring(self.preload_N, self.stiffness_N_per_mm * 1e3)


class MassLaw(Table):
    """A hanging mass, ``B = M g``."""

    kind: Literal["mass"]
    weight_N: Positive

    def bias(self, film: Specimen) -> Bias:
        return Mass(self.weight_N)


class AntagonistLaw(Table):
    """A second cone like the specimen at the other end of a spacer, ``B = F(L - h, V2)``."""

    kind: Literal["antagonist"]
    spacer_mm: Positive
    voltage_V: NotNegative = 0.0

    def bias(self, film: Specimen) -> Bias:
        return Antagonist(film, self.spacer_mm * 1e-3, self.voltage_V)


class BistableLaw(Table):
    """A mechanism that snaps, ``B = F_m + k1 (h - h_m) - k3 (h - h_m)^3``."""

    kind: Literal["bistable"]
    middle_mm: float
    offset_N: float
    rate_N_per_mm: Positive
    cubic_N_per_mm3: Positive

    def bias(self, film: Specimen) -> Bias:
        return Bistable(self.middle_mm * 1e-3, self.offset_N, self.rate_N_per_mm * 1e3, self.cubic_N_per_mm3 * 1e9)


class TabulatedLaw(Table):
    """A measured law; a smooth curve through its points."""

    kind: Literal["tabulated"]
    displacement_mm: list[float] = Field(min_length=4, max_length=1000)
    force_N: list[float] = Field(min_length=4, max_length=1000)

    @model_validator(mode="after")
    def _usable(self) -> Self:
        self.bias(None)
        return self

    def bias(self, film: Specimen | None) -> Bias:
        return Tabulated(tuple(h * 1e-3 for h in self.displacement_mm), tuple(self.force_N))


Law = Annotated[SpringLaw | MassLaw | AntagonistLaw | BistableLaw | TabulatedLaw, Field(discriminator="kind")]


class Follow(Table):
    """Let the disk go against a bias law: at rest without voltage, then released at each voltage and back.

    The stage does what the bias would: in each of ``rate_Hz`` cycles a second it moves by a part of the way that would
    make force of the law and measured force equal.
    """

    do: Literal["follow"]
    bias: Law
    voltages_V: list[Positive] = Field(min_length=1, max_length=50)
    rate_Hz: float = Field(default=40.0, ge=5.0, le=100.0)
    speed_mm_per_s: Positive = 1.0
    settle_s: Positive = 1.0
    average_s: Positive = 5.0
    patience_s: Positive = 60.0
