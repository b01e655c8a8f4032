r"""The Mooney-Rivlin law, :math:`W = C_1 (I_1 - 3) + C_2 (I_2 - 3)` (Rivlin & Saunders 1951)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from model.arrays import Array
from model.material.law import Derivatives, Law, Parameter


class MooneyRivlin(Law):
    """Two moduli, of the squares of the stretches and of their inverses."""

    name = "mooney_rivlin"
    title = "Mooney-Rivlin"
    description = (
        "W = C1 (I1 - 3) + C2 (I2 - 3), G = 2 (C1 + C2). Stable at any stretch when neither modulus is negative; "
        "stands for Ogden terms with alpha = 2 and -2."
    )
    moduli = (
        Parameter("C1", "Pa", "Modulus of the first invariant. Typical: 1e4 to 5e5 Pa."),
        Parameter("C2", "Pa", "Modulus of the second invariant. Typical: 0 to a quarter of C1.", start=(0.02, 0.5)),
    )

    def energy(self, log: Array) -> Array:
        density: Array = self.mu[0] * np.expm1(2.0 * log).sum(axis=0) + self.mu[1] * np.expm1(-2.0 * log).sum(axis=0)
        return density

    def derivatives(self, log: Array) -> Derivatives:
        c1, c2 = 2.0 * self.mu
        squares, inverse = np.expm1(2.0 * log), np.expm1(-2.0 * log)
        stress = c1 * squares - c2 * inverse
        modulus = 2.0 * (c1 * (squares + 1.0) + c2 * (inverse + 1.0))
        return (
            stress[0] - stress[2],
            stress[1] - stress[2],
            modulus[0] + modulus[2],
            modulus[2],
            modulus[1] + modulus[2],
        )

    @classmethod
    def shear_modulus(cls, mu: Sequence[float], alpha: Sequence[float]) -> float:
        return 2.0 * (mu[0] + mu[1])

    @classmethod
    def weights(cls, alpha: Array) -> tuple[Array, Array]:
        return np.full(2, 2.0), np.zeros((2, 0))

    @classmethod
    def powers(cls, mu: Sequence[float], alpha: Sequence[float]) -> tuple[Sequence[float], Sequence[float]]:
        return (2.0 * mu[0], -2.0 * mu[1]), (2.0, -2.0)
