"""How many branches a sheet has, as far as its tests tell, and which others it could have unseen.

By the criteria of a film in a cone (`calibration.film.branches.spectrum`): AICc has to fall by `EARNED` for another
branch, and what is left out has to be predicted no worse.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.film.branches.result import FAR
from calibration.film.branches.spectrum import (
    ALMOST_SURE,
    DECADES_BEYOND,
    EARNED,
    GROUPS,
    MOST,
    PER_DECADE,
    PREDICTED,
)
from calibration.sheet.timed.problem import Point, TimedProblem

Array = NDArray[np.float64]

CLEAR = 60.0  # of AICc: a gain that no unfinished search explains


@dataclass(frozen=True, eq=False)
class Count:
    """A number of branches, fitted: AICc over the least of all, and what was left out over its noise."""

    branches: int
    point: Point
    aicc: float
    held_out: float


def free_columns(problem: TimedProblem, point: Point) -> NDArray[np.bool_]:
    """Entries of x that are fitted and at no bound."""
    low, high = problem.bounds(point.x)
    span = np.where(np.isfinite(high - low), high - low, 1.0)
    found: NDArray[np.bool_] = problem.varied(point.x) & (np.minimum(point.x - low, high - point.x) > 1e-6 * span)
    return found


def misfit(problem: TimedProblem, point: Point) -> float:
    """Chi-square over its freedom where that is no chance, times how many bins err together; 1 where it is."""
    data = point.residual[: problem.measured.size]
    freedom = max(1, data.size - int(free_columns(problem, point).sum()))
    ratio = float(data @ data) / freedom
    if not ratio > 1.0 + 3.0 * math.sqrt(2.0 / freedom):
        return 1.0
    together = 1.0
    for lag in range(1, data.size // 4):
        rho = float(data[lag:] @ data[:-lag]) / float(data @ data)
        if rho < 2.0 / math.sqrt(data.size):
            break
        together += 2.0 * rho
    return ratio * together


def aicc(problem: TimedProblem, point: Point, scale: float) -> float:
    """Of all rows, as those count that are independent."""
    numbers = int(free_columns(problem, point).sum()) - len(problem.records)
    crowding = 2.0 * numbers * (numbers + 1) / max(1.0, problem.samples - numbers - 1)
    return point.cost / scale + 2.0 * numbers + crowding


def held_out(problem: TimedProblem, point: Point) -> float:
    """Root mean square over noise of what a fit without it says of each part of the tests (to first order)."""
    free = free_columns(problem, point)
    columns, total = point.jacobian[:, free], 0.0
    parts = [np.tile(one.segment, len(one.directions)) + 10_000 * k for k, one in enumerate(problem.bins)]
    segments, count = np.concatenate(parts), problem.measured.size
    order = np.unique(segments)
    for mine in np.array_split(order, min(GROUPS, order.size)):
        out = np.zeros(point.residual.size, dtype=np.bool_)
        out[:count] = np.isin(segments, mine)
        step = np.linalg.lstsq(columns[~out], -point.residual[~out], rcond=1e-8)[0]
        there = point.residual[out] + columns[out] @ step
        total += float(there @ there)
    return math.sqrt(total / count)


def grid(problem: TimedProblem, beyond: float) -> Array:
    """Relaxation times (s) over the window and ``beyond`` it by so many decades."""
    shortest, longest = problem.window
    longest *= 10.0**beyond
    return np.geomspace(shortest, longest, max(2, round(PER_DECADE * math.log10(longest / shortest)) + 1))


def guess(problem: TimedProblem, from_: Point, number: int) -> Array | None:
    """A start with so many branches in all: the best times of a grid, moduli and ratios by linear least squares."""
    film, _, _, zeros = problem.split(from_.x)
    times = grid(problem, 0.0)
    relaxed, added = problem.of_one(film, times)
    columns = np.column_stack((relaxed, added.T)) / problem.sigma[:, None]
    target = (problem.measured - problem.zeros(zeros)) / problem.sigma
    if not np.isfinite(columns).all():
        return None
    gram, along = columns.T @ columns, columns.T @ target
    best: tuple[float, Array, NDArray[np.intp]] | None = None
    for these in itertools.combinations(range(times.size), number):
        pick = np.array([0, *(1 + k for k in these)])
        own = gram[np.ix_(pick, pick)]
        sizes = np.linalg.solve(own + 1e-10 * np.diag(np.diag(own)), along[pick])
        gain = float(along[pick] @ sizes)
        if (sizes > 0.0).all() and (best is None or gain > best[0]):
            best = gain, sizes, np.array(these)
    if best is None:
        return None
    _, sizes, picked = best
    start = film.copy()
    start[: problem.elastic.moduli] *= sizes[0]
    x = problem.vector(start, sizes[1:] / sizes[0], times[picked], zeros)
    low, high = problem.bounds(x)
    found: Array = np.clip(x, low, high)
    return found


def _pays(problem: TimedProblem, fewer: Point, more: Point) -> tuple[float, bool]:
    """The misfit of the richer fit, and whether its branch is earned."""
    scale = misfit(problem, more)
    earned = aicc(problem, more, scale) < aicc(problem, fewer, scale) - EARNED
    return scale, earned and held_out(problem, more) < PREDICTED * held_out(problem, fewer)


def count_branches(problem: TimedProblem, start: Array, wanted: int | None) -> list[Count]:
    """The sheet with 0, 1, ... branches up to those that pay, or without and with as many as are ``wanted``."""
    points = [problem.minimise(start)]
    scale = 1.0
    for number in range(1, (MOST if wanted is None else wanted) + 1):
        fewer = points[-1]
        begin = guess(problem, fewer, number)
        if begin is None:
            break
        point = problem.minimise(begin)
        found, pays = _pays(problem, fewer, point)
        if pays and aicc(problem, fewer, found) - aicc(problem, point, found) < CLEAR:
            # A valley that was left half way looks like a gain: both to their ends, the one with less from the other.
            film = problem.split(point.x)[0]
            other = np.concatenate((film, fewer.x[film.size :]))
            ends = [problem.minimise(start, last=True) for start in (fewer.x, other)]
            points[-1] = fewer = min(ends, key=lambda one: one.cost)
            point = problem.minimise(point.x, last=True)
            found, pays = _pays(problem, fewer, point)
        if wanted is None and not pays:
            break
        scale = found
        points.append(point)
    criteria = [aicc(problem, one, scale) for one in points]
    return [
        Count(problem.count(one.x), one, value - min(criteria), held_out(problem, one))
        for one, value in zip(points, criteria, strict=True)
    ]


def unseen(problem: TimedProblem, point: Point, scale: float) -> list[tuple[float, float]]:
    """Of relaxation times (s): from which ratio on a branch, if it were alone, would be found; inf where none would."""
    free = free_columns(problem, point)
    n, k = problem.numbers, problem.count(point.x)
    free[n : n + 2 * k] = False
    u, s, _ = np.linalg.svd(point.jacobian[:, free], full_matrices=False)
    base = u[:, s > 1e-10 * s[0]]
    times = grid(problem, DECADES_BEYOND)
    _, added = problem.of_one(problem.split(point.x)[0], times)
    found = []
    for time, shape in zip(times, added / problem.sigma, strict=True):
        rows = np.concatenate((shape, np.zeros(len(problem.records))))
        visible = float(np.linalg.norm(rows - base @ (base.T @ rows)))
        needed = (math.sqrt(EARNED + 4.0) + ALMOST_SURE) * math.sqrt(scale)
        size = needed / visible if visible > 1e-3 * float(np.linalg.norm(rows)) else math.inf
        found.append((float(time), size if size <= FAR else math.inf))
    return found
