"""Weibull statistics against SciPy's fits, likelihoods by hand and hidden truths of simulated campaigns."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from calibration.breakdown.compare import area_scaling, compare_groups, compare_lognormal
from calibration.breakdown.intervals import SCALE, Interval, WeibullFit, fit_weibull
from calibration.breakdown.location import fit_location
from calibration.breakdown.sample import Sample, simulate
from calibration.breakdown.study import study
from calibration.breakdown.weibull import (
    fit,
    log_likelihood_at_quantile,
    log_likelihood_at_shape,
    lognormal_log_likelihood,
)

SHAPE, TRUE_SCALE = 9.0, 4000.0


def campaign(rng: np.random.Generator, n: int, how: str = "none") -> Sample:
    """Breakdowns of a hidden truth by SciPy; three are censored at the weakest of them, at random, or by a ceiling."""
    value = stats.weibull_min.rvs(SHAPE, scale=TRUE_SCALE, size=n, random_state=rng)
    failed = np.ones(n, bool)
    if how == "strongest":  # the test ends when all but three have failed
        order = np.argsort(value)
        failed[order[-3:]] = False
        value[order[-3:]] = value[order[-4]]
    elif how == "random":  # three specimens were given up on the way, regardless of their strength
        given_up = rng.choice(n, 3, replace=False)
        failed[given_up] = False
        value[given_up] *= rng.uniform(0.5, 1.0, 3)
    elif how == "ceiling":
        top = TRUE_SCALE * (-math.log(0.3)) ** (1 / SHAPE)
        failed, value = value <= top, np.minimum(value, top)
    return Sample(value, failed, np.ones(n))


def by_hand(sample: Sample, shape: float, scale: float) -> float:
    """The log-likelihood, specimen by specimen."""
    total = 0.0
    for value, failed, area in zip(sample.value, sample.failed, sample.area, strict=True):
        total -= area * (value / scale) ** shape
        if failed:
            total += math.log(area * shape / scale * (value / scale) ** (shape - 1))
    return total


@pytest.mark.parametrize("how", ["none", "strongest", "random", "ceiling"])
def test_fit_is_that_of_scipy_and_the_top_of_the_likelihood_by_hand(how: str) -> None:
    sample = campaign(np.random.default_rng(3), 25, how)
    found = fit(*sample.rows)
    shape, scale = float(found.shape[0]), float(np.exp(found.log_scale[0, 0]))
    data = stats.CensoredData.right_censored(sample.value, ~sample.failed)
    theirs, _, their_scale = stats.weibull_min.fit(data, floc=0)
    assert (shape, scale) == (pytest.approx(theirs, rel=1e-4), pytest.approx(their_scale, rel=1e-4))
    top = by_hand(sample, shape, scale)
    assert found.log_likelihood[0] == pytest.approx(top, rel=1e-12)
    assert all(by_hand(sample, shape * a, scale * b) < top for a, b in ((1.01, 1), (0.99, 1), (1, 1.002), (1, 0.998)))
    s, _, middle = stats.lognorm.fit(data, floc=0)
    density = stats.lognorm.logpdf(sample.value, s, 0, middle)
    survival = stats.lognorm.logsf(sample.value, s, 0, middle)
    expected = np.where(sample.failed, density, survival).sum()
    assert lognormal_log_likelihood(*sample.rows[:2])[0] == pytest.approx(expected, abs=1e-6)


def test_profiles_are_the_likelihood_by_hand_maximised_over_the_other_parameter() -> None:
    sample = campaign(np.random.default_rng(4), 12, "random")
    sample = Sample(sample.value, sample.failed, np.geomspace(0.5, 2.0, 12))
    shapes, scales = np.linspace(3, 30, 2701), np.linspace(3000, 6000, 30001)
    at_scale = log_likelihood_at_quantile(*sample.rows, SCALE, np.log([4200.0]))[0]
    assert at_scale == pytest.approx(max(by_hand(sample, k, 4200.0) for k in shapes), abs=1e-5)
    at_shape = log_likelihood_at_shape(*sample.rows, np.array([7.0]))[0]
    assert at_shape == pytest.approx(max(by_hand(sample, 7.0, s) for s in scales[::10]), abs=1e-5)


def covered(interval: Interval, truth: float) -> bool:
    return interval.low <= truth <= interval.high


@pytest.mark.parametrize(
    ("count", "least", "most"),
    [
        pytest.param(60, 0.85, 1.0, marks=pytest.mark.slow),  # wider by chance
        pytest.param(200, 0.90, 0.99, marks=pytest.mark.long),
    ],
)
@pytest.mark.parametrize("how", ["strongest", "random", "ceiling"])
def test_95_percent_intervals_cover_the_truth_in_so_many_campaigns_of_ten(
    how: str, count: int, least: float, most: float
) -> None:
    rng = np.random.default_rng(5)
    campaigns = [one for one in (campaign(rng, 10, how) for _ in range(count)) if one.usable]
    fits: list[WeibullFit] = [fit_weibull(one, rng, 200) for one in campaigns]
    low = TRUE_SCALE * (-math.log(0.9)) ** (1 / SHAPE)
    for name, truth in (("scale", TRUE_SCALE), ("shape", SHAPE), ("low_quantile", low)):
        for kind in ("profile", "bootstrap"):
            share = np.mean([covered(getattr(getattr(one, name), kind), truth) for one in fits])
            assert least <= share <= most, (how, name, kind, share)


def test_intervals_of_the_scale_cover_in_a_few_campaigns() -> None:
    rng = np.random.default_rng(15)
    fits = [fit_weibull(campaign(rng, 10, "strongest"), rng, 100) for _ in range(20)]
    assert 0.85 <= np.mean([covered(one.scale.profile, TRUE_SCALE) for one in fits]) < 1.0
    assert 0.85 <= np.mean([covered(one.scale.bootstrap, TRUE_SCALE) for one in fits]) <= 1.0


@pytest.mark.slow
def test_groups_20_percent_apart_are_told_apart_with_the_power_that_is_stated() -> None:
    rng = np.random.default_rng(6)
    labels = ["a"] * 8 + ["b"] * 8
    seen, stated, false = [], [], []
    for _ in range(40):
        value = campaign(rng, 16).value
        apart = np.where(np.array(labels) == "b", value * 1.2, value)
        found = compare_groups(Sample(apart, np.ones(16, bool), np.ones(16)), labels, rng, 150)
        seen.append(found.p_scale < 0.05)
        stated.append(found.power)
        same = compare_groups(Sample(value, np.ones(16, bool), np.ones(16)), labels, rng, 150)
        false.append(same.p_scale < 0.05)
    assert np.mean(seen) == pytest.approx(np.mean(stated), abs=0.15)
    assert np.mean(false) <= 0.13  # 5 % expected of 40


@pytest.mark.slow
def test_area_scaling_finds_the_weakest_link_and_the_absence_of_any_influence() -> None:
    rng = np.random.default_rng(7)
    area = np.tile([0.1, 1.0, 10.0], 12)
    value = campaign(rng, 36).value
    linked = area_scaling(Sample(value * area ** (-1 / SHAPE), np.ones(36, bool), area), rng, 100)
    assert covered(linked.interval, 1.0) and not covered(linked.interval, 0.0)
    assert linked.p_weakest_link > 0.05 > linked.p_no_influence
    flat = area_scaling(Sample(value, np.ones(36, bool), area), rng, 100)
    assert covered(flat.interval, 0.0) and flat.p_no_influence > 0.05 > flat.p_weakest_link
    scaled = fit(*Sample(value * area ** (-1 / SHAPE), np.ones(36, bool), area).rows)
    plain = fit(*Sample(value, np.ones(36, bool), np.ones(36)).rows)
    assert np.exp(scaled.log_scale[0, 0]) == pytest.approx(np.exp(plain.log_scale[0, 0]), rel=0.02)


def test_location_is_found_where_there_is_one_and_not_where_there_is_none() -> None:
    rng = np.random.default_rng(8)
    value = 3000.0 + stats.weibull_min.rvs(1.6, scale=600.0, size=60, random_state=rng)
    there = fit_location(Sample(value, value < 4000.0, np.ones(60)), rng, 100)
    assert covered(there.location_interval, 3000.0) and there.p_none < 0.05
    none = fit_location(campaign(rng, 60), rng, 100)
    assert none.location_interval.low == 0.0 and none.p_none > 0.05


def test_few_specimens_are_warned_of_and_many_are_told_from_a_lognormal() -> None:
    rng = np.random.default_rng(9)
    few = study(campaign(rng, 8), None, 1, 200)
    assert max(few.lognormal.wrong_if_weibull, few.lognormal.wrong_if_lognormal) > 0.1
    assert any("too few to tell Weibull from lognormal" in one for one in few.warnings)
    value = stats.lognorm.rvs(0.3, scale=4000.0, size=300, random_state=rng)
    many = compare_lognormal(Sample(value, np.ones(300, bool), np.ones(300)), rng, 200)
    assert many.log_ratio < 0 and max(many.wrong_if_weibull, many.wrong_if_lognormal) < 0.05


def test_a_drift_within_the_table_is_warned_of_without_groups() -> None:
    value = campaign(np.random.default_rng(10), 20).value
    assert study(Sample(value * np.repeat([1.0, 0.6], 10), np.ones(20, bool), np.ones(20)), None, 1, 200).halves
    found = study(Sample(value * np.repeat([1.0, 0.6], 10), np.ones(20, bool), np.ones(20)), None, 1, 200)
    assert any("first and second half" in one for one in found.warnings)


def test_the_same_seed_gives_the_same_numbers() -> None:
    sample = campaign(np.random.default_rng(11), 10, "random")
    assert study(sample, None, 5, 200) == study(sample, None, 5, 200)


def test_a_campaign_that_was_ended_by_a_failure_is_simulated_with_as_many_failures() -> None:
    """Three survivors at the last failure: the number of failures was chosen; by a ceiling it is left to chance."""
    ended, ceiling = (campaign(np.random.default_rng(8), 10, how) for how in ("strongest", "ceiling"))
    y, failed = simulate(ended, SHAPE, np.full(10, math.log(TRUE_SCALE)), np.random.default_rng(9), 40)
    assert (failed.sum(axis=1) == 7).all()
    assert (np.sort(y, axis=1)[:, -4:] == y.max(axis=1, keepdims=True)).all()
    _, by_ceiling = simulate(ceiling, SHAPE, np.full(10, math.log(TRUE_SCALE)), np.random.default_rng(9), 40)
    assert len(set(by_ceiling.sum(axis=1).tolist())) > 2


def test_newtons_method_for_a_lognormal_doubles_its_digits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three failures below a ceiling that 27 survive: five steps leave less than 1e-9; with a wrong slope it creeps."""
    value = stats.lognorm.rvs(0.2, scale=4000.0, size=30, random_state=np.random.default_rng(3))
    sample = Sample(np.minimum(value, 3300.0), value <= 3300.0, np.ones(30))
    assert sample.failed.sum() == 3
    end = lognormal_log_likelihood(*sample.rows[:2])[0]
    s, _, middle = stats.lognorm.fit(stats.CensoredData.right_censored(sample.value, ~sample.failed), floc=0)
    density, survival = (one(sample.value, s, 0, middle) for one in (stats.lognorm.logpdf, stats.lognorm.logsf))
    assert end == pytest.approx(np.where(sample.failed, density, survival).sum(), abs=1e-5)
    monkeypatch.setattr("calibration.breakdown.weibull.STEPS", 5)
    assert lognormal_log_likelihood(*sample.rows[:2])[0] == pytest.approx(end, abs=1e-9)
