"""A cone that takes time, of its own: linear elements in ln R, and Maxwell branches by an exponential update.

It shares nothing with `model`. Unknown are radius and height of the nodes; every element has the elastic logarithmic
strains ``w`` of each branch. With the flow ``dw/dt = du/dt - (w + N(w))/tau``, where N is what a finite strain adds,
a step of ``dt`` with ``x = dt/tau`` and ``p = (1 - exp(-x))/x`` is

    w <- exp(-x) w + p (du - x N),    N the mean of both ends (two passes),

second order in dt, and exact at small strain. The balance at the end of each step is solved by Newton's method.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.linalg import solve_banded

Array = NDArray[np.float64]
EPS_0 = 8.8541878128e-12


@dataclass(frozen=True)
class ViscousCone:
    """A film with branches (ratio, time in s) on its rig."""

    a: float = 4e-3
    b: float = 20e-3
    thickness: float = 40e-6
    prestretch: float = 1.2
    mu: tuple[float, ...] = (5e3, 3.5e4)
    alpha: tuple[float, ...] = (2.5, 5.6)
    eps_r: float = 1.7
    branches: tuple[tuple[float, float], ...] = ((0.1, 1.0), (0.1, 30.0))
    elements: int = 80

    @property
    def modulus(self) -> float:
        """Of the relaxed film at small strain (Pa)."""
        return 0.5 * sum(m * a for m, a in zip(self.mu, self.alpha, strict=True))

    def law(self, u: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Stresses dW/du1, dW/du2 and their derivatives 11, 12, 22 at log stretches (2, ...)."""
        found = np.zeros((5, *u.shape[1:]))
        for mu, alpha in zip(self.mu, self.alpha, strict=True):
            one, two, thin = np.exp(alpha * u[0]), np.exp(alpha * u[1]), np.exp(-alpha * (u[0] + u[1]))
            found += mu * np.array((one - thin, two - thin, alpha * (one + thin), alpha * thin, alpha * (two + thin)))
        return tuple(found)  # type: ignore[return-value]

    def excess(self, w: Array) -> Array:
        """N(w): the flow at a finite strain over 1/tau, less w."""
        s1, s2, *_ = self.law(w)
        found: Array = np.array((2.0 * s1 - s2, 2.0 * s2 - s1)) / (6.0 * self.modulus) - w
        return found

    def times(self, t: Sequence[float], moves: int) -> Array:
        """Times of the steps of a piecewise linear history: so many evenly in each stretch, and so many early ones."""
        times = [np.array([t[0]])]
        shortest = min([time for _, time in self.branches], default=1.0)
        for left, right in itertools.pairwise(t):
            length = right - left
            even = np.linspace(0.0, length, moves + 1)[1:]
            early = np.geomspace(min(0.02 * shortest, length / moves), length, moves + 1)
            times.append(left + np.unique(np.concatenate((even, early))))
        return np.unique(np.round(np.concatenate(times), 6))

    def history(self, t: Sequence[float], h: Sequence[float], voltage: Sequence[float], moves: int = 60) -> Trace:
        """Force along a piecewise linear history from rest, with ``moves`` steps in the shortest kind of stretch."""
        at = self.times(t, moves)
        heights, volts = np.interp(at, t, h), np.interp(at, t, voltage)
        return Trace(at, heights, volts, self.forces(at, heights, volts))

    def forces(self, at: Array, heights: Array, volts: Array) -> Array:
        """Force at the end of every step from one of the times ``at`` to the next, from rest at the first."""
        n = self.elements
        radius = np.exp(np.linspace(math.log(self.a), math.log(self.b), n + 1))
        width, middle = np.diff(radius), 0.5 * (radius[1:] + radius[:-1])
        weight = 2.0 * math.pi * middle * width * self.thickness / self.prestretch**2
        r, z = radius.copy(), heights[0] * np.log(self.b / radius) / math.log(self.b / self.a)
        u = np.full((2, n), math.log(self.prestretch))
        w = np.zeros((len(self.branches), 2, n))
        force = np.zeros(at.size)
        shape = np.log(self.b / radius) / math.log(self.b / self.a)
        for k in range(at.size):
            dt = at[k] - at[k - 1] if k else 0.0
            z = z + (heights[k] - z[0]) * shape
            drive = [
                (np.exp(-dt / tau), -np.expm1(-dt / tau) / (dt / tau) if dt else 1.0, dt / tau)
                for _, tau in self.branches
            ]
            before = [self.excess(one) for one in w]
            mean = before
            for _ in range(2 if dt and self.branches else 1):
                base = [e * one - p * x * add for (e, p, x), one, add in zip(drive, w, mean, strict=True)]
                r, z, now, force[k] = self._balance(r, z, u, base, drive, volts[k], width, middle, weight)
                ends = [one + p * (now - u) for (_, p, _), one in zip(drive, base, strict=True)]
                mean = [0.5 * (one + self.excess(end)) for one, end in zip(before, ends, strict=True)]
            u = now
            if self.branches:
                w = np.array(ends)
        return force

    def _balance(
        self,
        r: Array,
        z: Array,
        old: Array,
        base: list[Array],
        drive: list[tuple[float, float, float]],
        volts: float,
        width: Array,
        middle: Array,
        weight: Array,
    ) -> tuple[Array, Array, Array, float]:
        n = self.elements
        r, z = r.copy(), z.copy()
        for _ in range(40):
            d = np.array((np.diff(r), np.diff(z)))
            length, mid = np.hypot(d[0], d[1]), 0.5 * (r[1:] + r[:-1])
            u = np.log(np.array((self.prestretch * length / width, self.prestretch * mid / middle)))
            s1, s2, h11, h12, h22 = (one.copy() for one in self.law(u))
            for (ratio, _), (_, p, _), one in zip(self.branches, drive, base, strict=True):
                t1, t2, c11, c12, c22 = self.law(one + p * (u - old))
                s1, s2 = s1 + ratio * t1, s2 + ratio * t2
                h11, h12, h22 = h11 + ratio * p * c11, h12 + ratio * p * c12, h22 + ratio * p * c22
            electric = EPS_0 * self.eps_r * (volts / self.thickness) ** 2 * np.exp(2.0 * (u[0] + u[1]))
            s1, s2 = s1 - electric, s2 - electric
            h11, h12, h22 = h11 - 2.0 * electric, h12 - 2.0 * electric, h22 - 2.0 * electric
            # gradients of u1, u2 by (r0, z0, r1, z1) of an element, and the second derivatives of u1
            slope = d / length**2
            g1 = np.array((-slope[0], -slope[1], slope[0], slope[1]))
            g2 = np.zeros((4, n))
            g2[0] = g2[2] = 0.5 / mid
            grad = weight * (s1 * g1 + s2 * g2)
            hess = h11 * g1[:, None] * g1[None] + h22 * g2[:, None] * g2[None]
            hess += h12 * (g1[:, None] * g2[None] + g2[:, None] * g1[None])
            square = 1.0 / length**2
            second = np.zeros((2, 2, n))
            for i in range(2):
                for j in range(2):
                    second[i, j] = (i == j) * square - 2.0 * slope[i] * slope[j]
            for i in range(4):
                for j in range(4):
                    hess[i, j] += s1 * second[i % 2, j % 2] * (1.0 if (i < 2) == (j < 2) else -1.0)
            for i in (0, 2):
                for j in (0, 2):
                    hess[i, j] -= s2 * 0.25 / mid**2
            hess *= weight
            total = np.zeros(2 * (n + 1))
            band = np.zeros((7, 2 * (n + 1)))
            place = 2 * np.arange(n)
            for i in range(4):
                np.add.at(total, place + i, grad[i])
                for j in range(4):
                    np.add.at(band, (3 + i - j, place + j), hess[i, j])
            force = total[1]
            inner = slice(2, 2 * n)
            step = solve_banded((3, 3), band[:, inner] if n else band, -total[inner])
            size = float(np.abs(step).max())
            step *= min(1.0, 0.3 * float(length.min()) / size) if size > 0.3 * float(length.min()) else 1.0
            r[1:-1] += step[0::2]
            z[1:-1] += step[1::2]
            if size < 1e-10 * self.b:
                return r, z, u, float(force)
        raise AssertionError(f"no balance at {z[0]:.4g} m, {volts:.4g} V")


@dataclass(frozen=True, eq=False)
class Trace:
    """Force (N) along a history: times (s), displacement (m), voltage (V)."""

    t: Array
    h: Array
    voltage: Array
    force: Array

    def at(self, times: Array) -> Array:
        """Force at other times, by interpolation."""
        with np.errstate(over="ignore"):  # slopes of a force that rests at zero
            found: Array = PchipInterpolator(self.t, self.force)(times)
        return found
