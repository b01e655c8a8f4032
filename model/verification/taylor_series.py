"""Power series of the film's equations, from point to point: the steps of `model.verification.reference`.

The equations are written in its docstring. Each series is built by recurrence (as in Corliss & Chang, ACM TOMS 8, 114,
1982), with small differences formed by ``expm1``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass
class States:
    """B states, lengths over the ring radius and stresses over ``scale``."""

    mu: Array  # (N, B)
    alpha: Array  # (N, B)
    scale: Array
    electric: Array  # eps (V/T)^2 / scale
    log_prestretch: Array
    log_disk: Array  # ln(a/b)
    height: Array
    relaxed: bool

    def take(self, index: NDArray[np.intp]) -> States:
        return States(
            self.mu[:, index],
            self.alpha[:, index],
            self.scale[index],
            self.electric[index],
            self.log_prestretch[index],
            self.log_disk[index],
            self.height[index],
            self.relaxed,
        )

    @property
    def size(self) -> int:
        return self.height.size


def stresses(states: States, e1: Array, e2: Array) -> tuple[Array, Array]:
    """True stresses over ``scale``; differences of powers by expm1."""
    along, across = np.expm1(states.alpha * e1), np.expm1(states.alpha * e2)
    through = np.expm1(-states.alpha * (e1 + e2))
    maxwell = states.electric * np.exp(2 * (e1 + e2))
    s1 = np.sum(states.mu * (along - through), axis=0) - maxwell
    s2 = np.sum(states.mu * (across - through), axis=0) - maxwell
    return s1, s2


def evaluate(series: Array, length: Array) -> Array:
    value: Array = series[-1]
    for k in range(series.shape[0] - 2, -1, -1):
        value = value * length + series[k]
    return value


def derivative(series: Array) -> Array:
    out: Array = series[1:] * np.arange(1, series.shape[0])[:, None, None]
    return out


def _dot(left: Array, right: Array, k: int) -> Array:
    """Coefficient ``k`` of a product."""
    out: Array = np.einsum("ib,ib->b", left[: k + 1], right[k::-1])
    return out


def _divide(numerator: Array, quotient: Array, denominator: Array, k: int) -> None:
    """Set coefficient ``k`` of a quotient from that of its numerator."""
    if k:
        numerator = numerator - np.einsum("ib,ib->b", quotient[:k], denominator[k:0:-1])
    quotient[k] = numerator / denominator[0]


class _Film:
    """Series of the stresses, the stiffnesses and of ``exp(e1 - hoop)``, ``R l1 / (b lp)``, for series of the strains.

    Everything is a sum of exponentials of ``c1 e1 + c2 e2 + c3 x``, one row each, extended together:
    ``y = exp(u)`` gives ``k y_k = sum_i i u_i y_(k-i)``. ``e2`` is the strain that sets the stress.
    """

    def __init__(self, states: States, order: int, x: Array, e1: Array, e2: Array) -> None:
        alpha, mu = states.alpha, states.mu
        n, none = len(mu), np.zeros_like(alpha)
        # Rows: l1^alpha, l2^alpha, (l1 l2)^-alpha, (l1 l2)^2, R l1 / (b lp).
        one = np.ones((1, states.size))
        self.by_e1 = np.concatenate([alpha, none, -alpha, 2 * one, one])
        self.by_e2 = np.concatenate([none, alpha, -alpha, 2 * one, 0 * one])
        argument = self.by_e1 * e1 + self.by_e2 * e2
        argument[-1] += x - states.log_prestretch
        self.rows = np.empty((order + 1, *argument.shape))
        self.rows[0] = np.exp(argument)
        self.rates = np.empty_like(self.rows)
        weight, zero = mu * alpha, 0 * one
        maxwell = states.electric[None]
        self.mix = np.stack(  # s1, s2, s2 - s1, s11, s12, s22
            [
                np.concatenate([mu, none, -mu, -maxwell, zero]),
                np.concatenate([none, mu, -mu, -maxwell, zero]),
                np.concatenate([-mu, mu, none, zero, zero]),
                np.concatenate([weight, none, weight, -2 * maxwell, zero]),
                np.concatenate([none, none, weight, -2 * maxwell, zero]),
                np.concatenate([none, weight, weight, -2 * maxwell, zero]),
            ]
        )
        self.out = np.empty((order + 1, 6, states.size))
        self.out[0] = np.einsum("qrb,rb->qb", self.mix, self.rows[0])
        # Differences of nearly equal powers must not be formed from the powers.
        self.out[0, 0], self.out[0, 1] = stresses(states, e1, e2)
        self.out[0, 2] = np.sum(mu * self.rows[0, :n] * np.expm1(alpha * (e2 - e1)), axis=0)
        self.s1, self.s2, self.gap, self.s11, self.s12, self.s22 = (self.out[:, q] for q in range(6))
        self.reach = self.rows[:, -1]

    def extend(self, k: int, d1: Array, d2: Array) -> None:
        """Coefficient ``k >= 1`` from ``d1 = k e1_k`` and ``d2 = k e2_k``."""
        self.rates[k] = self.by_e1 * d1 + self.by_e2 * d2
        if k == 1:
            self.rates[1, -1] += 1.0
        self.rows[k] = np.einsum("irb,irb->rb", self.rates[1 : k + 1], self.rows[k - 1 :: -1]) / k
        self.out[k] = np.einsum("qrb,rb->qb", self.mix, self.rows[k])


def taut_series(states: States, x: Array, start: Array, order: int) -> Array:
    """Coefficients of (e1, e2, natural = e2, theta, w) about ``x``, shape (order + 1, 5, B)."""
    y = np.zeros((order + 1, 5, states.size))
    y[0] = start
    y[0, 2] = start[1]
    film = _Film(states, order, x, y[0, 0], y[0, 1])
    shape = (order + 1, states.size)
    de1, de2, ratio, tilt, denominator, inner = (np.empty(shape) for _ in range(6))
    sine, cosine, across = np.empty(shape), np.empty(shape), np.empty(shape)  # across = exp(e1 - e2)
    sine[0], cosine[0], across[0] = np.sin(start[3]), np.cos(start[3]), np.exp(start[0] - start[1])
    turning, spreading = np.empty(shape), np.empty(shape)  # i theta_i and i (e1 - e2)_i
    for k in range(order):
        if k:
            d1, d2 = de1[k - 1], de2[k - 1]
            film.extend(k, d1, d2)
            turning[k], spreading[k] = k * y[k, 3], d1 - d2
            sine[k] = np.einsum("ib,ib->b", turning[1 : k + 1], cosine[k - 1 :: -1]) / k
            cosine[k] = np.einsum("ib,ib->b", turning[1 : k + 1], sine[k - 1 :: -1]) / -k
            across[k] = np.einsum("ib,ib->b", spreading[1 : k + 1], across[k - 1 :: -1]) / k
            de2[k] = _dot(across, cosine, k)
        else:  # exp(e1 - e2) cos(theta) - 1 without cancellation
            de2[0] = np.expm1(start[0] - start[1]) * cosine[0] - 2 * np.sin(0.5 * start[3]) ** 2
        denominator[k] = film.s11[k] - film.s1[k]
        inner[k] = film.s2[k] - film.s12[k]
        _divide(film.gap[k] + _dot(inner, de2, k), de1, denominator, k)
        _divide(film.s2[k], ratio, film.s1, k)
        tilt[k] = _dot(across, sine, k)
        y[k + 1, 0] = de1[k] / (k + 1)
        y[k + 1, 1] = y[k + 1, 2] = de2[k] / (k + 1)
        y[k + 1, 3] = -_dot(ratio, tilt, k) / (k + 1)
        y[k + 1, 4] = _dot(film.reach, sine, k) / (k + 1)
    return y


def wrinkled_series(states: States, x: Array, start: Array, order: int) -> Array:
    """As :func:`taut_series`, for a zone without hoop stress: ``theta`` constant, ``natural`` wider than ``e2``."""
    y = np.zeros((order + 1, 5, states.size))
    y[0] = start
    film = _Film(states, order, x, y[0, 0], y[0, 2])
    sine, cosine = np.sin(start[3]), np.cos(start[3])
    shape = (order + 1, states.size)
    de1, de2, dn, slope, denominator, across, spreading = (np.empty(shape) for _ in range(7))
    across[0] = np.exp(start[0] - start[1])
    for k in range(order):
        if k:
            film.extend(k, de1[k - 1], dn[k - 1])
            spreading[k] = de1[k - 1] - de2[k - 1]
            across[k] = np.einsum("ib,ib->b", spreading[1 : k + 1], across[k - 1 :: -1]) / k
            de2[k] = across[k] * cosine
        else:
            de2[0] = np.expm1(start[0] - start[1]) * cosine - 2 * np.sin(0.5 * start[3]) ** 2
        _divide(-film.s12[k], slope, film.s22, k)  # dn/de1 at no hoop stress
        denominator[k] = film.s11[k] - film.s1[k] + _dot(film.s12, slope, k)
        _divide(-film.s1[k], de1, denominator, k)
        dn[k] = _dot(slope, de1, k)
        y[k + 1, 0] = de1[k] / (k + 1)
        y[k + 1, 1] = de2[k] / (k + 1)
        y[k + 1, 2] = dn[k] / (k + 1)
        y[k + 1, 4] = film.reach[k] * sine / (k + 1)
    return y
