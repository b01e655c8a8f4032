r"""The Yeoh law, :math:`W = C_1 J + C_2 J^2 + C_3 J^3` with :math:`J = I_1 - 3` (Yeoh 1993)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from model.arrays import Array
from model.material.first_invariant import derivatives, invariant
from model.material.law import Derivatives, Law, Parameter


class Yeoh(Law):
    """A cubic in the first invariant."""

    name = "yeoh"
    title = "Yeoh"
    description = (
        "W = C1 J + C2 J^2 + C3 J^3, J = I1 - 3, G = 2 C1. C2 is mostly negative (softening) and C3 positive "
        "(stiffening): such a film is stable where C1 + 2 C2 J + 3 C3 J^2 > 0."
    )
    moduli = (
        Parameter("C1", "Pa", "Half the shear modulus. Typical: 1e4 to 5e5 Pa."),
        Parameter(
            "C2",
            "Pa",
            "Modulus of the square of I1 - 3. Typical: -0.1 to 0.1 of C1.",
            search=(-1.0, 10.0),
            start=(1e-4, 0.05),
        ),
        Parameter(
            "C3",
            "Pa",
            "Modulus of the cube of I1 - 3. Typical: 0 to 0.02 of C1.",
            search=(-0.1, 10.0),
            start=(1e-5, 0.01),
        ),
    )

    def energy(self, log: Array) -> Array:
        c1, c2, c3 = self.mu
        total, _ = invariant(log)
        density: Array = total * (c1 + total * (c2 + total * c3))
        return density

    def derivatives(self, log: Array) -> Derivatives:
        c1, c2, c3 = self.mu
        total, squares = invariant(log)
        return derivatives(squares, c1 + total * (2.0 * c2 + total * (3.0 * c3)), 2.0 * c2 + total * (6.0 * c3))

    @classmethod
    def shear_modulus(cls, mu: Sequence[float], alpha: Sequence[float]) -> float:
        return 2.0 * mu[0]

    @classmethod
    def weights(cls, alpha: Array) -> tuple[Array, Array]:
        return np.full(3, 2.0), np.zeros((3, 0))
