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

from calibration.film.branches.polygon import FIRST, bin_numbers, knots_of, lines_through, through
from calibration.film.curve import Curve, CurveError
from calibration.film.reduction import CONTACT_MARGIN

Array = NDArray[np.float64]
Elastic = Callable[[Array, Array], Array]  # force (N) at displacements (m) and voltages (V)

LEAST_H, LEAST_V = 1.5e-3, 3e-3  # of the largest, by which it may lie off whatever the noise
LOW, HIGH = 0.25, 0.5  # of the largest displacement, between which a cycle goes
MOVED = 20.0  # noises of the displacement: less is a hold


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
        knots = knots_of(t, (h, v), (LEAST_H, LEAST_V), self.period)
        found_h, found_v = (np.maximum(through(t, values, knots), 0.0) for values in (h, v))
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
        part, number, count = bin_numbers(self.t[rows], knots, self.period)
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
        noise = force - lines_through(time, mean_force, segment, t, number)
        return Bins(self, time, np.interp(time, knots, high), np.interp(time, knots, volts), mean_force + here,
                    size, segment, rows, number, noise)  # fmt: skip

    @cached_property
    def cycle(self) -> NDArray[np.intp]:
        """Number of the cycle of each stretch between bends, from 0: one begins where the disk leaves its low place."""
        _, high, _ = self.history
        top = float(high.max())
        number, been_up, found = 0, False, []
        for left, right in itertools.pairwise(high):
            if been_up and left < LOW * top and right > left:
                number, been_up = number + 1, False
            been_up |= right > HIGH * top
            found.append(number)
        return np.array(found, dtype=np.intp)

    def cycle_at(self, times: Array) -> NDArray[np.intp]:
        """Number of the cycle at these times (s)."""
        knots, _, _ = self.history
        found: NDArray[np.intp] = self.cycle[np.clip(np.searchsorted(knots, times, side="left") - 1, 0, knots.size - 2)]
        return found

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


def thinned(curve: Curve, most: int) -> Curve:
    """The curve with every n-th of its samples, about so many."""
    step = max(1, curve.h.size // most)
    columns = {name: getattr(curve, name) for name in _COLUMNS}
    fewer: dict[str, Any] = {name: None if one is None else one[::step] for name, one in columns.items()}
    return replace(curve, **fewer)
