"""The closed loop on the simulated bench: what it does to the film, what it logs, what ends it and how it goes on."""

from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Callable, Iterable
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from calibration.film.propagation import NUISANCES
from calibration.film.systematic import SYSTEMATIC
from rig.analysis.refitting import RefitProcess
from rig.base.errors import Breakdown, FaultError, LimitError, Stopped
from rig.base.toml_file import parse_table
from rig.log.dataset import load_run
from rig.log.reader import read_log
from rig.protocol.experiment import Experiment, prepare
from rig.protocol.plan import plan
from rig.protocol.predict import check_plan
from rig.protocol.protocol import Protocol
from rig.replay.recording import load_recording
from rig.replay.rerun import rerun
from rig.run.resume import prepare_resumed
from rig.run.run import run
from rig.scene.scene import load_scene
from rig.steps.advisor import Advice, Ask, Kind, Standing
from rig.steps.learn import FAILURES, Learning
from rig.steps.places import connected
from rig.steps.rig import CyclesDone
from rig.steps.wanted import BY_TIME, STATED, Counts, parse_wanted

SCENE = Path(str(files("sim_fixtures"))) / "scenes" / "cone-4mm.toml"
PROTOCOL = """
[[step]]
do = "home"
[[step]]
do = "zero"
duration_s = 0.5
[[step]]
do = "approach"
speed_mm_per_s = 4.0
threshold_mN = 8.0
max_travel_mm = 8.0
[[step]]
do = "learn"
until = "stiffness 0.8 %, eps_r 1 %"
at_most_min = 1
settle_s = 0.2
[[step]]
do = "return"
speed_mm_per_s = 4.0
"""


class Scripted:
    """An advisor that says what it was told to say, half a second after it was asked."""

    def __init__(self, says: Iterable[Advice | None]) -> None:
        self._says = iter(says)
        self.questions: list[Ask] = []
        self._asked = 0.0

    def ask(self, question: Ask, now: float) -> None:
        self.questions.append(question)
        self._asked = now

    def answer(self, now: float, stopping: Callable[[], bool]) -> Advice | None:
        return None if now < self._asked + 0.5 else next(self._says)

    def close(self) -> None:
        pass


def go(h: float, voltage: float, hold_s: float = 1.0, relative: float = 0.02) -> Advice:
    told = {"quantity": "eps_r", "value": 1.7, "standard_uncertainty": 1.7 * relative, "relative": relative}
    known = (
        Standing("stiffness", 1.2e5, 1.2e3, 0.01, 0.008, Kind.UNREACHABLE, "thickness alone leaves 0.9 %"),
        Standing(**told, wanted=0.01, outcome=Kind.TIME, reason="well enough by one fit"),
    )
    return Advice(Kind.GO, "tells most per second", h, voltage, hold_s, wanted=0.01, **told, known=known)


def ends(kind: Kind) -> Advice:
    return replace(go(0.0, 0.0, relative=0.009), kind=kind, h=float("nan"), voltage=float("nan"), hold_s=0.0)


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    path = tmp_path_factory.mktemp("learn") / "protocol.toml"
    path.write_text(PROTOCOL, encoding="utf-8")
    return prepare(SCENE, path)


@pytest.fixture(scope="module")
def places() -> dict[float, tuple[float, ...]]:
    scene, _ = load_scene(SCENE)
    return connected(scene, scene.specimen.specimen())


def carry_out(experiment: Experiment, out: Path, says: Iterable[Advice | None], **options: object) -> Scripted:
    advisor = Scripted(says)
    run(experiment, out, lambda done, total, label: None, advisor=advisor, **options)
    return advisor


# --- What is understood


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("esp_r 0.5 %", "Is eps_r meant?"),
        ("G 1 %", "no quantity of the fit"),
        ("", "no quantity of the fit"),
        ("eps_r", "missing"),
        ("eps_r 0 %", "outside"),
        ("eps_r -1 %", "outside"),
        ("eps_r nan %", "no number"),
        ("eps_r 0.5", "the unit is missing"),
        ("eps_r 1.2.3 %", "no number"),
        ("eps_r 60 %", "outside"),
        ("eps_r 1 % given the weather", "not understood"),
        ("eps_r 1 %, eps_r 2 %", "twice"),
    ],
)
def test_what_is_not_understood_is_refused_with_the_reason(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parse_wanted(text)


def test_several_wishes_and_which_parts_count() -> None:
    one, other = parse_wanted("eps_r 0.5 % given dimensions, stiffness 1%")
    assert (one.name, one.relative, one.counts) == ("eps_r", 0.005, Counts.GIVEN_DIMENSIONS)
    assert (other.name, other.relative, other.counts) == ("stiffness", 0.01, Counts.ALL)
    budget = {"noise": 0.03, "thickness": 0.04, "lack of fit": 0.12}
    assert other.of(-1.0, budget) == pytest.approx((0.13, np.hypot(0.04, 0.12)))
    assert one.of(1.0, budget) == pytest.approx((np.hypot(0.03, 0.12), 0.12))


def test_what_is_stated_and_what_time_lowers_are_entries_of_the_budget() -> None:
    assert set(STATED) == {part for part, *_ in SYSTEMATIC} | {"eccentricity"}
    assert {kind.replace("_", " ") for kind in NUISANCES} < set(BY_TIME)
    assert not set(STATED) & set(BY_TIME)


# --- What may be done


def test_all_places_and_ways_are_held_against_the_limits_before(places: dict[float, tuple[float, ...]]) -> None:
    scene, _ = load_scene(SCENE)
    protocol = parse_table(PROTOCOL, Protocol, "protocol", "here")
    (action,) = [one for one in plan(protocol, scene) if isinstance(one, Learning)]
    assert action.highest_voltage == max(places) > 1000.0
    assert {one.h[1] for one in action.may} == {h[-1] for h in places.values()}
    lower = scene.model_copy(update={"limits": scene.limits.model_copy(update={"field_V_per_um": 30.0})})
    with pytest.raises(LimitError, match=r"Step 4 .*field"):
        check_plan([action], lower)
    levels = sorted(places)
    for below, above in itertools.pairwise(levels):  # the way at the lower voltage is always allowed
        assert set(places[above]) <= set(places[below])


# --- How it ends, with a rig that stands still


class Still:
    """A rig at 0 V that is held where it is; each look at its clock takes a quarter of a second."""

    def __init__(self, experiment: Experiment, says: Iterable[Advice], at_most_s: float = 600.0) -> None:
        (action,) = [one for one in experiment.actions if isinstance(one, Learning)]
        h = action.places[0.0][0]
        rig = MagicMock(scene=experiment.scene, advisor=Scripted(says), counts={})
        rig.recorder.displacement = h
        rig.clock.now.side_effect = itertools.count(0.0, 0.25)
        for _ in replace(action, h=(h, h), duration=at_most_s, done=CyclesDone(1, 0.0)).carry_out(rig):
            pass
        calls = [one.args for one in rig.recorder.result.call_args_list]
        self.outcomes = [(name, outcome) for _, _, outcome, name, *_ in calls]
        self.decisions = [one.args[0]["outcome"] for one in rig.recorder.decision.call_args_list]


BROKEN = Advice(Kind.FAILED, "the process has ended")


def told(advice: Advice, **outcomes: Kind) -> Advice:
    return replace(advice, known=tuple(replace(one, outcome=outcomes[one.quantity]) for one in advice.known))


@pytest.mark.parametrize(
    ("stiffness", "eps_r", "ended"),
    [
        (Kind.TIME, Kind.TIME, ("failed", "failed")),
        (Kind.MET, Kind.TIME, ("met", "failed")),
        (Kind.TIME, Kind.UNREACHABLE, ("failed", "unreachable")),
    ],
)
def test_what_no_fit_has_settled_has_failed_where_fits_that_fail_end_it(
    experiment: Experiment,
    places: dict[float, tuple[float, ...]],
    stiffness: Kind,
    eps_r: Kind,
    ended: tuple[str, str],
) -> None:
    here = told(go(places[0.0][0], 0.0), stiffness=stiffness, eps_r=eps_r)
    still = Still(experiment, [here, *[BROKEN] * FAILURES])
    assert still.outcomes == [("stiffness", ended[0]), ("eps_r", ended[1])]


def test_what_was_never_known_has_failed_and_what_a_later_fit_knows_needs_time(experiment: Experiment) -> None:
    assert Still(experiment, [BROKEN] * FAILURES).outcomes == [("stiffness", "failed"), ("eps_r", "failed")]
    assert Still(experiment, [BROKEN], at_most_s=1.0).outcomes == [("stiffness", "failed"), ("eps_r", "failed")]
    later = told(ends(Kind.TIME), stiffness=Kind.TIME, eps_r=Kind.TIME)
    assert Still(experiment, [BROKEN, BROKEN, later]).outcomes == [("stiffness", "time"), ("eps_r", "time")]


def test_the_film_is_not_charged_where_the_ways_take_the_time_that_is_left(
    experiment: Experiment, places: dict[float, tuple[float, ...]]
) -> None:
    high = max(places)
    assert Still(experiment, [go(places[high][0], high)], at_most_s=10.0).decisions == ["time"]


# --- What it does


@pytest.mark.slow
def test_it_goes_where_it_is_told_says_why_and_ends_at_0_V(
    experiment: Experiment, places: dict[float, tuple[float, ...]], tmp_path: Path
) -> None:
    low, high = sorted(places)[3], sorted(places)[5]
    h1, h2 = places[high][3], places[low][8]
    out = tmp_path / "run.mcap"
    wrong = go(h1 + 1e-4, high)
    advisor = carry_out(experiment, out, [go(h1, high), wrong, go(h2, low), ends(Kind.TIME)])
    log, measured = read_log(out), load_run(out)
    rows = [message.fields for message in log.messages("/decision")]
    assert [row["outcome"] for row in rows] == ["go", "failed", "go", "time"]
    assert [row["number"] for row in rows] == [1, 2, 3, 4]
    assert "no place that was checked" in rows[1]["reason"]
    assert (rows[0]["displacement_m"], rows[0]["voltage_V"]) == (h1, high)
    assert [row["spent_s"] for row in rows] == sorted(row["spent_s"] for row in rows)
    # What the film underwent: held at both places, never beyond, and off at the end.
    for h, volts in ((h1, high), (h2, low)):
        there = (np.abs(measured.h - h) < 3e-5) & (np.abs(measured.voltage - volts) < 0.01 * volts + 3.0)
        assert np.count_nonzero(there) > 80
    assert np.nanmax(measured.voltage) < 1.02 * high
    assert (log.outcome or {})["status"] == "complete"
    assert abs(log.columns("/hv/sample")["voltage_V"][-1]) < 60.0
    moved = np.abs(np.diff(measured.h)) > 2e-5  # the disk moves at the lower voltage of the two
    assert np.nanmax(measured.voltage[1:][moved & (measured.h[1:] > 1e-3)]) < 1.02 * low + 20.0
    results = [message.fields for message in log.messages("/result")]  # all that was wanted, not only the last to come
    told = [(one["name"], one["outcome"], one["value"], one["unit"]) for one in results]
    assert told == [("stiffness", "unreachable", 1.2e5, "Pa"), ("eps_r", "time", 1.7, "1")]
    assert [one["standard_uncertainty"] for one in results] == pytest.approx([1.2e3, 1.7 * 0.009])
    standings = [message.fields for message in log.messages("/standing")]
    assert [(one["number"], one["quantity"]) for one in standings][-2:] == [(4, "stiffness"), (4, "eps_r")]
    assert [one["wanted_uncertainty"] for one in standings][-2:] == [0.008, 0.01]
    curves = measured.curves(experiment.scene.specimen.specimen(), {"learn"}, force_noise=5e-3)
    assert {curve.nominal_voltage for curve in curves} == {0.0, low, high}
    assert [one.voltage for one in advisor.questions] == [0.0, high, high, low]
    again = rerun(load_recording(out))
    assert again.exit_code == 0, again.report


@pytest.mark.slow
def test_fits_that_keep_failing_end_the_step_in_order(experiment: Experiment, tmp_path: Path) -> None:
    out, said = tmp_path / "run.mcap", []
    carry_out(experiment, out, [Advice(Kind.FAILED, "the process has ended")] * FAILURES, say=said.append)
    log = read_log(out)
    assert (log.outcome or {})["status"] == "complete"
    assert sum("the process has ended" in words for words in said) == FAILURES
    results = [message.fields for message in log.messages("/result")]  # nothing is known, and it says so
    assert [(one["name"], one["outcome"]) for one in results] == [("stiffness", "failed"), ("eps_r", "failed")]
    assert np.isnan([one["value"] for one in results]).all() and "eps_r 1 %: not known: the fits f" in " ".join(said)
    assert np.nanmax(np.abs(log.columns("/hv/sample")["voltage_V"])) < 60.0


@pytest.mark.slow
def test_stopped_while_a_fit_runs_it_is_safe_and_goes_on_at_the_next_question(
    experiment: Experiment, places: dict[float, tuple[float, ...]], tmp_path: Path
) -> None:
    volts = sorted(places)[4]
    out, again = tmp_path / "run.mcap", tmp_path / "again.mcap"

    def never() -> Iterable[Advice | None]:
        yield go(places[volts][2], volts)
        os.kill(os.getpid(), signal.SIGINT)
        while True:
            yield None

    with pytest.raises(Stopped):
        carry_out(experiment, out, never())
    log = read_log(out)
    assert (log.outcome or {})["safe"] == "yes"
    spent = [message.fields["spent_s"] for message in log.messages("/decision")]
    rest = prepare_resumed(out)
    (action,) = [one for one in rest.actions if isinstance(one, Learning)]
    assert (action.done.count, action.done.reference) == (1, spent[0])
    assert rest.earlier == (out,)
    advisor = carry_out(rest, again, [ends(Kind.MET)])
    (question,) = advisor.questions
    assert question.number == 2 and question.spent_s >= spent[0]


@pytest.mark.slow
def test_a_film_that_breaks_down_ends_it_safely(
    experiment: Experiment, places: dict[float, tuple[float, ...]], tmp_path: Path
) -> None:
    scene = experiment.scene
    film = scene.simulation.film.model_copy(update={"breakdown_field_MV_per_m": 25.0})
    weak = scene.model_copy(update={"simulation": scene.simulation.model_copy(update={"film": film})})
    volts = max(places)
    out = tmp_path / "run.mcap"
    with pytest.raises((Breakdown, LimitError, FaultError)):
        carry_out(replace(experiment, scene=weak), out, [go(places[volts][-1], volts)])
    log = read_log(out)
    assert (log.outcome or {})["safe"] == "yes"
    assert len(list(log.messages("/decision"))) == 1


# --- The process that fits


def test_each_step_is_served_by_what_it_wants(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    second = '[[step]]\ndo = "learn"\nuntil = "stiffness 2 %"\nat_most_min = 1\n[[step]]\ndo = "return"'
    path = tmp_path / "protocol.toml"
    path.write_text(PROTOCOL.replace('[[step]]\ndo = "return"', second), encoding="utf-8")
    twice = prepare(SCENE, path)
    told: list[dict[str, Any]] = []
    monkeypatch.setattr(RefitProcess, "_send", lambda self, line: told.append(dict(line)))
    with RefitProcess(twice, tmp_path / "none.mcap") as process:
        process.ask(Ask(4, 1, 0.0, 0.0, 1.0, 50.0), 0.0)
        process._waiting = False
        process.ask(Ask(5, 1, 0.0, 0.0, 1.0, 50.0), 1.0)
    assert [line["step"]["until"] for line in told if "scene" in line] == [
        "stiffness 0.8 %, eps_r 1 %",
        "stiffness 2 %",
    ]


@pytest.mark.slow
def test_a_process_that_dies_is_told_and_the_next_question_has_another(experiment: Experiment, tmp_path: Path) -> None:
    with RefitProcess(experiment, tmp_path / "none.mcap") as process:
        first = process.pid
        process.ask(Ask(4, 1, 0.0, 0.0, 1.0, 50.0), 0.0)
        assert first is not None
        os.kill(first, signal.SIGKILL)
        told = process.answer(10.0, lambda: False)
        assert told is not None and told.kind is Kind.FAILED and "has ended" in told.reason
        process.ask(Ask(4, 2, 0.0, 0.0, 1.0, 50.0), 20.0)
        second = process.pid
        assert second not in (None, first)
        told = process.answer(30.0, lambda: False)
        assert told is not None and told.kind is Kind.FAILED and "there is no such file" in told.reason
        process.ask(Ask(4, 3, 0.0, 0.0, 1.0, 50.0), 40.0)
        assert process.answer(50.0, lambda: True) is None or process.pid == second
    assert process.pid is None
