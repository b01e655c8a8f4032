"""Histories as polygons: where values over time bend, and bins of time along the stretches between the bends.

A history is solved along a polygon, because steps of time end where it bends. Bins are even, and grow in proportion to
the time since the last bend, where a film relaxes in the logarithm of time.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SIGMAS = 5.5  # of its noise, by which a reading may lie off its polygon: one in 10^7
EVEN, PER_DECADE = 16, 12  # bins of a stretch of a history: evenly, and in the logarithm of the time since it began
FIRST = 2.0  # periods of the samples: the first of the latter
MOST_BENDS = 400  # of a run
MAD = 0.6745 * math.sqrt(6.0)  # of second differences of white noise, over its standard deviation


def knots_of(t: Array, values: Sequence[Array], least: Sequence[float], period: float) -> Array:
    """Times (s) at which any of the ``values`` bends; each may lie off its polygon by its ``least`` of its largest."""
    bends: set[int] = set()
    allowed = []
    for one, part in zip(values, least, strict=True):
        allowed.append(max(SIGMAS * _noise(one), part * float(one.max()), 1e-12))
        bends |= set(_few_bends(t, one, allowed[-1]))
    at = _apart(t, np.array(sorted(bends)), FIRST * period)
    knots = _pruned(t, t[at], values, [0.25 * one for one in allowed])
    return _sharpened(t, knots, values, allowed, 3.0 * period)


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


def edges_of(length: float, period: float) -> Array:
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


def bin_numbers(t: Array, knots: Array, period: float) -> tuple[NDArray[np.intp], NDArray[np.intp], int]:
    """Of every sample the stretch between ``knots`` (s) and the bin that it is in; and how many bins there are."""
    part = np.clip(np.searchsorted(knots, t, side="left") - 1, 0, knots.size - 2)
    number, count = np.empty(t.size, dtype=np.intp), 0
    for k in np.unique(part):
        mine = part == k
        edges = edges_of(knots[k + 1] - knots[k], period)
        _, number[mine] = np.unique(np.searchsorted(edges, t[mine] - knots[k]), return_inverse=True)
        number[mine] += count
        count = int(number[mine].max()) + 1
    return part, number, count


def lines_through(time: Array, mean: Array, segment: NDArray[np.intp], t: Array, number: NDArray[np.intp]) -> Array:
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
    found, spans = [0, t.size - 1], [(0, t.size - 1)]
    while spans:
        left, right = spans.pop()
        if right - left < 2:
            continue
        part = slice(left, right + 1)
        line = values[left] + (values[right] - values[left]) * (t[part] - t[left]) / (t[right] - t[left])
        off = np.abs(values[part] - line)
        worst = left + int(off.argmax())
        if off[worst - left] > allowed and left < worst < right:
            found.append(worst)
            spans += [(left, worst), (worst, right)]
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


def _pruned(t: Array, knots: Array, values: Sequence[Array], allowed: list[float]) -> Array:
    """Knots without those at which the polygons of all values bend by less than is ``allowed``."""
    stretches = [Stretches.of(t, one, knots) for one in values]
    while knots.size > 2:
        share = np.diff(knots)[:-1] / (knots[2:] - knots[:-2])
        bend = np.zeros(knots.size - 2)
        for one, most in zip(stretches, allowed, strict=True):
            found = one.polygon(knots)
            bend = np.maximum(bend, np.abs(found[1:-1] - found[:-2] - share * (found[2:] - found[:-2])) / most)
        least = int(bend.argmin())
        if bend[least] >= 1.0:
            break
        knots = np.delete(knots, least + 1)
        stretches = [one.without(least + 1) for one in stretches]
    return knots


def _sharpened(t: Array, knots: Array, values: Sequence[Array], allowed: list[float], most: float) -> Array:
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


def through(t: Array, values: Array, knots: Array) -> Array:
    """Values at the knots of the polygon nearest to all values (least squares)."""
    return Stretches.of(t, values, knots).polygon(knots)


@dataclass(frozen=True, eq=False)
class Stretches:
    """What a polygon needs of the samples of every stretch between its knots, about their means (Chan et al. 1983).

    count : samples; t, value : their means; wide, tilt : sums of the squares of the times about their mean, and of
    their products with the values; reading : the value at every knot
    """

    count: Array
    t: Array
    value: Array
    wide: Array
    tilt: Array
    reading: Array

    @classmethod
    def of(cls, t: Array, values: Array, knots: Array) -> Self:
        """From the samples."""
        n = knots.size - 1
        place = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, n - 1)
        count = np.bincount(place, minlength=n).astype(float)
        some = np.maximum(count, 1.0)
        mean, level = np.bincount(place, t, n) / some, np.bincount(place, values, n) / some
        off = t - mean[place]
        wide, tilt = (np.bincount(place, one, n).astype(float) for one in (off * off, off * values))
        return cls(count, mean, level, wide, tilt, np.interp(knots, t, values))

    def without(self, knot: int) -> Self:
        """The same samples with one knot less."""
        k = slice(knot - 1, knot + 1)
        count, total = self.count[k], max(float(self.count[k].sum()), 1.0)
        between = float(count.prod()) / total
        apart = float(self.t[knot] - self.t[knot - 1]), float(self.value[knot] - self.value[knot - 1])

        def joined(values: Array, one: float) -> Array:
            return np.concatenate((values[: knot - 1], [one], values[knot + 1 :]))

        return type(self)(
            joined(self.count, float(count.sum())),
            joined(self.t, float(count @ self.t[k]) / total),
            joined(self.value, float(count @ self.value[k]) / total),
            joined(self.wide, float(self.wide[k].sum()) + between * apart[0] ** 2),
            joined(self.tilt, float(self.tilt[k].sum()) + between * apart[0] * apart[1]),
            np.delete(self.reading, knot),
        )

    def polygon(self, knots: Array) -> Array:
        """Values at the knots, with least squares."""
        from scipy.linalg import solveh_banded

        length = np.diff(knots)
        share = (self.t - knots[:-1]) / length  # of a stretch, at the mean of its samples
        wide, tilt = self.wide / length**2, self.tilt / length
        n = knots.size
        own, right, band = np.zeros(n), np.zeros(n), np.zeros((2, n))
        own[:-1] = self.count * (1.0 - share) ** 2 + wide
        own[1:] += self.count * share**2 + wide
        right[:-1] = self.count * (1.0 - share) * self.value - tilt
        right[1:] += self.count * share * self.value + tilt
        weak = 1e-6 * float(own.max())  # a stretch of a few samples keeps the readings at its ends
        band[0, 1:], band[1] = self.count * share * (1.0 - share) - wide, own + weak
        found: Array = solveh_banded(band, right + weak * self.reading)
        return found
