"""Loss of tension, breakdown, pull-in, and branches followed past limit points."""

from __future__ import annotations

import math

import numpy as np
import pytest

from model.material.materials import NAMED, Material
from model.membrane.solve import Status, solve, solve_many
from model.specimen import Specimen
from model.stability.branches import pull_in, vary_displacement, vary_voltage
from model.stability.limits import breakdown_voltage, pull_in_voltage, taut_limit

PARKER = NAMED["parker-cao2018"]
# Softer and softer against a field as it stretches (exponent below 2): it pulls in before it loses all tension.
SOFT = Specimen(4e-3, 20e-3, 100e-6, 3.0, Material("soft", (1e5,), (1.3,), 3.0))


def film(lp: float) -> Specimen:
    return Specimen(4e-3, 20e-3, 40e-6, lp, PARKER)


# Peak fields (MV/m) at which the Parker film (a = 4 mm) loses hoop tension, h = 4 to 12 mm: from
# three independent codes. Without pre-stretch a state takes seconds.
@pytest.mark.parametrize(
    ("lp", "low", "high"),
    [pytest.param(1.0, 17, 48, marks=pytest.mark.slow), (1.1, 60, 66), (1.2, 81, 84), (1.3, 102, 104)],
)
def test_field_at_loss_of_tension(lp: float, low: float, high: float) -> None:
    limit = taut_limit(film(lp), np.array([4e-3, 12e-3] if lp == 1.0 else [4e-3, 8e-3, 12e-3]))
    field = limit.peak_field / 1e6
    assert np.all((low < field) & (field < high))
    np.testing.assert_array_equal(limit.status, Status.TAUT)


def test_tension_vanishes_at_the_taut_limit() -> None:
    h = np.array([3e-3, 9e-3, 15e-3])
    limit = taut_limit(film(1.1), h)
    below = solve_many(film(1.1), h, limit.voltage * (1 - 1e-6))
    above = solve_many(film(1.1), h, limit.voltage * (1 + 1e-6))
    np.testing.assert_array_equal(below.status, Status.TAUT)
    np.testing.assert_array_equal(above.status, Status.WRINKLED)
    scale = solve_many(film(1.1), h).min_hoop_stress
    assert np.all(np.abs(limit.min_hoop_stress) < 1e-6 * scale)


def test_breakdown_stands_beside_the_taut_limit() -> None:
    limit = taut_limit(film(1.2), [12e-3])
    there = solve_many(film(1.2), [12e-3], limit.breakdown_voltage, wrinkling="tension_field")
    np.testing.assert_allclose(there.peak_field, 80e6, rtol=1e-6)
    assert np.isnan(taut_limit(SOFT, 4e-3).breakdown_voltage)


def test_breakdown_in_a_wrinkled_film() -> None:
    limit = breakdown_voltage(film(1.0), 12e-3)
    assert limit.status == Status.WRINKLED
    assert limit.peak_field == pytest.approx(80e6, rel=1e-6)
    plain = breakdown_voltage(film(1.0), 12e-3, wrinkling="plain")
    assert plain.voltage > 1.05 * limit.voltage  # the plain equations miss the folds' higher field


@pytest.mark.slow
def test_no_breakdown_before_the_film_hangs_slack() -> None:
    limit = breakdown_voltage(film(1.0), 4e-3)
    assert math.isnan(limit.voltage)
    assert math.isnan(limit.force)


def test_breakdown_needs_a_field() -> None:
    with pytest.raises(ValueError, match="states no breakdown field"):
        breakdown_voltage(SOFT, 1e-2)
    with pytest.raises(ValueError, match="positive"):
        breakdown_voltage(SOFT, 1e-2, -1.0)


@pytest.mark.slow
def test_branch_agrees_with_the_solver_and_turns_at_the_pull_in() -> None:
    branch = vary_voltage(SOFT, 10e-3, 500.0, points=80)
    turn = branch.limit_points[0]
    stable, voltage = branch.stable, branch.voltage
    assert stable[:turn].all()
    assert not stable[turn + 1 :].any()
    assert np.all(np.diff(voltage[: turn + 1]) > 0.0)
    found = solve_many(SOFT, 10e-3, voltage[: turn - 2], tolerance=1e-9)
    np.testing.assert_allclose(branch.force[: turn - 2], found.force, rtol=1e-7)
    fold = pull_in(SOFT, 10e-3, 500.0)
    assert fold is not None
    assert voltage.max() <= fold * (1 + 1e-9)
    # The voltage is a smooth function of the force through the fold: its top is there.
    near = slice(turn - 2, turn + 3)
    parabola = np.polynomial.Polynomial.fit(branch.force[near], voltage[near], 3)
    tops = parabola.deriv().roots()
    top = tops[np.argmin(np.abs(tops - branch.force[turn]))].real
    assert parabola(top) == pytest.approx(fold, rel=2e-4)


@pytest.mark.slow
def test_pull_in_is_where_answers_end() -> None:
    h = np.array([4e-3, 10e-3, 20e-3])
    limit = pull_in_voltage(SOFT, h)
    below = solve_many(SOFT, h, limit.voltage * (1 - 1e-3))
    above = solve_many(SOFT, h, limit.voltage * (1 + 1e-3))
    assert below.answered.all()
    np.testing.assert_array_equal(above.status, Status.UNSTABLE)
    assert np.isnan(above.force).all()


@pytest.mark.slow
def test_soft_film_that_loses_hoop_tension_has_no_natural_width() -> None:
    """With an exponent below 2 a fold would widen without bound: losing tension is the pull-in of the wrinkled film."""
    limit = pull_in_voltage(SOFT, 10e-3, wrinkling="tension_field")
    taut = taut_limit(SOFT, 10e-3)
    assert limit.voltage == pytest.approx(taut.voltage, rel=1e-4)


@pytest.mark.slow
def test_no_pull_in_for_a_film_that_slackens_first() -> None:
    limit = pull_in_voltage(film(1.2), [4e-3, 10e-3], wrinkling="tension_field")
    assert np.isnan(limit.voltage).all()
    np.testing.assert_array_equal(limit.status, Status.SLACK)


@pytest.mark.slow
def test_taut_until_pull_in_is_told() -> None:
    limit = taut_limit(SOFT, 4e-3)
    assert limit.status == Status.UNSTABLE
    assert limit.min_hoop_stress > 0.0
    assert limit.voltage == pytest.approx(pull_in_voltage(SOFT, 4e-3).voltage, rel=1e-3)


def test_small_steps_of_voltage_never_jump() -> None:
    """The force falls smoothly to the pull-in and then there is none: no step lands on another branch."""
    voltage = np.linspace(0.0, 400.0, 81)
    found = solve_many(SOFT, 10e-3, voltage)
    answered = found.answered
    last = np.flatnonzero(answered)[-1]
    assert answered[: last + 1].all()
    assert 330.0 < voltage[last] < 337.0
    steps = np.diff(found.force[: last + 1])
    assert np.all(steps < 0.0)
    assert np.all(np.diff(steps)[:-1] < 0.0)  # steeper and steeper


@pytest.mark.slow
def test_branch_in_displacement() -> None:
    branch = vary_displacement(film(1.2), 1000.0, 25e-3)
    assert branch.ended == "the end of the range"
    assert branch.limit_points == ()
    assert branch.stable.all()
    found = solve_many(film(1.2), branch.h[::7], 1000.0, tolerance=1e-10)
    np.testing.assert_allclose(branch.force[::7], found.force, rtol=1e-7)


def test_branch_says_what_it_cannot_start_from() -> None:
    with pytest.raises(ValueError, match="slack or unstable"):
        vary_displacement(film(1.0), 2500.0, 1e-3)
    with pytest.raises(ValueError, match="displacement"):
        vary_voltage(SOFT, -1.0, 100.0)
    assert solve(film(1.0), 1e-3, 2500.0).status is Status.SLACK
