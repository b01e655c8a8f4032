"""Statistics over specimens, held to what simulated campaigns of known scatter say."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rig.campaign.statistics import DAY_S, Value, statistics_of

MEAN, BETWEEN, WITHIN = 70.0, 5.0, 2.0


def campaign(
    rng: np.random.Generator, specimens: int, runs: int, *, apart: float = 0.0, drift: float = 0.0
) -> list[Value]:
    """Specimens of two batches in turn, so many runs of each, an hour apart."""
    found, hour = [], 0
    for k in range(specimens):
        own = MEAN + BETWEEN * rng.normal() + (apart if k % 2 else 0.0)
        for _ in range(runs):
            at = hour * 3600.0
            found.append(Value(f"s{k}", "AB"[k % 2], at, own + WITHIN * rng.normal() + drift * at / DAY_S))
            hour += 1
    return found


@pytest.mark.slow
def test_intervals_hold_the_mean_and_the_scatters_are_those_of_the_truth() -> None:
    rng = np.random.default_rng(1)
    inside, between, within = 0, [], []
    for _ in range(200):
        found = statistics_of("x", "1", campaign(rng, 8, 3))
        inside += found.interval[0] <= MEAN <= found.interval[1]
        between.append(found.between**2)
        within.append(found.within**2)
    assert 180 <= inside <= 199
    assert np.mean(between) == pytest.approx(BETWEEN**2, rel=0.15)
    assert np.mean(within) == pytest.approx(WITHIN**2, rel=0.05)
    assert found.specimens == found.repeated == 8


@pytest.mark.slow
def test_groups_that_differ_are_told_apart_and_those_that_do_not_are_not() -> None:
    rng = np.random.default_rng(2)
    same = [statistics_of("x", "1", campaign(rng, 12, 1)).p_groups for _ in range(100)]
    apart = [statistics_of("x", "1", campaign(rng, 12, 1, apart=15.0)).p_groups for _ in range(50)]
    assert np.mean(np.array(same) < 0.05) <= 0.12
    assert np.mean(np.array(apart) < 0.05) >= 0.9


@pytest.mark.slow
def test_a_drift_over_the_days_is_found_and_a_late_batch_is_none() -> None:
    rng = np.random.default_rng(3)
    drifting = statistics_of("x", "1", campaign(rng, 40, 2, drift=8.0))
    assert drifting.drift_per_day == pytest.approx(8.0, abs=3 * drifting.drift_uncertainty)
    assert drifting.p_drift < 0.01
    none = [statistics_of("x", "1", campaign(rng, 10, 1)).p_drift for _ in range(100)]
    assert np.mean(np.array(none) < 0.05) <= 0.12
    late = [
        Value(f"s{k}", "A" if k < 10 else "B", k * DAY_S, (60.0 if k < 10 else 80.0) + rng.normal()) for k in range(20)
    ]
    found = statistics_of("x", "1", late)
    assert abs(found.drift_per_day) < 3 * found.drift_uncertainty and found.p_groups < 1e-3


def test_bounds_are_counted_and_in_no_number() -> None:
    values = [Value("a", "", 0.0, 1.0), Value("b", "", 1.0, 2.0), Value("c", "", 2.0, 99.0, bound=True)]
    found = statistics_of("x", "V", values)
    assert (found.specimens, found.mean, found.bounds) == (2, 1.5, 1)


def test_too_few_say_nothing() -> None:
    found = statistics_of("x", "V", [Value("a", "A", 0.0, 1.0)])
    assert found.mean == 1.0
    for number in (found.standard_uncertainty, found.between, found.within, found.p_groups, found.p_drift):
        assert math.isnan(number)
    assert math.isnan(statistics_of("x", "V", []).mean)
