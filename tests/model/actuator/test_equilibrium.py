"""Film against bias: equilibria, all of them, and the biases' laws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from model.actuator.bias import Antagonist, Bias, Bistable, Mass, Spring, Tabulated, forces
from model.actuator.equilibrium import Actuator, equilibria
from model.material.materials import NAMED
from model.membrane.solve import Status, solve
from model.specimen import Specimen
from model.verification.baselines import explicit_shooting

PARKER = NAMED["parker-cao2018"]
TAUT = Specimen(4e-3, 20e-3, 40e-6, 1.2, PARKER)
LOOSE = Specimen(4e-3, 20e-3, 40e-6, 1.0, PARKER)
SPRING, MASS = Spring(0.8, 50.0), Mass(0.25)
ANTAGONIST = Antagonist(TAUT, 20e-3)
BISTABLE = Bistable(middle=10e-3, offset=0.15, rate=60.0, cubic=1.5e6)
TABLE = Tabulated(tuple(np.linspace(0, 15e-3, 16)), tuple(0.8 - 50 * np.linspace(0, 15e-3, 16)))
EVERY = [SPRING, MASS, ANTAGONIST, Antagonist(TAUT, 20e-3, voltage=1000.0), BISTABLE, TABLE]


@pytest.mark.parametrize("bias", EVERY, ids=lambda bias: type(bias).__name__)
def test_slope_is_the_derivative_of_the_force(bias: Bias) -> None:
    h = np.array([3e-3, 8e-3, 12e-3])
    step = 1e-5
    central = (bias.force(h + step) - bias.force(h - step)) / (2 * step)
    np.testing.assert_allclose(bias.slope(h), central, rtol=1e-5, atol=1e-6)


def test_biases_together_are_biases_one_by_one() -> None:
    h = np.linspace(2e-3, 14e-3, 5) * np.ones((len(EVERY), 1))
    force, slope = forces(EVERY, h)
    for i, bias in enumerate(EVERY):
        np.testing.assert_allclose(force[i], bias.force(h[i]), rtol=1e-9)
        np.testing.assert_allclose(slope[i], bias.slope(h[i]), rtol=1e-9)


def test_a_law_ends_where_it_ends() -> None:
    assert SPRING.reach == (0.0, 16e-3)
    assert np.isnan(TABLE.force(np.array([16e-3]))).all()
    with pytest.raises(ValueError, match="stiffness"):
        Spring(0.8, -1.0)
    with pytest.raises(ValueError, match="at least four"):
        Tabulated((0.0, 1e-3), (1.0, 2.0))
    with pytest.raises(ValueError, match="weight"):
        Mass(float("nan"))


@pytest.mark.parametrize("bias", [SPRING, MASS, ANTAGONIST], ids=["spring", "mass", "antagonist"])
@pytest.mark.parametrize("voltage", [0.0, 1500.0])
def test_equilibrium_is_where_the_paper_s_shooting_finds_it(bias: Bias, voltage: float) -> None:
    def excess(h: float) -> float:
        push = (
            explicit_shooting(TAUT, 20e-3 - h, 0.0, 1e-10).force
            if isinstance(bias, Antagonist)
            else float(bias.force(np.array(h)))
        )
        return explicit_shooting(TAUT, h, voltage, 1e-10).force - push

    expected = brentq(excess, 5e-3, 15e-3, xtol=1e-12)
    found = equilibria(Actuator(TAUT, bias), voltage)
    assert found.blind == ()
    (one,) = found.found
    assert one.stable
    assert one.status is Status.TAUT
    assert abs(one.h - expected) < 1e-9 * 20e-3 + 3 * one.error_estimate
    assert one.error_estimate < 1e-8 * 20e-3


def test_a_bistable_bias_has_three_equilibria_and_loses_two_of_them_as_the_voltage_rises() -> None:
    actuator = Actuator(LOOSE, BISTABLE)
    three = equilibria(actuator, 1500.0)
    assert [one.stable for one in three.found] == [True, False, True]
    for one in three.found:
        film = solve(LOOSE, one.h, 1500.0, wrinkling="tension_field").force
        assert film == pytest.approx(float(BISTABLE.force(np.array(one.h))), rel=1e-8)
        assert one.stiffness == pytest.approx(
            (
                solve(LOOSE, one.h + 1e-6, 1500.0, wrinkling="tension_field").force
                - solve(LOOSE, one.h - 1e-6, 1500.0, wrinkling="tension_field").force
            )
            / 2e-6
            - float(BISTABLE.slope(np.array(one.h))),
            rel=1e-4,
        )
    assert len(equilibria(actuator, 2000.0).found) == 1


@pytest.mark.slow
def test_two_equilibria_between_two_samples_are_found() -> None:
    """Just before the fold at which the bistable actuator snaps, two equilibria lie closer than the samples."""
    actuator = Actuator(LOOSE, BISTABLE)
    low, high = 1500.0, 2000.0
    for _ in range(18):
        middle = 0.5 * (low + high)
        many = len(equilibria(actuator, middle, span=(5e-3, 8e-3), points=65).found) == 2
        low, high = (middle, high) if many else (low, middle)
    coarse = equilibria(actuator, low * (1 - 1e-5), span=(3e-3, 10e-3), points=15)
    assert len(coarse.found) == 2
    assert coarse.found[1].h - coarse.found[0].h < 0.2 * 7e-3 / 14


def test_a_film_without_an_answer_is_told_as_a_blind_range() -> None:
    soft = Specimen(4e-3, 20e-3, 100e-6, 3.0, type(PARKER)("soft", (1e5,), (1.3,), 3.0))
    found = equilibria(Actuator(soft, MASS), 360.0)
    assert found.blind
    low, high, status = found.blind[0]
    assert low < high
    assert status in (Status.UNSTABLE, Status.NOT_CONVERGED)


def test_bad_questions_are_refused() -> None:
    with pytest.raises(ValueError, match="voltage"):
        equilibria(Actuator(TAUT, MASS), float("nan"))
    with pytest.raises(ValueError, match="span"):
        equilibria(Actuator(TAUT, MASS), 0.0, span=(5e-3, 1e-3))
