"""How many branches a film has, as far as a record tells, and which others it could have unseen.

A branch is searched for among many relaxation times, so it must explain more than its two numbers would by chance: AICc
has to fall by `EARNED`, and what is left out has to be predicted no worse. That leaves one false branch in some hundred
elastic films.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.film.branches.joint import SOFTENING, Joint, Point
from calibration.film.branches.response import with_branches
from calibration.film.branches.result import FAR, USUAL
from calibration.film.propagation import Covariance

Array = NDArray[np.float64]

EARNED = 7.0  # by which AICc must fall for another branch
PREDICTED = 1.02  # what is left out may be predicted worse by this factor at most
MOST = 3  # branches that are looked for
PER_DECADE = 4  # relaxation times that a search tries
GROUPS = 8  # parts of the records that are left out in turn
ALMOST_SURE = 1.6449  # standard deviations that 95 of 100 stay below
DECADES_BEYOND = 1.3  # of the window, for branches that are not seen


@dataclass(frozen=True, eq=False)
class Count:
    """A number of branches, fitted: AICc over its least, root mean square of what was left out over its noise."""

    branches: int
    point: Point
    aicc: float
    held_out: float


def free_columns(joint: Joint, point: Point) -> NDArray[np.bool_]:
    """Entries of x that are fitted and at no bound."""
    low, high = joint.bounds(point.x)
    span = np.where(np.isfinite(high - low), high - low, 1.0)
    inside = np.minimum(point.x - low, high - point.x) > 1e-6 * span
    return joint.varied(point.x) & inside


def guess(joint: Joint, from_: Point, more: int) -> Array | None:
    """A start with so many branches ``more`` than a fit has: the best times of a grid, all else to first order.

    None where they would explain too little to be worth it. Of the law the modulus alone may change: exponents far from
    their minimum excuse anything.
    """
    x, moduli = from_.x, joint.coordinates.moduli
    times = grid(joint, 0.0)
    film = joint.film(x)
    shapes = np.zeros((times.size, from_.residual.size))
    added = [one.added(film, times) for one in joint.responses]
    shapes[:, : joint.force.size] = np.concatenate(added, axis=1) / joint.sigma
    others = joint.varied(x)
    others[: joint.coordinates.film_numbers] = False
    columns = np.column_stack((from_.jacobian[:, :moduli] @ x[:moduli], from_.jacobian[:, others]))
    base, _ = np.linalg.qr(columns)
    left = shapes.T - base @ (base.T @ shapes.T)
    residual = from_.residual - base @ (base.T @ from_.residual)
    gram, along = left.T @ left, -left.T @ residual
    best, least, chosen = None, 0.0, None
    for these in itertools.combinations(range(times.size), more):
        pick = np.array(these)
        own = gram[np.ix_(pick, pick)]
        ratio = np.linalg.solve(own + 1e-9 * np.diag(np.diag(own)), along[pick])
        gain = -float(along[pick] @ ratio)
        if (ratio > 0.0).all() and gain < least:
            best, least, chosen = ratio, gain, pick
    if best is None or chosen is None or -least < EARNED + 4.0:
        return None
    step = np.linalg.lstsq(columns, -from_.residual - shapes[chosen].T @ best, rcond=None)[0]
    softer = float(np.clip(1.0 + step[0], 0.1, 1.5))
    start = x.copy()
    start[others] += step[1:]
    start[:moduli] *= softer
    low, high = joint.bounds(start)
    start = np.clip(start, low, high)
    n, k = len(joint.coordinates.names), joint.count(x)
    ratio = np.concatenate((start[n : n + k], best / softer))
    time = np.concatenate((np.exp(start[n + k : n + 2 * k]), times[chosen]))
    return joint.vector(with_branches(joint.coordinates.film(start), ratio, time), start[n + 2 * k :])


def grid(joint: Joint, beyond: float) -> Array:
    """Relaxation times (s) over the window and ``beyond`` it by so many decades."""
    shortest, longest = joint.window()
    longest *= 10.0**beyond
    return np.geomspace(shortest, longest, max(2, round(PER_DECADE * math.log10(longest / shortest)) + 1))


def misfit(joint: Joint, point: Point) -> float:
    """Chi-square over its freedom where that is no chance, times how many bins err together; 1 where it is."""
    data = point.residual[: joint.force.size][joint.kept]
    freedom = data.size - int(free_columns(joint, point)[: point.x.size - len(joint.nuisances)].sum())
    ratio = float(data @ data) / max(1, freedom)
    if not ratio > 1.0 + 3.0 * math.sqrt(2.0 / max(1, freedom)):
        return 1.0
    together = 1.0
    for lag in range(1, data.size // 4):
        rho = float(data[lag:] @ data[:-lag]) / float(data @ data)
        if rho < 2.0 / math.sqrt(data.size):
            break
        together += 2.0 * rho
    return ratio * together


def aicc(joint: Joint, point: Point, scale: float) -> float:
    """Of all samples, as those count that are independent; ``scale`` is the misfit of the richest model."""
    effective = joint.samples / joint.correlation_time
    numbers = int(free_columns(joint, point)[: point.x.size - len(joint.nuisances)].sum())
    crowding = 2.0 * numbers * (numbers + 1) / max(1.0, effective - numbers - 1)
    return point.cost / scale + 2.0 * numbers + crowding


def held_out(joint: Joint, point: Point) -> float:
    """Root mean square over noise of what a fit without it says of each part of the records (to first order)."""
    free = free_columns(joint, point)
    columns, total = point.jacobian[:, free], 0.0
    count = joint.force.size
    kept = joint.kept
    segments = np.concatenate([one.segment + 1000 * k for k, one in enumerate(joint.bins)])
    order = np.unique(segments[kept])
    for mine in np.array_split(order, min(GROUPS, order.size)):
        out = np.zeros(point.residual.size, dtype=np.bool_)
        out[:count] = np.isin(segments, mine) & kept
        step = np.linalg.lstsq(columns[~out], -point.residual[~out], rcond=1e-10)[0]
        there = point.residual[out] + columns[out] @ step
        total += float(there @ there)
    return math.sqrt(total / joint.data)


def count_branches(joint: Joint, start: Array, wanted: int | None) -> list[Count]:
    """The film with 0, 1, ... branches up to those that pay, or without and with as many as are ``wanted``.

    The last one is the answer. Where the forces look like a film that softens from cycle to cycle, the same is done
    with a softening of every cycle fitted along, and taken if it pays as a branch must.
    """
    plain = _Counting(joint, start, wanted)
    terms = sum(one.kind == SOFTENING for one in joint.nuisances)
    if not terms or not softens_perhaps(joint, plain.points[-1]):
        return plain.counts()
    state, kept = joint.state, joint.kept
    joint.soften = True
    softened = _Counting(joint, start, wanted)
    here, there = plain.points[-1], softened.points[-1]
    if joint.kept is not kept:
        joint.soften = False
        here = joint.fit(here.x)
        state = joint.state
        joint.soften = True
        there = joint.fit(there.x)
    scale = misfit(joint, there)
    gain = aicc(joint, here, scale) - aicc(joint, there, scale) - 2.0 * terms
    softer_by = [one.prior * (one.kind == SOFTENING) for one in joint.nuisances]
    if gain > EARNED and float(there.x[there.x.size - len(softer_by) :] @ softer_by) > 0.0:
        softened.points[-1] = there
        return softened.counts()
    joint.soften, joint.state = False, state
    plain.points[-1] = here
    return plain.counts()


def softens_perhaps(joint: Joint, point: Point) -> bool:
    """Whether a softening of every cycle would explain more of what a fit leaves over than chance does."""
    first = point.x.size - len(joint.nuisances)
    columns = [first + k for k, one in enumerate(joint.nuisances) if one.kind == SOFTENING]
    free = free_columns(joint, point)
    with_them = free.copy()
    with_them[columns] = True
    left = []
    for chosen in (free, with_them):
        part = point.jacobian[:, chosen]
        rest = point.residual - part @ np.linalg.lstsq(part, point.residual, rcond=1e-10)[0]
        left.append(float(rest @ rest))
    return left[0] - left[1] > EARNED + 2.0 * len(columns)


class _Counting:
    """Fits with a rising number of branches."""

    def __init__(self, joint: Joint, start: Array, wanted: int | None) -> None:
        self.joint, self.points, self.scale = joint, [joint.fit(start)], 1.0
        for number in range(1, (MOST if wanted is None else wanted) + 1):
            state, kept = joint.state, joint.kept
            point = _fitted(joint, self.points, number)
            if point is None:
                joint.state = state
                break
            if joint.kept is not kept:  # fewer bins: what was fitted to more is fitted again
                self.points = [joint.fit(one.x) for one in self.points]
                state = joint.state
                point = joint.fit(point.x)
            fewer = self.points[-1]
            scale = misfit(joint, point)
            pays = aicc(joint, point, scale) < aicc(joint, fewer, scale) - EARNED
            pays &= held_out(joint, point) < PREDICTED * held_out(joint, fewer)
            if wanted is None and not pays:
                joint.state = state
                break
            self.scale = scale
            self.points.append(point)

    def counts(self) -> list[Count]:
        """Each with its criteria."""
        criteria = [aicc(self.joint, one, self.scale) for one in self.points]
        return [
            Count(self.joint.count(one.x), one, value - min(criteria), held_out(self.joint, one))
            for one, value in zip(self.points, criteria, strict=True)
        ]


def _fitted(joint: Joint, points: Sequence[Point], number: int) -> Point | None:
    """The fit with so many branches, begun from the elastic one or from that with one branch less."""
    starts = [guess(joint, points[0], number), guess(joint, points[-1], 1) if number > 1 else None]
    best, least = None, math.inf
    for start in starts:
        if start is not None:
            joint.settle(start)
            cost = joint.evaluate(start).cost
            if cost < least:
                best, least = start, cost
    return None if best is None else joint.fit(best)


@dataclass(frozen=True, eq=False)
class Unseen:
    """A branch more: its relaxation time (s), from which ratio on it would show (inf: none that occurs), its shape."""

    time: float
    shows_from: float
    shape: Array

    @property
    def size(self) -> float:
        """The largest ratio that may be there unseen; the usual one where none would show."""
        return self.shows_from if math.isfinite(self.shows_from) else USUAL


def unseen(joint: Joint, point: Point, scale: float, *, alone: bool = False) -> list[Unseen]:
    """From which ratio on a further branch of each relaxation time would be found, or any if it were ``alone``."""
    free = free_columns(joint, point)
    if alone:
        first, count = len(joint.coordinates.names), joint.count(point.x)
        free[first : first + 2 * count] = False
    u, s, _ = np.linalg.svd(point.jacobian[:, free], full_matrices=False)
    base = u[:, s > 1e-10 * s[0]]
    times = grid(joint, DECADES_BEYOND)
    film = joint.film(point.x)
    found = []
    shapes = np.concatenate([one.added(film, times) for one in joint.responses], axis=1) / joint.sigma
    for time, shape in zip(times, shapes, strict=True):
        rows = np.concatenate((shape, np.zeros(len(joint.nuisances))))
        visible = float(np.linalg.norm(rows - base @ (base.T @ rows)))
        needed = (math.sqrt(EARNED + 4.0) + ALMOST_SURE) * math.sqrt(scale)
        size = needed / visible if visible > 1e-3 * float(np.linalg.norm(rows)) else math.inf
        found.append(Unseen(float(time), size if size <= FAR else math.inf, rows))
    return found


def covariance(joint: Joint, point: Point) -> Covariance:
    """Linear propagation at a minimum; the shape parameters lie in their ranges (rectangular: JCGM 100:2008, 4.3.7)."""
    first, last = joint.coordinates.moduli, joint.coordinates.film_numbers
    width = np.array([high - low for low, high in (one.search for one in joint.coordinates.parameters[first:])])
    known = np.eye(last - first, point.x.size, first)
    if width.size:
        known = known * (math.sqrt(12.0) / width)[:, None]
    return Covariance(np.concatenate((point.jacobian, known)), free_columns(joint, point))
