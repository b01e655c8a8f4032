"""Tests of a sheet with Maxwell branches by an integration of its own: scipy's BDF over the viscous strains.

Nothing of `calibration` or `model` is used. Ogden's law; time (s), stretch, nominal stress (Pa).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]
SECOND = {"uniaxial": -0.5, "equibiaxial": 1.0, "pure shear": 0.0}  # ln l2 over ln l1


@dataclass(frozen=True)
class Sheet:
    """Moduli (Pa), exponents, and branches (ratio, time in s)."""

    mu: tuple[float, ...] = (2e4, 1e3)
    alpha: tuple[float, ...] = (2.0, 4.5)
    branches: tuple[tuple[float, float], ...] = ((0.4, 0.8), (0.25, 25.0))

    @property
    def modulus(self) -> float:
        """Of the relaxed sheet at small strain (Pa)."""
        return 0.5 * sum(m * a for m, a in zip(self.mu, self.alpha, strict=True))

    def true(self, x1: Array | float, x2: Array | float) -> tuple[Array, Array]:
        """Stresses with none on the faces."""
        s1: Array = np.zeros_like(np.asarray(x1, dtype=float))
        s2: Array = np.zeros_like(s1)
        for mu, alpha in zip(self.mu, self.alpha, strict=True):
            face = np.exp(-alpha * (np.asarray(x1) + np.asarray(x2)))
            s1, s2 = (
                s1 + mu * (np.exp(alpha * np.asarray(x1)) - face),
                s2 + mu * (np.exp(alpha * np.asarray(x2)) - face),
            )
        return s1, s2

    def stress(self, kind: str, knots: list[float], stretches: list[float], t: Array) -> Array:
        """Nominal stress along the first direction at times of a test that is linear in stretch between its knots."""
        second = SECOND[kind]

        def logs(when: Array | float) -> tuple[Array, Array]:
            one = np.log(np.interp(when, knots, stretches))
            return one, second * one

        total = self.true(*logs(t))[0]
        for ratio, time in self.branches:

            def flow(when: float, v: Array, time: float = time) -> list[float]:
                u1, u2 = logs(when)
                s1, s2 = self.true(u1 - v[0], u2 - v[1])
                over = 6.0 * self.modulus * time
                return [float(2.0 * s1 - s2) / over, float(2.0 * s2 - s1) / over]

            v = np.zeros((2, t.size))
            now = np.zeros(2)
            for left, right in itertools.pairwise(knots):
                rows = (t >= left) & (t <= right)
                asked = np.unique(np.append(t[rows], right))
                found = solve_ivp(flow, (left, right), now, "BDF", t_eval=asked, rtol=1e-8, atol=1e-11)
                v[:, rows] = found.y[:, np.searchsorted(asked, t[rows])]
                now = found.y[:, -1]
            u1, u2 = logs(t)
            total = total + ratio * self.true(u1 - v[0], u2 - v[1])[0]
        found_stress: Array = total / np.exp(logs(t)[0])
        return found_stress


def relaxation(top: float = 2.0, ramp: float = 2.0, hold: float = 120.0) -> tuple[list[float], list[float]]:
    """Pulled, held."""
    return [0.0, ramp, ramp + hold], [1.0, top, top]


def cycles(top: float = 2.0, rates: tuple[float, ...] = (0.05, 0.5), count: int = 2) -> tuple[list[float], list[float]]:
    """So many cycles at each rate (1/s)."""
    t, stretch = [0.0], [1.0]
    for rate in rates:
        for _ in range(count):
            for place in (top, 1.0):
                t, stretch = [*t, t[-1] + (top - 1.0) / rate], [*stretch, place]
    return t, stretch
