r"""The Gent law, :math:`W = -\frac{\mu J_m}{2} \ln(1 - J/J_m)` with :math:`J = I_1 - 3` (Gent 1996).

The chains have a largest length: where ``J`` comes near ``J_m`` the stress grows without bound, and beyond there is no
film. For ``J_m`` towards infinity it is the neo-Hookean law.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from model.arrays import Array
from model.material.first_invariant import derivatives, invariant
from model.material.law import Derivatives, Law, Parameter


class Gent(Law):
    """Chains of limited length."""

    name = "gent"
    title = "Gent"
    description = (
        "W = -mu Jm/2 ln(1 - (I1 - 3)/Jm), G = mu. Stiffens without bound where I1 - 3 comes near Jm; for a large Jm "
        "it is neo-Hooke. A film can be stretched to where I1 - 3 = Jm and no further."
    )
    moduli = (Parameter("mu", "Pa", "Shear modulus. Typical: 1e4 to 1e6 Pa."),)
    shapes = (
        Parameter(
            "Jm",
            "1",
            "Value of I1 - 3 at which the chains are fully stretched. Typical: 5 to 200.",
            lower=1e-2,
            search=(0.1, 1000.0),
            start=(8.0, 200.0),
        ),
    )

    def energy(self, log: Array) -> Array:
        total, _ = invariant(log)
        left = np.where(total < self.alpha[0], total / self.alpha[0], np.nan)
        density: Array = -0.5 * self.mu[0] * self.alpha[0] * np.log1p(-left)
        return density

    def derivatives(self, log: Array) -> Derivatives:
        total, squares = invariant(log)
        left = 1.0 - total / self.alpha[0]
        inverse = 1.0 / np.where(left > 0.0, left, np.nan)
        first = 0.5 * self.mu[0] * inverse
        return derivatives(squares, first, first * inverse / self.alpha[0])

    def by_parameters(self, log: Array) -> tuple[Array, Array]:
        total, squares = invariant(log)
        share = total / self.alpha[0]
        inverse = 1.0 / np.where(share < 1.0, 1.0 - share, np.nan)
        rise = 2.0 * (squares[:2] - squares[2])
        by_mu = 0.5 * inverse * rise
        return by_mu[None], (-self.mu[0] * inverse * share / self.alpha[0] * by_mu)[None]

    @classmethod
    def shear_modulus(cls, mu: Sequence[float], alpha: Sequence[float]) -> float:
        return mu[0]
