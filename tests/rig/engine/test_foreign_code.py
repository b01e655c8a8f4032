"""Steps and drivers of other packages that misbehave: nothing skips the way to the safe state, or hides its end."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from rig.base.errors import FaultError
from rig.engine.engine import Engine
from rig.engine.outcome import Outcome
from rig.log.nowhere import NoLog
from rig.log.writer import LogWriter
from rig.operator.control import Control, Question
from rig.protocol.experiment import gains_of, prepare
from rig.run.backend import open_bench
from rig.safety.guard import GuardState
from rig.steps.base import Action, Turns
from rig.steps.output import ramp_to
from rig.steps.prompt import Prompt
from rig.steps.rig import Rig
from rig.steps.turns import pause

FIXTURES = Path(str(files("sim_fixtures")))
Carry = Callable[[Rig], Turns]


@dataclass(frozen=True, kw_only=True)
class Foreign(Action):
    carry: Carry

    def carry_out(self, rig: Rig) -> Turns:
        yield from self.carry(rig)


class Answering(Control):
    """Somebody who types what is asked for, a quarter of a second later."""

    def poll(self, now: float) -> None:
        if self.question is None:
            self.asked = now
        elif self.answer is None and now > self.asked + 0.25:
            self.take(self.question.expected or "done", "a test")


def run(carry: Carry, spoil: Callable[[Engine], None] = lambda engine: None) -> tuple[Engine, Outcome, Any]:
    experiment = prepare(FIXTURES / "scenes" / "cone-4mm.toml", FIXTURES / "protocols" / "short.toml")
    step = Prompt.model_construct(do="prompt", text="of another package")
    action = Foreign(by=step, step=1, label="foreign", voltage=(0.0, 300.0), duration=30.0, carry=carry)
    bench = open_bench(experiment.scene)
    engine = Engine(
        bench,
        [action],
        cast(LogWriter, NoLog()),
        gains_of(experiment.certificates),
        Answering(),
        lambda done, total, label: None,
        requested="a test",
    )
    spoil(engine)
    outcome, error = engine.run()
    return engine, outcome, error


def up(rig: Rig) -> Turns:
    yield from ramp_to(rig, 300.0, 30.0)


def true_volts(engine: Engine) -> float:
    assert engine.bench.simulated is not None
    return float(engine.bench.simulated.world.voltage(np.array([engine.clock.now()]))[0])


def test_a_step_that_ends_the_program_does_not_skip_the_way_to_off() -> None:
    def leaves(rig: Rig) -> Turns:
        yield from up(rig)
        sys.exit(0)

    engine, outcome, error = run(leaves)
    assert isinstance(error, FaultError) and "SystemExit" in str(error)
    assert outcome.safe and outcome.status == "fault" and true_volts(engine) < 60.0


@pytest.mark.parametrize("what", ["next_poll", "moving", "counters", "exit"])
def test_a_driver_that_fails_at_every_question_does_not_skip_the_way_to_off(what: str) -> None:
    """The stage's driver, from when the voltage is up."""

    def spoils(rig: Rig) -> Turns:
        yield from up(rig)
        stage = rig.bench.stage
        if what == "exit":
            stage.poll = lambda now: sys.exit(0)  # type: ignore[method-assign]
        else:
            broken = property(lambda self: 1 / 0)
            rig.bench.stage.__class__ = type("Broken", (type(stage),), {what: broken})
        if what in ("moving", "counters"):
            raise RuntimeError("a mistake")
        yield

    engine, outcome, error = run(spoils)
    assert error is not None and outcome.safe and true_volts(engine) < 60.0
    assert outcome.standing == (what in ("next_poll", "counters"))


def test_no_step_goes_higher_than_the_operator_has_typed() -> None:
    def goes_on(rig: Rig) -> Turns:
        yield from up(rig)
        yield from ramp_to(rig, 400.0, 30.0)

    _, outcome, error = run(goes_on)
    assert isinstance(error, FaultError) and "not confirmed so high" in str(error)
    assert outcome.safe and outcome.status == "fault"


def test_a_step_with_hands_cannot_ask_for_them_under_voltage() -> None:
    at: list[GuardState] = []

    def asks(rig: Rig) -> Turns:
        yield from up(rig)
        assert rig.guard is not None
        at.append(rig.guard.state)
        yield from rig.ask(Question("Touch it."))
        at.append(rig.guard.state)
        yield from pause(rig, 1.0)

    _, outcome, error = run(asks)
    assert at == [GuardState.LIVE] and outcome.safe
    assert isinstance(error, FaultError) and "asks for the operator's hands" in str(error)
