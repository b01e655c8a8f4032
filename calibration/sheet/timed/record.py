"""One test of a sheet over time: its stretches as polygons, its stresses as means over short times."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calibration.film.branches.polygon import bin_numbers, correlation, knots_of, lines_through, through
from calibration.sheet.sheet_tests import HomogeneousTest, TestsError

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Array = NDArray[np.float64]

LEAST = 1.5e-3  # of the largest strain, by which a reading may lie off its polygon whatever the noise
AT_REST = 0.02  # of the largest strain: a test that begins farther from stretch 1 was pulled there before
MOVED = 0.01  # of the largest strain: less is a hold
LEAST_ROWS = 20
LONG = 20  # rows of a bin from which its noise tells correlations
LEAST_NOISE = 1e-4  # of the largest stress: error of the means that no row's noise explains
FALLS = 0.02  # of the largest stress, by which it falls at a held stretch where the sheet takes time


@dataclass(frozen=True, eq=False)
class SheetRecord:
    """A test from its beginning: time (s), stretches, and nominal stresses (Pa, along the first direction; second NaN).

    ``pulled`` says that the test begins stretched, and is taken as pulled there from rest in the time between two rows.
    """

    name: str
    kind: str
    t: Array
    stretch: Array  # (2, n)
    stress: Array  # (2, n)
    pulled: bool

    @classmethod
    def of(cls, test: HomogeneousTest) -> SheetRecord:
        """Of a test whose rows have a time.

        Raises
        ------
        TestsError
            When they have none, or it does not rise.
        """
        whole = test.history
        if whole is None:
            raise TestsError(
                f"{test.name}: its rows have no time; branches need a column of time with its unit "
                "(--column time=NUMBER --unit time=s)"
            )
        t = whole.time
        rising = np.concatenate(([True], t[1:] > np.maximum.accumulate(t)[:-1]))
        if rising.sum() < max(LEAST_ROWS, 0.9 * t.size):
            raise TestsError(
                f"{test.name}: {int(rising.sum())} of {t.size} rows have a time later than all before; at least "
                f"{LEAST_ROWS} and nine in ten are needed"
            )
        stretch = np.stack((whole.stretch1, whole.stretch2))[:, rising]
        stress = np.stack((whole.stress1, whole.stress2))[:, rising]
        largest = float(np.abs(np.log(stretch)).max())
        pulled = bool(np.abs(np.log(stretch[:, 0])).max() > AT_REST * largest)
        return cls(test.name, test.kind, t[rising] - t[0], stretch, stress, pulled)

    @property
    def period(self) -> float:
        """Time between rows (s)."""
        return float(np.median(np.diff(self.t)))

    @property
    def span(self) -> float:
        """Length (s)."""
        return float(self.t[-1])

    @cached_property
    def polygon(self) -> tuple[Array, Array]:
        """Times at which the test bends (s), and the given stretches (1 or 2, knots) there, linear in between."""
        given = self.stretch if self.kind == "biaxial" else self.stretch[:1]
        shifted = [one - float(one.min()) for one in given]
        moved = [one for one in shifted if one.any()]
        ends = self.t[[0, -1]]
        knots = knots_of(self.t, moved, [LEAST] * len(moved), self.period) if moved else ends
        found = np.stack([through(self.t, one, knots) for one in given])
        if self.pulled:
            knots, found = np.concatenate(([-self.period], knots)), np.pad(found, ((0, 0), (1, 0)), constant_values=1.0)
        else:
            found[:, 0] = 1.0
        return knots, found

    def logs(self, times: Array) -> Array:
        """Logarithmic stretches (2, n) of the polygon at these times."""
        knots, given = self.polygon
        found = np.log([np.interp(times, knots, one) for one in given])
        if len(found) == 2:
            return np.asarray(found)
        second = {"uniaxial": -0.5, "equibiaxial": 1.0, "pure shear": 0.0}[self.kind]
        return np.concatenate((found, second * found))

    @cached_property
    def bins(self) -> Bins:
        """Means of the stresses, one direction after the other."""
        knots, _ = self.polygon
        part, number, count = bin_numbers(self.t, knots, self.period)
        size = np.bincount(number, minlength=count)

        def mean(values: Array) -> Array:
            total: Array = np.bincount(number, values, count) / size
            return total

        directions = [k for k in range(2) if np.isfinite(self.stress[k]).all()]
        segment = np.rint(mean(part.astype(float))).astype(np.intp)
        time = mean(self.t)
        stress = np.stack([mean(self.stress[k]) for k in directions])
        noise = [
            self.stress[k] - lines_through(time, mean(self.stress[k]), segment, self.t, number) for k in directions
        ]
        return Bins(self, time, stress, size, segment, number, np.stack(noise), tuple(directions))

    @cached_property
    def moving(self) -> NDArray[np.bool_]:
        """Which stretches between bends are moves."""
        _, given = self.polygon
        return np.asarray(np.abs(np.diff(given)).max(axis=0) > MOVED * np.abs(given - 1.0).max())


@dataclass(frozen=True, eq=False)
class Bins:
    """Mean stresses (Pa) of a test, (directions, bins), with time (s), rows and stretch of the history of each.

    ``noise`` (directions, rows) is what a line through the bins leaves over of each row.
    """

    record: SheetRecord
    time: Array
    stress: Array
    size: NDArray[np.intp]
    segment: NDArray[np.intp]
    number: NDArray[np.intp]
    noise: Array
    directions: tuple[int, ...]

    def averaging(self, times: Array) -> csr_array:
        """Matrix (bins, times) from values at ``times`` (s), linear in between, to their means over the bins' rows."""
        from scipy.sparse import csr_array

        t = self.record.t
        left = np.clip(np.searchsorted(times, t, side="right") - 1, 0, times.size - 2)
        share = np.clip((t - times[left]) / (times[left + 1] - times[left]), 0.0, 1.0)
        weight = 1.0 / self.size[self.number]
        values = np.concatenate(((1.0 - share) * weight, share * weight))
        rows, columns = np.tile(self.number, 2), np.concatenate((left, left + 1))
        return csr_array((values, (rows, columns)), shape=(self.size.size, times.size))

    @property
    def single(self) -> float:
        """Standard deviation of one row's noise (Pa)."""
        freedom = max(1, self.noise.size - self.stress.size)
        return math.sqrt(float((self.noise**2).sum()) / freedom)

    @cached_property
    def correlated(self) -> float:
        """How many rows carry the information of one independent one."""
        long = (self.size >= LONG)[self.number]
        rows = np.flatnonzero(long)
        return max((correlation(one[long], rows, LONG) for one in self.noise), default=1.0) if rows.size else 1.0

    @property
    def sigma(self) -> Array:
        """Standard deviations of the means (Pa), (bins,)."""
        largest = float(np.abs(self.stress).max())
        alone = self.single * np.sqrt(np.minimum(self.correlated, self.size) / self.size)
        return np.hypot(alone, LEAST_NOISE * largest)


def stress_fallen(test: HomogeneousTest) -> float:
    """By how much of its largest the stress falls where the stretch is held; 0 where it does not, or without a time."""
    if test.history is None:
        return 0.0
    try:
        record = SheetRecord.of(test)
        bins, largest = record.bins, float(np.nanmax(np.abs(record.stress)))
    except (TestsError, ValueError):
        return 0.0
    fallen = 0.0
    for k in np.unique(bins.segment):
        rows = np.flatnonzero(bins.segment == k)
        if not record.moving[k] and rows.size > 3:
            fallen = max(fallen, float((bins.stress[0][rows[0]] - bins.stress[0][rows[-1]]) / largest))
    return fallen if fallen > FALLS else 0.0


def steps_of(bins: Bins, fine: int) -> Array:
    """Times (s) of the steps along a test: ``fine`` from bin to bin, with its bends."""
    knots, _ = bins.record.polygon
    ends = np.unique(np.concatenate((knots, bins.time)))
    parts = ends[:-1, None] + np.diff(ends)[:, None] * np.arange(fine) / fine
    return np.unique(np.concatenate((parts.ravel(), ends)))
