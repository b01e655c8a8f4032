r"""Ogden's law: a sum of powers of the principal stretches (Ogden 1972, Proc. R. Soc. A 326, 565-584).

.. math:: W = \sum_n \frac{\mu_n}{\alpha_n}
              \left(\lambda_1^{\alpha_n} + \lambda_2^{\alpha_n} + (\lambda_1\lambda_2)^{-\alpha_n} - 3\right)

in the convention of Cao & Conn 2018, so that ``G = 1/2 sum mu_n alpha_n`` and ``dW/dL_i = sum mu_n (l_i^al_n -
l_3^al_n)``. Other codes write ``2 mu / alpha^2`` in front: there ``mu_other = mu * alpha / 2``.

It is the law of most fits, and so it is written out for speed: one ``expm1`` a power serves stresses, tangents and the
derivatives by the parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from model.arrays import Array
from model.material.law import Derivatives, Law, Parameter

LEAST_EXPONENT = 1e-6  # in size: at zero the energy of a term has no meaning


class Ogden(Law):
    """One or more Ogden terms; single terms may be negative, G may not."""

    name = "ogden"
    title = "Ogden"
    description = (
        "Ogden terms, W = sum mu/alpha (l1^alpha + l2^alpha + (l1 l2)^-alpha - 3), G = 1/2 sum mu alpha. "
        "Codes that write 2 mu/alpha^2 have mu_other = mu alpha / 2."
    )
    moduli = (
        Parameter(
            "mu",
            "Pa",
            "Modulus of every term, in the convention G = 1/2 sum mu alpha; of the sign of its exponent in a stable "
            "film. Typical: 1e3 to 1e6 Pa.",
        ),
    )
    shapes = (
        Parameter(
            "alpha",
            "1",
            "Exponent of every term, not zero; from 2 to 8 for most elastomers, negative where sheets soften in "
            "compression.",
            search=(0.2, 30.0),
            start=(1.2, 12.0),
        ),
    )
    series = True

    __slots__ = ("_shared", "_twice_shear")

    def __init__(self, mu: Array, alpha: Array) -> None:
        super().__init__(mu, alpha)
        # (2, terms): mu and mu alpha, when all states share them
        self._shared = np.stack((mu[:, 0], mu[:, 0] * alpha[:, 0])) if mu.shape[1] == 1 else None
        self._twice_shear: Array = (mu * alpha).sum(axis=0)

    def _powers(self, log: Array) -> Array:
        """``exp(al_n X) - 1`` of every term, (terms, 3, ..., S)."""
        alpha = self.alpha.reshape(len(self.alpha), *(1,) * (log.ndim - 1), -1)
        exponents: Array = alpha * log
        return np.expm1(exponents, out=exponents)

    def energy(self, log: Array) -> Array:
        ratio = self.mu / self.alpha
        powers = self._powers(log).sum(axis=1)
        density: Array = (ratio.reshape(len(ratio), *(1,) * (log.ndim - 2), -1) * powers).sum(axis=0)
        return density

    def derivatives(self, log: Array) -> Derivatives:
        powers = self._powers(log)
        if self._shared is not None:
            m, a = (self._shared @ powers.reshape(len(powers), powers[0].size)).reshape((2, *powers.shape[1:]))
        else:
            m = self.mu[0] * powers[0]
            a = self.alpha[0] * m
            for n in range(1, powers.shape[0]):
                term = self.mu[n] * powers[n]
                m += term
                term *= self.alpha[n]
                a += term
        a += self._twice_shear
        return m[0] - m[2], m[1] - m[2], a[0] + a[2], a[2], a[1] + a[2]

    def by_parameters(self, log: Array) -> tuple[Array, Array]:
        powers = self._powers(log)
        by_mu = powers[:, :2] - powers[:, 2:]
        slopes = (powers + 1.0) * log
        shape = (len(self.mu), *(1,) * (log.ndim - 1), -1)
        return by_mu, self.mu.reshape(shape) * (slopes[:, :2] - slopes[:, 2:])

    def projected(self, log: Array, rate1: Array, rate2: Array) -> tuple[Array, Array]:
        rates = np.stack((rate1, rate2, -(rate1 + rate2)))
        axes = tuple(range(1, log.ndim))
        powers = self._powers(log)
        by_mu: Array = (powers * rates).sum(axis=axes)
        powers += 1.0
        by_alpha: Array = self.mu * (powers * (log * rates)).sum(axis=axes)
        return by_mu, by_alpha

    @classmethod
    def shear_modulus(cls, mu: Sequence[float], alpha: Sequence[float]) -> float:
        return 0.5 * math.fsum(m * a for m, a in zip(mu, alpha, strict=True))

    @classmethod
    def weights(cls, alpha: Array) -> tuple[Array, Array]:
        return 0.5 * alpha, 0.5 * np.eye(len(alpha))

    @classmethod
    def check(cls, mu: Sequence[float], alpha: Sequence[float]) -> None:
        super().check(mu, alpha)
        if not all(abs(a) >= LEAST_EXPONENT for a in alpha):
            raise ValueError(
                f"alpha = {tuple(alpha)} holds an exponent of zero; allowed: |alpha| >= {LEAST_EXPONENT:g}"
            )

    @classmethod
    def draw(cls, random: np.random.Generator, terms: int) -> tuple[Array, Array]:
        low, high = np.log(cls.shapes[0].start)
        alpha = np.sort(np.exp(random.uniform(low, high, terms)))
        return random.dirichlet(np.ones(terms)), alpha

    @classmethod
    def powers(cls, mu: Sequence[float], alpha: Sequence[float]) -> tuple[Sequence[float], Sequence[float]]:
        return mu, alpha
