"""The least time to a target against closed forms: the slope of a straight line, half the time at each end."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from calibration.film.least_time import least_time

X = np.linspace(-1.0, 1.0, 9)


def line(*wanted: tuple[float, float]) -> Any:
    """Readings of a straight line at nine places, a unit of information a second; wanted: sums of level and slope."""
    rows = np.stack([np.ones_like(X), X], axis=1)
    return cast("Any", SimpleNamespace(rows=rows, wanted=np.array(wanted), h=X))


@pytest.mark.parametrize("held", [0.0, 40.0, 90.0])
def test_the_slope_of_a_line(held: float) -> None:
    """Its variance is (1/s1 + 1/s2)/4 with s1, s2 seconds at the ends; ``held`` of s1 have passed already."""
    places, target = line((0.0, 1.0)), 0.005  # 100 s at each end
    known = np.diag([1e-9, 1e-9]) + held * np.outer(places.rows[0], places.rows[0])
    excess, seconds = least_time(places, known, np.array([target]), range(9), 1e4)
    assert 0.97 < excess <= 1.0
    assert seconds.sum() == pytest.approx(200.0 - held, rel=0.03)
    assert seconds[0] == pytest.approx(100.0 - held, abs=8.0) and seconds[-1] == pytest.approx(100.0, rel=0.08)


def test_two_wishes_are_both_met_and_one_without_a_target_costs_nothing() -> None:
    places, known = line((0.0, 1.0), (1.0, 0.0)), np.diag([1e-9, 1e-9])
    alone = least_time(places, known, np.array([0.01, np.inf]), range(9), 1e4)[1].sum()
    assert alone == pytest.approx(100.0, rel=0.03)
    excess, seconds = least_time(places, known, np.array([0.01, 0.005]), range(9), 1e4)  # the level: any 200 s
    information = (places.rows * seconds[:, None]).T @ places.rows
    assert np.all(np.diag(np.linalg.inv(information)) < 1.03 * np.array([0.005, 0.01])) and excess <= 1.0
    assert seconds.sum() == pytest.approx(200.0, rel=0.06)


def test_what_time_does_not_suffice_for_or_nothing_there_tells_of_is_said() -> None:
    places, known = line((0.0, 1.0)), np.diag([1e-9, 1.0])
    excess, seconds = least_time(places, known, np.array([0.005]), range(9), 50.0)
    assert excess == pytest.approx(4.0, rel=0.1) and seconds.sum() == pytest.approx(50.0)
    excess, seconds = least_time(places, known, np.array([0.005]), [4], 50.0)  # in the middle: nothing of the slope
    assert excess == pytest.approx(200.0) and np.isfinite(seconds).all()
