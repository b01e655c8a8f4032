"""Sheets over time in small: closed forms of linear viscoelasticity, derivatives by differences, criteria by hand."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.sheet.sheet_tests import HomogeneousTest, TestHistory, TestsError
from calibration.sheet.timed import count as counting
from calibration.sheet.timed.count import beside, count_branches, guess, unseen
from calibration.sheet.timed.fit import fit_timed
from calibration.sheet.timed.predict import ConePrediction
from calibration.sheet.timed.problem import ZERO, TimedProblem
from calibration.sheet.timed.record import LEAST_NOISE, SheetRecord, steps_of, stress_fallen
from calibration.sheet.timed.report import _cones, _relaxation
from calibration.sheet.timed.stress import elastic_parts
from model.material.ogden import Ogden

Array = NDArray[np.float64]

MU, ALPHA = 2e4, 2.5
G = 0.5 * MU * ALPHA
RATIO, TIME, RAMP, END = 0.4, 1.5, 1.0, 9.0
SMALL = 1e-4  # strain at which the law is linear


def straight(t: Array, strain: float) -> Array:
    return 1.0 + strain * np.minimum(t / RAMP, 1.0)


def linear(t: Array, strain: float, ratio: float = RATIO) -> Array:
    """Young's modulus 3 G, and a Maxwell branch that is pulled at a constant rate and then held."""
    rising = TIME / RAMP * -np.expm1(-np.minimum(t, RAMP) / TIME)
    branch = rising * np.exp(-np.maximum(t - RAMP, 0.0) / TIME)
    return 3.0 * G * strain * (np.minimum(t / RAMP, 1.0) + ratio * branch)


def made(
    strain: float = SMALL, noise: float = 0.0, ratio: float = RATIO, name: str = "pulled", rate: float = 20.0
) -> HomogeneousTest:
    t = np.arange(0.0, END, 1.0 / rate)
    stress = linear(t, strain, ratio)
    stress = stress + noise * stress.max() * np.random.default_rng(1).standard_normal(t.size)
    stretch = straight(t, strain)
    columns = stretch, stretch**-0.5, stress, np.full_like(t, np.nan)
    return HomogeneousTest(name, "uniaxial", *columns, TestHistory(t, *columns))


def film(problem: TimedProblem) -> Array:
    """The numbers of the law, as shares and shape parameters."""
    share = np.array([1.0, ALPHA])
    (mu,), _ = problem.elastic.film(share)
    found = np.array([MU / mu, ALPHA])
    assert problem.elastic.film(found)[0][0] == pytest.approx(MU)
    return found


@pytest.fixture(scope="module")
def problem() -> TimedProblem:
    return TimedProblem([made(), made(0.5 * SMALL, name="half")], 1, Ogden, negative_exponents=False)


@pytest.fixture(scope="module")
def truth(problem: TimedProblem) -> Array:
    return problem.vector(film(problem), np.array([RATIO]), np.array([TIME]))


def test_elastic_strains_at_small_strain_are_those_of_a_maxwell_element() -> None:
    law = Ogden(np.array([[MU]]), np.array([[ALPHA]]))
    t = np.linspace(0.0, END, 91)
    u = np.log(straight(t, SMALL))
    (w,) = elastic_parts(law, np.array([G, G]), np.array([TIME, 3.0]), [t], [np.stack((u, -0.5 * u))])
    assert w.shape == (2, t.size, 2)
    expected = (linear(t, SMALL, 1.0) - linear(t, SMALL, 0.0)) / (3.0 * G)
    assert w[0, :, 0] == pytest.approx(expected, abs=1e-3 * SMALL)
    assert w[1, :, 0] == pytest.approx(-0.5 * expected, abs=1e-3 * SMALL)
    held = t > 2.0
    assert np.diff(np.log(w[0, held, 1])) == pytest.approx(-0.1 / 3.0, rel=1e-3)


def test_a_short_history_beside_a_long_one_is_that_alone() -> None:
    law = Ogden(np.array([[MU]]), np.array([[ALPHA]]))
    u = np.log(np.linspace(1.0, 1.8, 9))
    both = np.stack((u, -0.5 * u))
    t = np.linspace(0.0, 2.0, 9)
    modulus, tau = np.array([G]), np.array([TIME])
    alone = elastic_parts(law, modulus, tau, [t[:5]], [both[:, :5]])[0]
    beside_it = elastic_parts(law, modulus, tau, [t, t[:5]], [both, both[:, :5]])
    assert [one.shape[1] for one in beside_it] == [9, 5]
    assert beside_it[1] == pytest.approx(alone, rel=1e-12)


def test_the_stress_of_a_problem_is_that_of_linear_viscoelasticity(problem: TimedProblem, truth: Array) -> None:
    point = problem.evaluate(truth)
    assert np.abs(problem.stress(truth) - problem.measured).max() < 2e-3 * problem.largest[0]
    assert point.residual.size == problem.measured.size + 2
    assert point.residual[:-2] == pytest.approx((problem.stress(truth) - problem.measured) / problem.sigma, abs=1e-6)
    assert point.cost == pytest.approx(float((point.residual**2).sum()))
    relaxed, added = problem.of_one(truth[:2], np.array([TIME]))
    assert relaxed + RATIO * added[0] == pytest.approx(problem.stress(truth), rel=1e-12)
    late = np.concatenate([one.time > 8.5 for one in problem.bins])
    assert relaxed[late] == pytest.approx(np.repeat([3 * G * SMALL, 1.5 * G * SMALL], problem._rows)[late], rel=1e-3)


def test_a_vector_holds_law_branches_and_zeros(problem: TimedProblem, truth: Array) -> None:
    assert problem.count(truth) == 1 and truth.size == 2 + 2 + 2
    numbers, ratio, time, zeros = problem.split(truth)
    assert (numbers.size, ratio.tolist(), time.tolist(), zeros.tolist()) == (
        2,
        [RATIO],
        [pytest.approx(TIME)],
        [0.0, 0.0],
    )
    assert problem.window == pytest.approx((0.1, END - 0.05))
    low, high = problem.bounds(truth)
    assert (low[2], high[2]) == (0.0, 20.0)
    assert np.exp([low[3], high[3]]) == pytest.approx([0.1 / 3.0, 10.0 * (END - 0.05)])
    assert np.isinf(low[4:]).all() and np.isinf(high[4:]).all()
    assert problem.varied(truth).tolist() == [*problem.elastic.free.tolist(), True, True, True, True]
    fixed = TimedProblem([made(0.5)], 1, Ogden, negative_exponents=False, fixed={"alpha1": ALPHA})
    assert fixed.varied(np.zeros(5)).tolist() == [True, False, True, True, True]


def test_zeros_are_in_units_of_a_share_of_the_largest_stress(problem: TimedProblem, truth: Array) -> None:
    moved = truth.copy()
    moved[-2:] = 1.0, -2.0
    change = np.split(problem.stress(moved) - problem.stress(truth), [problem._rows[0]])
    for one, size, largest in zip(change, (1.0, -2.0), problem.largest, strict=True):
        assert one == pytest.approx(size * ZERO * largest, rel=1e-9)
    assert problem.evaluate(moved).residual[-2:].tolist() == [1.0, -2.0]
    assert problem.largest == pytest.approx([np.abs(one.stress).max() for one in problem.bins])


def test_derivatives_are_differences() -> None:
    problem = TimedProblem([made(0.5)], 1, Ogden, negative_exponents=False)
    x = problem.vector(film(problem), np.array([RATIO, 0.2]), np.array([TIME, 0.3]), np.array([0.5]))
    point = problem.evaluate(x)
    for k in range(x.size):
        step = np.zeros(x.size)
        step[k] = 1e-4 * max(abs(x[k]), 1.0)
        difference = (problem.evaluate(x + step).residual - problem.evaluate(x - step).residual) / (2.0 * step[k])
        assert np.abs(point.jacobian[:, k] - difference).max() < 2e-3 * np.abs(difference).max(), k


def test_steps_of_time_are_made_finer_until_they_are_good_enough() -> None:
    problem = TimedProblem([made(1.0, 1e-3, rate=10.0)], 1, Ogden, negative_exponents=False)
    x = problem.vector(film(problem), np.array([3.0]), np.array([0.3]))
    coarse = problem.stress(x)
    error = problem.refine(x)
    fine = problem.stress(x)
    problem.fine *= 4
    problem._lay()
    true = problem.stress(x)
    largest = problem.largest[0]
    assert error < 1e-3
    assert np.abs(fine - true).max() / largest < 2.0 * error
    assert np.abs(coarse - true).max() > np.abs(fine - true).max()
    easy = TimedProblem([made(0.05, 0.02)], 1, Ogden, negative_exponents=False)
    easy.refine(easy.vector(film(easy), np.array([RATIO]), np.array([TIME])))
    assert (easy.fine, easy.times[0].size) == (1, steps_of(easy.bins[0], 1).size)


def test_stretches_of_several_tests_are_told_apart(problem: TimedProblem) -> None:
    assert np.unique(problem.stretches).tolist() == [0, 1, 10_000, 10_001]
    assert problem.stretches.size == problem.measured.size == problem.sigma.size
    assert problem.independent == pytest.approx(sum(one.noise.size / one.correlated for one in problem.bins))


def test_a_test_that_begins_stretched_is_pulled_within_a_period() -> None:
    whole = made(0.5)
    assert whole.history is not None
    late = {name: getattr(whole.history, name)[20:] for name in ("time", "stretch1", "stretch2", "stress1", "stress2")}
    record = SheetRecord.of(replace(whole, history=TestHistory(*late.values())))
    assert record.pulled and not SheetRecord.of(whole).pulled
    knots, given = record.polygon
    assert knots[:2] == pytest.approx([-0.05, 0.0]) and given[0, :2] == pytest.approx([1.0, 1.5], abs=1e-6)
    assert record.logs(np.array([-0.05, 1.0]))[:, 0].tolist() == [0.0, 0.0]
    assert record.logs(np.array([1.0]))[:, 0] == pytest.approx([math.log(1.5), -0.5 * math.log(1.5)], rel=1e-6)
    assert record.moving.tolist() == [True] + [False] * (knots.size - 2)


def test_rows_out_of_order_are_left_out_and_too_many_refused() -> None:
    whole = made(0.5)
    assert whole.history is not None
    t = whole.history.time.copy()
    t[50] = t[30]
    record = SheetRecord.of(replace(whole, history=replace(whole.history, time=t)))
    assert record.t.size == t.size - 1
    t[60:100] = t[59]
    with pytest.raises(TestsError, match=f"{t.size - 41} of {t.size} rows have a time later than all before"):
        SheetRecord.of(replace(whole, history=replace(whole.history, time=t)))
    assert stress_fallen(replace(whole, history=replace(whole.history, time=t))) == 0.0


def test_means_over_bins_are_those_of_a_polygon_between_its_knots() -> None:
    """Of a straight line the means by the matrix are the line at the mean times, and those of the rows themselves."""
    bins = SheetRecord.of(made(0.5, 1e-3)).bins
    times = steps_of(bins, 4)
    assert bins.averaging(times) @ (3.0 * times + 1.0) == pytest.approx(3.0 * bins.time + 1.0)
    assert np.asarray(bins.averaging(times).sum(axis=1)).ravel() == pytest.approx(1.0)
    assert bins.size.sum() == bins.record.t.size
    one = bins.number == 5
    assert bins.stress[0, 5] == pytest.approx(bins.record.stress[0, one].mean())
    ends = np.unique(np.concatenate((bins.record.polygon[0], bins.time)))
    assert times.size == 4 * (ends.size - 1) + 1


def test_the_noise_of_means_is_that_of_rows_over_the_root_of_their_number() -> None:
    noise = 4e-3
    bins = SheetRecord.of(made(0.5, noise, rate=100.0)).bins
    largest = float(np.abs(bins.stress).max())
    assert bins.single == pytest.approx(noise * largest, rel=0.08)
    assert bins.correlated == 1.0
    assert bins.sigma == pytest.approx(np.hypot(bins.single / np.sqrt(bins.size), LEAST_NOISE * largest))


def test_how_far_the_stress_falls_in_a_hold() -> None:
    t = np.array([RAMP, END])
    at_top, at_end = linear(t, SMALL)
    assert stress_fallen(made()) == pytest.approx((at_top - at_end) / at_top, abs=0.03)
    assert stress_fallen(made(ratio=0.0)) == 0.0


def test_a_start_has_the_branch_of_data_that_are_linear_in_it(problem: TimedProblem, truth: Array) -> None:
    elastic = problem.evaluate(problem.vector(1.3 * film(problem), np.zeros(0), np.zeros(0)))
    start = guess(problem, elastic, 1)
    assert start is not None
    numbers, ratio, time, _ = problem.split(start)
    assert abs(math.log10(time[0] / TIME)) < 0.13  # half a step of four a decade
    assert ratio[0] == pytest.approx(RATIO, rel=0.15)
    assert problem.elastic.film(numbers)[0][0] * numbers[1] == pytest.approx(MU * ALPHA, rel=0.1)
    wild = SimpleNamespace(x=elastic.x * np.nan)
    assert guess(problem, wild, 1) is None  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("gains", "earned", "wanted", "number"),
    [
        ({1: 500.0, 2: 900.0, 3: 8.0}, {1, 2}, None, 2),
        ({1: 500.0, 2: 900.0}, {2}, None, 2),  # one explains much and predicts badly, as where two are missing
        ({1: 500.0, 2: 900.0, 3: 950.0}, {3}, None, 0),  # but no more than one is passed over
        ({1: 20.0, 2: 900.0}, {2}, None, 0),
        ({1: 1.0, 2: 1.0, 3: 1.0}, set(), 2, 2),
    ],
)
def test_branches_are_added_while_they_pay(
    monkeypatch: pytest.MonkeyPatch, gains: dict[int, float], earned: set[int], wanted: int | None, number: int
) -> None:
    stub = SimpleNamespace(minimise=lambda start, last=False: start)
    monkeypatch.setattr(counting, "guess", lambda problem, fewer, number: number if number in gains else None)
    monkeypatch.setattr(counting, "gain", lambda problem, fewer, more, scale: gains[more])
    monkeypatch.setattr(counting, "pays", lambda problem, fewer, more: (1.0 + more, more in earned))
    monkeypatch.setattr(counting, "counted", lambda problem, points, scale: (points, scale))
    points, scale = count_branches(stub, 0, wanted)  # type: ignore[arg-type, misc]
    assert points == list(range(number + 1))
    assert scale == (1.0 + number if number else 1.0)


def test_a_gain_that_may_be_an_unfinished_search_is_tried_to_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """A small gain: the fit with less goes to its end from its own place and from the richer one's law."""
    ends: list[Array] = []

    def minimise(start: Array, last: bool = False) -> Any:
        if last:
            ends.append(start)
        return SimpleNamespace(x=np.asarray(start, dtype=float), cost=float(np.sum(start)))

    stub = SimpleNamespace(minimise=minimise, split=lambda x: (x[:2],))
    monkeypatch.setattr(counting, "guess", lambda problem, fewer, number: np.array([1.0, 1.0, 5.0, 5.0, 0.0]))
    monkeypatch.setattr(counting, "gain", lambda problem, fewer, more, scale: 10.0)
    monkeypatch.setattr(counting, "pays", lambda problem, fewer, more: (1.0, fewer.cost > 6.0))
    monkeypatch.setattr(counting, "counted", lambda problem, points, scale: points)
    points = count_branches(stub, np.array([3.0, 4.0, 0.0]), None)  # type: ignore[arg-type]
    assert [one.tolist() for one in ends] == [[3.0, 4.0, 0.0], [1.0, 1.0, 0.0], [1.0, 1.0, 5.0, 5.0, 0.0]]
    assert len(points) == 1 and points[0].x.tolist() == [1.0, 1.0, 0.0]  # type: ignore[attr-defined]


def test_a_branch_alone_shows_from_less_than_beside_the_one_that_was_found(problem: TimedProblem, truth: Array) -> None:
    point = problem.evaluate(truth)
    alone = dict(unseen(problem, point, 1.0))
    near = min(alone, key=lambda time: abs(math.log(time / TIME)))
    assert alone[near] < 0.1
    assert alone[max(alone)] > 2.0 * alone[near]  # far beyond the end of the test it looks like stiffness
    times, rows = beside(problem, point, 1.0, 50.0)
    assert (np.abs(np.log10(times / TIME)) >= 0.5 - 1e-6).all() and times.max() <= 50.0
    assert rows.shape == (times.size, point.residual.size) and (rows[:, -2:] == 0.0).all()


def test_a_fit_gives_modulus_and_branch_and_counts_what_is_uncertain() -> None:
    """Small strain: the exponent is fixed, as it changes nothing there."""
    given = [made(noise=2e-3), made(0.5 * SMALL, 2e-3, name="half")]
    found = fit_timed(given, terms=1, fixed={"alpha1": ALPHA}, branches=1, predict=[made(2.0 * SMALL, name="other")])
    shear = found.quantities["G"]
    assert abs(shear.value - G) < 3.0 * shear.uncertainty < 0.03 * G
    assert shear.uncertainty == pytest.approx(math.hypot(*shear.budget.values()))
    (branch,) = found.spectrum.branches
    assert abs(branch.ratio - RATIO) < 3.0 * branch.ratio_uncertainty < 0.1
    assert abs(math.log(branch.time / TIME)) < 3.0 * branch.time_relative
    at_once = found.spectrum.instant
    assert abs(at_once.value - (1.0 + RATIO) * G) < 3.0 * at_once.uncertainty
    assert at_once.value == pytest.approx((1.0 + branch.ratio) * shear.value)
    assert [one.name for one in found.tests] == ["pulled", "half"]
    assert set(found.zeros) == {"pulled", "half"}
    assert all(abs(zero) < 3.0 * ZERO * 3.0 * G * SMALL * 1.4 for zero in found.zeros.values())
    assert found.predicted[0].rms < 5e-3 * found.predicted[0].largest
    assert found.predicted[0].r_squared > 0.99
    assert found.reduced_chi_square == pytest.approx(1.0, abs=0.5)
    assert found.stiffness_relative(1.0 + SMALL, 1.0) == pytest.approx(shear.relative, rel=0.6)
    assert "alpha1" not in found.quantities and found.fixed == {"alpha1": ALPHA}
    told = re.findall(r"<!-- (.*?) -->", _relaxation(found.tests))
    assert "time since the sheet stood still / s" in told and any("stretch 1" in one for one in told)


def test_the_picture_of_cones_names_its_axes_with_units() -> None:
    h = np.linspace(0.0, 5e-3, 5)
    cone = ConePrediction("run-7", h, h, 0.0 * h, 10.0 * h, 9.0 * h, 10.0 / 9.0, 0.02)
    words = re.findall(r"<!-- (.*?) -->", _cones([cone]))
    assert {"run-7", "displacement h / mm", "force / N"} <= set(words)
    assert cone.rms == pytest.approx(0.1 * math.sqrt(30.0 / 80.0))
    assert cone.rms_scaled == pytest.approx(0.0, abs=1e-12)
    assert not cone.agrees and replace(cone, uncertainty=0.06).agrees
