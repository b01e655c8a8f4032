"""Branches of films that take time, from data of an independent cone."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from calibration.film.branches.estimate import with_elastic_error
from calibration.film.branches.identify import identify_branches
from calibration.film.branches.joint import Joint
from calibration.film.branches.polygon import Stretches, through
from calibration.film.branches.record import Record
from calibration.film.branches.response import Motion, Relaxed
from calibration.film.branches.result import BranchCount, FoundBranch, Known, LeftOut, Spectrum
from calibration.film.branches.spectrum import count_branches, covariance
from calibration.film.curve import Curve
from calibration.film.identify import identify
from calibration.film.result import GOOD, Identification, Quantity
from model.material.materials import NAMED, Branch, Material
from model.membrane.solution import Status
from model.membrane.solve import solve
from model.specimen import Specimen
from tests.calibration.film.independent import secant_modulus
from tests.calibration.film.shooting import Cone
from tests.calibration.film.viscous_cone import ViscousCone
from tests.calibration.film.viscous_runs import ONE_TERM, paper, records, run

BRANCHES = ((0.1, 1.0), (0.1, 30.0))
REFERENCE_N = {  # NUMERICS: another code's values
    8.823529: 0.174014016,
    17.647059: 0.21955249,
    44.117647: 0.217206552,
    73.529412: 0.216274197,
    100.0: 0.215938708,
}


def test_the_independent_cone_gives_the_reference_forces() -> None:
    trace = ViscousCone(elements=24).history([0.0, 10.0, 100.0], [0.0, 10e-3, 10e-3], [0.0] * 3, moves=24)
    assert trace.at(np.array(list(REFERENCE_N))) == pytest.approx(list(REFERENCE_N.values()), rel=5e-4)


def curve_of(t: np.ndarray, h: np.ndarray, voltage: np.ndarray, force: np.ndarray, noise: float = 2e-6) -> Curve:
    film = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"], name="cone")
    return Curve(
        label="whole", run="run", specimen=film, h=h, force=force, voltage=voltage, nominal_voltage=0.0,
        direction=np.zeros(t.size, dtype=np.int8), force_noise=1e-3, displacement_noise=noise, time=t,
    )  # fmt: skip


def test_a_noisy_record_becomes_the_polygon_that_was_run() -> None:
    t = np.arange(0.003, 70.0, 0.01)
    corners = [0.0, 12.0, 42.0, 47.0, 50.0, 62.0, 70.0], [0.0, 12e-3, 12e-3, 12e-3, 12e-3, 0.0, 0.0]
    volts = [0.0, 0.0, 0.0, 1000.0, 1000.0, 1000.0, 1000.0]
    random = np.random.default_rng(3)
    v = np.interp(t, corners[0], volts)
    h = np.interp(t, *corners) + 2e-6 * random.standard_normal(t.size)
    v = v + 2.0 * random.standard_normal(t.size) * (v > 0.0)
    curve = curve_of(t, h, v, np.zeros(t.size))
    knots, high, voltage = Record(curve, t, h, v, curve.force, np.ones(t.size, dtype=bool)).history
    assert knots.size <= len(corners[0]) + 3
    for corner in corners[0][1:-1]:
        assert np.abs(knots - corner).min() < 0.06, corner
    assert np.interp(t, knots, high) == pytest.approx(np.interp(t, *corners), abs=6e-6)
    assert np.interp(t, knots, voltage) == pytest.approx(np.interp(t, corners[0], volts), abs=6.0)


def test_a_polygon_of_merged_stretches_is_that_of_all_samples() -> None:
    """A knot less changes two stretches; the polygon is the least-squares fit of hat functions to every sample."""
    t = np.arange(500.0, 560.0, 0.01)
    random = np.random.default_rng(5)
    values = np.interp(t, [500.0, 512.0, 530.0, 560.0], [0.0, 12.0, 12.0, 1.0]) + 0.1 * random.standard_normal(t.size)
    knots = t[[0, 300, 1200, 1230, 3000, 4000, t.size - 1]]
    merged = Stretches.of(t, values, knots).without(3).without(1)
    left = knots[[0, 2, 4, 5, 6]]
    hats = np.stack([np.interp(t, left, one) for one in np.eye(left.size)], axis=1)
    direct = np.linalg.lstsq(hats, values, rcond=None)[0]
    assert merged.polygon(left) == pytest.approx(direct, abs=1e-4)
    assert merged.polygon(left) == pytest.approx(through(t, values, left), abs=1e-9)


def test_means_over_bins_have_no_bias_by_the_curvature_of_the_force() -> None:
    t = np.arange(0.003, 24.0, 0.01)
    h = np.interp(t, [0.0, 12.0, 24.0], [0.0, 12e-3, 0.0])

    def elastic(place: np.ndarray, volts: np.ndarray) -> np.ndarray:
        return 2e5 * place**3

    curve = curve_of(t, h, np.zeros(t.size), elastic(h, h), noise=0.0)
    record = Record(curve, t, h, curve.voltage, curve.force, np.ones(t.size, dtype=bool))
    bins = record.bins(elastic)
    assert bins.size.sum() == t.size
    assert bins.time.size < 150
    assert bins.force == pytest.approx(elastic(np.interp(bins.time, t, h), bins.h), abs=1e-5 * bins.force.max())


def test_what_a_branch_adds_to_first_order_is_what_the_independent_cone_has() -> None:
    ratio = 0.02
    times, high = [0.0, 5.0, 15.0], [0.0, 10e-3, 10e-3]
    cones = (ViscousCone(branches=((ratio, 2.0),), elements=20), ViscousCone(branches=(), elements=20))
    slow, elastic = (one.history(times, high, [0.0] * 3, moves=36) for one in cones)
    t = slow.t
    film = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"])
    motion = Motion(film, np.interp(t, times, high), np.zeros(t.size))
    added = motion.forces(film.material, t, [2.0])[0]
    true = (slow.at(t) - elastic.at(t)) / ratio
    assert np.abs(added - true).max() < 0.02 * np.abs(true).max()


def test_a_film_that_hangs_slack_at_the_highest_voltage_has_a_response_all_the_same() -> None:
    """A search comes by such films, and so does a cone predicted from a sheet: what is asked at 0 V is right."""
    soft = Specimen(4e-3, 20e-3, 40e-6, 1.2, Material("soft", (2e4,), (2.5,), 3.0))
    assert solve(soft, 6e-3, 5000.0).status is Status.SLACK
    alone, charged = (Relaxed(soft, 10e-3, volts) for volts in (0.0, 5000.0))
    h = np.linspace(0.0, 10e-3, 7)
    assert charged.force(h, np.zeros(7)) == pytest.approx(alone.force(h, np.zeros(7)), rel=1e-12)
    assert np.isfinite(charged.force(h, np.full(7, 5000.0))).all()
    still, moved = (Motion(soft, h, np.linspace(0.0, volts, 7)) for volts in (0.0, 5000.0))
    assert moved.u == pytest.approx(still.u, rel=1e-12)
    assert np.array_equal(moved.weight, still.weight)


def test_a_film_without_any_state_has_no_force_and_raises_nothing() -> None:
    """A step of a search may ask for one: it is not taken."""
    wild = Specimen(6e-3, 20e-3, 500e-6, 3.0, Material("wild", (1e300,), (900.0,), 3.0))
    found = Relaxed(wild, 10e-3, 2000.0)(np.linspace(0.0, 10e-3, 5), np.zeros(5))
    assert np.isnan(found["force"]).all()
    assert found["mu"].shape == (5, 1)


@pytest.mark.slow
def test_an_elastic_fit_imports_nothing_of_branches() -> None:
    code = (
        "import sys, calibration.film.identify, calibration.film.summary, rig.analysis.film;"
        "print([m for m in sys.modules if 'branches' in m and m.startswith('calibration') or 'membrane.history' in m])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_sentences_come_from_the_facts() -> None:
    one = FoundBranch(0.1, 0.01, 30.0, 0.1, "identified", (0.08, 0.12), (25.0, 36.0), 0.01, 0.1)
    stiff = Quantity(2e5, 2e3, "Pa", {}, GOOD)
    said = Spectrum(
        (one,), (0.02, 600.0), stiff, (BranchCount(1, 0.0, LeftOut(1.0, 1.0, 1.0)),), 1000.0, 1200.0, 0.02
    ).sentences
    assert "a branch of 1000 s would look like stiffness; hold 20 min to see it" in said
    assert (
        "no branch is needed to explain this record"
        in Spectrum((), (0.02, 60.0), stiff, (), 100.0, 119.0, 0.0).sentences
    )


def relaxed_stiffness(cone: ViscousCone, found: Identification) -> float:
    return secant_modulus(Cone(mu=cone.mu, alpha=cone.alpha), *found.fixed_stretch)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_papers_sweep_of_a_viscous_film() -> None:
    """Fitted as elastic it is a few per cent off and good-looking, and says so; with branches the truth is covered."""
    cone = ViscousCone(branches=BRANCHES, **ONE_TERM)
    curves = run(cone, paper(), 1)
    elastic = identify(curves, terms=1)
    off = elastic.quantities["eps_r"].value / cone.eps_r - 1.0
    residual = max(one.rms_residual for one in elastic.curves) / float(max(c.force.max() for c in curves))
    assert 0.01 < off < 0.06
    assert residual < 0.006
    assert with_elastic_error(elastic, curves).elastic_error["eps_r"] == pytest.approx(off, abs=0.6 * off)
    for name in ("eps_r", "stiffness", "stiffness_fixed"):
        assert elastic.quantities[name].verdict != GOOD
        assert "viscous" in elastic.quantities[name].doubt
    assert any("--branches auto" in one for one in elastic.warnings)

    found, _ = identify_branches(records(curves), curves, terms=1)
    assert found.spectrum is not None
    assert len(found.spectrum.branches) == 2
    eps, stiff = found.quantities["eps_r"], found.quantities["stiffness_fixed"]
    assert abs(eps.value - cone.eps_r) < 2.5 * eps.uncertainty  # one experiment; many are in `test_branches_proofs`
    assert eps.uncertainty < 0.012 * eps.value
    assert abs(stiff.value - relaxed_stiffness(cone, found)) < 2.5 * stiff.uncertainty
    for one, (ratio, time) in zip(found.spectrum.branches, BRANCHES, strict=True):
        assert abs(one.ratio - ratio) < 2.5 * one.ratio_uncertainty
        assert abs(math.log(one.time / time)) < 2.5 * one.time_relative
    assert found.spectrum.instant.value > stiff.value
    assert len(found.material.branches) == 2


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1])
def test_no_branch_is_found_in_an_elastic_film(seed: int) -> None:
    cone = ViscousCone(branches=(), **ONE_TERM)
    curves = run(cone, paper((0.0, 1500.0)), seed)
    found, _ = identify_branches(records(curves), curves, terms=1)
    assert found.spectrum is not None
    assert found.spectrum.branches == ()
    assert abs(found.quantities["eps_r"].value - cone.eps_r) < 3.0 * found.quantities["eps_r"].uncertainty


def softened(curves: list[Curve], losses: tuple[float, ...]) -> list[Curve]:
    """The curves of a film that has lost so much of its force by each cycle."""
    return [replace(curve, force=curve.force * (1.0 - loss)) for curve, loss in zip(curves, losses, strict=True)]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_film_that_softens_and_relaxes_is_told_apart() -> None:
    """Both bias permittivity; holds tell the branch, equal cycles the softening. Told before it is believed."""
    cone = ViscousCone(branches=((0.2, 8.0),), **ONE_TERM)
    curves = run(cone, paper((0.0, 0.0, 1500.0), hold=15.0, speed=3e-3), 5)
    losses = 0.0, 0.04, 0.055
    given = softened(curves, losses)
    found, _ = identify_branches(records(given), given, terms=1, branches=1)
    assert found.spectrum is not None
    assert [one.cycle for one in found.spectrum.softening] == [2, 3]
    for one, loss in zip(found.spectrum.softening, losses[1:], strict=True):
        assert abs(one.loss - loss) < 3.0 * one.uncertainty < 0.01
    eps, stiff = found.quantities["eps_r"], found.quantities["stiffness_fixed"]
    assert abs(eps.value - cone.eps_r) < 3.0 * eps.uncertainty < 0.06 * eps.value
    assert abs(stiff.value - relaxed_stiffness(cone, found)) < 3.0 * stiff.uncertainty
    (branch,) = found.spectrum.branches
    assert abs(branch.ratio - 0.2) < 3.0 * branch.ratio_uncertainty
    assert abs(math.log(branch.time / 8.0)) < 3.0 * branch.time_relative


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_fit_ends_where_the_exact_model_does_after_few_solutions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cost is that of the exact solutions; one more of them moves the answer by a small part of its uncertainty."""
    cone = ViscousCone(branches=((0.5, 0.8), (0.3, 12.0)), **ONE_TERM)
    given = records(run(cone, paper((0.0, 1500.0), hold=30.0, speed=6e-3), 3, rate=50.0))
    joint = Joint(given, Material("start", (2e4,), (5.0,), 2.0), 1)
    tried = count_branches(joint, joint.vector(Material("start", (2e4,), (5.0,), 2.0)), None)
    assert [one.branches for one in tried] == [0, 1, 2]
    assert joint.solved <= 6
    point = tried[-1].point
    deviation = np.sqrt(np.diag(covariance(joint, point).matrix))
    joint.exact(point)
    further = joint.minimise(joint.evaluate(point.x))
    free = joint.varied(point.x)
    assert np.abs((further.x - point.x)[free]).max() < 1.0  # or `deviation` would be one of numbers that stand still
    assert (np.abs(further.x - point.x)[free] < 0.25 * deviation[free]).all()
    truth = joint.vector(
        Material("truth", cone.mu, cone.alpha, cone.eps_r, branches=tuple(Branch(*one) for one in cone.branches))
    )
    quick = np.argsort(point.x[5:7])  # after a modulus, an exponent, eps_r and two ratios: the times
    order = np.concatenate((np.arange(3), 3 + quick, 5 + quick))
    assert np.abs((point.x[order] - truth[:7]) / deviation[order]).max() < 4.0
    assert point.settled
    monkeypatch.setattr("calibration.film.branches.joint.OUTER", 0)
    ended = joint.fit(point.x)
    assert not ended.settled and not joint.fewer(ended, joint.kept).settled


@pytest.mark.slow
@pytest.mark.long  # one that hangs slack on its only way back: the next test
@pytest.mark.timeout(600)
def test_a_film_that_is_slack_after_a_third_of_its_record_is_fitted_to_that_third() -> None:
    """It is slack on its first way back, before any voltage: no permittivity, and the branch as good as the rest."""
    cone = ViscousCone(branches=((1.04, 10.3),), **ONE_TERM)
    curves = run(cone, paper((0.0, 1500.0), hold=60.0, speed=3e-3), 1, rate=50.0)
    found, relaxed = identify_branches(records(curves), curves, terms=1)
    assert found.spectrum is not None
    assert found.spectrum.left_out > 0.5
    assert any("move back more slowly" in one for one in found.warnings)
    (branch,) = found.spectrum.branches
    assert branch.verdict == "identified"
    assert abs(branch.ratio - 1.04) < 3.0 * branch.ratio_uncertainty < 0.05
    assert abs(math.log(branch.time / 10.3)) < 3.0 * branch.time_relative < 0.05
    assert found.spectrum.counts[-1].left_out.explained
    assert "eps_r" not in found.quantities
    assert relaxed[1].flagged is not None and relaxed[1].flagged.all()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_where_a_film_hangs_slack_its_forces_are_left_out() -> None:
    """A strong branch that has relaxed in a hold pushes on the way back: the film hangs, and reads as no force."""
    cone = ViscousCone(branches=((1.0, 10.0),), **ONE_TERM)
    curves = run(cone, paper((0.0,), hold=60.0, speed=6e-3), 1, rate=50.0)
    down = np.concatenate([one.direction for one in curves]) < 0
    force = np.concatenate([one.force for one in curves])
    assert (np.abs(force[down]) < 4e-3).mean() > 0.1  # or it would tell nothing
    found, relaxed = identify_branches(records(curves), curves, terms=1, branches=1)
    assert found.spectrum is not None
    (branch,) = found.spectrum.branches
    assert abs(branch.ratio - 1.0) < 3.0 * branch.ratio_uncertainty < 0.1
    assert abs(math.log(branch.time / 10.0)) < 3.0 * branch.time_relative
    stiff = found.quantities["stiffness_fixed"]
    assert abs(stiff.value - relaxed_stiffness(cone, found)) < 3.0 * stiff.uncertainty
    assert found.spectrum.counts[-1].left_out.explained
    (curve,) = relaxed
    assert curve.flagged is not None and curve.flagged.any()


@pytest.mark.parametrize("explained", [True, False])
def test_no_branch_counts_as_identified_where_left_out_parts_are_not_predicted(explained: bool) -> None:
    both = Known(1.062, 0.0122), Known(math.log(0.564), 0.014)
    found = FoundBranch.judged(*both, (0.02, 214.0), explained=explained)
    assert found.verdict == ("identified" if explained else "bounded")
    left = LeftOut(2.08, 1.03 if explained else 2.0, 0.4 if explained else 1e-9)
    stiffness = Quantity(1e5, 1e3, "Pa", {}, GOOD)
    spectrum = Spectrum((found,), (0.02, 214.0), stiffness, (BranchCount(1, 0.0, left),), 1000.0, 1200.0, 0.0)
    assert any("none counts as identified" in one for one in spectrum.sentences) is not explained


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("noise", "seed"), [(1e-3, 1), (1e-3, 2), (4e-3, 1)])
def test_a_branch_with_a_quick_one_folded_into_it_is_known_no_better_than_that(noise: float, seed: int) -> None:
    """The quick branch is not found; alone, its neighbour's figure is off by many of its uncertainties."""
    ratio, time = 0.93, 0.61
    cone = ViscousCone(branches=((0.38, 0.1), (ratio, time)), **ONE_TERM)
    curves = run(cone, paper((0.0,), hold=10.0, speed=3e-3), seed, rate=50.0, noise=(noise, 2e-6, 2.0))
    found, _ = identify_branches(records(curves), curves, terms=1)
    assert found.spectrum is not None
    (branch,) = found.spectrum.branches
    assert branch.ratio - ratio > 2.5 * branch.ratio_alone
    assert abs(branch.ratio - ratio) < 2.5 * branch.ratio_uncertainty
    assert abs(math.log(branch.time / time)) < 2.5 * branch.time_relative
    known = branch.ratio_uncertainty < 0.15 * branch.ratio
    assert branch.verdict == ("identified" if known else "bounded")
    assert any("a further branch near 0.1" in one for one in found.spectrum.sentences) is not known
    assert known is (noise < 2e-3)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_branch_that_outlasts_its_record_is_not_held_at_the_end_of_it() -> None:
    """Held there it would bend the law, and be certain of itself."""
    cone = ViscousCone(branches=((0.4, 60.0),), **ONE_TERM)
    curves = run(cone, paper((0.0, 1500.0), hold=10.0, speed=3e-3), 3, rate=50.0)
    found, _ = identify_branches(records(curves), curves, terms=1)
    assert found.spectrum is not None
    (branch,) = found.spectrum.branches
    assert found.spectrum.window[1] < 50.0
    assert branch.verdict == "outside the window"
    assert abs(branch.ratio - 0.4) < 3.0 * branch.ratio_uncertainty
    assert abs(math.log(branch.time / 60.0)) < 3.0 * branch.time_relative
    eps, stiff = found.quantities["eps_r"], found.quantities["stiffness_fixed"]
    assert abs(eps.value - cone.eps_r) < 3.0 * eps.uncertainty
    assert abs(stiff.value - relaxed_stiffness(cone, found)) < 3.0 * stiff.uncertainty
