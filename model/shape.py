"""The film's meridian, for drawing: where the solver has the film, and how thin and how highly charged it is there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from model import ritz
from model.ladder import Answer, Start, climb, first_modes
from model.law import Array, Evaluations
from model.membrane import _Block, _Inputs
from model.specimen import Specimen

TOLERANCE = 1e-4  # of the force; far below the width of a line
FINE = 8  # steps of integration from one point to the next


@dataclass(frozen=True, eq=False)
class Meridians:
    """Films from the disk's rim to the ring at even steps of ln R: arrays (states, points), NaN without an answer.

    Attributes
    ----------
    r, z : deformed radius, and height above the ring's plane (m)
    thinning : thickness at rest over thickness, the product of the stretches in the plane
    field : true electric field (V/m)
    """

    r: Array
    z: Array
    thinning: Array
    field: Array


def meridians(specimen: Specimen, h: ArrayLike, voltage: ArrayLike, points: int) -> Meridians:
    """Taut films at displacements ``h`` (m) and voltages ``voltage`` (V), broadcast to a shape (states,).

    With the solver's unknowns, hoop strain ``e = r/R - 1`` and slope ``w = -dz/dR`` over ``x = ln(R/b)``:
    ``r = R (1 + e)``, ``z`` the integral of ``w R dx`` from x to 0, thinning ``l1 l2``, field ``V l1 l2 / T``.
    """
    inputs = _Inputs.gather(specimen, h, voltage)
    shape = Meridians(*(np.full((inputs.h.size, points), np.nan) for _ in range(4)))
    for index in inputs.blocks():
        problem = _Block(inputs, index, Evaluations()).problem
        breaks = problem.cut()
        modes = first_modes(float(problem.span.max()) / (len(breaks) - 1), TOLERANCE)
        grid = ritz.Grid.lay(modes, breaks)
        answers, _, _ = climb(problem, TOLERANCE, Start(grid, ritz.guess(problem, grid)))
        for answer in answers:
            at = index[answer.index]
            radius, e, z, thinning = _over_radius(answer, points)
            shape.r[at] = specimen.ring_radius * radius * (1.0 + e)
            shape.z[at] = specimen.ring_radius * z * np.sign(inputs.h[at])[:, None]
            shape.thinning[at] = specimen.prestretch**2 * thinning
            shape.field[at] = shape.thinning[at] * np.abs(inputs.voltage[at])[:, None] / specimen.thickness
    return shape


def _over_radius(answer: Answer, points: int) -> tuple[Array, Array, Array, Array]:
    """R/b, e, z/b and l1 l2/lp^2 at the points, (states, points) each."""
    grid = answer.grid
    xi = np.linspace(-1.0, 1.0, FINE * (points - 1) + 1)
    to_fine = ritz.barycentric(grid.table.xi, xi)
    e, q = grid.strain(answer.state.c)

    def fine(values: Array) -> Array:
        """From (Q, M, S) to (S, M, len(xi))."""
        return np.moveaxis(np.tensordot(to_fine, values, 1), (0, 1, 2), (2, 1, 0))

    breaks = grid.breaks.T[:, :, None]
    width = breaks[:, 1:] - breaks[:, :-1]
    x = breaks[:, :-1] + 0.5 * (xi + 1.0) * width  # (S, M, len(xi))
    rise = fine(answer.state.w) * np.exp(x)
    steps = 0.25 * (rise[..., 1:] + rise[..., :-1]) * width * (xi[1] - xi[0])
    states = len(x)
    above = np.cumsum(steps.reshape(states, -1)[:, ::-1], axis=1)[:, ::-1]  # z at the left end of each step
    ends = np.concatenate((x[..., :-1].reshape(states, -1), np.zeros((states, 1))), axis=1)
    heights = np.concatenate((above, np.zeros((states, 1))), axis=1)
    drawn = np.linspace(x[:, 0, 0], 0.0, points, axis=1)

    def pick(values: Array, places: Array) -> Array:
        return np.array([np.interp(*row) for row in zip(drawn, places, values, strict=True)])

    every = x.reshape(states, -1)
    e, q, w = (fine(values) for values in (e, q, answer.state.w))
    thinning = np.hypot(1.0 + q, w) * (1.0 + e)
    return (
        np.exp(drawn),
        pick(e.reshape(states, -1), every),
        pick(heights, ends),
        pick(thinning.reshape(states, -1), every),
    )
