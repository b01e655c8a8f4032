"""The explicit form of the equations over ``x = ln(R/b)`` and its Jacobian, for whole meshes at once.

Unknown are ``L1 = ln l1``, ``L2 = ln l2``, the slope ``theta`` and ``z/b``. With true stresses over G as derivatives of
the energy by the logarithmic stretches (``s12 = ds1/dL2 = ds2/dL1``), ``q = l1/l2`` and ``w = q cos(theta) - 1``::

    L1' = ((s2 - s12) w + s2 - s1) / (s11 - s1)
    L2' = w
    theta' = -(s2/s1) q sin(theta)
    z' = exp(x) l1/lp sin(theta)

from the balance of forces along and across the meridian (Cao & Conn 2018, eqs. (1)-(4), differentiated).
"""

from __future__ import annotations

import numpy as np

from model.verification.baselines.common import Array, Film


class Explicit:
    """Slopes of the unknowns and their derivatives for one film; ``y`` has shape (4, n)."""

    def __init__(self, film: Film) -> None:
        self.film = film
        self.weights = np.stack([film.mu, film.mu * film.alpha, film.mu * film.alpha**2])
        electric = film.electric
        self.maxwell = np.array([[electric], [2.0 * electric], [4.0 * electric]])
        self.points = 0  # at which slopes were evaluated

    def _powers(self, y: Array) -> tuple[Array, Array, Array]:
        """``sum mu alpha^k l^alpha`` along, across and through the film, k = 0, 1, 2; Maxwell's part in the last."""
        alpha = self.film.alpha
        along, across = np.exp(np.multiply.outer(alpha, y[:2])).transpose(1, 0, 2)
        through = 1.0 / (along * across)
        area = np.exp(2.0 * (y[0] + y[1]))
        w = self.weights
        sign = np.array([[1.0], [-1.0], [1.0]])  # (l1 l2)^-alpha brings -alpha with each derivative
        return w @ along, w @ across, sign * (w @ through) + self.maxwell * area

    def slopes(self, x: Array, y: Array) -> Array:
        """d/dx of (L1, L2, theta, z), shape (4, n)."""
        self.points += x.size
        along, across, through = self._powers(y)
        s1, s2 = along[0] - through[0], across[0] - through[0]
        s11, s12 = along[1] - through[1], -through[1]
        q = np.exp(y[0] - y[1])
        w, sine = q * np.cos(y[2]) - 1.0, np.sin(y[2])
        out = np.empty_like(y)
        out[0] = ((s2 - s12) * w + s2 - s1) / (s11 - s1)
        out[1] = w
        out[2] = -s2 / s1 * q * sine
        out[3] = np.exp(x + y[0]) / self.film.lp * sine
        return out

    def jacobian(self, x: Array, y: Array) -> Array:
        """Derivatives of `slopes` by the unknowns, shape (4, 4, n)."""
        along, across, through = self._powers(y)
        s1, s2 = along[0] - through[0], across[0] - through[0]
        s11, s12, s22 = along[1] - through[1], -through[1], across[1] - through[1]
        s111, s112 = along[2] - through[2], -through[2]
        q = np.exp(y[0] - y[1])
        cosine, sine = np.cos(y[2]), np.sin(y[2])
        w1, turn = q * cosine, q * sine
        w = w1 - 1.0
        below = s11 - s1
        slope = ((s2 - s12) * w + s2 - s1) / below
        out = np.zeros((4, 4, x.size))
        out[0, 0] = ((s12 - s112) * w + (s2 - s12) * w1 + s12 - s11 - slope * (s111 - s11)) / below
        out[0, 1] = ((s22 - s112) * w - (s2 - s12) * w1 + s22 - s12 - slope * (s112 - s12)) / below
        out[0, 2] = -(s2 - s12) * turn / below
        out[1, 0], out[1, 1], out[1, 2] = w1, -w1, -turn
        ratio = s2 / s1
        out[2, 0] = -turn * ((s12 - ratio * s11) / s1 + ratio)
        out[2, 1] = -turn * ((s22 - ratio * s12) / s1 - ratio)
        out[2, 2] = -ratio * w1
        rise = np.exp(x + y[0]) / self.film.lp
        out[3, 0], out[3, 2] = rise * sine, rise * cosine
        return out
