"""Where the relaxed law loses convexity, beyond the end of a branch, and where an answer once had a hole."""

from __future__ import annotations

from itertools import groupby, pairwise

import numpy as np
import pytest

from model.material.gent import Gent
from model.material.materials import NAMED, Material
from model.membrane.convexity import _least
from model.membrane.solve import Status, solve, solve_many
from model.specimen import Specimen
from model.stability.limits import slack_voltage
from model.verification.continuation import follow

PARKER = NAMED["parker-cao2018"]
# Stiffens with the stretch: from about 528 V on its relaxed stress falls over stretches that its profile has.
STIFFENING = Specimen(4e-3, 20e-3, 40e-6, 1.2, Material("s", (2e4, 3.0), (1.8, 14.0), 3.0))
H = 20e-3


def runs(status: np.ndarray) -> list[str]:
    """The statuses in their order, repetitions left out."""
    return [Status(value).name for value, _ in groupby(status.tolist())]


@pytest.mark.parametrize("tolerance", [1e-4, pytest.param(1e-5, marks=pytest.mark.slow), 1e-6])
def test_no_state_where_the_relaxed_law_falls(tolerance: float) -> None:
    assert solve(STIFFENING, H, 545.738, tolerance=tolerance, wrinkling="tension_field").status is Status.UNSTABLE


def test_the_statuses_along_the_voltage_change_once() -> None:
    voltage = np.arange(500.0, 636.0, 5.0)
    found = solve_many(STIFFENING, H, voltage, tolerance=1e-6, wrinkling="tension_field")
    assert runs(found.status) == ["WRINKLED", "UNSTABLE", "SLACK"]
    # The law's own limit: finite elements that share nothing with the solver end at 528 V.
    assert voltage[found.answered].max() == 525.0
    assert np.all(np.diff(found.force[found.answered]) < 0.0)


@pytest.mark.parametrize(
    "tolerance",
    [*(pytest.param(t, marks=pytest.mark.long) for t in (1e-8, 1e-6)), pytest.param(1e-4, marks=pytest.mark.slow)],
)
def test_between_loss_of_convexity_and_slack_no_voltage_has_an_answer(tolerance: float) -> None:
    """At 1812.87 V the energy is convex at every point of a state that is there; the branch has ended before."""
    soft = Specimen(4e-3, 20e-3, 40e-6, 1.2, Material("soft", (8e4,), (2.5,), 2.5))
    voltage = np.sort(np.append(np.arange(1740.0, 1840.0, 4.0), 1812.872509958235))
    found = solve_many(soft, 0.003157894736842105, voltage, tolerance=tolerance, wrinkling="tension_field")
    assert runs(found.status) == ["WRINKLED", "UNSTABLE", "SLACK"]


@pytest.mark.parametrize("voltage", [505.0, 522.0, 527.0])
def test_one_answer_at_every_tolerance_up_to_the_loss_of_convexity(voltage: float) -> None:
    found = [solve(STIFFENING, H, voltage, tolerance=t, wrinkling="tension_field") for t in (1e-4, 1e-6, 1e-8)]
    assert [one.status for one in found] == [Status.WRINKLED] * 3
    for one, other in pairwise(found):
        assert abs(one.force / other.force - 1.0) <= one.error_estimate + other.error_estimate


@pytest.mark.slow
def test_the_answer_near_the_loss_of_convexity_is_that_of_finite_elements() -> None:
    truth = follow(STIFFENING, H, 520.0, wrinkling="tension_field")
    assert truth.reached
    found = solve(STIFFENING, H, 520.0, tolerance=1e-6, wrinkling="tension_field")
    assert found.force == pytest.approx(truth.force, rel=3.0 * truth.error + 2e-6)


def test_a_taut_zone_about_to_vanish_leaves_no_hole() -> None:
    film = Specimen(4e-3, 20e-3, 40e-6, 1.5, PARKER)
    voltage = np.array([2650.0, 2655.0, 2655.660551501382, 2656.0, 2660.0])
    found = solve_many(film, 6e-3, voltage, tolerance=1e-6, wrinkling="tension_field")
    assert runs(found.status) == ["WRINKLED"]
    assert found.force[2] == pytest.approx(0.0392320, abs=6e-8)
    assert np.all(np.diff(found.force) < 0.0)
    profile = solve(film, 6e-3, voltage[2], tolerance=1e-6, wrinkling="tension_field").profile()
    assert np.count_nonzero(np.diff(profile.wrinkled)) == 2


# High above the disk a stiffening film has solutions far out that no film at rest can reach.
@pytest.mark.parametrize(
    ("mu", "alpha", "lp", "h"),
    [
        pytest.param((1e4,), (3.0,), 1.0, 0.4, marks=pytest.mark.slow),
        ((3e4, 100.0), (1.3, 5.0), 1.0, 0.02),
        ((1e4,), (2.3,), 2.0, 0.4),
    ],
)
def test_nothing_is_answered_beyond_the_end_of_the_branch(
    mu: tuple[float, ...], alpha: tuple[float, ...], lp: float, h: float
) -> None:
    film = Specimen(4e-3, 20e-3, 40e-6, lp, Material("high", mu, alpha, 3.0))
    voltage = np.linspace(0.0, 1.05 * float(slack_voltage(film, np.array(h))), 40)
    found = solve_many(film, h, voltage, tolerance=1e-6, wrinkling="tension_field")
    order = runs(found.status)
    assert order in (["TAUT", "WRINKLED", "UNSTABLE", "SLACK"], ["TAUT", "UNSTABLE", "SLACK"]), order
    for one in (12, 24, 36):
        alone = solve(film, h, float(voltage[one]), tolerance=1e-6, wrinkling="tension_field")
        assert alone.status == found.status[one]


# One cone from disk to ring, where two resolutions may agree by chance; and a soft film whose cut stood too far off.
# The last two are one taut film and one with a zone, of which two resolutions agreed by chance.
CONES = [
    ((0.0012054977978506354, 9.180462869683009e-05, 1.8100168076447036), (39978.21946418071, 4.044769341731701),
     (3.250610344511693, 13.610365147187853), 0.015282737235284215, 2742.8402356381657),
    ((0.006130649035947979, 8.415586808868475e-05, 2.185941430063424), (34129.7959109893,),
     (3.7344277942008333,), 0.014486088377418079, 2163.11987641582),
    ((0.0021989125143208076, 6.781589893605347e-05, 2.085317500001251), (51932.89140572999,),
     (1.789813742132428,), 0.0019138087501209598, 946.7605522280443),
    ((0.0024524525549298897, 1.116524672339377e-05, 1.988070250997784), (31771.914439505195, 109.65313210981235),
     (2.06232521828303, 13.518331402885813), 0.007801455103719507, 599.4025310294924),
]  # fmt: skip


@pytest.mark.parametrize(("film", "mu", "alpha", "h", "voltage"), CONES)
def test_forces_at_three_tolerances_agree_within_what_they_state(
    film: tuple[float, float, float], mu: tuple[float, ...], alpha: tuple[float, ...], h: float, voltage: float
) -> None:
    disk, thickness, lp = film
    specimen = Specimen(disk, 20e-3, thickness, lp, Material("random", mu, alpha, 3.0))
    for ask in (solve, lambda *state, **options: solve_many(*state, **options)):
        found = [ask(specimen, h, voltage, tolerance=t, wrinkling="tension_field") for t in (1e-4, 1e-6, 1e-8)]
        for one in found[:2]:
            off = abs(float(one.force / found[2].force) - 1.0)
            assert off <= float(one.error_estimate + found[2].error_estimate)


# Plain states whose folds would be narrow: a coarse path ends elsewhere, or leads beyond the end of the branch, which
# finite elements put at 0.892 and 0.9953 of these voltages, and a path by arc length at 0.9032 and 0.9955.
NARROW = [
    (Specimen(0.0011381801274735225, 0.02, 3.239765965589568e-05, 1.832555713779216,
              Material("gent", (34000.41330776372,), (33.7022454043573,), 3.0, law=Gent)),
     0.010765115144026132, 600.5630577564228, 0.85, 0.905),
    (Specimen(0.0012216328217614031, 0.02, 3.123252206135942e-05, 1.7957123275996947,
              Material("four", (40612.01118328048, 3.265505815686074, 7.514450088127211, 130.58223351214053),
                       (3.038784712010136, 11.412884817239597, 9.96639062554887, 5.9849122979849385), 3.0)),
     0.006794967767594611, 905.6430184799761, 0.99, 0.9965),
]  # fmt: skip


@pytest.mark.parametrize(("film", "h", "voltage", "before", "beyond"), NARROW)
@pytest.mark.parametrize("tolerance", [1e-4, 1e-8])
def test_beyond_the_end_of_a_plain_branch_every_state_is_unstable(
    film: Specimen, h: float, voltage: float, before: float, beyond: float, tolerance: float
) -> None:
    shares = np.array([before, beyond, beyond + 0.004, 1.0])
    found = solve_many(film, h, voltage * shares, tolerance=tolerance)
    assert runs(found.status) == ["WRINKLED", "UNSTABLE"]
    assert found.answered.sum() == 1


def test_the_edge_of_a_wrinkled_zone_is_no_loss_of_convexity_and_its_place_is_in_the_stated_error() -> None:
    """There the stiffness jumps from 0.08 to 0.88, and a cut that stood 1e-4 off erred by 1e-8 of the force."""
    gent = Material("gent", (50672.300100066874,), (45.724719395253445,), 3.0, law=Gent)
    film = Specimen(0.001353911976017867, 0.02, 5.108230813636204e-05, 1.3816623147432765, gent)
    state = film, 0.02118595399296025, 725.6747638432524
    found = [solve(*state, tolerance=t, wrinkling="tension_field") for t in (1e-4, 1e-6, 1e-8, 1e-10)]
    assert [one.status for one in found] == [Status.WRINKLED] * 4
    for one in found[:3]:
        assert abs(one.force / found[3].force - 1.0) <= one.error_estimate + found[3].error_estimate


def test_a_wrinkled_state_that_few_modes_miss_is_answered_at_every_tolerance() -> None:
    """Finite elements reach it; from few modes Newton's method did not."""
    mu = (97643.18595220073, -19706.66788112732, 2.2799639527785134, -3359.9663142161844)
    alpha = (1.5589107015025991, -1.4518212935716015, 5.32138030197117, -2.9596100475021205)
    film = Specimen(
        0.004713513453938472, 0.02, 1.875235593041573e-05, 1.2437070885741517, Material("r", mu, alpha, 3.0)
    )
    for tolerance in (1e-4, 1e-6, 1e-8):
        found = solve(film, 0.01918485560370611, 616.6871445743986, tolerance=tolerance, wrinkling="tension_field")
        assert found.status is Status.WRINKLED
        assert found.force == pytest.approx(0.0738718119, rel=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("lp", [1.0, 1.2, 1.5, 2.0, 2.5, 3.0])
@pytest.mark.parametrize("name", sorted(NAMED))
def test_a_sweep_to_slack_has_few_statuses_and_no_hole(name: str, lp: float) -> None:
    film = Specimen(4e-3, 20e-3, 40e-6, lp, NAMED[name])
    voltage = np.linspace(0.0, float(slack_voltage(film, np.array(10e-3))), 240)
    found = solve_many(film, 10e-3, voltage, tolerance=1e-6, wrinkling="tension_field")
    order = runs(found.status)
    assert len(order) <= 4, order
    assert "NOT_CONVERGED" not in order, order


X = np.array([0.0, 0.3, 0.5, 1.0, 1.2])  # uneven


@pytest.mark.parametrize(
    ("values", "wrinkled", "least"),
    [
        (3.0 + 2.0 * (X - 0.25) ** 2, 0, 3.0),
        (3.0 + 2.0 * (X - 0.45) ** 2, 0, 3.0),  # a parabola has its own least, between the points
        (3.0 + 2.0 * (X - 0.55) ** 2, 0, 3.0),
        (3.0 + 2.0 * (X - 1.05) ** 2, 0, 3.0),
        (3.0 + X, 0, 3.0),  # at an end it is that of the point
        (4.0 - X, 0, 2.8),
        (3.0 + 2.0 * (X - 1.15) ** 2, 0, 3.005),
        (np.array([5.0, 4.0, np.nan, 4.0, 5.0]), 0, -2.125),  # no law there: -1 stands for it
        (3.0 + 2.0 * (X - 0.45) ** 2, 2, 3.005),  # over the edge of a wrinkled zone no parabola leads
        (3.0 + 2.0 * (X - 0.45) ** 2, 3, 3.005),
        (3.0 + 2.0 * (X - 0.45) ** 2, 4, 3.0),
    ],
)
def test_the_least_along_a_film_is_that_of_the_parabola_through_its_lowest_points(
    values: np.ndarray, wrinkled: int, least: float
) -> None:
    """Two films side by side, the other one even; the first ``wrinkled`` points of the first are wrinkled."""
    both = np.stack((values, np.full(5, 7.0)), axis=1)
    zone = np.zeros((5, 2), dtype=np.bool_)
    zone[:wrinkled, 0] = True
    found = _least(np.stack((X, X), axis=1), both, zone)
    assert found[0] == pytest.approx(least, abs=1e-12)
    assert found[1] == 7.0


def test_a_parabola_dips_below_its_points_by_no_more_than_half_of_what_they_differ() -> None:
    place = np.array([[0.0], [0.9], [1.0]])
    values = np.array([[2.0], [1.0], [1.9]])  # the parabola through them falls to less than 0.5
    dip = np.polynomial.Polynomial.fit(place[:, 0], values[:, 0], 2)
    assert dip(dip.deriv().roots()[0]) < 0.5
    assert _least(place, values, np.zeros((3, 1), dtype=np.bool_))[0] == pytest.approx(0.5)
