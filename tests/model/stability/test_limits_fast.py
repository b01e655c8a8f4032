"""Limits of the voltage found of films whose answer to each voltage is given, and branches on few modes."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from model.material.materials import NAMED, Material
from model.membrane.solve import Status, solve_many
from model.specimen import Specimen
from model.stability import branches, limits
from model.stability.limits import breakdown_voltage, pull_in_voltage, slack_voltage, taut_limit

SOFT = Specimen(4e-3, 20e-3, 100e-6, 3.0, Material("soft", (1e5,), (1.3,), 3.0))
FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"])
H = np.array([4e-3, 10e-3])
FIELD_PER_V = 1e6  # of the given films, V/m


def given(monkeypatch: pytest.MonkeyPatch, ends: np.ndarray, why: Status, *, slack: np.ndarray | None = None) -> None:
    """Films that are taut up to the voltages ``ends``, and beyond have the status ``why``, or hang ``slack``."""

    def solve(specimen: Any, h: Any, voltage: Any, **how: Any) -> Any:
        v = np.broadcast_to(np.asarray(voltage, dtype=float), np.shape(h))
        status = np.where(v <= ends, int(Status.TAUT), int(why))
        if slack is not None:
            status = np.where(v >= slack, int(Status.SLACK), status)
        answered = status == Status.TAUT

        def only(values: Any) -> Any:
            return np.where(answered, values, np.nan)

        return SimpleNamespace(
            status=status.astype(np.int8),
            answered=answered,
            force=only(1.0 - v / 1e5),
            peak_field=only(FIELD_PER_V * v),
            min_hoop_stress=only(1e4 * (1.0 - (v / 900.0) ** 2)),
        )

    monkeypatch.setattr(limits, "solve_many", solve)
    monkeypatch.setattr(limits, "pull_in", lambda specimen, h, highest: None)


def test_the_last_voltage_with_a_state_is_the_pull_in(monkeypatch: pytest.MonkeyPatch) -> None:
    ends = 0.5 * slack_voltage(SOFT, H)
    given(monkeypatch, ends, Status.UNSTABLE)
    found = pull_in_voltage(SOFT, H, tolerance=1e-4)
    assert np.all((found.voltage <= ends) & (found.voltage >= ends - 1e-4 * slack_voltage(SOFT, H)))
    np.testing.assert_allclose(found.force, 1.0 - found.voltage / 1e5)
    np.testing.assert_array_equal(found.status, Status.TAUT)  # of the state given


def test_a_fold_found_by_arc_length_is_the_voltage_of_the_plain_film(monkeypatch: pytest.MonkeyPatch) -> None:
    ends = 0.5 * slack_voltage(SOFT, H)
    given(monkeypatch, ends, Status.UNSTABLE)
    asked: list[tuple[float, float]] = []

    def fold(specimen: Any, h: float, highest: float) -> float:
        asked.append((h, highest))
        return 321.0

    monkeypatch.setattr(limits, "pull_in", fold)
    assert pull_in_voltage(SOFT, -H, tolerance=1e-3).voltage.tolist() == [321.0, 321.0]
    assert [h for h, _ in asked] == H.tolist()
    assert np.all(np.array([v for _, v in asked]) > ends)
    asked.clear()
    assert np.all(pull_in_voltage(SOFT, H, tolerance=1e-3, wrinkling="tension_field").voltage < ends)
    assert asked == []


def test_where_all_tension_is_lost_first_there_is_no_pull_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor where a state next to slack is told as unstable: nothing has stiffness left there that could tell."""
    slack = slack_voltage(FILM, H)
    for why, last in ((Status.SLACK, slack * 0.9), (Status.UNSTABLE, slack * (1.0 - 3e-5)), (Status.TAUT, slack)):
        given(monkeypatch, last, why, slack=slack)
        found = pull_in_voltage(FILM, H)
        assert np.isnan(found.voltage).all() and np.isnan(found.force).all()
        np.testing.assert_array_equal(found.status, Status.SLACK)
    given(monkeypatch, slack * (1.0 - 3e-4), Status.UNSTABLE, slack=slack)  # further off it is one
    assert np.isfinite(pull_in_voltage(FILM, H).voltage).all()


def test_a_way_that_ends_without_a_reason_next_to_an_unstable_state_is_a_pull_in(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """And one that only does not converge is none."""
    slack = slack_voltage(SOFT, H)
    ends = 0.5 * slack
    given(monkeypatch, ends, Status.NOT_CONVERGED)
    found = pull_in_voltage(SOFT, H, tolerance=1e-3)
    assert np.isnan(found.voltage).all()
    np.testing.assert_array_equal(found.status, Status.NOT_CONVERGED)


def test_tension_is_lost_where_the_hoop_stress_is_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    given(monkeypatch, np.array([1e9, 1e9]), Status.UNSTABLE)
    monkeypatch.setattr(limits, "slack_voltage", lambda specimen, h: np.full(np.shape(h), 5000.0))
    found = taut_limit(FILM, H)
    np.testing.assert_allclose(found.voltage, 900.0, rtol=1e-8)
    np.testing.assert_array_equal(found.status, Status.TAUT)
    assert np.all(np.abs(found.min_hoop_stress) < 1.0)
    np.testing.assert_allclose(found.breakdown_voltage, 80.0, rtol=1e-6)


def test_taut_until_it_pulls_in_has_the_last_taut_voltage(monkeypatch: pytest.MonkeyPatch) -> None:
    given(monkeypatch, np.array([400.0, 600.0]), Status.UNSTABLE)
    found = taut_limit(SOFT, H)
    np.testing.assert_allclose(found.voltage, [400.0, 600.0], rtol=1e-7)
    np.testing.assert_array_equal(found.status, Status.UNSTABLE)
    np.testing.assert_allclose(found.min_hoop_stress, 1e4 * (1.0 - (found.voltage / 900.0) ** 2))
    assert np.isnan(found.breakdown_voltage).all()


def test_breakdown_is_where_the_field_is_or_nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    given(monkeypatch, np.array([30.0, 70.0]), Status.SLACK)
    found = breakdown_voltage(SOFT, H, 5e7)
    assert math.isnan(found.voltage[0]) and math.isnan(found.force[0]) and math.isnan(found.peak_field[0])
    assert found.voltage[1] == pytest.approx(50.0, rel=1e-8)
    assert found.peak_field[1] == pytest.approx(5e7, rel=1e-8)


@pytest.fixture
def few_modes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(branches, "MODES", 12)


def test_a_branch_is_made_of_the_solver_s_states_and_turns_at_the_pull_in(few_modes: None) -> None:
    branch = branches.vary_voltage(SOFT, 10e-3, 500.0, points=32)
    (turn,) = branch.limit_points[:1]
    assert branch.stable[:turn].all() and not branch.stable[turn + 1 :].any()
    some = slice(0, turn - 2, 4)
    found = solve_many(SOFT, 10e-3, branch.voltage[some], tolerance=1e-9)
    np.testing.assert_allclose(branch.force[some], found.force, rtol=1e-4)  # of so few modes
    # Its points are those of the quadrature: the largest field is at the disk, a little beside the first of them.
    np.testing.assert_allclose(branch.peak_field[some], found.peak_field, rtol=3e-2)
    np.testing.assert_allclose(
        branch.min_hoop_stress[some], found.min_hoop_stress, atol=0.06 * branch.min_hoop_stress[0]
    )
    fold = branches.pull_in(SOFT, 10e-3, 500.0)
    assert fold is not None and branch.voltage[turn] <= fold * (1.0 + 1e-9)
    assert branch.voltage[turn] > 0.99 * fold
    # Beside it: an answer below, none above.
    statuses = solve_many(SOFT, 10e-3, fold * np.array([0.999, 1.001])).status
    assert statuses.tolist() == [Status.WRINKLED, Status.UNSTABLE]
    assert branches.pull_in(SOFT, 10e-3, 0.9 * fold) is None


def test_newton_s_matrix_of_a_branch_has_the_derivatives_of_its_residual(few_modes: None) -> None:
    """By the modes, the force and the varied parameter, the slopes following; central differences."""
    for vary, parameter in (("voltage", 0.4), ("displacement", 0.7)):
        path = branches._Path(SOFT, 10e-3, 300.0, vary)  # type: ignore[arg-type]
        found, _ = branches._follow(path, parameter, 1)
        point, n = found[0], len(found[0].c)
        matrix, residual, at, r, rate = path.system(point)
        assert np.abs(residual).max() < 1e-7
        for column in (0, 3, n, n + 1):
            ends = []
            step = 1e-5
            for sign in (1.0, -1.0):
                change = np.zeros(n + 2)
                change[column] = sign * step
                moved = branches._Point(
                    point.c + change[:n],
                    point.w + path.slopes(point, change, at, r, rate),
                    point.lam + float(change[n]),
                    point.parameter + float(change[n + 1]),
                    *point.rest(),
                )
                ends.append(path.system(moved)[1])
            got = (ends[0] - ends[1]) / (2.0 * step)
            np.testing.assert_allclose(matrix[:, column], got, rtol=1e-4, atol=1e-5 * np.abs(matrix[:, column]).max())


def test_a_branch_in_displacement_is_made_of_the_solver_s_states(few_modes: None) -> None:
    branch = branches.vary_displacement(FILM, 1000.0, 12e-3, points=25)
    assert branch.ended == "25 points" and branch.limit_points == () and branch.stable.all()
    assert branch.h[0] == pytest.approx(0.02 * 12e-3) and np.all(np.diff(branch.h) > 0.0)
    found = solve_many(FILM, branch.h[::5], 1000.0, tolerance=1e-9)
    np.testing.assert_allclose(branch.force[::5], found.force, rtol=1e-6)
    np.testing.assert_array_equal(branch.voltage, 1000.0)
    assert branches.vary_displacement(FILM, 1000.0, 0.3e-3).ended == "the end of the range"
