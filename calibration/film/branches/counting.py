"""How many branches there are, as far as data tell: criteria that are the same for films in cones and for sheets.

A branch is searched for among many relaxation times, so it must explain more than its two numbers would by chance: AICc
has to fall by `EARNED`, and what is left out has to be predicted no worse. That leaves one false branch in some hundred
elastic films.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from calibration.film.branches.result import FAR, LeftOut

Array = NDArray[np.float64]

EARNED = 7.0  # by which AICc must fall for another branch
CLEAR = 60.0  # of AICc: a gain that neither chance nor an unfinished search explains
PREDICTED = 1.02  # what is left out may be predicted worse by this factor at most
MOST = 3  # branches that are looked for
PER_DECADE = 4  # relaxation times that a search tries
GROUPS = 8  # parts of the records that are left out in turn
ALMOST_SURE = 1.6449  # standard deviations that 95 of 100 stay below
DECADES_BEYOND = 1.3  # of the window, for branches that are not seen
SEARCHED = 1.0 / 3.0, 10.0  # of the ends of the window: a time is not held at an end that it lies beyond
APART = 0.5  # decades: a branch nearer to another one is one with it
OCCURS = 0.02, 2.0  # ratios of branches
MOST_LIKELY = 50.0  # logarithm of a likelihood over that without: what is more is as sure
RATIOS = 25  # of them, evenly in the logarithm, that an average is taken of


class Fitted(Protocol):
    """A fit. The last residuals are those of the errors that are fitted along, the last numbers of x."""

    @property
    def x(self) -> Array:
        """The numbers that are fitted."""

    @property
    def residual(self) -> Array:
        """Of the data, then of the errors, over their standard deviations."""

    @property
    def jacobian(self) -> Array:
        """Derivatives of the residuals by x."""

    @property
    def cost(self) -> float:
        """Chi-square."""


class Problem(Protocol):
    """What has branches: a film in a cone or a sheet, with its records."""

    @property
    def window(self) -> tuple[float, float]:
        """Shortest and longest relaxation time (s) that is looked for."""

    @property
    def independent(self) -> float:
        """How many samples are held against the model, as those count that are independent."""

    @property
    def stretches(self) -> NDArray[np.intp]:
        """Which stretch of which record every residual of the data is of; -1 where it is left out."""

    def count(self, x: Array) -> int:
        """How many branches ``x`` has."""

    def bounds(self, x: Array) -> tuple[Array, Array]:
        """Limits of ``x``."""

    def varied(self, x: Array) -> NDArray[np.bool_]:
        """Entries of ``x`` that are fitted."""


P = TypeVar("P", bound=Fitted)


@dataclass(frozen=True, eq=False)
class Count(Generic[P]):
    """A number of branches, fitted: AICc over its least, and how it predicts what is left out."""

    branches: int
    point: P
    aicc: float
    left_out: LeftOut


def free_columns(problem: Problem, point: Fitted) -> NDArray[np.bool_]:
    """Entries of x that are fitted and at no bound."""
    low, high = problem.bounds(point.x)
    span = np.where(np.isfinite(high - low), high - low, 1.0)
    inside = np.minimum(point.x - low, high - point.x) > 1e-6 * span
    found: NDArray[np.bool_] = problem.varied(point.x) & inside
    return found


def unknown_columns(problem: Problem, point: Fitted) -> NDArray[np.bool_]:
    """Entries of x that are uncertain: what is free, and times at an end of the search, which is no knowledge."""
    free, count = free_columns(problem, point), problem.count(point.x)
    errors = point.residual.size - problem.stretches.size
    last = point.x.size - errors
    free[last - count : last] |= point.x[last - 2 * count : last - count] > 0.0
    return free


def numbers(problem: Problem, point: Fitted) -> int:
    """How many numbers of film and branches were fitted."""
    errors = point.residual.size - problem.stretches.size
    return int(free_columns(problem, point)[: point.x.size - errors].sum())


def misfit(problem: Problem, point: Fitted) -> float:
    """Chi-square over its freedom where that is no chance, times how many bins err together; 1 where it is."""
    stretches = problem.stretches
    data = point.residual[: stretches.size][stretches >= 0]
    freedom = max(1, data.size - numbers(problem, point))
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


def aicc(problem: Problem, point: Fitted, scale: float) -> float:
    """Of all samples, as those count that are independent; ``scale`` is the misfit of the richest model."""
    fitted = numbers(problem, point)
    crowding = 2.0 * fitted * (fitted + 1) / max(1.0, problem.independent - fitted - 1)
    return point.cost / scale + 2.0 * fitted + crowding


def left_out(problem: Problem, point: Fitted) -> LeftOut:
    """How a fit to the rest predicts each part of the records in turn (to first order); noise as the misfit has it."""
    columns = point.jacobian[:, free_columns(problem, point)]
    norms = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(norms > 0.0, norms, 1.0)
    stretches = problem.stretches
    kept = stretches >= 0
    order = np.unique(stretches[kept])
    parts = np.array_split(order, min(GROUPS, order.size))
    _, rank, whole = _least(columns, point.residual)
    total, found = 0.0, []
    for mine in parts:
        out = np.zeros(point.residual.size, dtype=np.bool_)
        out[: stretches.size] = np.isin(stretches, mine)
        step, known, rest = _least(columns[~out], point.residual[~out])
        there = point.residual[out] + columns[out] @ step
        total += float(there @ there)
        freedom = max(1, int(out.sum()) - (rank - known))
        found.append((freedom, max(0.0, whole - rest)))
    # A few numbers, as those next to where a film hangs slack, do not tell of another law.
    telling = [one for one in found if one[0] >= rank] or found
    return LeftOut.judged(math.sqrt(total / int(kept.sum())), telling, misfit(problem, point))


def _least(columns: Array, residual: Array) -> tuple[Array, int, float]:
    """The least-squares step, how many directions it takes, and chi-square after it."""
    found, _, rank, _ = np.linalg.lstsq(columns, -residual, rcond=1e-10)
    step: Array = found.astype(np.float64)
    left = residual + columns @ step
    return step, int(rank), float(left @ left)


def pays(problem: Problem, fewer: Fitted, more: Fitted) -> tuple[float, bool]:
    """The misfit of the richer fit, and whether its branch is earned."""
    scale = misfit(problem, more)
    earned = gain(problem, fewer, more, scale) > EARNED
    return scale, earned and left_out(problem, more).noise < PREDICTED * left_out(problem, fewer).noise


def gain(problem: Problem, fewer: Fitted, more: Fitted, scale: float) -> float:
    """By how much AICc falls from one fit to the other."""
    return aicc(problem, fewer, scale) - aicc(problem, more, scale)


def counted(problem: Problem, points: Sequence[P], scale: float) -> list[Count[P]]:
    """Fits with their criteria."""
    criteria = [aicc(problem, one, scale) for one in points]
    return [
        Count(problem.count(one.x), one, value - min(criteria), left_out(problem, one))
        for one, value in zip(points, criteria, strict=True)
    ]


def grid(problem: Problem, beyond: float) -> Array:
    """Relaxation times (s) over the window and ``beyond`` it by so many decades."""
    shortest, longest = problem.window
    longest *= 10.0**beyond
    return np.geomspace(shortest, longest, max(2, round(PER_DECADE * math.log10(longest / shortest)) + 1))


def searched(window: tuple[float, float]) -> tuple[float, float]:
    """Logarithms of the shortest and the longest relaxation time (s) that a fit may come to."""
    short, long = (math.log(end * factor) for end, factor in zip(window, SEARCHED, strict=True))
    return short, long


def further_times(problem: Problem, found: Array, last: float) -> Array:
    """Relaxation times (s), up to the ``last``, of branches that may stand unseen beside those that were ``found``."""
    near = np.concatenate((found * 10.0**-APART, found * 10.0**APART))
    times = np.union1d(grid(problem, DECADES_BEYOND), near[near >= problem.window[0]])
    away = np.abs(np.log10(times[:, None] / found)).min(axis=1, initial=math.inf)
    chosen: Array = times[(away > APART - 1e-9) & (times <= last)]
    return chosen


def hidden(point: Fitted, free: NDArray[np.bool_], rows: Array, scale: float) -> Array:
    """What further branches add to the residuals that may be there unseen, each with a ratio that is to be expected.

    ``rows`` are what they add with a ratio of one (branches, residuals). The ratio is the root mean square over those
    that occur, weighted by how well they go with the data beside what is ``free``, where it is as probable before as
    not that there is one.
    """
    u, s, _ = np.linalg.svd(point.jacobian[:, free], full_matrices=False)
    base = u[:, s > 1e-10 * s[0]]
    ratios = np.geomspace(*OCCURS, RATIOS)
    found = np.zeros_like(rows)
    for one, row in zip(found, rows, strict=True):
        visible = row - base @ (base.T @ row)
        along, square = float(visible @ point.residual) / scale, float(visible @ visible) / scale
        gain = -2.0 * along * ratios - square * ratios**2  # by which chi-square falls
        likely = np.exp(np.minimum(0.5 * gain, MOST_LIKELY))
        one[:] = math.sqrt(float((likely * ratios**2).sum()) / (RATIOS + float(likely.sum()))) * row
    return found


def shifted(response: Array, times: Array, rows: Array) -> tuple[float, float]:
    """The largest shift of a number by one of the branches that are `hidden`, and the relaxation time (s) of that one.

    ``response`` is what a change of the residuals does to the number.
    """
    if not times.size:
        return 0.0, 0.0
    sizes = np.abs(rows @ response)
    worst = int(np.argmax(sizes))
    return float(sizes[worst]), float(times[worst])


def shows_from(point: Fitted, free: NDArray[np.bool_], rows: Array, scale: float) -> list[float]:
    """From which ratio on a further branch would be found beside what is ``free``; inf where none that occurs would.

    ``rows`` are what further branches of ratio one add to the residuals (branches, residuals).
    """
    u, s, _ = np.linalg.svd(point.jacobian[:, free], full_matrices=False)
    base = u[:, s > 1e-10 * s[0]]
    needed = (math.sqrt(EARNED + 4.0) + ALMOST_SURE) * math.sqrt(scale)
    found = []
    for one in rows:
        visible = float(np.linalg.norm(one - base @ (base.T @ one)))
        size = needed / visible if visible > 1e-3 * float(np.linalg.norm(one)) else math.inf
        found.append(size if size <= FAR else math.inf)
    return found
