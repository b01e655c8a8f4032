"""The film's law at a point: true stresses and tangent moduli in logarithmic stretches.

With ``L_i = ln l_i`` the Ogden energy of a pre-stretched film under the voltage ``V`` is

    W*(L1, L2) = sum mu_n/al_n (e^(al_n L1) + e^(al_n L2) + e^(-al_n (L1+L2)) - 3) - (k/2) e^(2 (L1+L2)),
    k = eps (V/T)^2

and its gradient is the true stress: ``dW*/dL_i = sigma_i = sum mu_n (l_i^al_n - (l1 l2)^-al_n) - k l1^2 l2^2``.
Logarithms and ``expm1`` keep every digit of a stress at strains of 1e-16, and make the second derivatives sums of
powers already at hand. Stresses are in units of the shear modulus.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array


@dataclass(slots=True)
class Evaluations:
    """How many points each part of the law was evaluated at: what a state pays for."""

    mechanical: int = 0
    electric: int = 0
    relaxed: int = 0


@dataclass(slots=True)
class Film:
    """Material numbers of a block of states, the states along the last axis.

    mu, alpha : (terms, S) or, when all states share them, (terms, 1); mu in units of G
    field : ``eps (V/T)^2 / G`` of shape (S,), or None when no state has a voltage
    """

    mu: Array
    alpha: Array
    field: Array | None
    count: Evaluations
    _weights: Array | None = None  # (2, terms): mu and mu alpha, when shared

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Film:
        """The states at ``index``."""
        field = None if self.field is None else self.field[index]
        if self.mu.shape[1] == 1:
            return Film(self.mu, self.alpha, field, self.count, self._weights)
        return Film(self.mu[:, index], self.alpha[:, index], field, self.count)

    def powers(self, log_stretch: Array) -> Array:
        """``exp(al_n X) - 1`` of every term, (terms, 3, ..., S), where ``log_stretch`` stacks L1, L2, -(L1+L2)."""
        alpha = self.alpha.reshape(len(self.alpha), *(1,) * (log_stretch.ndim - 1), -1)
        exponents: Array = alpha * log_stretch
        return np.expm1(exponents, out=exponents)

    def sums(self, powers: Array) -> tuple[Array, Array]:
        """``sum mu_n (l^al_n - 1)`` and ``sum mu_n al_n l^al_n`` of L1, L2, -(L1+L2), each (3, ..., S)."""
        self.count.mechanical += powers[0, 0].size
        if self.mu.shape[1] == 1:
            if self._weights is None:
                self._weights = np.stack((self.mu[:, 0], self.mu[:, 0] * self.alpha[:, 0]))
            both = (self._weights @ powers.reshape(len(powers), powers[0].size)).reshape((2, *powers.shape[1:]))
            stress, modulus = both[0], both[1]
        else:
            stress = self.mu[0] * powers[0]
            modulus = self.alpha[0] * stress
            for n in range(1, powers.shape[0]):
                term = self.mu[n] * powers[n]
                stress += term
                term *= self.alpha[n]
                modulus += term
        modulus += 2.0  # sum mu_n al_n = 2 G, the unit of stress
        return stress, modulus

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


@dataclass(slots=True)
class Relief:
    """How the natural hoop stretch follows where the film is relaxed: ``dL2 = change + rate dL1``; zero elsewhere."""

    change: Array
    rate: Array
    regular: NDArray[np.bool_]  # d(sigma2)/dL2 > 0: a natural stretch exists


def stress(film: Film, log_stretch: Array) -> Stress:
    """True stress ``dW*/dL_i`` and tangent ``d2W*/dL_i dL_j`` at stacked log stretches (3, ..., S)."""
    m, a = film.sums(film.powers(log_stretch))
    t1 = m[0] - m[2]
    t2 = m[1] - m[2]
    h11 = a[0] + a[2]
    h22 = a[1] + a[2]
    h12 = a[2]
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
