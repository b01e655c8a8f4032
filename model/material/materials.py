"""Elastomer films: a law with its parameters, permittivity, strength; named sets with their source."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

from model.material.law import Law
from model.material.ogden import Ogden

# scipy.constants.epsilon_0 (CODATA 2022), written out because importing SciPy is slow; a test compares the two.
EPSILON_0 = 8.8541878188e-12


@dataclass(frozen=True)
class Branch:
    """One Maxwell branch of a film that takes time (`model.membrane.history`).

    ratio : its stiffness over that of the relaxed film; 0 is no branch
    time : relaxation time (s)
    """

    ratio: float
    time: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.ratio < math.inf:
            raise ValueError(f"branch: ratio = {self.ratio!r}; it must not be negative, and finite")
        if not 0.0 < self.time < math.inf:
            raise ValueError(f"branch: time = {self.time!r} s; it must be positive and finite")


@dataclass(frozen=True)
class Material:
    r"""An incompressible dielectric elastomer.

    By default its law is Ogden's, in the convention of Cao & Conn 2018 (`model.material.ogden`), whose small-strain
    shear modulus is ``G = 1/2 sum mu_n alpha_n``.

    Parameters
    ----------
    name : what to call it in reports
    mu : moduli of the law (Pa), in its order: Ogden's mu of every term, Gent's mu, Yeoh's C1, C2, C3
    alpha : shape parameters of the law (dimensionless), in its order: Ogden's exponents, Gent's Jm
    eps_r : relative permittivity
    breakdown_field : dielectric strength (V/m, true field), or None when unknown
    max_stretch : largest stretch the film stands, or None when unknown
    source : where the numbers come from
    law : what ``mu`` and ``alpha`` are parameters of
    branches : Maxwell branches beside the relaxed film; only `model.membrane.history` knows them

    See `with_law` for the law's own names, and ``values`` for the way back.
    """

    name: str
    mu: tuple[float, ...]
    alpha: tuple[float, ...]
    eps_r: float
    breakdown_field: float | None = None
    max_stretch: float | None = None
    source: str = field(default="", compare=False)
    law: type[Law] = Ogden
    branches: tuple[Branch, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "mu", tuple(float(m) for m in self.mu))
        object.__setattr__(self, "alpha", tuple(float(a) for a in self.alpha))
        label = f"material {self.name!r}: " if self.name else ""
        try:
            self.law.check(self.mu, self.alpha)
        except ValueError as error:
            raise ValueError(f"{label}{error}") from None
        if not 0.0 < self.eps_r < math.inf:
            raise ValueError(f"{label}eps_r = {self.eps_r!r}; it must be positive and finite")
        for name, limit, least in (
            ("breakdown_field", self.breakdown_field, 0.0),
            ("max_stretch", self.max_stretch, 1.0),
        ):
            if limit is not None and not least < limit < math.inf:
                raise ValueError(f"{label}{name} = {limit!r}; it must be above {least:g} and finite, or None")

    @classmethod
    def with_law(
        cls,
        name: str,
        law: type[Law],
        values: Mapping[str, float | Sequence[float]],
        eps_r: float,
        *,
        breakdown_field: float | None = None,
        max_stretch: float | None = None,
        source: str = "",
    ) -> Self:
        """A material from the law's own names, e.g. ``{"mu": 5e4, "Jm": 40}``; in a series one list a name.

        Raises
        ------
        ValueError : a name is missing or unknown, or a value is not allowed
        """
        names = [p.name for p in (*law.moduli, *law.shapes)]
        if wrong := [key for key in values if key not in names]:
            raise ValueError(f"the law {law.name!r} has no parameter {wrong[0]!r}; it has {', '.join(names)}")
        if missing := [key for key in names if key not in values]:
            raise ValueError(f"the law {law.name!r} needs {', '.join(missing)}")

        def numbers(key: str) -> list[float]:
            value = values[key]
            return [float(value)] if isinstance(value, int | float) else [float(v) for v in value]

        if law.series and len(counts := {key: len(numbers(key)) for key in names}) and len(set(counts.values())) > 1:
            told = " and ".join(f"{key} has {count}" for key, count in counts.items())
            raise ValueError(f"{told} entries; give one of each per term")
        return cls(
            name,
            tuple(v for p in law.moduli for v in numbers(p.name)),
            tuple(v for p in law.shapes for v in numbers(p.name)),
            eps_r,
            breakdown_field,
            max_stretch,
            source,
            law,
        )

    @property
    def values(self) -> dict[str, float]:
        """Every parameter by the name that results call it: "mu1", "alpha1" of the first Ogden term, "Jm"."""
        return dict(zip(self.law.names(len(self.mu), len(self.alpha)), (*self.mu, *self.alpha), strict=True))

    @property
    def terms(self) -> int:
        """Number of terms of a series; 1 of another law."""
        return len(self.mu) // len(self.law.moduli) if self.law.series else 1

    def with_value(self, name: str, value: float) -> Material:
        """The material with another value of one parameter, named as in ``values``, or of "eps_r".

        Raises
        ------
        ValueError : there is no such parameter, or the value is not allowed
        """
        if name == "eps_r":
            return replace(self, eps_r=value)
        names = list(self.values)
        if name not in names:
            raise ValueError(f"{name!r} is no parameter of the material; it has {', '.join(names)}, eps_r")
        numbers = [*self.mu, *self.alpha]
        numbers[names.index(name)] = value
        return replace(self, mu=tuple(numbers[: len(self.mu)]), alpha=tuple(numbers[len(self.mu) :]))

    @property
    def powers(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The law as Ogden terms: moduli (Pa) and exponents.

        Raises
        ------
        ValueError : it is no sum of powers of the stretches
        """
        terms = self.law.powers(self.mu, self.alpha)
        if terms is None:
            raise ValueError(f"material {self.name!r}: the law {self.law.name!r} is no sum of powers of the stretches")
        return tuple(terms[0]), tuple(terms[1])

    @cached_property
    def shear_modulus(self) -> float:
        """Small-strain shear modulus G (Pa)."""
        return self.law.shear_modulus(self.mu, self.alpha)

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
