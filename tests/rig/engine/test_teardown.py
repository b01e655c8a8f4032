"""The way to the safe state, with a bench that does what each case says: what is told to whom, when, and how often."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import pytest

from drivers.links.link import DeviceLost
from drivers.roles import HVFlag, HVSample
from rig.base.clock import VirtualClock
from rig.engine.teardown import AGAIN_S, LISTEN_S, Rest, Teardown
from rig.safety.guard import AT_ONCE_S

TURN_S = 0.01
RAMP_LIMIT_S = 3.0


class Rig:
    """Bench, guard, recorder and control in one; the output is off ``falls_s`` after it was told so."""

    off_limit = AT_ONCE_S
    ramp_limit = RAMP_LIMIT_S
    second_words = ""
    simulated = None

    def __init__(self, *roles: str, commanded: bool = True) -> None:
        self.clock = VirtualClock()
        self.devices = dict.fromkeys(roles)
        self.commanded = commanded
        self.told: list[tuple[float, str]] = []
        self.events: list[tuple[str, str]] = []
        self.falls_s = 0.5
        self.deaf: set[str] = set()  # what it is told so changes nothing
        self.silent: dict[str, tuple[float, float]] = {}  # from when to when a role cannot be read
        self.moving = False
        self.count = 0  # signals
        self.signal_at = math.inf
        self.turn = 0.0
        self.best_effort = False
        self._off_at = math.inf if commanded else 0.0
        self.scene = self
        self.hv = object() if "hv" in roles else None

    @property
    def stage(self) -> Rig:
        return self

    @property
    def output_is_safe(self) -> bool:
        return self.clock.now() >= self._off_at

    def say(self, word: str) -> None:
        self.told.append((self.clock.now(), word))
        if word != "stop" and word not in self.deaf:
            self._off_at = min(self._off_at, self.clock.now() + self.falls_s)

    def stop(self) -> None:
        self.say("stop")
        self._read("stage")

    def ramp_off(self, cause: str) -> None:
        self.say("ramp")

    def kill(self, cause: str) -> None:
        self.say("kill")

    def poll(self, role: Any, now: float | None = None) -> list[Any]:
        if now is None:  # of the control
            self.count = 2 if role >= self.signal_at else 0
            return []
        self._read(role)
        return [HVSample(now, 0.0, 0.0, 0.0, HVFlag(0))] if role == "hv" else []

    def _read(self, role: str) -> None:
        begin, end = self.silent.get(role, (math.inf, math.inf))
        if begin <= self.clock.now() < end:
            raise DeviceLost(role, "it is gone")

    def add(self, sample: Any) -> Any:
        return sample

    def on_sample(self, sample: Any) -> None:
        self.judged = sample.t

    def command(self, *said: str) -> None:
        assert said == ("stage", "stop", "")

    def event(self, severity: str, source: str, message: str) -> None:
        self.events.append((source, message))

    def tick(self, now: float) -> None:
        assert self.turn == now

    def run(self, *, orderly: bool = True, listen: float = 0.0, guard: bool = True) -> Rest:
        me: Any = self
        teardown = Teardown(me, me if guard else None, me, me)
        return teardown.run("a test", orderly, lambda now: now + TURN_S, listen)

    def when(self, word: str) -> list[float]:
        return [t for t, one in self.told if one == word]


def test_the_stage_stops_first_and_an_orderly_end_ramps_down() -> None:
    rig = Rig("stage", "force", "hv")
    assert rig.run() == Rest(safe=True, standing=True)
    assert [word for _, word in rig.told] == ["stop", "ramp"]
    assert rig.clock.now() == pytest.approx(0.5, abs=TURN_S) and rig.events == [] and rig.best_effort
    assert rig.judged > 0.4


def test_any_other_end_takes_the_output_off_at_once() -> None:
    rig = Rig("stage", "hv")
    assert rig.run(orderly=False).safe
    assert [word for _, word in rig.told] == ["stop", "kill"]


def test_a_ramp_that_takes_too_long_is_cut_short_and_the_emergency_off_has_its_time() -> None:
    rig = Rig("stage", "hv")
    rig.deaf = {"ramp", "kill"}
    assert not rig.run().safe
    assert rig.when("kill") == pytest.approx([RAMP_LIMIT_S], abs=2 * TURN_S)  # the guard itself sends it again
    assert rig.clock.now() == pytest.approx(RAMP_LIMIT_S + AT_ONCE_S, abs=3 * TURN_S)
    assert rig.events[-1][0] == "hv" and "NOT SAFE" in rig.events[-1][1]


@pytest.mark.parametrize("orderly", [True, False])
def test_a_second_signal_takes_the_output_off_at_once_and_waits_for_nothing_else(orderly: bool) -> None:
    rig = Rig("stage", "hv")
    rig.signal_at, rig.deaf = 1.0, {"ramp"}
    assert rig.run(orderly=orderly, listen=2.0).safe
    if orderly:
        assert rig.when("kill") == pytest.approx([1.0], abs=2 * TURN_S)
    assert rig.clock.now() == pytest.approx(1.5 if orderly else 1.0, abs=3 * TURN_S)


def test_a_supply_that_cannot_be_read_is_sent_off_again_ten_times_a_second_until_it_can() -> None:
    """The ramp may be lost: it is hastened at once. That it can be read again proves nothing of the off before."""
    rig = Rig("stage", "hv")
    rig.silent["hv"] = (0.1, 1.1)
    rig.falls_s = 2.0
    assert rig.run().safe
    kills = rig.when("kill")
    assert kills[0] == pytest.approx(0.1, abs=2 * TURN_S)
    late = [t for t in kills if t > 0.2]
    assert 8 <= len(late) <= 11 and all(b - a >= AGAIN_S - 1e-9 for a, b in pairwise(late))
    assert len(rig.events) == 1  # each error is told once


def test_a_stage_that_does_not_answer_is_told_again_ten_times_a_second() -> None:
    rig = Rig("stage", "hv")
    rig.silent["stage"] = (0.0, 1.0)
    assert rig.run(listen=1.5) == Rest(safe=True, standing=True)
    stops = rig.when("stop")
    assert 10 <= len(stops) <= 13
    gaps = [b - a for a, b in pairwise(stops[1:])]
    assert all(AGAIN_S - 1e-9 <= gap <= AGAIN_S + 2 * TURN_S for gap in gaps)


def test_a_stage_that_goes_on_moving_is_waited_for_and_then_said() -> None:
    rig = Rig("stage", "hv")
    rig.moving = True
    assert rig.run() == Rest(safe=True, standing=False)
    assert rig.clock.now() == pytest.approx(RAMP_LIMIT_S, abs=2 * TURN_S)


def test_instruments_are_heard_until_the_time_that_is_asked_for() -> None:
    rig = Rig("stage", "hv")
    rig.run(listen=2.5)
    assert rig.clock.now() == pytest.approx(2.5, abs=2 * TURN_S)


def test_an_output_that_was_never_commanded_is_listened_to_and_not_hastened() -> None:
    rig = Rig("stage", "hv", commanded=False)
    rig._off_at = math.inf
    rig.deaf = {"ramp"}
    assert not rig.run().safe
    assert rig.clock.now() == pytest.approx(LISTEN_S, abs=2 * TURN_S)
    assert rig.when("kill") == []


def test_without_high_voltage_safe_is_what_has_none() -> None:
    rig = Rig("stage", "force")
    assert rig.run(guard=False) == Rest(safe=True, standing=True)
    assert [word for _, word in rig.told] == ["stop"] and rig.events == []
    lost = Rig("stage", "hv")  # its supply was never reached
    assert not lost.run(guard=False).safe and "NOT SAFE" in lost.events[-1][1]
