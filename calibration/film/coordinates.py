"""The film's parameters as a fit has them: of order one, within bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from model.material.law import Law, Parameter
from model.material.materials import Material

Array = NDArray[np.float64]

PERMITTIVITY_BOUNDS = (0.5, 200.0)


@dataclass(frozen=True)
class Coordinates:
    """``x = [shares, shape parameters, (eps_r)]``, and whatever comes after it.

    The shares are the moduli of the law, made of order one (`model.material.law.Law.weights`): of Ogden terms
    ``g_n = mu_n alpha_n / (2 G_0) > 0``, which keeps the film stable at any stretch.

    moduli, film_numbers : how many shares, and where eps_r stands in x
    scale : G_0 (Pa)
    eps_r : the permittivity where it is no parameter
    """

    law: type[Law]
    moduli: int
    film_numbers: int
    parameters: tuple[Parameter, ...]
    names: tuple[str, ...]
    scale: float
    electric: bool
    eps_r: float

    @classmethod
    def of(cls, at: Material, terms: int, electric: bool) -> Self:
        """Coordinates around a material; ``terms`` counts for a series only."""
        moduli, shapes = at.law.counts(terms)
        names = [f"g{n + 1}" for n in range(moduli)]
        names += [*at.law.names(moduli, shapes)[moduli:], *(["eps_r"] if electric else [])]
        parameters = at.law.parameters(moduli, shapes)
        return cls(at.law, moduli, moduli + shapes, parameters, tuple(names), at.shear_modulus, electric, at.eps_r)

    def film(self, x: Array) -> Material:
        """The material of a parameter vector."""
        n = self.film_numbers
        alpha = x[self.moduli : n]
        mu = self.scale * x[: self.moduli] / self.law.weights(alpha)[0]
        eps_r = float(x[n]) if self.electric else self.eps_r
        return Material(name="identified", mu=tuple(mu), alpha=tuple(alpha), eps_r=eps_r, law=self.law)

    def vector(self, material: Material) -> Array:
        """The parameter vector of a material."""
        mu, alpha = np.array(material.mu), np.array(material.alpha)
        eps = [material.eps_r] if self.electric else []
        return np.concatenate((mu * self.law.weights(alpha)[0] / self.scale, alpha, eps))

    def bounds(self, x: Array) -> tuple[Array, Array]:
        """Lower and upper bounds of a parameter vector; exponents keep the sign they have in ``x``."""
        n = self.film_numbers
        lower, upper = np.array([p.search for p in self.parameters]).T
        mirrored = self.law.series & (np.arange(n) >= self.moduli) & (x[:n] < 0.0)
        low, high = np.where(mirrored, -upper, lower), np.where(mirrored, -lower, upper)
        if self.electric:
            low, high = np.append(low, PERMITTIVITY_BOUNDS[0]), np.append(high, PERMITTIVITY_BOUNDS[1])
        return low, high

    def by_parameters(self, x: Array, by_mu: Array, by_alpha: Array, by_eps: Array) -> Array:
        """Derivatives by x (..., P) from those by mu (..., moduli), alpha (..., shapes) and eps_r (...)."""
        alpha = x[..., self.moduli : self.film_numbers]
        weighed = [self.law.weights(one) for one in alpha.reshape(math.prod(alpha.shape[:-1]), alpha.shape[-1])]
        weight = np.array([w for w, _ in weighed]).reshape(*alpha.shape[:-1], self.moduli)
        slope = np.array([by for _, by in weighed]).reshape(*weight.shape, alpha.shape[-1])
        by_share = by_mu * self.scale / weight
        through_mu = (by_share * x[..., : self.moduli] / weight)[..., None] * slope
        parts = [by_share, by_alpha - through_mu.sum(axis=-2)]
        if self.electric:
            parts.append(by_eps[..., None])
        return np.concatenate(parts, axis=-1)
