"""Strokes, what ends them, their work and where its energy comes from."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import brentq

from model.actuator.bias import Antagonist, Bias, Bistable, Mass, Spring
from model.actuator.energy import energy_balance, stored, work_by_energy
from model.actuator.equilibrium import Actuator, equilibria
from model.actuator.stroke import Criteria, Limit, Strokes, strokes
from model.material.materials import NAMED, Material
from model.membrane.solve import Status, Wrinkling, solve
from model.specimen import Specimen
from model.stability.limits import breakdown_voltage, taut_limit
from model.verification.baselines import explicit_shooting
from model.verification.reference import reference

PARKER = NAMED["parker-cao2018"]
STRENGTH = 80e6
SPRING, MASS = Spring(0.8, 50.0), Mass(0.25)
BISTABLE = Bistable(middle=10e-3, offset=0.15, rate=60.0, cubic=1.5e6)
SOFT = Material("soft", (1e5,), (1.3,), 3.0)


def film(lp: float, a: float = 4e-3) -> Specimen:
    return Specimen(a, 20e-3, 40e-6, lp, PARKER)


def biases(lp: float, wrinkling: Wrinkling) -> list[Bias]:
    return [SPRING, MASS, Antagonist(film(lp), 20e-3, wrinkling=wrinkling)]


@dataclass(frozen=True)
class Broken:
    """Six actuators at breakdown."""

    actuators: list[Actuator]
    found: Strokes


@pytest.fixture(scope="module", params=["plain", "tension_field"])
def broken(request: pytest.FixtureRequest) -> Broken:
    kind: Wrinkling = request.param
    actuators = [Actuator(film(lp), bias, kind) for lp in (1.0, 1.2) for bias in biases(lp, kind)]
    return Broken(actuators, strokes(actuators, Criteria(field=STRENGTH)))


def test_breakdown_ends_the_stroke_where_the_reference_has_that_field_and_that_force(broken: Broken) -> None:
    actuators, found = broken.actuators, broken.found
    wrinkling = actuators[0].wrinkling
    np.testing.assert_array_equal(found.limit, Limit.BREAKDOWN)
    end = reference([one.film for one in actuators], found.reached, found.voltage, wrinkling=wrinkling)
    begin = reference([one.film for one in actuators], found.rest, 0.0)
    # Where hoop tension is lost the plain equations have the largest field inside the film, and less sharply so.
    sharp = (found.status == Status.TAUT) | (wrinkling == "tension_field")
    np.testing.assert_allclose(end.peak_field[sharp], STRENGTH, rtol=1e-6)
    np.testing.assert_allclose(end.peak_field, STRENGTH, rtol=2e-5)
    # A field off by so much is a stroke off by about as much: the stated error must cover it.
    assert np.all(np.abs(end.peak_field / STRENGTH - 1.0) * found.stroke < 3.0 * found.error_estimate)
    for i, one in enumerate(actuators):
        at = np.array([found.rest[i], found.reached[i]])
        push = one.bias.force(at)
        assert begin.force[i] == pytest.approx(push[0], rel=1e-7)
        assert end.force[i] == pytest.approx(push[1], rel=1e-7)


@pytest.mark.parametrize("bias", [SPRING, MASS], ids=["spring", "mass"])
def test_breakdown_ends_the_stroke_where_the_bias_line_meets_the_breakdown_boundary(bias: Bias) -> None:
    """The construction of the paper's supplement, figure S2."""
    one = Actuator(film(1.2), bias, "plain")

    def gap(h: float) -> float:
        boundary = breakdown_voltage(one.film, h, wrinkling="plain")
        return float(boundary.force - bias.force(np.array(h)))

    crossing = brentq(gap, 8e-3, 14e-3, xtol=1e-11)
    found = strokes([one], Criteria(field=STRENGTH))
    assert found.reached[0] == pytest.approx(crossing, abs=1e-8 * 20e-3)
    assert found.error_estimate[0] < 1e-7 * 20e-3


def test_tension_ends_the_stroke_at_the_taut_limit() -> None:
    actuators = [Actuator(film(1.0), bias, "plain") for bias in biases(1.0, "plain")]
    found = strokes(actuators, Criteria(field=STRENGTH, tension=True), folds_at_work="tension_field")
    np.testing.assert_array_equal(found.limit, Limit.TENSION)
    limit = taut_limit(film(1.0), found.reached)
    np.testing.assert_allclose(found.voltage, limit.voltage, rtol=1e-6)
    both = strokes([Actuator(film(1.2), MASS, "plain")], Criteria(field=STRENGTH, tension=True))
    assert both.limit[0] == Limit.BREAKDOWN  # pre-stretched as much, the film breaks down first


def test_voltage_ends_the_stroke_at_the_equilibrium() -> None:
    actuators = [Actuator(film(1.1), bias) for bias in biases(1.1, "tension_field")]
    found = strokes(actuators, Criteria(voltage=1500.0))
    np.testing.assert_array_equal(found.limit, Limit.VOLTAGE)
    for i, one in enumerate(actuators):
        (there,) = equilibria(one, 1500.0).found
        (rest,) = equilibria(one).found
        assert found.reached[i] == pytest.approx(there.h, abs=1e-9)
        assert found.rest[i] == pytest.approx(rest.h, abs=1e-9)


def test_stretch_and_range_and_missing_rest_are_told() -> None:
    found = strokes([Actuator(film(1.2), MASS)], Criteria(stretch=1.75))
    assert found.limit[0] == Limit.STRETCH
    assert found.max_stretch[0] == pytest.approx(1.75, abs=1e-6)
    too_tight = strokes([Actuator(film(1.2), MASS)], Criteria(stretch=1.6))  # more than that at rest
    assert (too_tight.limit[0], too_tight.stroke[0]) == (Limit.STRETCH, 0.0)
    heavy = strokes([Actuator(film(1.2), Mass(60.0))], Criteria(field=STRENGTH))
    assert heavy.limit[0] == Limit.NO_REST
    assert math.isnan(heavy.stroke[0])
    many = strokes([Actuator(film(1.2), Mass(60.0)), Actuator(film(1.2), MASS)], Criteria(field=STRENGTH))
    alone = strokes([Actuator(film(1.2), MASS)], Criteria(field=STRENGTH))
    assert many.stroke[1] == pytest.approx(alone.stroke[0], rel=1e-9)


@pytest.mark.slow
def test_a_film_that_gives_up_ends_the_stroke() -> None:
    soft = Specimen(4e-3, 20e-3, 100e-6, 3.0, SOFT)
    found = strokes([Actuator(soft, MASS, "plain")], Criteria(voltage=5000.0))
    assert found.limit[0] in (Limit.FILM, Limit.SNAP)
    assert 0.0 < found.voltage[0] < 1000.0


@pytest.mark.slow
def test_a_bistable_actuator_snaps_and_lands_on_the_other_equilibrium() -> None:
    one = Actuator(film(1.0), BISTABLE)
    low, high = (strokes([one], Criteria(voltage=v), tolerance=1e-6) for v in (1500.0, 2000.0))
    assert (low.snaps[0], high.snaps[0]) == (0, 1)
    assert low.reached[0] == pytest.approx(equilibria(one, 1500.0).found[0].h, abs=1e-7)
    (there,) = equilibria(one, 2000.0).found
    assert high.reached[0] == pytest.approx(there.h, abs=1e-7)
    assert high.stroke[0] > 5.0 * low.stroke[0]


@pytest.mark.slow
def test_a_snap_into_breakdown_is_not_made() -> None:
    one = Actuator(film(1.0), BISTABLE)
    found = strokes([one], Criteria(field=70e6), tolerance=1e-6)
    assert found.limit[0] == Limit.SNAP
    assert len(equilibria(one, found.voltage[0] * (1 - 1e-5)).found) == 3
    assert len(equilibria(one, found.voltage[0] * (1 + 1e-5)).found) == 1
    assert found.peak_field[0] < 70e6


def test_work_of_the_forces_is_work_of_the_energies(broken: Broken) -> None:
    found = broken.found
    for i, one in enumerate(broken.actuators):
        rest, reached, voltage = float(found.rest[i]), float(found.reached[i]), float(found.voltage[i])
        assert found.work[i] == pytest.approx(work_by_energy(one, rest, reached, voltage), rel=1e-6)
        blocked = float(one.bias.force(np.array(rest))) - solve(one.film, rest, voltage, wrinkling=one.wrinkling).force
        assert found.blocked_force[i] == pytest.approx(blocked, rel=1e-6)


@pytest.mark.parametrize(
    ("wrinkling", "lp", "within"),
    [("plain", 1.2, 1e-7), pytest.param("tension_field", 1.0, 2e-4, marks=pytest.mark.slow)],
)
def test_energy_given_is_energy_found(wrinkling: Wrinkling, lp: float, within: float) -> None:
    """Along the path the source and the bias give what the film stores; folds give the path kinks, so 2e-4 there."""
    one = Actuator(film(lp), MASS, wrinkling)
    found = strokes([one], Criteria(field=STRENGTH))
    sums = energy_balance(one, float(found.rest[0]), float(found.reached[0]), float(found.voltage[0]))
    assert abs(sums.residual) < within
    assert sums.bias == pytest.approx(0.25 * found.stroke[0], rel=1e-9)
    assert 0.1 < sums.efficiency < 0.4


def test_stored_energy_has_the_force_and_the_charge_as_derivatives() -> None:
    one, h, voltage = film(1.2), 10e-3, 1200.0
    step, push = 1e-5, 1.0
    up, down = (stored(one, h + s, voltage, "plain").at_voltage for s in (step, -step))
    assert (up - down) / (2 * step) == pytest.approx(explicit_shooting(one, h, voltage, 1e-10).force, rel=1e-5)
    up, down = (stored(one, h, voltage + v, "plain").at_voltage for v in (push, -push))
    assert -(up - down) / (2 * push) == pytest.approx(stored(one, h, voltage, "plain").charge, rel=1e-5)


def test_slack_on_the_way_is_told() -> None:
    """Held at rest at its end voltage this loosely mounted film hangs slack, and pulls with no force."""
    loose = film(1.0, 10e-3)
    one = Actuator(loose, Spring(0.06, 5.0))
    found = strokes([one], Criteria(field=STRENGTH))
    assert found.way[0] == Status.SLACK
    assert found.work[0] > 0.0
    assert math.isnan(work_by_energy(one, float(found.rest[0]), float(found.reached[0]), float(found.voltage[0])))


def test_criteria_must_be_sensible() -> None:
    with pytest.raises(ValueError, match="field"):
        Criteria(field=-1.0)
    with pytest.raises(ValueError, match="all be"):
        strokes([Actuator(film(1.0), MASS, "plain"), Actuator(film(1.0), MASS)], Criteria(field=STRENGTH))
