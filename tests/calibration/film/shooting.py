"""A cone of its own: the membrane's equations integrated from the disk to the ring and shot at the boundary values.

It shares nothing with `model`. With ``x = ln R``, ``l1``, ``l2`` the total stretches and ``F`` the force::

    sin(theta) = F lp / (2 pi R T S1)         (first integral of the vertical balance)
    dl2/dx = l1 cos(theta) - l2
    dl1/dx = (S2 cos(theta) - S1 - W12 dl2/dx) / W11
    dz/dx  = R l1 sin(theta) / lp

with ``S1``, ``S2`` the derivatives of the energy density by the stretches, electric part included. Unknown are l1 at
the disk and F; at the ring ``l2 = lp`` and ``z = h`` (Newton, all states at once; Runge-Kutta of order 4).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
EPS_0 = 8.8541878128e-12
STEPS, NODES = 48, 12


@dataclass(frozen=True)
class Cone:
    """A film on its rig; ``stretch_loss`` and ``field_gain`` make the permittivity depend on area stretch and field.

    ``jm`` > 0 makes it a Gent film of the modulus ``mu[0] alpha[0] / 2``.
    """

    a: float = 4e-3
    b: float = 20e-3
    thickness: float = 40e-6
    prestretch: float = 1.2
    mu: tuple[float, ...] = (5e3, 3.5e4)
    alpha: tuple[float, ...] = (2.5, 5.6)
    eps_r: float = 1.7
    jm: float = 0.0
    stretch_loss: float = 0.0
    field_gain: float = 0.0  # relative change of the permittivity at 50 V/um

    def stresses(self, l1: Array, l2: Array, field: Array) -> tuple[Array, Array, Array, Array]:
        """S1, S2 and the derivatives of S1 by both stretches, at the field V/T."""
        area = l1 * l2
        if self.jm > 0.0:
            modulus = 0.5 * self.mu[0] * self.alpha[0]
            thin = area**-2.0
            factor = modulus * self.jm / (self.jm - (l1**2 + l2**2 + thin - 3.0))
            s1, s2 = factor * (l1**2 - thin), factor * (l2**2 - thin)
            rise = factor * factor / (modulus * self.jm) * (l1**2 - thin)
            by1 = factor * 2.0 * (l1 + thin / l1) + rise * 2.0 * (l1 - thin / l1)
            by2 = factor * 2.0 * thin / l2 + rise * 2.0 * (l2 - thin / l2)
        else:
            s1, s2, by1, by2 = np.zeros((4, *area.shape))
            for mu, alpha in zip(self.mu, self.alpha, strict=True):
                one, two, thin = l1**alpha, l2**alpha, area**-alpha
                s1, s2 = s1 + mu * (one - thin), s2 + mu * (two - thin)
                by1, by2 = by1 + mu * alpha * (one + thin) / l1, by2 + mu * alpha * thin / l2
        # A d/dA of eps/2 E0^2 A^2 (1 - c ln(A/A0)) + eps/4 g E0^4 A^4 / Er^2, and the same operation on that
        eps, loss = EPS_0 * self.eps_r, self.stretch_loss
        square = eps * (field * area) ** 2
        left = 1.0 - loss * (np.log(area / self.prestretch**2) + 0.5)
        fourth = eps * self.field_gain * (field * area) ** 4 / 50e6**2
        electric, slope = square * left + fourth, square * (2.0 * left - loss) + 4.0 * fourth
        first = (s1 - electric) / l1
        return first, (s2 - electric) / l2, (by1 - slope / l1 - first) / l1, (by2 - slope / l2) / l1

    def forces(self, h: Array, voltage: Array | float) -> Array:
        """Force (N) at displacements (m) of 0.1 mm or more, up to about half of the ring's radius."""
        h, voltage = np.broadcast_arrays(np.asarray(h, dtype=float), voltage)
        field, ring = voltage / self.thickness, np.stack((np.full(h.size, self.prestretch), h))
        slope = np.arctan2(h, self.b - self.a)
        stretch = self.prestretch * (1.0 + 0.6 * (1.0 / np.cos(slope) - 1.0)) + 0.01
        s1 = self.stresses(stretch, ring[0], field)[0]
        force = 2.2 * math.pi * self.a * self.thickness / self.prestretch * s1 * np.sin(slope)
        unknown = np.stack((stretch, force))
        for _ in range(60):
            steps = np.stack((1e-7 * unknown[0], 1e-7 * np.abs(unknown[1]) + 1e-12))
            nearby = [unknown, unknown + steps * [[1.0], [0.0]], unknown + steps * [[0.0], [1.0]]]
            ends = self._shoot(np.concatenate(nearby, axis=1), np.tile(field, 3))
            there, *moved = np.split(ends, 3, axis=1)
            miss = there - ring
            if np.abs(miss[0]).max() < 1e-10 and np.abs(miss[1]).max() < 1e-12:
                return np.asarray(unknown[1])
            (a, c), (b, d) = ((one - there) / step for one, step in zip(moved, steps, strict=True))
            det = a * d - b * c
            lost = ~np.isfinite(det) | (det == 0.0)  # a meridian past the vertical: less force
            det[lost] = 1.0
            change = np.stack(((-miss[0] * d + miss[1] * b) / det, (-miss[1] * a + miss[0] * c) / det))
            change[:, lost] = np.stack((0.0 * unknown[0], -0.2 * unknown[1]))[:, lost]
            limit = np.stack((0.15 * unknown[0], 0.4 * np.abs(unknown[1]) + 1e-6))
            unknown = unknown + np.clip(change, -limit, limit)
        raise AssertionError(f"the shooting did not converge: {np.abs(miss).max(axis=1)}")

    def _shoot(self, unknown: Array, field: Array) -> Array:
        """Hoop stretch and height at the ring."""
        force = unknown[1]
        state = np.stack((unknown[0], np.full(force.size, self.prestretch), np.zeros(force.size)))
        x, step = math.log(self.a), math.log(self.b / self.a) / STEPS
        pull = force * self.prestretch / (2.0 * math.pi * self.thickness)

        def slope(at: float, y: Array) -> Array:
            radius = math.exp(at)
            l1, l2 = y[0], y[1]
            s1, s2, w11, w12 = self.stresses(l1, l2, field)
            sine = np.clip(pull / (radius * s1), -0.999999, 0.999999)
            cosine = np.sqrt(1.0 - sine**2)
            by2 = l1 * cosine - l2
            return np.stack(((s2 * cosine - s1 - w12 * by2) / w11, by2, radius * l1 * sine / self.prestretch))

        for _ in range(STEPS):
            k1 = slope(x, state)
            k2 = slope(x + step / 2, state + step / 2 * k1)
            k3 = slope(x + step / 2, state + step / 2 * k2)
            k4 = slope(x + step, state + step * k3)
            state = state + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            x += step
        return np.asarray(state[1:])

    def curves(self, voltages: Sequence[float], highest: float) -> list[Callable[[Array], Array]]:
        """Force at every voltage as a function of displacement up to ``highest`` (m), by `NODES` states each."""
        nodes = 0.5 * highest * (1.0 - np.cos((2 * np.arange(NODES) + 1) * np.pi / (2 * NODES))) + 1e-4
        h, volts = np.tile(nodes, len(voltages)), np.repeat(np.asarray(voltages, dtype=float), NODES)
        found = self.forces(h, volts).reshape(len(voltages), NODES) / nodes
        fits = [
            np.polynomial.chebyshev.Chebyshev.fit(nodes, values, NODES - 1, domain=[0.0, highest + 2e-4])
            for values in found
        ]
        return [partial(_force, fit) for fit in fits]

    def changed(self, **fields: float) -> Cone:
        """The same with other dimensions or parameters."""
        return replace(self, **fields)  # type: ignore[arg-type] # names of fields


def _force(fit: Callable[[Array], Array], h: Array) -> Array:
    return np.asarray(h * fit(h))
