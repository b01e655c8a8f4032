r"""Whether the law under its voltage rises with the meridional stretch at every point of a film and between them.

The equations determine a profile only while the energy is convex in the meridional stretch at the hoop stretch that
each circle has: ``d2W*/dl1^2 > 0`` where the film is taut, and where it is wrinkled ``d2W*/dl1^2 - (d2W*/dl1 dl2)^2 /
(d2W*/dl2^2) > 0`` with ``d2W*/dl2^2 > 0``. Where this fails between two stretches the profile may jump from one to the
other at any radius, and what a solver returns is where its iteration left the jump: such a state is not one. Points
alone do not see it, for two of them may stand on either side; so the law is tested along the way from point to point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.material.law import relax, stack, stress
from model.membrane.output import edges
from model.membrane.ritz import Grid, Problem, State, evaluate
from model.membrane.soft_cone import along
from model.membrane.wrinkled_cone import natural_width

BETWEEN = 4  # pieces of the way from one point to the next


@dataclass(slots=True)
class Stations:
    """Log stretches along films from the disk to the ring, (P, S)."""

    log1: Array
    hoop: Array  # of the circle
    natural: Array  # that makes the stress, or near it
    relaxed: bool  # whether the film may wrinkle

    def toward(self, other: Stations, share: float) -> Stations:
        """Stations so far on the way to those of another state."""

        def mean(one: Array, two: Array) -> Array:
            return one + share * (two - one)

        return Stations(
            mean(self.log1, other.log1),
            mean(self.hoop, other.hoop),
            mean(self.natural, other.natural),
            other.relaxed,
        )

    def take(self, index: NDArray[np.intp]) -> Stations:
        return Stations(self.log1[:, index], self.hoop[:, index], self.natural[:, index], self.relaxed)


def stations(problem: Problem, grid: Grid, state: State, lam: Array) -> Stations:
    """The points, both edges, and the ways between them cut in pieces."""
    at = evaluate(problem, grid, state)
    edge = edges(problem, grid, state, at, lam)
    states = len(lam)
    share = np.linspace(0.0, 1.0, BETWEEN, endpoint=False)[None, :, None]

    def cut(values: Array, ends: Array) -> Array:
        inside = values.swapaxes(0, 1).reshape(-1, states)
        all_ = np.concatenate((ends[:1], inside, ends[1:]))
        pieces = all_[:-1, None] + share * (all_[1:] - all_[:-1])[:, None]
        return np.concatenate((pieces.reshape(-1, states), all_[-1:]))

    clamped = np.broadcast_to(problem.log_prestretch, edge.log1.shape)
    log1, log2, hoop = at.log[0], at.log[1], at.hoop
    if state.cones is not None:
        seen = along(problem, grid, state, at)
        log1, log2, hoop = seen.log1, seen.log2, seen.hoop
    return Stations(cut(log1, edge.log1), cut(hoop, clamped), cut(log2, edge.log2), state.relaxed is not None)


def margin(problem: Problem, found: Stations) -> Array:
    """Least stiffness along the films, (S,), as a share of what it is without Maxwell stress: positive where convex."""
    return _least(found.log1, *stiffness(problem, found))


SHARES = (0.0, 0.5, 1.0)  # of the radial displacement
SAFE = 0.96  # of the coupling that would make the energy flat


def between(problem: Problem, grid: Grid, state: State) -> NDArray[np.bool_]:
    """Whether the energy is convex from the taut film with ``r = R`` to these taut states, at every point.

    In ``q = dr/dR - 1``, ``w`` and ``e = r/R - 1``. As ``e q R^2 dx`` has the integral ``[R^2 e^2/2] = 0`` between
    clamped edges, any multiple of ``e q`` may be added: what counts is whether one multiple makes every point convex.
    """
    e1, q1 = grid.strain(state.c)
    share = np.array(SHARES)[:, None, None, None]
    e, q = share * e1, share * q1
    metric = (1.0 + q) ** 2 + state.w * state.w
    log1, hoop = 0.5 * np.log(metric) + problem.log_prestretch, np.log1p(e) + problem.log_prestretch
    law = stress(problem.film, stack(log1, hoop))
    along, down, around = (1.0 + q) / metric, state.w / metric, 1.0 / (1.0 + e)
    tm, d = law.t1 / metric, law.h11 - 2.0 * law.t1
    qw, ww, we = d * along * down, d * down * down + tm, law.h12 * down * around
    # The slope is eliminated, as Newton does it.
    qq = d * along * along + tm - qw * qw / ww
    qe = law.h12 * along * around - qw * we / ww
    ee = (law.h22 - law.t2) * around * around - we * we / ww
    axes = (0, 1, 2)
    good = ((ww > 0.0) & (qq > 0.0) & (ee > 0.0)).all(axis=axes)
    room = SAFE * np.sqrt(np.maximum(qq * ee, 0.0))
    low, high = (-qe - room).max(axis=axes), (room - qe).min(axis=axes)
    return np.asarray(good & (low < high))


def stiffness(problem: Problem, found: Stations) -> tuple[Array, NDArray[np.bool_]]:
    """``d2W*/dl1^2`` as a share of that without Maxwell stress, -1 without a law; and where the film is wrinkled."""
    law = stress(problem.film, stack(found.log1, found.hoop))
    wrinkled = (law.t2 < 0.0) & found.relaxed
    if wrinkled.any():
        start = np.where(wrinkled, np.maximum(found.natural, found.hoop), found.hoop)
        # Where the film does not wrinkle nothing is sought: the law there is the plain one.
        natural, _ = natural_width(problem, found.log1[:, None], start[:, None], 1e-6, wrinkled[:, None])
        log2 = np.where(wrinkled, natural[:, 0], found.hoop)
        law = stress(problem.film, stack(found.log1, log2))
    bare = np.abs(law.h11 - law.t1 + (0.0 if law.maxwell is None else law.maxwell))
    if not wrinkled.any():
        return (law.h11 - law.t1) / bare, wrinkled
    loose = relax(problem.film, law, wrinkled)
    rise = (loose.h11 - loose.t1) / bare
    # Without a natural width to settle at there is no relaxed law.
    return np.where(wrinkled & ~(law.h22 > 0.0), -1.0, rise), wrinkled


def _least(place: Array, values: Array, wrinkled: NDArray[np.bool_]) -> Array:
    """Least of ``values`` (P, S) along ``place``, of the parabola through the least and its neighbours; NaN is none.

    At the edge of a wrinkled zone the values jump: no parabola leads over it.
    """
    values = np.where(np.isfinite(values), values, -1.0)
    last, columns = len(values) - 1, np.arange(values.shape[1])
    lowest = values.argmin(axis=0)
    middle = np.clip(lowest, 1, last - 1)
    x0, x1, x2 = (place[middle + k, columns] for k in (-1, 0, 1))
    y0, y1, y2 = (values[middle + k, columns] for k in (-1, 0, 1))
    kinds = [wrinkled[middle + k, columns] for k in (-1, 0, 1)]
    with np.errstate(all="ignore"):
        d01, d12 = (y1 - y0) / (x1 - x0), (y2 - y1) / (x2 - x1)
        curve = (d12 - d01) / (x2 - x0)
        slope = d01 + curve * (x1 - x0)
        dip = y1 - 0.25 * slope * slope / curve
        inside = (lowest == middle) & (curve > 0.0) & np.isfinite(dip)
        inside &= (kinds[0] == kinds[1]) & (kinds[2] == kinds[1])
    # The parabola dips below its points by no more than they differ.
    bound = y1 - 0.5 * np.maximum(np.abs(y0 - y1), np.abs(y2 - y1))
    least: Array = values[lowest, columns]
    return np.where(inside, np.minimum(least, np.maximum(dip, bound)), least)
