"""What is said of each quantity that a closed loop is to find: its own outcome, whatever the others are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from calibration.film.curve import Curve
from calibration.film.result import Identification
from rig.analysis.learning import HOPELESS, Learner
from rig.scene.scene import load_scene
from rig.steps.advisor import Advice, Ask, Kind
from rig.steps.moves import ramp_duration
from rig.steps.places import connected
from rig.steps.wanted import parse_wanted

SCENE = Path(__file__).resolve().parents[3] / "sim_fixtures" / "scenes" / "cone-4mm.toml"
WISH = "stiffness 1 %, eps_r 1 %"
MET, TIME, LOST = Kind.MET, Kind.TIME, Kind.UNREACHABLE
GOOD, POOR, STUCK = (0.009, 0.001), (0.03, 0.001), (0.03, 0.02)  # relative uncertainty, and what of it stays

Stands = Mapping[str, tuple[float, float]]


class Told(Learner):
    """Its fits stand as they are told to; where it goes next is not asked."""

    def standing(self, curves: object, fit: object) -> dict[str, tuple[float, float]]:
        return dict(cast("Any", fit).stands)

    def _next(self, *args: Any, **options: Any) -> Advice:
        *_, self.missing, reason = args
        return Advice(Kind.GO, reason, 3e-3, 0.0, 8.0)


PAUSED_M = 3.00013e-3  # where a pause left the disk, as it was measured


def answers(fits: Sequence[Stands], left_s: float = 600.0) -> tuple[list[Advice], Told]:
    scene, _ = load_scene(SCENE)
    learner = Told(scene, parse_wanted(WISH))
    found = []
    for number, stands in enumerate(fits, 1):
        budget = {name: {"noise": one[0], "thickness": one[1]} for name, one in stands.items()}
        quantities = {name: SimpleNamespace(value=1.0, budget=budget[name]) for name in stands}
        fit = cast("Identification", SimpleNamespace(stands=stands, quantities=quantities))
        found.append(learner.advise([], fit, Ask(4, number, PAUSED_M, 0.0, 60.0, left_s)))
    return found, learner


def both(stiffness: tuple[float, float], eps_r: tuple[float, float]) -> Stands:
    return {"stiffness": stiffness, "eps_r": eps_r}


@pytest.mark.parametrize(
    ("fits", "kind", "outcomes"),
    [
        ([both(GOOD, GOOD)], Kind.GO, (TIME, TIME)),  # one fit says so: another one has to confirm it
        ([both(GOOD, GOOD)] * 2, MET, (MET, MET)),
        ([both(GOOD, POOR), both(POOR, GOOD), both(GOOD, GOOD)], Kind.GO, (TIME, MET)),
        ([both(STUCK, POOR)] * (HOPELESS - 1), Kind.GO, (TIME, TIME)),
        ([both(STUCK, POOR)] * HOPELESS, Kind.GO, (LOST, TIME)),  # the other one only needs more time, and gets it
        ([both(STUCK, POOR)] * HOPELESS + [both(STUCK, GOOD)] * 2, LOST, (LOST, MET)),
        ([both(GOOD, STUCK)] * HOPELESS, LOST, (MET, LOST)),
        ([both(STUCK, STUCK)] * HOPELESS, LOST, (LOST, LOST)),
        ([both(STUCK, GOOD), both(STUCK, GOOD), both(POOR, GOOD), both(STUCK, GOOD)], Kind.GO, (TIME, MET)),
        ([both(STUCK, POOR)] * HOPELESS + [both(GOOD, GOOD)] * 2, MET, (MET, MET)),  # later fits say that it can be
    ],
)
def test_each_quantity_has_its_own_outcome(fits: Sequence[Stands], kind: Kind, outcomes: tuple[Kind, Kind]) -> None:
    *_, last = answers(fits)[0]
    assert last.kind is kind
    assert tuple(one.outcome for one in last.known) == outcomes
    for one in last.known:
        assert ("thickness alone leaves 2 %" in one.reason) is (one.outcome is LOST)
        assert one.outcome is not MET or one.relative <= one.wanted
    if kind is LOST:
        assert "cannot be reached" in last.reason


def test_what_cannot_be_reached_is_not_what_the_next_place_is_chosen_for() -> None:
    (*_, last), learner = answers([both(STUCK, POOR)] * HOPELESS)
    assert last.quantity == "eps_r" and learner.missing == ["eps_r"]


def test_the_time_is_out_for_what_needed_more_and_only_for_that() -> None:
    fits = [both(STUCK, POOR)] * HOPELESS
    *_, last = answers(fits, left_s=1.0)[0]
    assert last.kind is TIME and [one.outcome for one in last.known] == [LOST, TIME]
    assert "more" in last.known[1].reason


def test_a_quantity_that_the_fit_does_not_know_yet_takes_nothing_from_the_other() -> None:
    (first, second), _ = answers([{"stiffness": GOOD}] * 2)
    assert first.kind is second.kind is Kind.GO
    assert [(one.quantity, one.outcome) for one in second.known] == [("stiffness", MET)]


def test_a_claim_is_confirmed_at_a_place_that_was_checked() -> None:
    (advice,), _ = answers([both(GOOD, GOOD)])
    scene, _ = load_scene(SCENE)
    places = connected(scene, scene.specimen.specimen())[0.0]
    assert advice.kind is Kind.GO and advice.voltage == 0.0
    assert advice.h in places
    assert abs(advice.h - PAUSED_M) == min(abs(one - PAUSED_M) for one in places)


@pytest.fixture(scope="module")
def learner() -> Learner:
    scene, _ = load_scene(SCENE)
    return Learner(scene, parse_wanted("eps_r 0.2 % noise and zeros"))


def held(learner: Learner, seconds: float) -> list[Curve]:
    """The film at the highest displacement at 0 V."""
    n = round(seconds * learner.scene.rates["force"])
    at = np.full(n, learner.h[learner.voltage == 0.0].max())
    still = np.zeros(n, dtype=np.int8)
    errors = {"force_noise": 2e-3, "displacement_noise": 2e-6, "force_zero": 1e-3, "displacement_zero": 2e-6}
    samples = {"h": at, "force": np.full(n, 0.1), "voltage": np.zeros(n), "direction": still}
    specimen = learner.scene.specimen.specimen()
    return [Curve(label="0 V", run="one", nominal_voltage=0.0, specimen=specimen, **samples, **errors)]


@pytest.mark.parametrize("left_s", [30.0, 13.0, 10.0, 5.0, 3.0])
def test_the_film_is_charged_only_where_the_ways_leave_time_to_hold_it(learner: Learner, left_s: float) -> None:
    advice = learner.advise(held(learner, 60.0), None, Ask(1, 1, 3e-3, 0.0, 100.0, left_s))
    if left_s < 8.0:
        assert advice.kind is Kind.TIME and "time is out" in advice.reason
        return
    assert advice.kind is Kind.GO and advice.voltage > 0.0
    ways = 2.0 * (ramp_duration(learner.scene, 0.0, advice.voltage) + learner.settle_s)
    assert ways + advice.hold_s <= left_s


def test_at_high_voltage_the_way_back_is_counted_once(learner: Learner) -> None:
    volts = float(learner.voltage.max())
    advice = learner.advise(held(learner, 60.0), None, Ask(1, 1, 3e-3, volts, 100.0, 4.0))
    way = ramp_duration(learner.scene, volts, 0.0) + learner.settle_s
    assert advice.kind is Kind.GO and advice.expected_s == pytest.approx(4.0 + way)
