"""The film from disk to ring: shape, stretches, stresses and field of one solved state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model import ritz
from model.law import Array, relax, stack, stress
from model.output import edges
from model.ritz import Grid, Problem, State


@dataclass(frozen=True)
class Profile:
    """Values along the undeformed radius ``R``, from the disk to the ring.

    Attributes
    ----------
    R : radius in the pre-stretched flat film (m)
    r, z : where that point is now: radius and distance from the ring's plane (m)
    slope : angle of the meridian to the ring's plane, positive downwards from the disk (rad)
    stretch_1, stretch_2 : total principal stretches, along the meridian and around; where wrinkled the natural one
    stress_1, stress_2 : true stresses (Pa)
    field : true electric field (V/m)
    wrinkled : whether the film is folded there
    """

    R: Array
    r: Array
    z: Array
    slope: Array
    stretch_1: Array
    stretch_2: Array
    stress_1: Array
    stress_2: Array
    field: Array
    wrinkled: NDArray[np.bool_]


def profile(
    problem: Problem, grid: Grid, state: State, lam: Array, points: int, *, ring: float, shear: float, field: float
) -> Profile:
    """The profile of the only state of ``problem``, ``points`` an element, denser towards the elements' ends.

    ``ring`` is b (m), ``shear`` is G (Pa), ``field`` is V/T (V/m).
    """
    t, m = grid.table, grid.elements
    at = ritz.evaluate(problem, grid, state)
    xi = -np.cos(np.linspace(0.0, np.pi, points))
    carry = ritz.barycentric(t.xi, xi)

    def sampled(values: Array) -> Array:
        """From (Q, M, 1) to (M * points,)."""
        return (carry @ values[:, :, 0]).T.ravel()

    half = 0.5 * (grid.breaks[1:, 0] - grid.breaks[:-1, 0])
    x = (grid.breaks[:-1, 0] + half)[:, None] + half[:, None] * xi
    radius = np.exp(x.ravel())
    log1, log2, q, e = (sampled(values) for values in (at.log[0], at.log[1], at.q, at.e))
    wrinkled = np.zeros(m * points, dtype=np.bool_)
    if state.relaxed is not None:
        wrinkled = np.repeat(state.relaxed[0, :, 0], points)
    edge = edges(problem, grid, state, at, lam)
    log1[[0, -1]], log2[[0, -1]], e[[0, -1]] = edge.log1[:, 0], edge.log2[:, 0], 0.0
    law = stress(problem.film, stack(log1[:, None], log2[:, None]))
    if state.relaxed is not None:
        law = relax(problem.film, law, wrinkled[:, None])

    # The drop to the ring: the polynomial through R w, integrated in closed form.
    legendre = np.polynomial.legendre
    to_legendre = (legendre.legvander(t.xi, t.points - 1) * (np.arange(t.points) + 0.5) * t.weight[:, None]).T
    drops = []
    below = 0.0
    for element in reversed(range(m)):
        integral = legendre.legint(to_legendre @ (grid.radius[:, element, 0] * state.w[:, element, 0])) * half[element]
        value = legendre.legval(1.0, integral) - legendre.legval(xi, integral)
        drops.append(below + value)
        below += float(value[0])
    keep = np.ones(m * points, dtype=np.bool_)
    keep[points::points] = False  # the cuts stand twice
    stretch_1 = np.exp(log1)
    rise = np.arctan2(np.sqrt(np.maximum(np.exp(2.0 * (log1 - problem.log_prestretch)) - (1.0 + q) ** 2, 0.0)), 1.0 + q)
    return Profile(
        R=(ring * radius)[keep],
        r=(ring * radius * (1.0 + e))[keep],
        z=ring * np.concatenate(drops[::-1])[keep],
        slope=rise[keep],
        stretch_1=stretch_1[keep],
        stretch_2=np.exp(log2)[keep],
        stress_1=shear * law.t1[keep, 0],
        stress_2=shear * law.t2[keep, 0],
        field=field * np.exp(log1 + log2)[keep],
        wrinkled=wrinkled[keep],
    )
