"""The whole history of a run: displacement and voltage as polygons, forces as means over short times.

The model is solved along polygons, because the steps of time of `model.membrane.history` end where a history bends.
Forces are averaged over bins that are even in a move and grow in proportion to the time since the last bend, where a
film relaxes in the logarithm of time. Within a bin the force of the elastic film carries each sample to the bin's own
time, so that neither the curvature of the force nor what the polygon leaves off biases the mean.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.film.curve import Curve, CurveError
from calibration.film.reduction import CONTACT_MARGIN

Array = NDArray[np.float64]
Elastic = Callable[[Array, Array], Array]  # force (N) at displacements (m) and voltages (V)

SIGMAS = 5.5  # of its noise, by which a reading may lie off its polygon: one in 10^7
LEAST_H, LEAST_V = 1.5e-3, 3e-3  # of the largest, by which it may lie off whatever the noise
EVEN, PER_DECADE = 16, 12  # bins of a stretch of a history: evenly, and in the logarithm of the time since it began
FIRST = 2.0  # periods of the samples: the first of the latter
MOVED = 20.0  # noises of the displacement: less is a hold
MOST_BENDS = 400  # of a run
MAD = 0.6745 * math.sqrt(6.0)  # of second differences of white noise, over its standard deviation


@dataclass(frozen=True, eq=False)
class Record:
    """One run from its beginning, sample by sample.

    Attributes
    ----------
    errors : Curve
        Any curve of the run: its specimen, and the uncertainties that are stated.
    t, h, voltage, force : ndarray
        Time (s), displacement (m), voltage (V), force (N), rising in time; displacement and voltage without gaps.
    used : ndarray of bool
        Samples whose force is a measurement of the film.
    """

    errors: Curve
    t: Array
    h: Array
    voltage: Array
    force: Array
    used: NDArray[np.bool_]

    @property
    def run(self) -> str:
        """Which log it is from."""
        return self.errors.run

    @property
    def period(self) -> float:
        """Time between samples (s)."""
        return float(np.median(np.diff(self.t)))

    @property
    def span(self) -> float:
        """Length of what is used (s)."""
        used = self.t[self.used]
        return float(used[-1] - used[0]) if used.size else 0.0

    @cached_property
    def history(self) -> tuple[Array, Array, Array]:
        """Times at which the run bends (s), and displacement (m) and voltage (V) there, linear in between."""
        t, h, v = self.t, np.maximum(self.h, 0.0), np.abs(self.voltage)
        bends, allowed = set(), []
        for values, least in ((h, LEAST_H), (v, LEAST_V)):
            allowed.append(max(SIGMAS * _noise(values), least * float(values.max()), 1e-12))
            bends |= set(_few_bends(t, values, allowed[-1]))
        at = _apart(t, np.array(sorted(bends)), FIRST * self.period)
        knots = _pruned(t, t[at], (h, v), [0.25 * one for one in allowed])
        knots = _sharpened(t, knots, (h, v), allowed, 3.0 * self.period)
        found_h, found_v = (np.maximum(_through(t, values, knots), 0.0) for values in (h, v))
        if not v.any():
            found_v[:] = 0.0
        if found_h[0] > 0.0 or found_v[0] > 0.0:  # rested flat before it began
            before = max(FIRST * self.period, 1e-3)
            knots = np.concatenate(([knots[0] - before], knots))
            found_h, found_v = np.concatenate(([0.0], found_h)), np.concatenate(([0.0], found_v))
        return knots, found_h, found_v

    def bins(self, elastic: Elastic) -> Bins:
        """Means of the forces that are used, carried to the bins' own times by the force of an ``elastic`` film."""
        knots, high, volts = self.history
        rows = np.flatnonzero(self.used & (self.t > knots[0]) & (self.t <= knots[-1]))
        part = np.clip(np.searchsorted(knots, self.t[rows], side="left") - 1, 0, knots.size - 2)
        number = np.empty(rows.size, dtype=np.intp)
        count = 0
        for k in np.unique(part):
            mine = part == k
            since = self.t[rows[mine]] - knots[k]
            edges = _edges(knots[k + 1] - knots[k], self.period)
            _, number[mine] = np.unique(np.searchsorted(edges, since), return_inverse=True)
            number[mine] += count
            count = int(number[mine].max()) + 1
        size = np.bincount(number, minlength=count)

        def mean(values: Array) -> Array:
            total: Array = np.bincount(number, values, count) / size
            return total

        t = self.t[rows]
        at_h, at_v = np.interp(t, knots, high), np.interp(t, knots, volts)
        time, segment = mean(t), np.rint(mean(part.astype(float))).astype(np.intp)
        off_h = np.where(self.moving[part], self.h[rows] - at_h, 0.0)
        off_v = np.where(at_v > 0.0, np.abs(self.voltage[rows]) - at_v, 0.0)
        off_h, off_v = mean(off_h)[number], mean(off_v)[number]  # the noise of single readings is none of the film
        there = elastic(np.maximum(at_h + off_h, 0.0), at_v + off_v)
        here = elastic(np.interp(time, knots, high), np.interp(time, knots, volts))
        force = self.force[rows] - there
        mean_force = mean(force)
        noise = force - _lines(time, mean_force, segment, t, number)
        return Bins(self, time, np.interp(time, knots, high), np.interp(time, knots, volts), mean_force + here,
                    size, segment, rows, number, noise)  # fmt: skip

    @cached_property
    def moving(self) -> NDArray[np.bool_]:
        """Which stretches between bends are moves of the disk."""
        _, high, _ = self.history
        return np.asarray(np.abs(np.diff(high)) > max(MOVED * self.errors.displacement_noise, 1e-3 * high.max()))


@dataclass(frozen=True, eq=False)
class Bins:
    """Mean forces of a record: time (s), displacement (m), voltage (V), force (N), samples and stretch of each.

    ``rows`` are the samples that are used, ``number`` the bin of each, ``noise`` (N) what a line through the bins
    leaves over of it.
    """

    record: Record
    time: Array
    h: Array
    voltage: Array
    force: Array
    size: NDArray[np.intp]
    segment: NDArray[np.intp]
    rows: NDArray[np.intp]
    number: NDArray[np.intp]
    noise: Array


def correlation(noise: Array, rows: NDArray[np.intp], most: int) -> float:
    """How many samples carry the information of one independent one: ``1 + 2 sum_k rho_k`` of neighbours, at least 1.

    As `calibration.film.reduction.correlation_time`; over no more than ``most`` samples, as bins are short.
    """
    total, time = float(noise @ noise), 1.0
    if total <= 0.0:
        return 1.0
    for lag in range(1, most):
        together = rows[lag:] - rows[:-lag] == lag
        rho = float(noise[lag:] @ (noise[:-lag] * together)) / total
        if rho < (3.0 if lag == 1 else 2.0) / math.sqrt(noise.size):
            break
        time += 2.0 * rho
    return time


def _edges(length: float, period: float) -> Array:
    """Ends of the bins of a stretch of that length (s), from its beginning."""
    first = FIRST * period
    even = np.linspace(0.0, length, EVEN + 1)[1:]
    if length <= first * EVEN:
        return np.linspace(0.0, length, max(2, int(length / first) + 1))[1:]
    count = max(2, math.ceil(PER_DECADE * math.log10(length / first)) + 1)
    both = np.unique(np.concatenate((np.geomspace(first, length, count), even)))
    kept = [0.0]
    for edge in both:
        if edge - kept[-1] >= min(first, length):
            kept.append(float(edge))
    return np.array([*kept[1:-1], length])


def _lines(time: Array, mean: Array, segment: NDArray[np.intp], t: Array, number: NDArray[np.intp]) -> Array:
    """The line through neighbouring bins of one stretch, at every sample."""
    slope = np.zeros(time.size)
    if time.size > 1:
        rise, run = np.diff(mean), np.diff(time)
        together = np.diff(segment) == 0
        for side in (slice(None, -1), slice(1, None)):
            slope[side] += np.where(together, rise / np.where(run > 0.0, run, 1.0), 0.0)
        neighbours = np.zeros(time.size)
        neighbours[:-1] += together
        neighbours[1:] += together
        slope /= np.maximum(neighbours, 1.0)
    found: Array = mean[number] + slope[number] * (t - time[number])
    return found


def _noise(values: Array) -> float:
    """Standard deviation of white noise on a curve; a value that rests at zero has none, and is left out."""
    second = np.abs(np.diff(values, 2))[np.abs(values[1:-1]) > 0.02 * float(values.max())]
    return float(np.median(second)) / MAD if second.size else 0.0


def _few_bends(t: Array, values: Array, allowed: float) -> list[int]:
    """`_bends`, of no more than `MOST_BENDS`: what has more follows its noise, and is allowed more."""
    found = _bends(t, values, allowed)
    while len(found) > MOST_BENDS:
        allowed *= 1.5
        found = _bends(t, values, allowed)
    return found


def _bends(t: Array, values: Array, allowed: float) -> list[int]:
    """Ends and bends of the polygon that no value is farther off than ``allowed`` (Ramer, Douglas and Peucker)."""
    found, todo = [0, t.size - 1], [(0, t.size - 1)]
    while todo:
        left, right = todo.pop()
        if right - left < 2:
            continue
        part = slice(left, right + 1)
        line = values[left] + (values[right] - values[left]) * (t[part] - t[left]) / (t[right] - t[left])
        off = np.abs(values[part] - line)
        worst = left + int(off.argmax())
        if off[worst - left] > allowed and left < worst < right:
            found.append(worst)
            todo += [(left, worst), (worst, right)]
    return found


def _apart(t: Array, at: NDArray[np.intp], least: float) -> NDArray[np.intp]:
    """Bends that are at least ``least`` (s) apart; the ends are kept."""
    kept = [int(at[0])]
    for k in at[1:]:
        if t[k] - t[kept[-1]] >= least:
            kept.append(int(k))
    if kept[-1] != at[-1]:
        kept[-1] = int(at[-1])
    return np.array(kept)


def _pruned(t: Array, knots: Array, values: tuple[Array, Array], allowed: list[float]) -> Array:
    """Knots without those at which the polygons of all values bend by less than is ``allowed``."""
    while knots.size > 2:
        found = [_through(t, one, knots) for one in values]
        share = np.diff(knots)[:-1] / (knots[2:] - knots[:-2])
        bend = np.zeros(knots.size - 2)
        for one, most in zip(found, allowed, strict=True):
            bend = np.maximum(bend, np.abs(one[1:-1] - one[:-2] - share * (one[2:] - one[:-2])) / most)
        least = int(bend.argmin())
        if bend[least] >= 1.0:
            break
        knots = np.delete(knots, least + 1)
    return knots


def _sharpened(t: Array, knots: Array, values: tuple[Array, Array], allowed: list[float], most: float) -> Array:
    """Bends moved, by ``most`` (s) at most, to where the lines through the stretches beside them cross."""
    first = np.searchsorted(t, knots)
    lines: list[list[tuple[float, float]]] = []
    for one in values:
        mine = []
        for left, right in itertools.pairwise(first):
            rows = slice(left + 2, right - 2)
            if right - left < 12:
                mine.append((math.nan, math.nan))
                continue
            middle = float(t[rows].mean())
            slope = float((t[rows] - middle) @ one[rows] / ((t[rows] - middle) ** 2).sum())
            mine.append((slope, float(one[rows].mean()) - slope * middle))
        lines.append(mine)
    found = knots.copy()
    for k in range(1, knots.size - 1):
        span = min(knots[k] - knots[k - 1], knots[k + 1] - knots[k])
        bends = [abs(mine[k][0] - mine[k - 1][0]) * span / one for mine, one in zip(lines, allowed, strict=True)]
        if not np.isfinite(bends).any():
            continue
        mine = lines[int(np.nanargmax(bends))]
        if mine[k][0] != mine[k - 1][0]:
            cross = (mine[k - 1][1] - mine[k][1]) / (mine[k][0] - mine[k - 1][0])
            if abs(cross - knots[k]) <= min(most, 0.3 * span):
                found[k] = cross
    return found


def _through(t: Array, values: Array, knots: Array) -> Array:
    """Values at the knots of the polygon nearest to all values (least squares)."""
    from scipy.linalg import solveh_banded

    place = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, knots.size - 2)
    share = (t - knots[place]) / (knots[place + 1] - knots[place])
    n = knots.size
    own = np.bincount(place, (1.0 - share) ** 2, n) + np.bincount(place + 1, share**2, n)
    beside = np.bincount(place, share * (1.0 - share), n)[: n - 1]
    right = np.bincount(place, (1.0 - share) * values, n) + np.bincount(place + 1, share * values, n)
    weak = 1e-6 * float(own.max())  # a stretch of a few samples keeps the readings at its ends
    band = np.zeros((2, n))
    band[0, 1:], band[1] = beside, own + weak
    found: Array = solveh_banded(band, right + weak * np.interp(knots, t, values))
    return found


def record_of(whole: Curve, first: float, last: float) -> Record:
    """The record of a run from its samples from the beginning to the end, measured between two times (s).

    ``whole`` is a curve of all samples of the run. What is not known of displacement and voltage in between is taken
    from its neighbours; before the first reading the film rested flat.
    """
    t = whole.time
    if t is None:
        raise CurveError(f"{whole.label}: its samples have no time; branches need it")
    order = np.unique(t, return_index=True)[1]
    t = t[order]
    filled = []
    for values in (whole.h[order], whole.voltage[order]):
        known = np.isfinite(values)
        if not known.any():
            raise CurveError(f"{whole.label}: no reading of displacement or voltage")
        filled.append(np.interp(t, t[known], values[known], left=0.0))
    used = whole.usable[order] & (t >= first) & (t <= last)
    used &= whole.h[order] > max(CONTACT_MARGIN * whole.displacement_zero, 0.0)
    return Record(whole, t, filled[0], filled[1], whole.force[order], used)


_COLUMNS = ("h", "force", "voltage", "direction", "time", "flagged")


def records_of_curves(curves: Sequence[Curve]) -> list[Record]:
    """A record a run from its curves alone: between them disk and voltage went straight from one to the next."""
    found = []
    for run in dict.fromkeys(curve.run for curve in curves):
        mine = [curve for curve in curves if curve.run == run]
        if any(curve.time is None for curve in mine):
            raise CurveError(f"{run}: its samples have no time; branches need it")
        columns: dict[str, Any] = {name: np.concatenate([getattr(one, name) for one in mine]) for name in _COLUMNS}
        whole = replace(mine[0], label=run, **columns)
        found.append(record_of(whole, -math.inf, math.inf))
    return found
