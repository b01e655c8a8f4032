"""Elastomer films: Ogden terms, permittivity, strength; named sets with their source."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

# scipy.constants.epsilon_0 (CODATA 2022), written out because importing SciPy is slow; a test compares the two.
EPSILON_0 = 8.8541878188e-12


@dataclass(frozen=True)
class Material:
    r"""An incompressible Ogden dielectric in the convention of Cao & Conn 2018.

    .. math:: W = \sum_n \frac{\mu_n}{\alpha_n} (l_1^{\alpha_n} + l_2^{\alpha_n} + (l_1 l_2)^{-\alpha_n} - 3)

    so that the small-strain shear modulus is ``G = 1/2 sum mu_n alpha_n``. Other codes write ``2 mu / alpha^2`` in
    front: there ``mu_other = mu * alpha / 2``.

    Parameters
    ----------
    name : what to call it in reports
    mu, alpha : Ogden moduli (Pa) and exponents, one of each a term; single terms may be negative, G may not
    eps_r : relative permittivity
    breakdown_field : dielectric strength (V/m, true field), or None when unknown
    max_stretch : largest stretch the film stands, or None when unknown
    source : where the numbers come from
    """

    name: str
    mu: tuple[float, ...]
    alpha: tuple[float, ...]
    eps_r: float
    breakdown_field: float | None = None
    max_stretch: float | None = None
    source: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mu", tuple(float(m) for m in self.mu))
        object.__setattr__(self, "alpha", tuple(float(a) for a in self.alpha))
        label = f"material {self.name!r}"
        if not self.mu or len(self.mu) != len(self.alpha):
            raise ValueError(
                f"{label}: mu has {len(self.mu)} and alpha {len(self.alpha)} entries; give one of each per Ogden term"
            )
        for name, values in (("mu", self.mu), ("alpha", self.alpha)):
            if not all(math.isfinite(v) for v in values):
                raise ValueError(f"{label}: {name} = {values} holds a value that is not finite")
        if not all(abs(a) >= 1e-6 for a in self.alpha):
            raise ValueError(f"{label}: alpha = {self.alpha} holds an exponent of zero; allowed: |alpha| >= 1e-6")
        if not 0.0 < self.shear_modulus < math.inf:
            raise ValueError(
                f"{label}: shear modulus 1/2 sum mu alpha = {self.shear_modulus:g} Pa; it must be positive"
            )
        if not 0.0 < self.eps_r < math.inf:
            raise ValueError(f"{label}: eps_r = {self.eps_r!r}; it must be positive and finite")
        for name, limit, least in (
            ("breakdown_field", self.breakdown_field, 0.0),
            ("max_stretch", self.max_stretch, 1.0),
        ):
            if limit is not None and not least < limit < math.inf:
                raise ValueError(f"{label}: {name} = {limit!r}; it must be above {least:g} and finite, or None")

    @cached_property
    def shear_modulus(self) -> float:
        """Small-strain shear modulus ``G = 1/2 sum mu_n alpha_n`` (Pa)."""
        return 0.5 * math.fsum(m * a for m, a in zip(self.mu, self.alpha, strict=True))

    @property
    def permittivity(self) -> float:
        """Absolute permittivity ``eps_0 eps_r`` (F/m)."""
        return EPSILON_0 * self.eps_r


NAMED: dict[str, Material] = {
    material.name: material
    for material in (
        Material(
            name="parker-cao2018",
            mu=(5e3, 3.5e4),
            alpha=(2.5, 5.6),
            eps_r=1.7,
            breakdown_field=80e6,
            max_stretch=2.4,
            source="Cao & Conn 2018, Performance Optimization of a Conical Dielectric Elastomer Actuator, "
            "Actuators 7(2) 32; strength and elongation are the manufacturer's (Parker Hannifin)",
        ),
        Material(
            name="treloar-ogden1972",
            mu=(0.63e6, 0.0012e6, -0.01e6),
            alpha=(1.3, 5.0, -2.0),
            eps_r=2.4,
            source="Ogden 1972, Large deformation isotropic elasticity, Proc. R. Soc. A 326, 565-584 (Treloar's "
            "rubber); eps_r is the usual handbook value of natural rubber, not Ogden's",
        ),
    )
}
