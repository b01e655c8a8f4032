"""From standards and readings to a gain and its budget, held against numbers worked out another way."""

import math

import numpy as np
import pytest

from calibration.sensors.sensor import SensorError, Standstill, characterise


def series(reading, levels=(0.0, 0.2, 0.4, 0.6, 0.8), cycles=3, noise=0.0, seed=1, **more):
    """Standstills rising and falling; ``reading(applied, direction, t)`` in the sensor's unit."""
    rng = np.random.default_rng(seed)
    found = []
    for cycle in range(1, cycles + 1):
        for direction, order in ((1, levels), (-1, levels[::-1])):
            for x in order:
                t = 10.0 * len(found)
                y = reading(x, direction, t) + noise / math.sqrt(100) * rng.standard_normal()
                found.append(
                    Standstill(x, more.get("error", 0.0), f"{x:g}", y, noise, 100, t, cycle=cycle, direction=direction)
                )
    return found


def component(found, name):
    return next(part.relative for part in found.budget if part.name == name)


def test_gain_zero_and_drift_of_a_straight_sensor_are_exact():
    found = characterise(series(lambda x, d, t: 0.013 + 1e-5 * t + 2.0 * x), {})
    assert found.gain == pytest.approx(0.5, rel=1e-12)
    assert found.zero == pytest.approx(0.013, rel=1e-9)
    assert found.drift == pytest.approx(1e-5, rel=1e-9)
    assert found.order == 1
    np.testing.assert_allclose(found.residuals, 0.0, atol=1e-12)
    assert (found.low, found.high) == (0.0, 0.8)


def test_statistical_part_agrees_with_ordinary_regression():
    standstills = series(lambda x, d, t: 2.0 * x, noise=0.01)
    found = characterise(standstills, {})
    x, y, t = (np.array([getattr(one, key) for one in standstills]) for key in ("applied", "reading", "t"))
    columns = np.column_stack([np.ones_like(x), t, x])
    beta, rss, *_ = np.linalg.lstsq(columns, y, rcond=None)
    u = math.sqrt(np.linalg.inv(columns.T @ columns)[2, 2] * rss[0] / (len(x) - 3))
    assert 1 / found.gain == pytest.approx(beta[2], rel=1e-9)
    # What the readings themselves scatter by is a floor: luck in the residuals must not make the fit look better.
    floor = math.sqrt(np.linalg.inv(columns.T @ columns)[2, 2]) * 0.01 / math.sqrt(100)
    assert component(found, "fit") == pytest.approx(max(u, floor) / beta[2], rel=1e-6)


def test_an_error_of_one_standard_is_not_averaged_away_by_repeating_it():
    few = characterise(series(lambda x, d, t: 2.0 * x, cycles=2, error=1e-3), {})
    many = characterise(series(lambda x, d, t: 2.0 * x, cycles=20, error=1e-3), {})
    assert component(many, "standards") == pytest.approx(component(few, "standards"), rel=0.02)
    # By hand, without drift: w = (x - mean) / sum (x - mean)^2 per level.
    x = np.array([0.0, 0.2, 0.4, 0.6, 0.8])
    w = (x - x.mean()) / ((x - x.mean()) ** 2).sum()
    assert component(many, "standards") == pytest.approx(1e-3 * math.sqrt((w**2).sum()), rel=0.02)


def test_what_all_standards_share_goes_in_as_it_is():
    found = characterise(series(lambda x, d, t: 2.0 * x), {"local gravity": 5e-4, "air buoyancy": 1.2e-4})
    assert found.gain_uncertainty == pytest.approx(math.hypot(5e-4, 1.2e-4), rel=1e-6)
    assert found.expanded_uncertainty(0.8) == pytest.approx(2 * 0.8 * math.hypot(5e-4, 1.2e-4), rel=1e-6)


def test_a_bent_sensor_is_told_by_its_order_and_paid_for():
    bent = characterise(series(lambda x, d, t: 2.0 * x + 0.02 * x * (0.8 - x), noise=0.002), {})
    straight = characterise(series(lambda x, d, t: 2.0 * x, noise=0.002), {})
    assert (bent.order, straight.order) == (2, 1)
    # The parabola is 0.02 x (0.8 - x): 0.0032 at its top, and its best line runs at two thirds of it.
    assert bent.linearity == pytest.approx(0.0032 / 2 / 2, rel=0.1)
    assert component(bent, "linearity") > 5 * component(straight, "fit")


def test_hysteresis_and_repeatability():
    found = characterise(series(lambda x, d, t: 2.0 * x - 1e-3 * d * x * (0.8 - x)), {})
    x = np.array([0.0, 0.2, 0.4, 0.6, 0.8])
    # Within a cycle falling comes after rising, so that the drift takes a small part of it.
    assert found.hysteresis == pytest.approx(float(np.mean(2e-3 * x * (0.8 - x))) / 2, rel=0.1)
    assert found.repeatability == pytest.approx(0.0, abs=1e-15)
    noisy = characterise(series(lambda x, d, t: 2.0 * x, cycles=20, noise=0.05), {})
    assert noisy.repeatability == pytest.approx(0.05 / 10 / 2, rel=0.15)
    assert noisy.noise == pytest.approx(0.05 * noisy.gain, rel=1e-9)


def test_stated_uncertainty_covers_the_truth_as_often_as_it_says():
    inside = 0
    for seed in range(400):
        found = characterise(series(lambda x, d, t: 2.0 * x, cycles=2, noise=0.02, seed=seed), {})
        inside += abs(found.gain - 0.5) <= 2 * found.gain * found.gain_uncertainty
    assert 0.92 <= inside / 400 <= 0.99


@pytest.mark.parametrize(
    ("standstills", "words"),
    [
        (series(lambda x, d, t: 2.0 * x)[:3], "at least"),
        (series(lambda x, d, t: 2.0 * x, levels=(0.5,)), "at least two"),
        (series(lambda x, d, t: math.nan), "no valid reading"),
        (series(lambda x, d, t: 0.0), "does not follow"),
    ],
)
def test_data_that_make_no_calibration_are_refused(standstills, words):
    with pytest.raises(SensorError, match=words):
        characterise(standstills, {})
