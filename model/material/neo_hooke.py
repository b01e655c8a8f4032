r"""The neo-Hookean law, :math:`W = \frac{\mu}{2} (\lambda_1^2 + \lambda_2^2 + \lambda_3^2 - 3)`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from model.arrays import Array
from model.material.first_invariant import derivatives, invariant
from model.material.law import Derivatives, Law, Parameter


class NeoHooke(Law):
    """One modulus: chains that never reach their full length."""

    name = "neo_hooke"
    title = "neo-Hooke"
    description = "W = mu/2 (I1 - 3), G = mu. For moderate stretches, to about 1.5; an Ogden term with alpha = 2."
    moduli = (Parameter("mu", "Pa", "Shear modulus. Typical: 1e4 to 1e6 Pa."),)

    def energy(self, log: Array) -> Array:
        density: Array = 0.5 * self.mu[0] * invariant(log)[0]
        return density

    def derivatives(self, log: Array) -> Derivatives:
        total, squares = invariant(log)
        return derivatives(squares, np.broadcast_to(0.5 * self.mu[0], total.shape), 0.0)

    @classmethod
    def shear_modulus(cls, mu: Sequence[float], alpha: Sequence[float]) -> float:
        return mu[0]

    @classmethod
    def powers(cls, mu: Sequence[float], alpha: Sequence[float]) -> tuple[Sequence[float], Sequence[float]]:
        return mu, (2.0,)
