"""How many branches a film has, as far as a record tells, and which others it could have unseen (`counting`)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.film.branches.counting import (
    CLEAR,
    DECADES_BEYOND,
    EARNED,
    MOST,
    Count,
    counted,
    free_columns,
    further_times,
    gain,
    grid,
    hidden,
    misfit,
    pays,
    shows_from,
    unknown_columns,
)
from calibration.film.branches.joint import SOFTENING, Joint, Point, State
from calibration.film.branches.response import with_branches
from calibration.film.branches.result import USUAL
from calibration.film.propagation import Covariance

Array = NDArray[np.float64]


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
    shapes[:, : joint.force.size] = np.where(joint.kept, np.concatenate(added, axis=1) / joint.sigma, 0.0)
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


def count_branches(joint: Joint, start: Array, wanted: int | None) -> list[Count[Point]]:
    """The film with 0, 1, ... branches up to those that pay, or without and with as many as are ``wanted``.

    The last one is the answer. Where the forces look like a film that softens from cycle to cycle, the same is done
    with a softening of every cycle fitted along, and taken if it pays as a branch must.
    """
    plain = _Counting(joint, start, wanted)
    terms = sum(one.kind == SOFTENING for one in joint.nuisances)
    if not terms or not softens_perhaps(joint, plain.fits[-1].point):
        return plain.counts()
    joint.soften, joint.within = True, np.ones_like(joint.kept)
    softened = _Counting(joint, start, wanted)
    there = softened.fits[-1].point
    joint.soften = False
    plain.keep(joint.kept)
    here = plain.fits[-1].point
    joint.soften = True
    scale = misfit(joint, there)
    earned = gain(joint, here, there, scale) - 2.0 * terms > EARNED
    softer_by = [one.prior * (one.kind == SOFTENING) for one in joint.nuisances]
    if earned and float(there.x[there.x.size - len(softer_by) :] @ softer_by) > 0.0:
        return softened.counts()
    joint.soften = False
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


@dataclass(frozen=True, eq=False)
class _Fit:
    """A fit, and the state of the joint model there."""

    point: Point
    state: State


class _Counting:
    """Fits with a rising number of branches."""

    def __init__(self, joint: Joint, start: Array, wanted: int | None) -> None:
        self.joint, self.scale = joint, 1.0
        self.fits = [_Fit(joint.fit(start), joint.state)]
        accepted, answer = 0, self.fits
        for number in range(1, (MOST if wanted is None else wanted) + 1):
            joint.state = self.fits[-1].state
            joint.within = np.ones_like(joint.kept)
            point = _fitted(joint, [one.point for one in self.fits], number)
            if point is None:
                break
            more = _Fit(point, joint.state)
            self.keep(joint.kept)
            joint.state = more.state
            scale, earned = pays(joint, self.fits[accepted].point, point)
            before, self.fits = self.fits, [*self.fits, more]
            if wanted is not None or earned:
                self.scale, accepted, answer = scale, number, self.fits
                continue
            if number > accepted + 1:
                break
            answer = before
            # Where it explains much and predicts badly, as one branch does where two are missing, two are tried.
            if not gain(joint, before[accepted].point, point, scale) > CLEAR:
                break
        self.fits = answer
        joint.state = self.fits[-1].state

    def keep(self, kept: NDArray[np.bool_]) -> None:
        """The same fits to the bins that are ``kept`` alone: where a richer one is not taut none can be compared."""
        if all(np.array_equal(one.state[2], kept) for one in self.fits):
            return
        again = []
        for one in self.fits:
            self.joint.state = one.state
            again.append(_Fit(self.joint.fewer(one.point, kept), self.joint.state))
        self.fits = again

    def counts(self) -> list[Count[Point]]:
        """Each with its criteria; the joint model is that of the last one."""
        self.joint.state = self.fits[-1].state
        return counted(self.joint, [one.point for one in self.fits], self.scale)


def _fitted(joint: Joint, points: Sequence[Point], number: int) -> Point | None:
    """The fit with so many branches, begun from the elastic one or from that with one branch less.

    None where no further branch of any time explains enough beside the fit with one less: ratios are not negative and
    forces almost linear in them, so that no other choice of branches does either (Lawson & Hanson 1974, ch. 23).
    """
    further = guess(joint, points[-1], 1)
    if further is None:
        return None
    best, least = further, math.inf
    for start in [further, guess(joint, points[0], number) if number > 1 else None]:
        if start is not None:
            joint.settle(start)
            cost = joint.evaluate(start).cost
            if cost < least:
                best, least = start, cost
    return joint.fit(best)


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
    times = grid(joint, DECADES_BEYOND)
    rows = _added(joint, point, times)
    sizes = shows_from(point, free, rows, scale)
    return [Unseen(float(time), size, row) for time, size, row in zip(times, sizes, rows, strict=True)]


def _added(joint: Joint, point: Point, times: Array) -> Array:
    """What branches of ratio one add to the residuals (times, residuals)."""
    film = joint.film(point.x)
    shapes = np.concatenate([one.added(film, times) for one in joint.responses], axis=1) / joint.sigma
    nothing = np.zeros((times.size, len(joint.nuisances)))
    return np.concatenate((np.where(joint.kept, shapes, 0.0), nothing), axis=1)


def beside(joint: Joint, point: Point, scale: float, last: float) -> tuple[Array, Array]:
    """Relaxation times (s) of branches that may hide beside those found, and what each adds to the residuals."""
    first, count = len(joint.coordinates.names), joint.count(point.x)
    times = further_times(joint, np.exp(point.x[first + count : first + 2 * count]), last)
    return times, hidden(point, free_columns(joint, point), _added(joint, point, times), scale)


def covariance(joint: Joint, point: Point) -> Covariance:
    """Linear propagation at a minimum; the shape parameters lie in their ranges (rectangular: JCGM 100:2008, 4.3.7)."""
    first, last = joint.coordinates.moduli, joint.coordinates.film_numbers
    width = np.array([high - low for low, high in (one.search for one in joint.coordinates.parameters[first:])])
    known = np.eye(last - first, point.x.size, first)
    if width.size:
        known = known * (math.sqrt(12.0) / width)[:, None]
    return Covariance(np.concatenate((point.jacobian, known)), unknown_columns(joint, point))
