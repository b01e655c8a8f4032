"""How many branches a sheet has, as far as its tests tell, and which others it could have unseen.

By the criteria of a film in a cone (`calibration.film.branches.counting`).
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from calibration.film.branches.counting import (
    CLEAR,
    DECADES_BEYOND,
    MOST,
    Count,
    counted,
    free_columns,
    further_times,
    gain,
    grid,
    hidden,
    pays,
    shows_from,
)
from calibration.sheet.timed.problem import Point, TimedProblem

Array = NDArray[np.float64]


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


def count_branches(problem: TimedProblem, start: Array, wanted: int | None) -> list[Count[Point]]:
    """The sheet with 0, 1, ... branches up to those that pay, or without and with as many as are ``wanted``."""
    points = [problem.minimise(start)]
    scale, accepted = 1.0, 0
    for number in range(1, (MOST if wanted is None else wanted) + 1):
        fewer = points[accepted]
        begin = guess(problem, fewer, number)
        if begin is None:
            break
        point = problem.minimise(begin)
        found, earned = pays(problem, fewer, point)
        if earned and gain(problem, fewer, point, found) < CLEAR:
            # A valley that was left half way looks like a gain: both to their ends, the one with less from the other.
            film = problem.split(point.x)[0]
            other = np.concatenate((film, fewer.x[film.size :]))
            ends = [problem.minimise(start, last=True) for start in (fewer.x, other)]
            points[accepted] = fewer = min(ends, key=lambda one: one.cost)
            point = problem.minimise(point.x, last=True)
            found, earned = pays(problem, fewer, point)
        points.append(point)
        if wanted is not None or earned:
            scale, accepted = found, number
        elif number > accepted + 1 or not gain(problem, fewer, point, found) > CLEAR:
            break  # else it explains much and predicts badly, as one branch does where two are missing: one more
    points = points[: accepted + 1]
    return counted(problem, points, scale)


def unseen(problem: TimedProblem, point: Point, scale: float) -> list[tuple[float, float]]:
    """Of relaxation times (s): from which ratio on a branch, if it were alone, would be found; inf where none would."""
    free = free_columns(problem, point)
    n, k = problem.numbers, problem.count(point.x)
    free[n : n + 2 * k] = False
    times = grid(problem, DECADES_BEYOND)
    return list(zip(times.tolist(), shows_from(point, free, _added(problem, point, times), scale), strict=True))


def _added(problem: TimedProblem, point: Point, times: Array) -> Array:
    """What branches of ratio one add to the residuals (times, residuals)."""
    _, added = problem.of_one(problem.split(point.x)[0], times)
    return np.concatenate((added / problem.sigma, np.zeros((times.size, len(problem.records)))), axis=1)


def beside(problem: TimedProblem, point: Point, scale: float, last: float) -> tuple[Array, Array]:
    """Relaxation times (s) of branches that may hide beside those found, and what each adds to the residuals."""
    times = further_times(problem, problem.split(point.x)[2], last)
    return times, hidden(point, free_columns(problem, point), _added(problem, point, times), scale)
