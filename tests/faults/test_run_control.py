"""What the operator does to a run while it goes on, and what the simulated hardware then did."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from rig.base.errors import FaultError, Stopped
from rig.cli.app import main
from rig.log.dataset import load_run
from rig.log.reader import read_log
from rig.operator.control import Control
from rig.sim.bench import SimulatedBench
from rig.steps.output import CLEARED
from tests.faults.conftest import SCENES
from tests.protocols import TO_THE_FILM, near

Tell = Callable[..., Any]  # of conftest.Story
LIVE = ("[simulation.hv]", "[simulation.hv]\nstart_live_V = 500.0")
ASKING = """
[[step]]
do = "home"
[[step]]
do = "zero"
duration_s = 0.5
[[step]]
do = "approach"
speed_mm_per_s = 4.0
threshold_mN = 8.0
[[step]]
do = "prompt"
text = "Close the lid"
[[step]]
do = "voltage"
voltage_V = 500
settle_s = 0.2
[[step]]
do = "voltage"
voltage_V = 0
[[step]]
do = "prompt"
text = "Look at the film"
[[step]]
do = "voltage"
voltage_V = 300
[[step]]
do = "return"
"""


class Operator:
    """Types what ``script`` says; called with the control and told nothing else, like a person at a keyboard."""

    name = "a person"

    def __init__(self, script: Callable[[Control], list[str]]) -> None:
        self._script = script

    def read(self, control: Control) -> list[str]:
        return self._script(control)

    def close(self) -> None: ...


def answers(control: Control) -> list[str]:
    """Whatever is asked, as expected."""
    question = control.question
    return [question.expected or "done"] if question is not None and control.answer is None else []


def said_in(story: Any, words: str) -> list[str]:
    messages = [message.fields["message"] for message in read_log(story.log).messages("/event")]
    return [message for message in messages if words in message]


def commands(story: Any) -> list[str]:
    """What was commanded of the supply and asked of the operator, in the order of time."""
    log = read_log(story.log)
    told = [(m.fields["t_s"], m.fields["command"]) for m in log.messages("/command") if m.fields["device"] == "hv"]
    asked = [(m.fields["t_s"], m.fields["message"][:5]) for m in log.messages("/event")]
    return [word for _, word in sorted(told + [(t, word) for t, word in asked if word == "asked"], key=lambda x: x[0])]


def test_a_pause_stops_the_stage_takes_the_voltage_off_and_the_interrupted_part_is_done_again(tell: Tell) -> None:
    paused_at: list[float] = []
    during: list[tuple[float, float]] = []  # the output and the stage's speed, more than 5 s into the pause

    def meanwhile(now: float, bench: SimulatedBench, control: Control) -> None:
        if control.pausing and now > paused_at[0] + 5.0:
            during.append((bench.world.output.at(now)[0], bench.world.stage.at(now)[1]))
            if now > paused_at[0] + 8.0:
                control.take("continue", "a test")

    def pause(bench: SimulatedBench, control: Control) -> None:
        paused_at.append(bench.now)
        control.take("pause", "a test")

    story = tell(pause, meanwhile=meanwhile)
    assert story.outcome.status == "complete" and story.outcome.safe, story.outcome.reason
    assert len(during) > 5 and all(abs(volts) < 1 and speed == 0 for volts, speed in during)
    at_1000 = [t for t, volts in story.outputs if volts > 990]
    assert at_1000[0] < paused_at[0] < paused_at[0] + 8 < at_1000[-1]
    assert commands(story).count("arm") == 2 and commands(story).count("asked") == 2  # the second key is used up
    assert "emergency_off" not in story.control_words
    run = load_run(story.log)
    kinds = [(phase.kind, phase.record) for phase in run.phases]
    at = kinds.index(("pause", False))
    assert kinds[at - 1] == ("ramp", False) and kinds[at + 1] == ("ramp", True)
    again = run.h[run.phase == at + 1]
    assert again.min() < 0.1e-3 and again.max() > 5.9e-3  # the whole ramp, from its beginning


def test_a_stop_during_a_pause_ends_the_run(tell: Tell) -> None:
    def meanwhile(now: float, bench: SimulatedBench, control: Control) -> None:
        if control.pausing and bench.world.output.at(now)[0] < 1:
            control.take("stop", "a test")

    story = tell(lambda bench, control: control.take("p", "a test"), meanwhile=meanwhile)
    assert isinstance(story.error, Stopped) and story.outcome.safe and story.outcome.standing


def test_nothing_is_armed_before_the_highest_voltage_has_been_typed(tell: Tell) -> None:
    typed: list[str] = []

    def script(control: Control) -> list[str]:
        wrong = ["yes", "100", "1000 mV", "", "continue"]
        if control.question is None or control.answer is not None or len(typed) > len(wrong):
            return []
        typed.append([*wrong, "1000"][len(typed)])
        return [typed[-1]]

    story = tell(control=Control([Operator(script)]))
    assert typed[-1] == "1000" and len(typed) == 6
    assert story.outcome.status == "complete" and max(volts for _, volts in story.outputs) > 990
    assert said_in(story, "armed by two acts: a test; '1000', by a person")


def test_without_the_first_act_the_second_does_not_help(tell: Tell) -> None:
    story = tell(requested="")
    assert isinstance(story.error, FaultError) and "was not asked for by the operator" in str(story.error)
    assert not story.control_words and max(volts for _, volts in story.outputs) < 1.0


def test_prompts_are_asked_with_the_voltage_off_and_arming_begins_anew(tell: Tell) -> None:
    asked: list[str] = []

    def script(control: Control) -> list[str]:
        if control.question is not None and control.answer is None:
            asked.append(control.question.text)
        return answers(control)

    outputs_when_asked: list[float] = []

    def meanwhile(now: float, bench: SimulatedBench, control: Control) -> None:
        if control.question is not None and "lid" not in control.question.text:
            outputs_when_asked.append(bench.world.output.at(now)[0])

    story = tell(control=Control([Operator(script)]), protocol=ASKING, meanwhile=meanwhile)
    assert story.outcome.status == "complete", story.outcome.reason
    texts = asked
    # Whoever was asked may have touched the rig: the second key comes after his answer, never before.
    assert [texts[0], texts[2]] == ["Close the lid", "Look at the film"]
    assert texts[1].startswith("High voltage up to 500 V") and texts[3].startswith("High voltage up to 500 V")
    assert all(abs(volts) < 1 for volts in outputs_when_asked)
    assert commands(story) == [
        *["asked", "asked", "arm", "set_voltage", "switch_on", "set_voltage", "switch_off"],
        *["asked", "asked", "arm", "set_voltage", "switch_on", "set_voltage", "switch_off"],
    ]
    assert len(said_in(story, "answered: 'done', by a person")) == 2


def test_the_loop_goes_on_while_the_operator_is_waited_for(tell: Tell) -> None:
    """A load cell lost while a question is open ends the run, though nobody has answered."""
    from rig.sim.truth import Fault

    def meanwhile(now: float, bench: SimulatedBench, control: Control) -> None:
        if control.question is not None and "Look" in control.question.text and not lost:
            lost.append(now)
            bench.inject(Fault(role="force", kind="vanish"))

    lost: list[float] = []

    def script(control: Control) -> list[str]:
        return [] if control.question is not None and "Look" in control.question.text else answers(control)

    story = tell(control=Control([Operator(script)]), protocol=ASKING, meanwhile=meanwhile)
    assert lost and story.outcome.status == "fault" and "force" in story.outcome.reason
    assert story.end - lost[0] < 2.0 and story.outcome.safe


@pytest.mark.parametrize("asked", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_supply_found_live_is_taken_down_when_the_operator_chooses(tell: Tell, asked: bool) -> None:
    seen: list[str] = []

    def script(control: Control) -> list[str]:
        if control.question is not None:
            seen.append(control.question.text)
        return answers(control)

    choice = {} if asked else {"take_down": "--take-down on the command line"}
    story = tell(control=Control([Operator(script)]), replace=LIVE, **choice)
    assert any("live, measured 500 V" in text for text in seen) is asked
    assert story.outcome.status == "complete" and abs(story.final_output) < 1, story.outcome.reason
    assert story.control_words[:2] == ["take_down", "arm"]


def test_a_supply_found_live_is_left_alone_while_the_operator_thinks_and_when_he_stops(tell: Tell) -> None:
    looked: list[float] = []

    def script(control: Control) -> list[str]:
        if control.question is not None and "live" in control.question.text:
            looked.append(1.0)
        return ["s"] if len(looked) > 200 else []  # ten seconds

    story = tell(control=Control([Operator(script)]), replace=LIVE)
    assert isinstance(story.error, Stopped) and not story.outcome.safe
    assert story.final_output == pytest.approx(500, abs=5) and not story.control_words and not story.stage_words[:-1]


OPEN_ONCE = '[[simulation.fault]]\nrole = "hv"\nkind = "inhibit"\nduration_s = 0.01\n'


@pytest.mark.slow
def test_with_nobody_there_what_has_latched_is_refused_before_anything_moves_and_cleared_when_asked(tell: Tell) -> None:
    latched = ("[simulation.film]", f"{OPEN_ONCE}[simulation.film]")
    refused = tell(replace=latched)
    assert refused.outcome.status == "fault" and refused.outcome.safe
    assert "give the same command with --clear" in refused.outcome.reason
    assert "has latched from before this run: inhibited" in refused.outcome.reason
    stage = [float(refused.bench.world.stage.at(t)[0]) for t in (0.0, refused.end)]
    assert stage[0] == stage[1] and not {"clear", "arm"} & set(refused.control_words)


@pytest.mark.slow
def test_what_the_operator_said_at_the_start_clears_it(tell: Tell) -> None:
    latched = ("[simulation.film]", f"{OPEN_ONCE}[simulation.film]")
    done = tell(replace=latched, clear=CLEARED)
    assert done.outcome.status == "complete", done.outcome.reason
    assert done.control_words[:2] == ["clear", "arm"]


def test_what_the_supply_has_latched_is_cleared_only_when_the_operator_says_so(tell: Tell) -> None:
    """An interlock that was open for a moment before the run, and is closed again."""
    asked: list[str] = []

    def script(control: Control) -> list[str]:
        if control.question is not None and control.answer is None:
            asked.append(control.question.text)
        return answers(control)

    open_once = '[[simulation.fault]]\nrole = "hv"\nkind = "inhibit"\nduration_s = 0.01\n'
    story = tell(control=Control([Operator(script)]), replace=("[simulation.film]", f"{open_once}[simulation.film]"))
    assert story.outcome.status == "complete", story.outcome.reason
    assert "the supply has latched: inhibited" in asked[0] and asked[1].startswith("High voltage up to 1000 V")
    assert story.control_words[:2] == ["clear", "arm"]
    assert story.outcome.status == "complete", story.outcome.reason


LATER = '[[simulation.fault]]\nrole = "hv"\nkind = "inhibit"\nat_s = 2.5\nduration_s = 0.01\n'
"""An interlock that is open for a moment, in a run that the supply began clean."""


def test_what_latches_before_the_lid_is_closed_is_not_cleared_by_what_was_said_at_the_start(tell: Tell) -> None:
    story = tell(replace=("[simulation.film]", f"{LATER}[simulation.film]"), protocol=ASKING, clear=CLEARED)
    assert story.outcome.status == "fault" and story.outcome.safe
    assert "has latched during this run: inhibited" in story.outcome.reason
    assert story.bench.world.stage.at(story.end)[0] > 0.0 and not {"clear", "arm"} & set(story.control_words)
    assert max(abs(volts) for _, volts in story.outputs) < 1.0
    flags = read_log(story.log).columns("/hv/sample")["flags"]
    assert flags[0] == 0 and flags[-1] != 0  # it still has it


def test_somebody_there_is_asked_about_what_has_latched_beside_that(tell: Tell) -> None:
    """He closes the interlock, which somebody else has opened, before he answers."""
    asked: list[str] = []

    def script(control: Control) -> list[str]:
        if control.question is not None and control.answer is None:
            asked.append(control.question.text)
        return answers(control) if not asked or "latched" not in asked[-1] or len(asked) > 100 else []

    faults = OPEN_ONCE + LATER.replace("inhibit", "interlock").replace("0.01", "3.0")
    control = Control([Operator(script)])
    story = tell(
        control=control, replace=("[simulation.film]", f"{faults}[simulation.film]"), protocol=ASKING, clear=CLEARED
    )
    assert story.outcome.status == "complete", story.outcome.reason
    assert asked[0] == "Close the lid" and asked[1].startswith("hv: the supply has latched: ")
    assert "interlock open" in asked[1] and commands(story)[:4] == ["asked", "asked", "clear", "asked"]
    assert "clear" not in commands(story)[4:] and said_in(story, "cleared by 'clear', by a person: ")


def test_what_latches_while_he_is_asked_is_asked_about_before_anything_is_cleared(tell: Tell) -> None:
    """He answers late: somebody has opened the interlock meanwhile, and closed it again."""
    asked: list[str] = []

    def script(control: Control) -> list[str]:
        if control.question is None or control.answer is not None:
            return []
        asked.append(control.question.text)
        return answers(control) if "latched" not in asked[-1] or asked.count(asked[-1]) > 100 else []

    faults = OPEN_ONCE + LATER.replace("inhibit", "interlock").replace("2.5", "3.0").replace("0.01", "1.0")
    story = tell(control=Control([Operator(script)]), replace=("[simulation.film]", f"{faults}[simulation.film]"))
    assert story.outcome.status == "complete", story.outcome.reason
    print([(m.fields["t_s"], m.fields["message"]) for m in read_log(story.log).messages("/event")][:12])
    first, second, *_ = dict.fromkeys(text for text in asked if "latched" in text)
    assert first.startswith("hv: the supply has latched: inhibited, fault. "), first
    assert "inhibited" in second and "interlock open" in second
    assert commands(story)[:3] == ["asked", "asked", "clear"]


IN_MEMORY = (
    TO_THE_FILM
    + """[[step]]
do = "voltage"
voltage_V = 300
[[step]]
do = "return"
"""
)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["asked for", "not asked for", "ended before"])
def test_in_memory_it_is_cleared_when_asked_for_and_the_replay_is_the_same(tmp_path: Path, case: str) -> None:
    """Also of a run that somebody had to touch first, and that ended before it was cleared."""
    faults, first, asked = OPEN_ONCE, "", [] if case == "not asked for" else ["--clear"]
    if case == "ended before":
        faults += '[[simulation.fault]]\nrole = "stage"\nkind = "silent"\nat_s = 2.5\n'
        first = '[[step]]\ndo = "prompt"\ntext = "Close the lid"\n'
    text = near((SCENES / "cone-4mm.toml").read_text()).replace("../calibrations", str(SCENES.parent / "calibrations"))
    scene, steps, log = tmp_path / "scene.toml", tmp_path / "steps.toml", tmp_path / "run.mcap"
    scene.write_text(text.replace("[simulation.film]", f"{faults}[simulation.film]"))
    steps.write_text(f'title = "One voltage"\n{IN_MEMORY.replace(TO_THE_FILM, TO_THE_FILM + first)}')
    done = CliRunner().invoke(main, ["run", str(scene), str(steps), "-o", str(log), *asked])
    told = [m.fields for m in read_log(log).messages("/command") if m.fields["device"] == "hv"]
    volts = read_log(log).columns("/hv/sample")["voltage_V"]
    if case == "asked for":
        assert done.exit_code == 0, done.output
        assert (told[0]["command"], told[0]["argument"]) == ("clear", CLEARED) and max(volts) > 290.0
    else:
        advised = "give the same command with --clear" in done.output
        assert done.exit_code == 4 and advised is (case == "not asked for"), done.output
        assert "clear" not in [row["command"] for row in told] and max(abs(volts)) < 5.0
    again = CliRunner().invoke(main, ["replay", "--rerun", str(log)])
    assert again.exit_code == 0, again.output
