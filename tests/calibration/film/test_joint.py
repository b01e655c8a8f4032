"""The joint fit of law, branches and the rig's errors, on two short runs of the independent cone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from calibration.film.branches.identify import _Found
from calibration.film.branches.joint import NUMERICAL, SOFTENS, Joint, Point
from calibration.film.branches.record import Record, record_of
from calibration.film.branches.spectrum import count_branches, guess, softens_perhaps, unseen
from calibration.film.curve import Curve
from model.material.materials import Branch, Material
from model.specimen import Specimen
from tests.calibration.film.viscous_cone import Trace, ViscousCone
from tests.calibration.film.viscous_runs import EXACT, ONE_TERM

Array = NDArray[np.float64]
Corners = tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]

RATIO, TIME = 0.3, 1.5
TWO_CYCLES: Corners = (
    (0.0, 2.0, 5.0, 7.0, 9.0, 11.0, 14.0),
    (0.0, 10e-3, 10e-3, 1e-3, 1e-3, 10e-3, 10e-3),
    (0.0,) * 7,
)
CHARGED: Corners = ((0.0, 1.0, 5.0, 5.5, 8.0), (0.0, 9e-3, 9e-3, 9e-3, 9e-3), (0.0, 0.0, 0.0, 1500.0, 1500.0))
RATE = 25.0
NOISE = 1e-4
TRUTH = Material("truth", ONE_TERM["mu"], ONE_TERM["alpha"], ONE_TERM["eps_r"], branches=(Branch(RATIO, TIME),))  # type: ignore[arg-type]
ELASTIC = replace(TRUTH, branches=())
STATED = {
    "force_zero": 2e-4,
    "displacement_zero": 1e-5,
    "lag_uncertainty": 5e-3,
    "compliance_uncertainty": 2e-5,
    "thickness_uncertainty": 0.02,
    "disk_radius_uncertainty": 0.01,
    "force_gain": 2e-3,
}


@lru_cache(maxsize=8)
def solved(disk: float, corners: Corners, ratio: float) -> Trace:
    """By the independent cone."""
    branches = ((ratio, TIME),) if ratio else ()
    return ViscousCone(a=disk, branches=branches, elements=20, **ONE_TERM).history(*corners, moves=14)  # type: ignore[arg-type]


def forces(t: Array, disk: float, corners: Corners, ratio: float = RATIO) -> Array:
    """Of the independent cone; smooth in between the corners, with a bend at each."""
    trace, found = solved(disk, corners, ratio), np.zeros(t.size)
    for left, right in pairwise(corners[0]):
        mine, known = (t >= left) & (t <= right), (trace.t >= left - 1e-9) & (trace.t <= right + 1e-9)
        found[mine] = CubicSpline(trace.t[known], trace.force[known])(t[mine])
    return found


def run(name: str, disk: float, corners: Corners, seed: int | None = 1, ratio: float = RATIO, **stated: float) -> Curve:
    """All samples of one run; the measured forces with noise, without any where there is no seed."""
    t = np.arange(0.01, corners[0][-1], 1.0 / RATE)
    noise = NOISE * np.random.default_rng(seed).standard_normal(t.size) if seed is not None else np.zeros(t.size)
    h, v = np.interp(t, *corners[:2]), np.interp(t, corners[0], corners[2])
    return Curve(
        label=name, run=name, specimen=Specimen(disk, 20e-3, 40e-6, 1.2, ELASTIC, name=name), h=h,
        force=forces(t, disk, corners, ratio) + noise, voltage=v, nominal_voltage=float(v.max()),
        direction=np.zeros(t.size, dtype=np.int8), force_noise=NOISE, displacement_noise=0.0, time=t,
        **(EXACT | stated),
    )  # fmt: skip


def record(curve: Curve) -> Record:
    return record_of(curve, -math.inf, math.inf)


def pair(seed: int | None = 1, **stated: float) -> list[Curve]:
    return [run("a", 4e-3, TWO_CYCLES, seed, **stated), run("b", 6e-3, CHARGED, seed, **stated)]


def joint_of(curves: Sequence[Curve], start: Material = ELASTIC) -> Joint:
    return Joint([record(one) for one in curves], start, 1, tolerance=1e-3)


def first_order(joint: Joint, x: Array) -> Point:
    joint.settle(x)
    return joint.evaluate(x)


def exact_at(joint: Joint, x: Array) -> Point:
    joint.exact(first_order(joint, x))
    return joint.evaluate(x)


@pytest.fixture(scope="module")
def stated() -> tuple[Joint, Array]:
    """Both runs with all that can be stated of the rig, and the truth as its vector."""
    joint = joint_of(pair(None, **STATED))
    return joint, joint.vector(TRUTH)


def test_a_vector_holds_film_branches_and_errors_and_gives_the_film_back(stated: tuple[Joint, Array]) -> None:
    joint, x = stated
    kinds = [(one.kind, one.run, one.prior) for one in joint.nuisances]
    assert kinds[:7] == [
        ("force_zero", "a", 2e-4),
        ("displacement_zero", "a", 1e-5),
        ("lag", "a", 5e-3),
        ("force_zero", "b", 2e-4),
        ("displacement_zero", "b", 1e-5),
        ("lag", "b", 5e-3),
        ("compliance", "the rig", 2e-5),
    ]
    assert kinds[7:] == [
        ("softening", "a, cycle 2", SOFTENS),
        ("thickness", "contrast 1", 1.0),
        ("disk_radius", "contrast 1", 1.0),
    ]
    assert x.size == 3 + 2 + len(kinds)
    assert joint.count(x) == 1
    back = joint.film(x)
    assert (*back.mu, *back.alpha, back.eps_r) == pytest.approx((*TRUTH.mu, *TRUTH.alpha, TRUTH.eps_r))
    assert [(one.ratio, one.time) for one in back.branches] == [pytest.approx((RATIO, TIME))]
    low, high = joint.bounds(x)
    assert joint.window == pytest.approx((2.0 / RATE, 14.0), abs=0.1)
    assert (low[3], high[3]) == (0.0, 20.0)
    assert np.exp([low[4], high[4]]) == pytest.approx([joint.window[0] / 3.0, 10.0 * joint.window[1]])
    assert np.isinf(low[5:]).all() and np.isinf(high[5:]).all()


def test_softening_and_held_numbers_are_not_varied(stated: tuple[Joint, Array]) -> None:
    joint, x = stated
    assert np.flatnonzero(~joint.varied(x)).tolist() == [3 + 2 + 7]
    held = Joint(joint.records[1:], ELASTIC, 1, ("eps_r",))
    assert held.coordinates.names == joint.coordinates.names[:2]  # no voltage counts: no permittivity to fit


def test_the_exact_model_has_the_forces_of_the_independent_cone(stated: tuple[Joint, Array]) -> None:
    joint, x = stated
    before = joint.state
    point = exact_at(joint, x)
    assert np.array_equal(joint.correction.at, x[:5])  # film and branches
    joint.state = before
    off = point.residual[: joint.force.size] * joint.sigma
    for one, mine in zip(joint.bins, np.split(off, [joint.bins[0].time.size]), strict=True):
        assert np.abs(mine).max() < 4e-3 * joint.peak, one.record.run
        assert np.sqrt(np.mean(mine**2)) < 1.5e-3 * joint.peak
    assert np.array_equal(point.residual[joint.force.size :], x[5:])


def test_derivatives_by_film_and_branches_are_differences_of_exact_solutions() -> None:
    joint = joint_of([run("b", 6e-3, CHARGED, None)])
    x = joint.vector(TRUTH)
    rough, here = first_order(joint, x), exact_at(joint, x)
    for k in range(5):
        moved = x.copy()
        moved[k] += 1e-2
        difference = (exact_at(joint, moved).residual - here.residual) / 1e-2
        assert np.abs(here.jacobian[:, k] - difference).max() < 0.05 * np.abs(difference).max(), k
        assert np.abs(rough.jacobian[:, k] - difference).max() < 0.02 * np.abs(difference).max(), k


def wrong(curve: Curve, **change: float) -> Curve:
    """The run as a rig with these errors would have recorded it."""
    assert curve.time is not None
    force = curve.force + change.get("zero", 0.0)
    if "late" in change:
        force = forces(np.maximum(curve.time - change["late"], 0.0), curve.specimen.disk_radius, TWO_CYCLES)
    if "loss" in change:
        force = np.where(curve.time > 9.0, force * (1.0 - change["loss"]), force)
    h = curve.h + change.get("compliance", 0.0) * force + change.get("offset", 0.0)
    return replace(curve, force=force, h=h)


@pytest.mark.parametrize(
    ("number", "size", "change"),
    [
        (0, 1.0, {"zero": 2e-4}),
        (1, -1.0, {"offset": 1e-5}),
        (2, 1.0, {"late": 5e-3}),
        (6, 1.0, {"compliance": 2e-5}),
        (7, 1.0, {"loss": SOFTENS}),
    ],
)
def test_an_error_of_one_run_is_what_its_number_explains(
    stated: tuple[Joint, Array], number: int, size: float, change: dict[str, float]
) -> None:
    """With the number at the error that was made, the residuals are those without it; the other run's stay."""
    joint, x = stated
    point = first_order(joint, x)
    data = joint.force.size
    first = joint.bins[0].time.size
    given = pair(None, **STATED)
    off = joint_of([wrong(given[0], **change), given[1]])
    assert [one.time.size for one in off.bins] == [one.time.size for one in joint.bins]
    there = x.copy()
    there[5 + number] = size
    seen, explained = (
        first_order(off, at).residual[:data] * off.sigma - point.residual[:data] * joint.sigma for at in (x, there)
    )
    mine = slice(1, first)  # but for the first bin: the run began before it was late
    assert np.abs(explained[mine]).max() < 0.1 * np.abs(seen[mine]).max()
    if number != 6:  # the rig is the same in both runs
        assert np.abs(explained[first:]).max() < 1e-6 * joint.peak


def test_contrasts_change_the_specimens_against_each_other(stated: tuple[Joint, Array]) -> None:
    """Of two films the errors are +1 and -1 over the root of two of what is not common: 2 % each, half of it common."""
    joint, x = stated
    point = first_order(joint, x)
    first = joint.bins[0].time.size
    column = point.jacobian[: joint.force.size, 5 + 8] * joint.sigma
    zero_v = np.concatenate([one.voltage == 0.0 for one in joint.bins])
    model = point.residual[: joint.force.size] * joint.sigma + joint.force
    share = column / model
    a, b = share[:first], share[first:][zero_v[first:]]
    assert a == pytest.approx(a[0], rel=1e-3) and b == pytest.approx(-a[0], rel=1e-3)
    assert abs(a[0]) == pytest.approx(0.02 * math.sqrt(0.5) * math.sqrt(0.5), rel=1e-3)


def test_deviations_are_those_of_means_and_what_is_stated_is_enlarged_where_samples_scatter_more() -> None:
    quiet = joint_of([run("a", 4e-3, TWO_CYCLES)])
    (bins,) = quiet.bins
    assert (quiet.excess, quiet.correlation_time) == (1.0, 1.0)
    assert quiet.sigma == pytest.approx(np.hypot(NOISE / np.sqrt(bins.size), NUMERICAL * quiet.peak), rel=1e-6)
    loud = joint_of([replace(run("a", 4e-3, TWO_CYCLES), force_noise=0.5 * NOISE)])
    assert loud.excess == pytest.approx(4.0, rel=0.25)
    assert loud.sigma == pytest.approx(
        np.hypot(0.5 * NOISE * math.sqrt(loud.excess) / np.sqrt(bins.size), NUMERICAL * quiet.peak), rel=1e-6
    )
    assert quiet.independent == bins.size.sum()


def test_a_reading_of_a_moving_disk_errs_by_the_films_stiffness() -> None:
    curve = run("a", 4e-3, TWO_CYCLES)
    still, moved = (joint_of([replace(curve, displacement_noise=size)]) for size in (0.0, 1e-5))
    (bins,) = moved.bins
    moving = moved.records[0].moving[bins.segment]
    assert moved.sigma[~moving] == pytest.approx(still.sigma[~moving], rel=1e-6)
    film = ViscousCone(branches=(), elements=20, **ONE_TERM)  # type: ignore[arg-type]
    ends = film.history([0.0, 1.0], [0.0, 6e-3], [0.0, 0.0], moves=12).at(np.array([0.9, 1.0]))
    stiffness = float(np.diff(ends)[0]) / 0.6e-3
    one = int(np.flatnonzero(moving & (np.abs(bins.h - 5.7e-3) < 3e-4))[0])
    expected = math.hypot(NOISE, 1e-5 * stiffness) / math.sqrt(bins.size[one])
    assert moved.sigma[one] == pytest.approx(math.hypot(expected, NUMERICAL * moved.peak), rel=0.08)


def test_bins_where_the_film_is_slack_are_left_out_unless_hardly_any_would_stay() -> None:
    strong = replace(ELASTIC, branches=(Branch(2.0, 3.0),))
    corners: Corners = ((0.0, 1.0, 10.0, 11.0, 11.5), (0.0, 12e-3, 12e-3, 0.5e-3, 0.5e-3), (0.0,) * 5)
    joint = joint_of([run("a", 4e-3, corners, ratio=0.0)])
    x = joint.vector(strong)
    point = exact_at(joint, x)
    (bins,) = joint.bins
    assert joint.kept[bins.time < 10.0].all()
    assert not joint.kept[bins.time > 10.8].any()
    assert (point.residual[: joint.kept.size][~joint.kept] == 0.0).all()
    assert (joint.stretches == -1).tolist() == (~joint.kept).tolist()
    assert joint.independent == bins.size[joint.kept].sum()
    fewer = joint.fewer(point, bins.time < 5.0)
    assert joint.kept.sum() == (bins.time < 5.0).sum()
    assert fewer.settled
    only = joint_of([run("a", 4e-3, corners, ratio=0.0)])
    only.within = only.kept & (bins.time > 10.7)  # of what may be kept next to nothing is taut
    exact_at(only, x)
    assert only.kept.all()


@pytest.fixture(scope="module")
def fitted() -> tuple[Joint, list[Curve], _Found]:
    """Both runs with noise, and the fit of them with as many branches as pay."""
    curves = pair(1, force_zero=2e-4, thickness_uncertainty=0.02, force_gain=2e-3)
    joint = joint_of(curves, Material("guess", (3e4,), (5.0,), 2.0))
    tried = count_branches(joint, joint.vector(Material("guess", (3e4,), (5.0,), 2.0)), None)
    return joint, curves, _Found(joint, tried, None)


def test_the_branch_of_the_cone_is_found_and_no_further_one(fitted: tuple[Joint, list[Curve], _Found]) -> None:
    joint, _, found = fitted
    assert [one.branches for one in found.tried][:2] == [0, 1]
    assert found.tried[-1].aicc == 0.0 and found.tried[0].aicc > 1000.0
    ratios = [one.ratio for one in found.film.branches]
    assert max(ratios) == pytest.approx(RATIO, rel=0.05)
    (time,) = [one.time for one in found.film.branches if one.ratio == max(ratios)]
    assert time == pytest.approx(TIME, rel=0.08)
    assert found.film.eps_r == pytest.approx(TRUTH.eps_r, rel=0.03)
    assert found.film.shear_modulus == pytest.approx(TRUTH.shear_modulus, rel=0.03)
    assert found.point.settled
    assert not joint.soften


def test_curves_less_the_branches_are_those_of_the_elastic_cone(fitted: tuple[Joint, list[Curve], _Found]) -> None:
    joint, curves, found = fitted
    for curve, plain, corners in zip(curves, found.relaxed(curves), (TWO_CYCLES, CHARGED), strict=True):
        assert curve.time is not None
        alone = forces(curve.time, curve.specimen.disk_radius, corners, 0.0)
        branches = float(np.abs(curve.force - alone).max())
        assert np.sqrt(np.mean((plain.force - alone) ** 2)) < 0.06 * branches
        assert plain.flagged is not None and not plain.flagged.any()
    for trace, one in zip(found.traces(), joint.bins, strict=True):
        assert np.array_equal(trace.measured, one.force)
        assert np.sqrt(np.mean((trace.model - trace.measured) ** 2)) < 5e-3 * joint.peak
        assert np.abs(trace.model - trace.relaxed).max() > 0.03 * joint.peak


def replace_effects(found: _Found) -> _Found:
    other = copy(found)
    other.effects = {}
    return other


def test_parts_of_an_uncertainty_are_those_of_the_covariance(fitted: tuple[Joint, list[Curve], _Found]) -> None:
    """All numbers free and no error but those fitted along: the squares of the parts are the inverse of J^T J."""
    joint, _, found = fitted
    low, high = joint.coordinates.parameters[1].search
    width = high - low
    known = np.zeros((1, found.point.x.size))
    known[0, 1] = math.sqrt(12.0) / width
    free = joint.varied(found.point.x)
    rows = np.concatenate((found.point.jacobian, known))[:, free]
    matrix = np.linalg.inv(rows.T @ rows)
    found = replace_effects(found)  # gains and what dimensions share are not in it
    for place, k in enumerate(np.flatnonzero(free)):
        parts = found.budget(np.eye(found.point.x.size)[k])
        parts.pop("lack of fit", None)
        assert math.hypot(*parts.values()) == pytest.approx(math.sqrt(matrix[place, place]), rel=1e-4), k
        assert {"noise", "force zero", "thickness"} <= set(parts)


def test_a_quick_move_is_answered_by_all_branches_at_once(fitted: tuple[Joint, list[Curve], _Found]) -> None:
    """Ogden's stress of one term, written out: the relaxed film from flat, the branches from the pre-stretch."""
    _, _, found = fitted
    mu, alpha, one, two, rest = found.film.mu[0], found.film.alpha[0], 1.5, 1.2, 1.2

    def stress(a: float, b: float) -> float:
        return mu * (a**alpha - (a * b) ** -alpha)

    over = one**2 - (one * two) ** -2.0
    ratio = sum(branch.ratio for branch in found.film.branches)
    value = (stress(one, two) + ratio * stress(one / rest, two / rest)) / over
    quantity = found.instant(one, two, rest)
    assert quantity.value == pytest.approx(value, rel=1e-9)
    assert found.stiffness(one, two).value == pytest.approx(stress(one, two) / over, rel=1e-9)
    assert 0.0 < found.stiffness(one, two).uncertainty < quantity.uncertainty < 0.1 * value


def test_a_branch_that_would_show_is_one_that_changes_the_forces(fitted: tuple[Joint, list[Curve], _Found]) -> None:
    joint, _, found = fitted
    hidden = unseen(joint, found.point, 1.0)
    alone = unseen(joint, found.point, 1.0, alone=True)
    assert [one.time for one in hidden] == [one.time for one in alone]
    assert all(a.shows_from <= b.shows_from * (1.0 + 1e-9) for a, b in zip(alone, hidden, strict=True))
    near = min(alone, key=lambda one: abs(math.log(one.time / TIME)))
    assert near.shows_from < 0.1 * RATIO
    size = len(joint.nuisances)
    assert all((one.shape[-size:] == 0.0).all() for one in hidden)


def test_a_loss_in_the_second_cycle_is_found_as_softening_and_not_as_another_branch() -> None:
    given = wrong(run("a", 4e-3, TWO_CYCLES, 2), loss=0.04)
    joint = joint_of([given])
    tried = count_branches(joint, joint.vector(ELASTIC), 1)
    assert joint.soften
    found = _Found(joint, tried, 1)
    (one,) = found.softening()
    assert (one.run, one.cycle) == ("a", 2)
    assert one.loss == pytest.approx(0.04, abs=0.01)
    curve = found.relaxed([given])[0]
    assert curve.time is not None
    late = curve.time > 12.0
    alone = forces(curve.time[late], 4e-3, TWO_CYCLES, 0.0)
    assert np.mean(curve.force[late]) == pytest.approx(np.mean(alone), rel=0.02)


def test_a_start_has_the_time_and_the_size_of_the_branch_and_none_where_there_is_none() -> None:
    for ratio in (RATIO, 0.0):
        joint = joint_of([run("a", 4e-3, TWO_CYCLES, 3, ratio)])
        x = joint.vector(ELASTIC)
        point = exact_at(joint, x)
        start = guess(joint, point, 1)
        assert not softens_perhaps(joint, joint.fit(x)) or ratio
        if not ratio:
            assert start is None or joint.film(start).branches[0].ratio < 0.02
            continue
        assert start is not None
        (branch,) = joint.film(start).branches
        assert branch.ratio == pytest.approx(RATIO, rel=0.35)
        assert abs(math.log10(branch.time / TIME)) < 0.3


def test_a_start_with_one_branch_more_keeps_the_time_of_the_one_that_is_there() -> None:
    joint = joint_of([run("a", 4e-3, TWO_CYCLES, 3)])
    poor = joint.vector(replace(ELASTIC, branches=(Branch(0.05, 0.1),)))
    more = guess(joint, first_order(joint, poor), 1)
    assert more is not None and joint.count(more) == 2
    quick, slow = joint.film(more).branches
    assert quick.time < 0.3  # all else moves to first order
    assert abs(math.log10(slow.time / TIME)) < 0.3
    assert slow.ratio == pytest.approx(RATIO, rel=0.4)
