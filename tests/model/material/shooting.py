"""Force of a cone by shooting, in terms of invariants: nothing here comes from the product but numbers to compare.

With ``H`` and ``V`` the horizontal and vertical nominal force an angle and a unit thickness, ``V = R S1 sin(theta)`` is
constant and ``dH/dR = S2``; ``l1`` follows from ``S1(l1, l2) = sqrt(H^2 + V^2)/R``, and ``dr/dR``, ``dz/dR`` from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, root

EPSILON_0 = 8.8541878188e-12
Slopes = Callable[[float, float], tuple[float, float]]  # dW/dI1, dW/dI2 (Pa) at I1, I2


@dataclass(frozen=True)
class Cone:
    disk: float
    ring: float
    thickness: float
    prestretch: float
    slopes: Slopes
    eps_r: float = 1.0

    def nominal(self, l1: float, l2: float, voltage: float) -> tuple[float, float]:
        """True stresses over the stretches (Pa)."""
        s1, s2, s3 = l1 * l1, l2 * l2, 1.0 / (l1 * l2) ** 2
        i1, i2 = s1 + s2 + s3, 1.0 / s1 + 1.0 / s2 + 1.0 / s3
        one, two = self.slopes(i1, i2)
        maxwell = EPSILON_0 * self.eps_r * (voltage / self.thickness) ** 2 * s1 * s2
        t1 = 2.0 * (one * (s1 - s3) - two * (1.0 / s1 - 1.0 / s3)) - maxwell
        t2 = 2.0 * (one * (s2 - s3) - two * (1.0 / s2 - 1.0 / s3)) - maxwell
        return t1 / l1, t2 / l2

    def force(self, h: float, voltage: float, most: float = 8.0) -> float:
        """Force (N) at displacement ``h`` (m); ``most`` is the largest meridional stretch to look for."""
        a, b, lp = self.disk, self.ring, self.prestretch

        def stretch(l2: float, pull: float) -> float:
            return float(brentq(lambda l1: self.nominal(l1, l2, voltage)[0] - pull, 0.9, most, xtol=1e-14, rtol=1e-14))

        def rates(radius: float, y: np.ndarray, v: float) -> list[float]:
            r, _, across = y
            l2 = lp * r / radius
            pull = math.hypot(across, v)
            l1 = stretch(l2, pull / radius)
            return [l1 / lp * across / pull, l1 / lp * v / pull, self.nominal(l1, l2, voltage)[1]]

        slope = math.atan(h / (b - a))
        s1, _ = self.nominal(lp * math.hypot(1.0, h / (b - a)), lp, voltage)
        size = a * s1

        def miss(x: np.ndarray) -> list[float]:
            found = solve_ivp(
                rates,
                (a, b),
                [a, 0.0, x[0] * size],
                args=(x[1] * size,),
                method="DOP853",
                rtol=1e-12,
                atol=1e-14 * size,
            )
            r, z, _ = found.y[:, -1]
            return [(r - b) / b, (z - h) / h]

        found = root(miss, [1.5 * math.cos(slope), 1.5 * math.sin(slope)], tol=1e-12)
        assert np.abs(miss(found.x)).max() < 1e-10, found.message
        return float(2.0 * math.pi * self.thickness / lp * found.x[1] * size)
