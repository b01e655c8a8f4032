"""Whole runs as polygons and bins: cases small enough to be written out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.film.branches import polygon
from calibration.film.branches.polygon import bin_numbers, correlation, edges_of, knots_of, lines_through, through
from calibration.film.branches.record import Record, record_of, records_of_curves, thinned
from calibration.film.curve import Curve, CurveError
from calibration.film.reduction import CONTACT_MARGIN
from model.material.materials import NAMED
from model.specimen import Specimen

Array = NDArray[np.float64]
FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"], name="cone")


def curve(t: Array | None, h: Array, voltage: Array | None = None, force: Array | None = None, **more: object) -> Curve:
    zeros = np.zeros(h.size)
    return Curve(
        label="whole", run="run", specimen=FILM, h=h, force=zeros if force is None else force,
        voltage=zeros if voltage is None else voltage, nominal_voltage=0.0,
        direction=np.zeros(h.size, dtype=np.int8), force_noise=1e-3, time=t, **more,  # type: ignore[arg-type]
    )  # fmt: skip


def record(corners: tuple[list[float], list[float]], rate: float = 20.0, **more: object) -> Record:
    t = np.arange(0.0, corners[0][-1] + 1e-9, 1.0 / rate)
    return record_of(curve(t, np.interp(t, *corners), **more), -math.inf, math.inf)  # type: ignore[arg-type]


def test_samples_of_a_record_rise_in_time_and_have_no_gaps() -> None:
    t = np.array([0.0, 1.0, 1.0, 3.0, 2.0, 4.0])
    h = np.array([math.nan, 2e-3, 9e-3, 4e-3, math.nan, 5e-3])
    found = record_of(curve(t, h, np.array([math.nan, 0.0, 0.0, 20.0, 10.0, 30.0])), 1.0, 3.0)
    assert found.t.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert found.h == pytest.approx([0.0, 2e-3, 3e-3, 4e-3, 5e-3])  # rested flat before the first reading
    assert found.voltage == pytest.approx([0.0, 0.0, 10.0, 20.0, 30.0])
    assert found.used.tolist() == [False, True, False, True, False]  # in the times that are measured, and read
    assert (found.run, found.period, found.span) == ("run", 1.0, 2.0)


def test_a_disk_that_does_not_touch_the_film_measures_nothing() -> None:
    h = np.array([0.0, 1e-5, 2e-5, 3e-5])
    t = np.arange(4.0)
    assert record_of(curve(t, h), -math.inf, math.inf).used.tolist() == [False, True, True, True]
    sure = record_of(curve(t, h, displacement_zero=1.001e-5 / CONTACT_MARGIN), -math.inf, math.inf)
    assert sure.used.tolist() == [False, False, True, True]


def test_a_run_without_time_or_without_any_reading_is_refused_by_name() -> None:
    h = np.array([1e-3, 2e-3])
    with pytest.raises(CurveError, match="whole: its samples have no time"):
        record_of(curve(None, h), 0.0, 1.0)
    with pytest.raises(CurveError, match="run: its samples have no time"):
        records_of_curves([curve(None, h)])
    with pytest.raises(CurveError, match="whole: no reading of displacement or voltage"):
        record_of(curve(np.arange(2.0), h, np.full(2, math.nan)), 0.0, 1.0)


def test_curves_of_one_run_are_one_record() -> None:
    first, second = curve(np.arange(3.0), np.full(3, 1e-3)), curve(np.arange(5.0, 9.0), np.full(4, 2e-3))
    (one, other) = records_of_curves([first, replace(first, run="other"), second])
    assert one.t.tolist() == [0.0, 1.0, 2.0, 5.0, 6.0, 7.0, 8.0]
    assert (one.run, other.run, other.t.size) == ("run", "other", 3)


def test_every_so_manieth_sample_is_kept() -> None:
    whole = curve(np.arange(100.0), np.linspace(0.0, 1e-3, 100))
    assert thinned(whole, 30).time is not None
    assert thinned(whole, 30).h.tolist() == whole.h[::3].tolist()
    assert thinned(whole, 1000).h.size == 100


def test_a_cycle_begins_where_the_disk_leaves_its_low_place() -> None:
    found = record(([0.0, 2.0, 4.0, 6.0, 8.0, 9.0, 10.0, 12.0], [0.0, 9e-3, 1e-3, 9e-3, 4e-3, 9e-3, 1e-3, 9e-3]))
    knots, high, _ = found.history
    rising = np.diff(high) > 0.0
    assert knots == pytest.approx([0.0, 2.0, 4.0, 6.0, 8.0, 9.0, 10.0, 12.0], abs=0.05)
    assert found.cycle[rising].tolist() == [0, 1, 1, 2]
    assert found.cycle_at(np.array([1.0, 3.9, 4.1, 8.5, 9.9, 10.1])).tolist() == [0, 0, 1, 1, 1, 2]


def test_moves_and_holds_are_told_by_the_noise_of_the_displacement() -> None:
    corners = ([0.0, 2.0, 5.0, 6.0, 8.0], [0.0, 9e-3, 9e-3, 9.1e-3, 9.1e-3])
    knots, _, _ = (found := record(corners)).history
    moving = {round(float(left)): bool(one) for left, one in zip(knots[:-1], found.moving, strict=True) if left > 0.5}
    assert (moving.get(2), moving.get(5)) in {(False, True), (False, None)}
    assert record(corners, displacement_noise=1e-5).moving[-1:].tolist() == [False]


def test_a_run_that_begins_displaced_came_there_from_rest() -> None:
    found = record(([0.0, 4.0], [5e-3, 5e-3]))
    knots, high, volts = found.history
    assert knots[:2] == pytest.approx([-2.0 * found.period, 0.0])
    assert (high[0], volts[0]) == (0.0, 0.0)
    assert high[1:] == pytest.approx(5e-3)


def test_ends_of_bins_are_even_and_in_proportion_to_the_time_since_the_bend() -> None:
    assert edges_of(1.0, 0.1) == pytest.approx(np.arange(0.2, 1.01, 0.2))  # as short as two periods
    long = edges_of(1000.0, 0.1)
    assert long[-1] == 1000.0 and long[0] == pytest.approx(0.2, rel=1e-9)
    assert np.diff(long).min() >= 0.2 * (1.0 - 1e-9)
    assert np.diff(long[long > 100.0]).max() <= 1000.0 / 16 + 1e-6
    early = long[(long > 3.0) & (long < 30.0)]
    assert early.size == pytest.approx(12, abs=1)  # a decade


def test_bins_number_the_samples_of_every_stretch_apart() -> None:
    t = np.arange(0.05, 2.0, 0.1)
    part, number, count = bin_numbers(t, np.array([0.0, 1.0, 2.0]), 0.1)
    assert part.tolist() == [0] * 10 + [1] * 10
    assert count == number.max() + 1 == 10
    assert np.bincount(number).tolist() == [2] * 10
    assert set(number[:10]) & set(number[10:]) == set()


def test_lines_go_through_neighbouring_bins_of_one_stretch_alone() -> None:
    time, mean, segment = np.array([0.5, 1.5, 2.5, 3.5]), np.array([1.0, 3.0, 10.0, 12.0]), np.array([0, 0, 1, 1])
    t = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    number = np.array([0, 0, 2, 2, 3])
    assert lines_through(time, mean, segment, t, number) == pytest.approx([0.0, 2.0, 9.0, 11.0, 13.0])
    middle = lines_through(np.array([0.0, 1.0, 3.0]), np.array([0.0, 2.0, 8.0]), np.zeros(3, dtype=np.intp),
                           np.array([1.0, 2.0]), np.array([1, 1]))  # fmt: skip
    assert middle == pytest.approx([2.0, 4.5])  # the mean of both slopes, 2 and 3


def test_samples_that_repeat_their_neighbour_count_half() -> None:
    white = np.random.default_rng(4).standard_normal(3000)
    rows = np.arange(6000)
    assert correlation(white, rows[:3000], 20) == 1.0
    assert correlation(np.repeat(white, 2), rows, 20) == pytest.approx(2.0, abs=0.15)
    assert correlation(np.repeat(white, 2), 2 * rows, 20) == 1.0  # not neighbours
    assert correlation(np.zeros(10), rows[:10], 20) == 1.0


def test_bends_are_where_lines_cross_and_straight_lines_have_none() -> None:
    t = np.arange(0.0, 10.0, 0.01)
    values = np.interp(t, [0.0, 3.004, 10.0], [0.0, 1.0, 1.0])
    knots = knots_of(t, [values], [1.5e-3], 0.01)
    assert knots == pytest.approx([0.0, 3.004, 9.99], abs=2e-3)
    assert knots_of(t, [t], [1.5e-3], 0.01) == pytest.approx([0.0, 9.99])
    assert through(t, values, knots) == pytest.approx([0.0, 1.0, 1.0], abs=1e-3)
    noise = 2e-3 * np.random.default_rng(6).standard_normal(t.size)
    assert polygon._noise(1.0 + noise) == pytest.approx(2e-3, rel=0.1)
    assert polygon._noise(np.zeros(10)) == 0.0


def test_means_of_a_straight_force_are_that_force() -> None:
    """Of a force that is linear in the displacement, carried to the bins' own times by another film's."""
    found = record(([0.0, 4.0, 8.0], [0.0, 8e-3, 8e-3]), force=None)
    found = replace(found, force=20.0 * found.h)
    bins = found.bins(lambda h, volts: 5.0 * h)
    assert bins.force == pytest.approx(20.0 * bins.h, abs=1e-6)
    assert np.abs(bins.noise).max() < 1e-4
    assert bins.size.sum() == bins.rows.size == int(found.used.sum())
    assert np.bincount(bins.number).tolist() == bins.size.tolist()
