"""Where to hold a film: designs that are known in closed form, on places whose information is made up."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.film.planning import Dwell, Places, _near, _route, one_term, propose
from calibration.film.propagation import secant
from model.material.materials import Material
from model.material.ogden import Ogden

Array = NDArray[np.float64]


def places(rows: Array, h: list[float], voltage: list[float], wanted: Array) -> Places:
    found = Places.__new__(Places)
    found.rows, found.h, found.voltage = rows, np.array(h), np.array(voltage)
    found.wanted, found.weight = wanted, np.ones(len(wanted))
    found.prior = 1e-8 * np.eye(rows.shape[1])
    return found


TWO = places(np.diag([1.0, 2.0]), [1e-3, 2e-3], [0.0, 0.0], np.array([[1.0, 1.0]]))


def nothing(route: object) -> float:
    return 0.0


def test_the_variance_of_a_sum_of_two_numbers_each_told_by_its_own_place() -> None:
    value, worth = TWO.judge(np.array([10.0, 5.0]), [0, 1])
    variance = 1.0 / 10.0 + 1.0 / (4.0 * 5.0)
    assert value == pytest.approx(math.log(variance))
    assert worth == pytest.approx(np.array([1.0 / 10.0**2, 1.0 / (4.0 * 5.0**2)]) / variance)


def test_the_time_is_shared_as_the_square_roots_of_the_variances_ask() -> None:
    """Of the least of 1/t1 + 1/(4 t2) with t1 + t2 stated: twice as long where a second tells half as much."""
    value, seconds = TWO.shared(30.0, [0, 1])
    assert seconds == pytest.approx([20.0, 10.0], rel=1e-3)
    assert value == pytest.approx(math.log(1.0 / 20.0 + 1.0 / 40.0), abs=1e-6)


def test_two_places_are_a_route_and_what_getting_there_costs_is_taken_off() -> None:
    route = propose(TWO, 30.0, nothing)
    assert [dwell.h for dwell in route] == [1e-3, 2e-3]
    assert [dwell.seconds for dwell in route] == pytest.approx([20.0, 10.0], rel=1e-3)
    slower = propose(TWO, 30.0, lambda route: 6.0 * len(route))
    assert sum(dwell.seconds for dwell in slower) == pytest.approx(18.0)
    assert propose(TWO, 3.0, nothing) == []
    for few in (0, 1):
        alone = places(TWO.rows[:few], [1e-3][:few], [0.0][:few], TWO.wanted)
        assert propose(alone, 30.0, nothing) == []


def test_the_best_places_of_a_straight_line_are_its_ends() -> None:
    """Offset and slope by readings of equal noise (Silvey 1980): half at each end, whatever lies between."""
    h = np.linspace(0.0, 10e-3, 6)
    line = np.column_stack((np.ones(6), h / 10e-3 - 0.5))
    found = propose(places(line, h.tolist(), [0.0] * 6, np.eye(2)), 40.0, nothing)
    assert [dwell.h for dwell in found] == pytest.approx([0.0, 10e-3])
    assert [dwell.seconds for dwell in found] == pytest.approx([20.0, 20.0], rel=1e-2)


def test_a_route_goes_up_and_down_and_ends_where_it_began() -> None:
    grid = places(np.ones((5, 1)), [1e-3, 3e-3, 1e-3, 3e-3, 5e-3], [0.0, 0.0, 800.0, 800.0, 800.0], np.ones((1, 1)))
    route = _route(grid, [4, 2, 1, 3, 0], np.array([3.0, 4.0, 10.0, 5.0, 6.0]))
    assert route == [
        Dwell(0.0, 1e-3, 6.0),
        Dwell(0.0, 3e-3, 5.0),  # half of the longest at the lowest voltage ...
        Dwell(800.0, 5e-3, 3.0),
        Dwell(800.0, 3e-3, 5.0),
        Dwell(800.0, 1e-3, 4.0),
        Dwell(0.0, 3e-3, 5.0),  # ... and its other half at the end
    ]
    short = _route(grid, [0, 4], np.array([3.9, 8.0]))
    assert short == [Dwell(0.0, 1e-3, 3.9), Dwell(800.0, 5e-3, 8.0)]


def test_neighbours_are_one_step_of_the_grid_apart() -> None:
    h, v = np.meshgrid([1e-3, 2e-3, 3e-3], [0.0, 500.0, 900.0])
    grid = SimpleNamespace(h=h.ravel(), voltage=v.ravel())
    near = [k for k in range(9) if _near(grid, 4, k)]  # type: ignore[arg-type]
    assert near == list(range(9))
    assert [k for k in range(9) if _near(grid, 0, k)] == [0, 1, 3, 4]  # type: ignore[arg-type]


def test_a_film_of_one_term_has_the_stresses_of_the_other_at_both_stretches() -> None:
    two = Material(name="two", mu=(5e3, 3.5e4), alpha=(2.5, 5.6), eps_r=1.7)
    one = one_term(two, (1.3, 2.0), 1.2)
    assert (len(one.mu), one.law) == (1, Ogden)
    at = np.array([1.3, 2.0])
    assert secant(one, at, 1.2)[0] == pytest.approx(secant(two, at, 1.2)[0], rel=1e-9)
    assert 2.5 < one.alpha[0] < 5.6
