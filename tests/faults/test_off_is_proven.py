"""An off counts when it was measured, and until then somebody sees to it: the run's end, and the guard without one."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

from rig.bench.bench import Bench
from rig.operator.control import Control
from rig.run.backend import open_bench
from rig.safety import last_words, process
from rig.safety.channel import Channel
from rig.safety.guard import SAFE_VOLTAGE, Guard, GuardState
from rig.safety.heartbeat import Heartbeat
from rig.safety.last_words import LastWords
from rig.safety.process import Server
from rig.safety.stopped import Peer
from rig.scene.scene import load_scene
from rig.sim.bench import SimulatedBench
from rig.sim.truth import Fault

Tell = Callable[..., Any]  # of conftest.Story
SCENES = Path(str(files("sim_fixtures"))) / "scenes"
NOBODY = [("stuck", 1), ("stuck", 2), ("deaf", 1), ("deaf", 2)]


def deafen(supply: Any, seconds: float = float("inf")) -> None:
    """Let writes of its control registers come to nothing, for so long from the first one on."""
    obey, began = supply._set_control, []

    def ignore(channel: Any, word: int, t: float) -> None:
        began.append(t)
        if t > began[0] + seconds:
            obey(channel, word, t)

    supply._set_control = ignore


@pytest.mark.parametrize(("kind", "signals"), NOBODY)
def test_an_output_that_does_not_obey_is_not_safe_though_it_is_still_low(tell: Tell, kind: str, signals: int) -> None:
    done: list[float] = []

    def meanwhile(now: float, bench: SimulatedBench, control: Control) -> None:
        if not done and 0 < bench.world.output.at(now)[0] < SAFE_VOLTAGE:
            done.append(now)
            supply = bench.instruments["hv"]
            if kind == "stuck":
                supply.stuck_on = True
            else:
                deafen(supply)
            for _ in range(signals):
                control.ask("a test")

    story = tell(meanwhile=meanwhile, replace=("ramp_V_per_s = 300.0", "ramp_V_per_s = 100.0"))
    assert done and story.final_output > SAFE_VOLTAGE  # it went on rising
    assert not story.outcome.safe and "NOT SAFE" in story.outcome.state


def test_an_off_that_failed_is_given_again_though_the_supply_can_be_read(tell: Tell) -> None:
    def mischief(bench: SimulatedBench, control: Control) -> None:
        deafen(bench.instruments["hv"], 0.05)
        control.ask("a test")
        control.ask("a test")

    story = tell(mischief)
    assert story.final_output < SAFE_VOLTAGE and story.outcome.safe
    assert story.took < 1.5


@pytest.mark.parametrize("scene", ["cone-4mm", "other-instruments"])
def test_an_orderly_end_is_prompt(tell: Tell, scene: str) -> None:
    story = tell(lambda bench, control: control.ask("a test"), scene=scene)
    assert story.outcome.safe and story.final_output < SAFE_VOLTAGE
    assert "emergency_off" not in story.control_words
    assert story.took < 1000 / 500 + 1.0


def test_the_stage_stands_before_a_guard_that_hangs_is_waited_for(tell: Tell, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[float] = []
    benches: list[Bench] = []
    make = Bench.__init__

    def remember(bench: Bench, *arguments: Any) -> None:
        make(bench, *arguments)
        benches.append(bench)

    def hang(guard: Guard, cause: str, ramp_off: Callable[[Guard, str], None] = Guard.ramp_off) -> None:
        clock = benches[0].clock
        clock.sleep_until(clock.now() + 1.0)
        ramp_off(guard, cause)

    monkeypatch.setattr(Bench, "__init__", remember)

    def mischief(bench: SimulatedBench, control: Control) -> None:
        now = benches[0].clock.now()
        begun.append(float(bench.world.stage.at(now)[0]))
        monkeypatch.setattr(Guard, "ramp_off", hang)
        control.ask("a test")

    story = tell(mischief)
    assert story.outcome.safe
    rest = float(story.bench.world.stage.at(story.end)[0])
    assert abs(rest - begun[0]) < 0.5e-3  # at 2 mm/s


@pytest.mark.parametrize("percent", [0.5, pytest.param(20.0, marks=pytest.mark.slow)])
def test_an_output_found_live_is_taken_down_at_the_ramp_of_the_scene(tell: Tell, percent: float) -> None:
    live = f"[simulation.hv]\nstart_live_V = 500.0\nramp_percent_per_s = {percent}"
    story = tell(replace=("[simulation.hv]", live), take_down="--take-down")
    path = story.outputs
    high = max(t for t, volts in path if volts > 495)
    low = next(t for t, volts in path if t > high and volts < 5)
    assert low - high == pytest.approx(500 / 500, abs=0.4)  # told five times a second; else 17 s and 0.4 s


# The guard's process without an engine that sees to it -----------------------------------------------------------


class Alone:
    """The guard's own loop on the simulated bench in memory, and an engine that says only what the test says."""

    def __init__(self) -> None:
        scene, _ = load_scene(SCENES / "cone-4mm.toml")
        assert scene.hv is not None
        self.bench = open_bench(scene)
        assert self.bench.simulated is not None
        self.truth, self.clock = self.bench.simulated, self.bench.clock
        ours, theirs = socket.socketpair()
        self.engine, self._theirs = Channel(ours), Channel(theirs)
        link = self.bench._opened.links["hv"]
        self.peer = Peer(os.getpid())
        self.server = Server(scene, scene.hv, link, self._theirs, self.clock, self.peer)  # type: ignore[arg-type]
        self._beats = self._calls = 0
        self.engine.send({"do": "appoint", "gain": 1.0, "fresh": {}})
        self.go(3.0)
        self.call("arm")
        self.call("request", 1000.0, 0.001)
        self.go(5.0)
        assert self.output > 990 and self.guard.state is GuardState.LIVE

    @property
    def guard(self) -> Guard:
        assert self.server._guard is not None
        return self.server._guard

    @property
    def output(self) -> float:
        return float(self.truth.world.output.at(self.clock.now())[0])

    def call(self, name: str, *arguments: object) -> None:
        self._calls += 1
        self.engine.send({"do": "call", "n": self._calls, "name": name, "args": list(arguments)})
        self.go(0.2)

    def go(self, seconds: float, *, engine_lives: bool = True) -> None:
        end = self.clock.now() + seconds
        while self.clock.now() < end:
            now = self.clock.now()
            if engine_lives and self.server._guard is not None:
                self._beats += 1
                beat = Heartbeat(self._beats, now, 0.001, {})
                self.engine.send({"do": "heartbeat", "data": beat.encode().hex()})
            try:
                self.server._turn()
            except Exception as error:
                self.server._fault(error)
            self.engine.receive()
            self.clock.sleep_until(now + 0.005)

    def leave(self) -> float:
        """Take leave, and give back how long the guard stays (s)."""
        began = self.clock.now()
        self.engine.send({"do": "close"})
        self.go(0.01, engine_lives=False)
        self.engine.close()
        self.server.run()
        return self.clock.now() - began


@pytest.fixture
def alone() -> Iterator[Alone]:
    rig = Alone()
    yield rig
    rig.engine.close()
    rig._theirs.close()
    rig.peer.close()
    rig.bench.close()


def test_a_switch_off_that_was_lost_is_made_up_for_without_the_engine(alone: Alone) -> None:
    now = alone.clock.now()
    alone.truth.inject(Fault(role="hv", kind="drop", direction="to_device", at_s=now, duration_s=1.5))
    alone.call("ramp_off", "a test")
    alone.go(4.0, engine_lives=False)
    assert alone.output < SAFE_VOLTAGE and alone.guard.output_is_safe


@pytest.mark.parametrize("word", ["ramp_off", "take_down"])
def test_a_ramp_down_that_the_output_does_not_follow_is_cut_short_without_the_engine(alone: Alone, word: str) -> None:
    supply: Any = alone.truth.instruments["hv"]
    supply.stuck_on = True
    if word == "take_down":
        alone.guard.state = GuardState.SAFE
    alone.call(word, "a test")
    supply.stuck_on = False  # it has missed the ramp; from here on it obeys
    alone.go(0.3, engine_lives=False)
    assert alone.output > 990
    alone.go(1.2, engine_lives=False)  # a ramp from 1000 V at 300 V/s would take 3.3 s
    assert alone.output < SAFE_VOLTAGE and alone.guard.output_is_safe


@pytest.mark.parametrize("word", ["", "ramp_off"])
def test_a_guard_does_not_leave_an_output_that_is_not_measured_off(alone: Alone, word: str) -> None:
    if word:
        alone.call(word, "a test")
    assert alone.leave() < 1.0
    assert alone.output < SAFE_VOLTAGE


def test_a_guard_leaves_a_supply_that_does_not_obey_in_the_end(alone: Alone, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "TRY_S", 20.0)
    supply: Any = alone.truth.instruments["hv"]
    supply.stuck_on = True
    assert 20.0 <= alone.leave() < 21.0
    assert alone.output > 990


def test_a_guard_goes_on_for_minutes_and_takes_a_supply_off_that_obeys_late(
    alone: Alone, monkeypatch: pytest.MonkeyPatch
) -> None:
    supply: Any = alone.truth.instruments["hv"]
    supply.stuck_on = True
    began = alone.clock.now()
    sleep = alone.clock.sleep_until

    def sleep_until(t: float) -> None:
        sleep(t)
        if alone.clock.now() > began + 100.0:
            supply.stuck_on = False

    monkeypatch.setattr(alone.clock, "sleep_until", sleep_until)
    assert 99.0 < alone.leave() < 103.0
    assert alone.output < SAFE_VOLTAGE


def test_a_guard_that_has_measured_off_leaves_at_once(alone: Alone) -> None:
    alone.call("ramp_off", "a test")
    alone.go(5.0)
    assert alone.leave() < 0.1


@pytest.mark.skipif(os.name != "posix", reason="terminals are POSIX")
@pytest.mark.timeout(20)
def test_a_terminal_that_was_stopped_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    import termios

    screen, terminal = os.openpty()
    monkeypatch.setattr(last_words, "STDERR", terminal)
    try:
        termios.tcflow(terminal, termios.TCOOFF)  # Ctrl-S
        voice = LastWords()
        voice.say("NOT SAFE")
        assert not voice.speak()
        termios.tcflow(terminal, termios.TCOON)
        assert voice.speak()
        shown = b""
        while len(shown) < len(b"NOT SAFE"):  # one read of a terminal may bring the first bytes alone
            shown += os.read(screen, 100)
        assert shown.startswith(b"NOT SAFE")
    finally:
        os.close(terminal)
        os.close(screen)
