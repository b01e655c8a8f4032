r"""What every law of an elastomer tells the model, and what follows from it: voltage and lost tension.

A law is an energy ``W(L1, L2)`` a volume of the unstretched film, in the logarithms ``L_i = ln l_i`` of the two
principal stretches in the film's plane; the film keeps its volume, so ``L3 = -(L1 + L2)``. Its gradient is the true
stress, ``dW/dL_i = sigma_i - sigma_3``. Under a voltage ``V`` the energy is

.. math:: W^*(L_1, L_2) = W(L_1, L_2) - \frac{k}{2} e^{2 (L_1 + L_2)}, \qquad k = \varepsilon (V/T)^2

and ``dW*/dL_i`` is the true stress that the membrane's balance sees. Logarithms make the second derivatives simple, and
with ``expm1`` every digit of a stress is kept at strains of 1e-16.

A law has moduli (Pa), in which its stresses are linear, and shape parameters (dimensionless). The solver works in
units of the shear modulus: it hands a law its moduli divided by G and takes back stresses divided by G.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array

Derivatives = tuple[Array, Array, Array, Array, Array]  # dW/dL1, dW/dL2, d2W/dL1^2, d2W/dL1 dL2, d2W/dL2^2


@dataclass(frozen=True)
class Parameter:
    """One parameter of a law.

    name : in reports and results, e.g. "mu"
    unit : "Pa" of a modulus, "1" of a shape parameter
    description : what it means, in one sentence
    lower, upper : allowed values, both included
    search : where a fit looks for it; of a modulus as its share of the shear modulus (`Law.weights`)
    start : from where a fit draws its starting points, as ``search``
    """

    name: str
    unit: str
    description: str
    lower: float = -math.inf
    upper: float = math.inf
    search: tuple[float, float] = (1e-6, 100.0)
    start: tuple[float, float] = (0.2, 1.0)

    @property
    def key(self) -> str:
        """Its name in a TOML file, with the unit."""
        return self.name if self.unit == "1" else f"{self.name}_{self.unit}"


class Law(ABC):
    """A law with the parameters of a block of states.

    A law's class says what it is (the class attributes and class methods); an object of it holds numbers for S states:
    ``mu`` (moduli, S) and ``alpha`` (shape parameters, S), or (moduli, 1) and (shape parameters, 1) when all states
    share them. Stresses and energies are in the unit of ``mu``.

    name : how scenes, cases and results call it
    title : how sentences call it
    description : the energy, and for which films it is meant
    moduli, shapes : its parameters
    series : whether it is a sum of terms, with as many values of every parameter as there are terms
    """

    name: ClassVar[str]
    title: ClassVar[str]
    description: ClassVar[str]
    moduli: ClassVar[tuple[Parameter, ...]]
    shapes: ClassVar[tuple[Parameter, ...]] = ()
    series: ClassVar[bool] = False

    __slots__ = ("alpha", "mu")

    def __init__(self, mu: Array, alpha: Array) -> None:
        self.mu, self.alpha = mu, alpha

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Self:
        """The law of the states at ``index``."""
        if self.mu.shape[1] == 1:
            return self
        return type(self)(self.mu[:, index], self.alpha[:, index])

    # --- the energy

    @abstractmethod
    def energy(self, log: Array) -> Array:
        """``W`` at stacked log stretches (3, ..., S), shape (..., S); zero without strain."""

    @abstractmethod
    def derivatives(self, log: Array) -> Derivatives:
        """First and second derivatives of ``W`` by L1 and L2 at stacked log stretches (3, ..., S); NaN where none.

        Five new arrays (..., S) that share no memory: the caller writes into them.
        """

    def by_parameters(self, log: Array) -> tuple[Array, Array]:
        """Derivatives of ``dW/dL1`` and ``dW/dL2`` by every modulus and shape parameter: (moduli, 2, ..., S) and
        (shape parameters, 2, ..., S)."""
        by_mu = np.empty((len(self.mu), 2, *log.shape[1:]))
        for n in range(len(self.mu)):
            unit = np.zeros_like(self.mu)
            unit[n] = 1.0
            by_mu[n] = type(self)(unit, self.alpha).derivatives(log)[:2]
        by_alpha = np.empty((len(self.alpha), 2, *log.shape[1:]))
        for n in range(len(self.alpha)):
            step = 1e-3 * np.maximum(np.abs(self.alpha[n]), 1e-3)
            total = np.zeros((2, *log.shape[1:]))
            for shift, weight in ((1.0, 8.0), (-1.0, -8.0), (2.0, -1.0), (-2.0, 1.0)):  # of the fourth order
                alpha = self.alpha.copy()
                alpha[n] += shift * step
                total += weight * np.array(type(self)(self.mu, alpha).derivatives(log)[:2])
            by_alpha[n] = total / (12.0 * step)
        return by_mu, by_alpha

    def projected(self, log: Array, rate1: Array, rate2: Array) -> tuple[Array, Array]:
        """``sum over points of rate1 d(dW/dL1) + rate2 d(dW/dL2)`` by every parameter, (moduli, S) and (shapes, S)."""
        axes = tuple(range(1, rate1.ndim))
        by_mu, by_alpha = ((rate1 * by[:, 0] + rate2 * by[:, 1]).sum(axis=axes) for by in self.by_parameters(log))
        return by_mu, by_alpha

    def least_tangent(self, log1: Array, log2: Array) -> Array:
        """The smaller eigenvalue of the second derivatives: above zero where the film is stable (Drucker, Hill)."""
        _, _, h11, h12, h22 = self.derivatives(stack(log1, log2))
        least: Array = 0.5 * (h11 + h22) - np.hypot(0.5 * (h11 - h22), h12)
        return least

    # --- the parameters

    @classmethod
    @abstractmethod
    def shear_modulus(cls, mu: Sequence[float], alpha: Sequence[float]) -> float:
        """Shear modulus G at small strain, in the unit of ``mu``."""

    @classmethod
    def weights(cls, alpha: Array) -> tuple[Array, Array]:
        """Weights ``w`` (moduli,) that make ``mu w / G`` of order one for a fit, and their slopes by the shape
        parameters (moduli, shapes). ``sum mu w = G`` where every modulus takes part in G."""
        return np.ones(len(cls.moduli)), np.zeros((len(cls.moduli), len(alpha)))

    @classmethod
    def counts(cls, terms: int) -> tuple[int, int]:
        """How many moduli and shape parameters there are; ``terms`` counts for a series only."""
        factor = terms if cls.series else 1
        return factor * len(cls.moduli), factor * len(cls.shapes)

    @classmethod
    def parameters(cls, moduli: int, shapes: int) -> tuple[Parameter, ...]:
        """What every number is, for so many: moduli first. In a series every parameter comes once a term."""
        if not cls.series:
            return (*cls.moduli, *cls.shapes)
        of_moduli = (p for p in cls.moduli for _ in range(moduli // len(cls.moduli)))
        of_shapes = (p for p in cls.shapes for _ in range(shapes // max(1, len(cls.shapes))))
        return (*of_moduli, *of_shapes)

    @classmethod
    def names(cls, moduli: int, shapes: int) -> tuple[str, ...]:
        """What results call them: with the number of the term in a series."""
        if not cls.series:
            return tuple(p.name for p in (*cls.moduli, *cls.shapes))
        terms = moduli // len(cls.moduli)
        return tuple(f"{p.name}{n + 1}" for p in (*cls.moduli, *cls.shapes) for n in range(terms))

    @classmethod
    def check(cls, mu: Sequence[float], alpha: Sequence[float]) -> None:
        """Refuse numbers that make no film.

        Raises
        ------
        ValueError : too few or too many, not finite, out of bounds, or no positive shear modulus
        """
        wanted = cls.counts(len(mu) // max(1, len(cls.moduli)))
        if not mu or (len(mu), len(alpha)) != wanted:
            names = ", ".join(p.name for p in (*cls.moduli, *cls.shapes))
            raise ValueError(
                f"{len(mu)} moduli and {len(alpha)} other parameters are given; the law {cls.name!r} has {names}"
                + (", one of each per term" if cls.series else "")
            )
        for name, parameter, value in zip(
            cls.names(len(mu), len(alpha)), cls.parameters(len(mu), len(alpha)), (*mu, *alpha), strict=True
        ):
            if not math.isfinite(value):
                raise ValueError(f"{name} = {value!r} is not finite")
            if not parameter.lower <= value <= parameter.upper:
                raise ValueError(f"{name} = {value:g}: allowed are {parameter.lower:g} to {parameter.upper:g}")
        shear = cls.shear_modulus(mu, alpha)
        if not 0.0 < shear < math.inf:
            raise ValueError(f"the small-strain shear modulus is {shear:g} Pa; it must be positive")

    @classmethod
    def draw(cls, random: np.random.Generator, terms: int) -> tuple[Array, Array]:
        """A starting point for a fit: shares (`weights`) of the moduli that make G one, and shape parameters."""
        low, high = np.log(np.array([p.start for p in cls.moduli])).T
        shares = np.exp(random.uniform(low, high))
        alpha = np.array([math.exp(random.uniform(*np.log(p.start))) for p in cls.shapes])
        w, _ = cls.weights(alpha)
        return shares / cls.shear_modulus((shares / w).tolist(), alpha.tolist()), alpha

    @classmethod
    def powers(cls, mu: Sequence[float], alpha: Sequence[float]) -> tuple[Sequence[float], Sequence[float]] | None:
        """The same law as Ogden terms (moduli, exponents), or None when it is no sum of powers of the stretches."""
        return None


@dataclass(slots=True)
class Evaluations:
    """How many points each part of the law was evaluated at: what a state pays for."""

    mechanical: int = 0
    electric: int = 0
    relaxed: int = 0


@dataclass(slots=True)
class Film:
    """Material numbers of a block of states, the states along the last axis.

    law : the elastomer, moduli in units of G
    field : ``eps (V/T)^2 / G`` of shape (S,), or None when no state has a voltage
    """

    law: Law
    field: Array | None
    count: Evaluations

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Film:
        """The states at ``index``."""
        return Film(self.law.take(index), None if self.field is None else self.field[index], self.count)

    def maxwell(self, log_stretch: Array) -> Array:
        """Maxwell stress ``k l1^2 l2^2`` (..., S)."""
        assert self.field is not None
        self.count.electric += log_stretch[0].size
        stress: Array = self.field * np.exp(-2.0 * log_stretch[2])
        return stress


def stack(log1: Array, log2: Array) -> Array:
    """L1, L2, L3 = -(L1+L2), of shape (3, ..., S)."""
    out = np.empty((3, *log1.shape))
    out[0] = log1
    out[1] = log2
    np.add(log1, log2, out=out[2])
    np.negative(out[2], out=out[2])
    return out


@dataclass(slots=True)
class Stress:
    """Stresses and tangent moduli in logarithmic stretch at points (..., S), units of G."""

    t1: Array
    t2: Array
    h11: Array
    h12: Array
    h22: Array
    maxwell: Array | None
    relief: Relief | None = None

    def where(self, new: NDArray[np.bool_], other: Stress) -> Stress:
        """These stresses, and those of ``other`` for the states that are ``new`` (S,)."""

        def pick(one: Array, two: Array) -> Array:
            return np.where(new, two, one)

        relief = self.relief
        if relief is not None and other.relief is not None:
            relief = Relief(
                pick(relief.change, other.relief.change),
                pick(relief.rate, other.relief.rate),
                np.where(new, other.relief.regular, relief.regular),
            )
        maxwell = None if self.maxwell is None or other.maxwell is None else pick(self.maxwell, other.maxwell)
        return Stress(
            pick(self.t1, other.t1),
            pick(self.t2, other.t2),
            pick(self.h11, other.h11),
            pick(self.h12, other.h12),
            pick(self.h22, other.h22),
            maxwell,
            relief,
        )


@dataclass(slots=True)
class Relief:
    """How the natural hoop stretch follows where the film is relaxed: ``dL2 = change + rate dL1``; zero elsewhere."""

    change: Array
    rate: Array
    regular: NDArray[np.bool_]  # d(sigma2)/dL2 > 0: a natural stretch exists


def stress(film: Film, log_stretch: Array) -> Stress:
    """True stress ``dW*/dL_i`` and tangent ``d2W*/dL_i dL_j`` at stacked log stretches (3, ..., S)."""
    film.count.mechanical += log_stretch[0].size
    t1, t2, h11, h12, h22 = film.law.derivatives(log_stretch)
    if film.field is None:
        return Stress(t1, t2, h11, h12, h22, None)
    b = film.maxwell(log_stretch)
    t1 -= b
    t2 -= b
    b2 = 2.0 * b
    h11 -= b2
    h12 -= b2
    h22 -= b2
    return Stress(t1, t2, h11, h12, h22, b)


def relax(film: Film, law: Stress, where: NDArray[np.bool_]) -> Stress:
    """The law with the hoop stretch eliminated ``where`` the film is wrinkled, so that the hoop stress is zero.

    Eliminating L2 from ``sigma2 + h12 dL1 + h22 dL2 = 0`` leaves ``h11 - h12^2/h22`` along the film and no resistance
    around it.
    """
    film.count.relaxed += int(np.count_nonzero(where))
    keep = ~where
    regular = law.h22 > 0.0
    regular |= keep
    give = where / law.h22
    rate = -law.h12 * give
    change = -law.t2 * give
    t1 = law.h12 * change
    t1 += law.t1
    h11 = law.h12 * rate
    h11 += law.h11
    return Stress(
        t1=t1,
        t2=law.t2 * keep,
        h11=h11,
        h12=law.h12 * keep,
        h22=law.h22 * keep,
        maxwell=law.maxwell,
        relief=Relief(change, rate, regular),
    )
