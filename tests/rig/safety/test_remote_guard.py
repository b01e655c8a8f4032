"""The engine's side of the guard's process: what is asked and answered, and what happens when that process is lost.

The process is a story at the other end of the socket pair, the supply a simulated output; one clock goes on where the
engine waits. Asserted is what the output was told by the engine itself, and where it stood.
"""

from __future__ import annotations

import math
import socket
from collections.abc import Callable, Iterator
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from drivers.links.link import DeviceError, DeviceLost, DeviceSilent
from drivers.roles import HVFlag, HVSample, MonitorSample, SampleFlag
from rig.base.errors import FaultError, LimitError
from rig.safety import process, remote
from rig.safety.channel import Channel, Message
from rig.safety.guard import AT_ONCE_S, GuardState
from rig.safety.remote import ANSWER_S, GO_ON_S, LEAVE_S, OPEN_AGAIN_S, SILENCE_S, START_S, UNARMED_S, RemoteGuard
from rig.safety.stopped import LOOK_S
from rig.scene.scene import load_scene
from tests.rig.safety.output import Clock, Lends, Output

SCENE, _ = load_scene(Path(str(files("sim_fixtures"))) / "scenes" / "cone-4mm.toml")
TURN_S = 0.005

STATE = {
    "is": "state",
    "state": "live",
    "cause": "",
    "commanded": True,
    "setpoint": 800.0,
    "output_is_safe": False,
    "ramp_duration": 2.5,
    "second_words": "",
    "given_back": False,
    "found": {"knob": 1.0},
    "ready": True,
    "identity": ["a model", "8", "2.0"],
    "settings": {"a": "b"},
    "counters": {"c": 4},
}


class Process:
    """That of the guard, as far as the engine handles it; ends by itself when told to close, unless it hangs."""

    pid = 4711

    def __init__(self, end: socket.socket) -> None:
        self.channel = Channel(end.dup())
        self.killed = False
        self.hangs = False
        self.waited: list[float] = []

    def kill(self) -> None:
        self.killed = True

    def wait(self, seconds: float) -> bool:
        self.waited.append(seconds)
        return self.killed or not self.hangs


class Bench:
    """A remote guard, the process that it talks to, and the output that both could command."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, kind: type[Output] = Output, *, shared: bool = True) -> None:
        self.clock = Clock()
        self.output = kind(self.clock)
        self.answers: Callable[[Message], Message | None] = lambda message: {**message, "is": "answer", "error": None}
        self.asked: list[Message] = []
        self.turns: Callable[[], None] = lambda: None
        self.peer = SimpleNamespace(stopped=False, close=lambda: None)
        self.opens: list[float] = []
        self.no_port_until = -math.inf
        self.link_closed = 0
        self.told: list[tuple[str, ...]] = []

        def open_link(table: Any, role: str, handles: Any = ()) -> Any:
            self.opens.append(self.clock.now())
            if self.clock.now() < self.no_port_until:
                raise DeviceLost("hv", "there is no port")
            return SimpleNamespace(settings={"of": "ours"}, reopen=self.output.reopen, close=self._close_link)

        hv: Any = type(SCENE.hv)
        monkeypatch.setattr(hv, "open", open_link)
        monkeypatch.setattr(hv, "two_may_hold", shared)
        monkeypatch.setattr(remote, "make_supply", lambda table, link, tap, when: self.output)
        monkeypatch.setattr(remote, "Peer", lambda pid: self.peer)
        monkeypatch.setattr(remote, "select", SimpleNamespace(select=self._wait))
        monkeypatch.setattr(remote.start, "start_guard", self._start)
        self.guard = RemoteGuard(SCENE, self.clock)  # type: ignore[arg-type]
        self.guard.attach(lambda role, way, data, t: self.told.append((role, way, data.hex())))

    def _start(self, end: socket.socket) -> Process:
        self.process = Process(end)
        return self.process

    def _close_link(self) -> None:
        self.link_closed += 1

    def _wait(self, ends: Any, _w: Any, _x: Any, seconds: float) -> Any:
        assert 0.0 < seconds <= max(LOOK_S, 0.1)  # bounded, always
        self.clock.sleep_until(self.clock.now() + min(seconds, TURN_S))
        self.serve()

    def serve(self) -> None:
        """One turn of the guard's process."""
        if self.process.killed or self.process.channel.closed:
            return
        self.turns()
        for message in self.process.channel.receive():
            self.asked.append(message)
            if message["do"] == "call" and (answer := self.answers(message)) is not None:
                self.say(answer)

    def say(self, message: Message) -> None:
        self.process.channel.send(message)

    def appointed(self) -> RemoteGuard:
        """Open, and at work."""
        self.say({"is": "opened", "settings": {"of": "its own", "port": "x"}})
        self.guard.opened()
        tell = lambda command, argument, t: self.told.append((command, argument))  # noqa: E731
        self.guard.appoint(1.0, 1.0, {"force": 0.5}, tell, lambda severity, text: self.told.append((severity, text)))
        self.serve()
        return self.guard

    def live(self) -> RemoteGuard:
        """With voltage on, by what the guard's process says."""
        guard = self.appointed()
        self.output._on, self.output._target, self.output.voltage, self.output._ramp = True, 800.0, 800.0, 300.0
        self.say(STATE)
        guard.poll(self.clock.now())
        assert guard.commanded
        return guard

    def poll(self, seconds: float, *, alive: bool = False) -> list[str]:
        """The engine's loop for so long; the errors that it met. Samples go back to the guard, as the engine does."""
        errors = []
        end = self.clock.now() + seconds
        while self.clock.now() < end - 1e-9:
            self.clock.sleep_until(min(self.clock.now() + TURN_S, end))
            if alive:
                self.say({"is": "alive"})
            try:
                for sample in self.guard.poll(self.clock.now()):
                    assert isinstance(sample, HVSample)
                    self.guard.on_sample(sample)
            except Exception as error:
                errors.append(str(error))
        return errors

    def die(self) -> float:
        self.process.channel.close()
        return self.clock.now()


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    bench = Bench(monkeypatch)
    yield bench
    finish(bench)


def finish(bench: Bench) -> None:
    bench.guard.close()
    bench.process.channel.close()


def test_it_waits_until_the_process_has_the_link_and_has_sent_nothing(bench: Bench) -> None:
    bench.turns = lambda: bench.clock.now() > 3.0 and bench.say({"is": "opened", "settings": {"port": "x"}})  # type: ignore[func-returns-value]
    bench.guard.opened()
    assert 3.0 < bench.clock.now() < 3.1
    assert bench.guard.link_settings == {"port": "x", "of": "ours"}
    assert bench.output.told == [] and bench.output.polls == []
    assert bench.guard.pid == Process.pid and bench.guard.fileno() >= 0


def test_a_process_that_says_nothing_has_half_a_minute(bench: Bench) -> None:
    with pytest.raises(FaultError, match="it says nothing"):
        bench.guard.opened()
    assert START_S < bench.clock.now() < START_S + 0.2


def test_a_process_that_has_died_is_not_waited_for(bench: Bench) -> None:
    bench.die()
    with pytest.raises(FaultError, match=r"did not start .its process has died"):
        bench.guard.opened()
    assert bench.clock.now() < 0.2 and bench.output.told == []


def test_why_the_link_cannot_be_opened_is_told(bench: Bench) -> None:
    bench.say({"is": "error", "error": process.pack_error(DeviceSilent("hv", "no answer", "Look."))})
    with pytest.raises(DeviceSilent, match="no answer"):
        bench.guard.opened()


def test_what_is_asked_goes_over_and_its_refusal_comes_back_as_what_it_is(bench: Bench) -> None:
    guard = bench.appointed()
    guard.arm()
    guard.check_supply(900.0)
    guard.check_off()
    guard.request(800.0, 4e-3)
    guard.check_move(1e-3, 2e-3)
    guard.clear_faults("by hand")
    guard.give_back()
    guard.take_down("found live")
    guard.ramp_off("an order")
    guard.kill("an emergency")
    calls = [(m["name"], *m["args"]) for m in bench.asked if m["do"] == "call"]
    assert calls == [
        ("arm",),
        ("check_supply", 900.0),
        ("check_off",),
        ("request", 800.0, 4e-3),
        ("check_move", 1e-3, 2e-3),
        ("clear_faults", "by hand"),
        ("give_back",),
        ("take_down", "found live"),
        ("ramp_off", "an order"),
        ("kill", "an emergency"),
    ]
    assert [m["n"] for m in bench.asked if m["do"] == "call"] == [*range(1, 11)]
    refusal = process.pack_error(LimitError("too high", device="hv"))
    bench.answers = lambda message: {"is": "answer", "n": message["n"], "error": refusal}
    with pytest.raises(LimitError, match="too high"):
        guard.request(1e6, 0.0)
    assert not bench.process.killed and bench.output.told == []


def test_arming_counts_as_commanded_though_the_answer_never_comes(bench: Bench) -> None:
    guard = bench.appointed()
    assert not guard.commanded
    bench.answers = lambda message: None
    with pytest.raises(FaultError, match="the guard is lost"):
        guard.arm()
    assert guard.commanded and bench.output.words == ["emergency_off"]


def test_the_engine_s_word_goes_over_as_it_is(bench: Bench) -> None:
    guard = bench.appointed()
    guard.heartbeat(b"\x01\xfe", 1.0)
    guard.on_monitor(MonitorSample(2.0, "monitor", "voltage", 790.0, SampleFlag(0)))
    guard.on_monitor(MonitorSample(2.0, "monitor", "temperature", 300.0, SampleFlag(0)))
    bench.serve()
    assert bench.asked[0]["do"] == "begin" and "scene" in bench.asked[0]["config"]
    assert bench.asked[1:] == [
        {"do": "appoint", "gain": 1.0, "second_gain": 1.0, "fresh": {"force": 0.5}},
        {"do": "heartbeat", "data": "01fe"},
        {"do": "reading", "values": [2.0, 790.0, 0]},
    ]


def test_what_the_guard_says_is_what_the_engine_sees(bench: Bench) -> None:
    guard = bench.appointed()
    bench.say(STATE)
    bench.say({"is": "sample", "values": [1.5, 801.0, 2e-6, 800.0, HVFlag.ON.value]})
    bench.say({"is": "wire", "way": "tx", "data": "0a0b", "t": 1.5})
    bench.say({"is": "command", "command": "set_voltage", "argument": "800.0 V", "t": 1.5})
    bench.say({"is": "event", "severity": "warning", "message": "look"})
    (sample,) = guard.poll(bench.clock.now())
    assert sample == HVSample(1.5, 801.0, 2e-6, 800.0, HVFlag.ON)
    assert bench.told == [("hv", "tx", "0a0b"), ("set_voltage", "800.0 V"), ("warning", "look")]
    assert (guard.state, guard.cause, guard.commanded) == (GuardState.LIVE, "", True)
    assert (guard.setpoint, guard.output_is_safe, guard.ramp_duration) == (800.0, False, 2.5)
    assert (guard.given_back, guard.ready, guard.settings, guard.counters) == (False, True, {"a": "b"}, {"c": 4})
    assert (guard.identity.model, guard.identity.serial, guard.identity.firmware) == ("a model", "8", "2.0")
    assert guard.ramp_limit == pytest.approx(1.5 * 2.5 + 10.0)  # no second reading
    assert guard.poll(bench.clock.now()) == []


def test_errors_are_raised_one_a_turn_and_the_same_one_once(bench: Bench) -> None:
    bench.appointed()
    for error in (DeviceLost("hv", "gone"), DeviceLost("hv", "gone"), FaultError("hv: off"), DeviceLost("hv", "gone")):
        bench.say({"is": "error", "error": process.pack_error(error)})
    assert len(bench.poll(0.1, alive=True)) == 3
    assert not bench.process.killed


@pytest.mark.parametrize("commanded", [True, False])
def test_a_process_that_says_nothing_is_lost_after_its_time(bench: Bench, commanded: bool) -> None:
    guard = bench.live() if commanded else bench.appointed()
    began = bench.clock.now()
    limit = SILENCE_S if commanded else UNARMED_S
    assert bench.poll(limit) == []
    errors = bench.poll(2 * TURN_S)
    assert "it has said nothing for" in errors[0]
    assert bench.process.killed and guard.state is GuardState.SAFE and not guard.output_is_safe
    assert bench.output.words == (["emergency_off"] if commanded else [])
    if commanded:
        assert "from here the output was commanded off" in errors[0]
        assert limit <= bench.output.when("emergency_off")[0] - began <= limit + 2 * TURN_S
    else:
        assert "the output was never commanded" in errors[0]


def test_a_process_that_says_that_it_turns_is_not_lost(bench: Bench) -> None:
    bench.live()
    assert bench.poll(3 * UNARMED_S, alive=True) == []
    assert not bench.process.killed and bench.output.told == []


def test_an_engine_that_was_held_up_does_not_blame_the_guard(bench: Bench) -> None:
    guard = bench.live()
    assert bench.poll(0.1, alive=True) == []
    bench.clock.sleep_until(bench.clock.now() + 1.0)
    assert guard.poll(bench.clock.now()) == []
    assert bench.poll(SILENCE_S - 0.06) == [] and not bench.process.killed
    assert bench.poll(0.1) and bench.process.killed  # the hold-up is no excuse for what comes after


def test_a_process_that_was_stopped_is_lost_at_once(bench: Bench) -> None:
    bench.live()
    bench.peer.stopped = True
    assert bench.poll(LOOK_S) == []
    errors = bench.poll(2 * TURN_S)
    assert "was stopped" in errors[0] and bench.output.words == ["emergency_off"]


@pytest.mark.parametrize(
    ("name", "seconds"), [("request", ANSWER_S), ("arm", UNARMED_S), ("check_move", ANSWER_S), ("kill", ANSWER_S)]
)
def test_a_call_that_is_not_answered_in_time_loses_the_guard(bench: Bench, name: str, seconds: float) -> None:
    guard = bench.live()
    bench.answers = lambda message: None
    bench.turns = lambda: bench.say({"is": "alive"})
    began = bench.clock.now()
    arguments = {"request": (900.0, 0.0), "check_move": (0.0, 1e-3), "kill": ("a test",)}.get(name, ())
    with pytest.raises(FaultError, match=f"it did not answer within {seconds:g} s"):
        getattr(guard, name)(*arguments)
    assert seconds <= bench.clock.now() - began <= seconds + 2 * TURN_S
    assert bench.output.words == ["emergency_off"] and bench.process.killed


@pytest.mark.parametrize("how", ["death", "damage"])
def test_the_loss_of_the_guard_takes_the_output_off_and_measures_it(bench: Bench, how: str) -> None:
    guard = bench.live()
    lost = bench.clock.now()
    if how == "death":
        bench.die()
    else:
        bench.process.channel._socket.send(bytes(80))
    errors = bench.poll(2.0)
    assert len(errors) == 1 and "the guard is lost" in errors[0]
    assert ("has died" if how == "death" else "corrupt") in errors[0]
    assert 0.0 <= bench.output.when("emergency_off")[0] - lost <= TURN_S + 1e-9
    assert bench.output.words == ["emergency_off"]  # measured off within a second: once is enough
    assert bench.output.voltage < 60.0 and guard.output_is_safe and guard.state is GuardState.SAFE
    assert ("emergency_off", f"the guard is lost: {guard.cause.partition(': ')[2]}") in bench.told
    with pytest.raises(FaultError, match="latched safe"):
        guard.request(100.0, 0.0)
    guard.check_off()
    assert bench.output.words == ["emergency_off"]


def test_off_is_sent_again_every_second_until_it_is_measured(bench: Bench) -> None:
    guard = bench.live()
    bench.output.deaf_from, bench.output.deaf_until = 0.0, bench.clock.now() + 3.5
    bench.die()
    bench.poll(6.0)
    sent = bench.output.when("emergency_off")
    assert [b - a for a, b in pairwise(sent)] == pytest.approx([process.INSIST_S] * 4, abs=2 * TURN_S)
    assert guard.output_is_safe and bench.output.voltage < 60.0


def test_a_link_that_is_gone_when_the_guard_is_lost_is_opened_again_and_the_off_is_sent_then(bench: Bench) -> None:
    guard = bench.live()
    lost = bench.clock.now()
    bench.output.gone_from, bench.output.back_at = lost, lost + 0.43
    bench.die()
    errors = bench.poll(3.0)
    assert any("the link is gone" in text for text in errors)
    (back,) = bench.output.reopened
    assert 0.43 <= back - lost <= 0.43 + 2 * TURN_S
    assert 0.0 <= bench.output.when("emergency_off")[0] - back <= 2 * TURN_S
    assert guard.output_is_safe and bench.output.voltage < 60.0
    assert ("warning", "the supply's link was gone for 0.43 s and is open again") in bench.told


def test_a_link_that_only_one_may_hold_is_opened_when_the_guard_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, shared=False)
    assert bench.opens == []
    guard = bench.live()
    lost = bench.die()
    bench.no_port_until = lost + 0.35
    errors = bench.poll(2.0)
    assert any("there is no port" in text for text in errors) and "the link is gone" in errors[0]
    assert [b - a for a, b in pairwise(bench.opens)] == pytest.approx([OPEN_AGAIN_S] * 4, abs=2 * TURN_S)
    assert bench.output.when("emergency_off")[0] == bench.opens[-1]
    assert guard.output_is_safe and bench.output.voltage < 60.0
    finish(bench)
    assert bench.link_closed == 1


def test_a_supply_that_cannot_be_read_is_sent_off_all_the_same(bench: Bench) -> None:
    bench.live()
    bench.output.silent = True
    bench.die()
    errors = bench.poll(2.5)
    assert any("does not answer" in text for text in errors)
    assert len(bench.output.when("emergency_off")) == 3


def test_an_output_that_was_never_commanded_is_left_alone_and_measured(bench: Bench) -> None:
    guard = bench.appointed()
    bench.die()
    errors = bench.poll(0.5)
    assert "the output was never commanded" in errors[0] and len(errors) == 1
    assert bench.output.told == [] and guard.output_is_safe and bench.output.polls
    assert guard.ready and guard.counters == {"errors": 3} and guard.next_poll == math.inf


def test_what_the_guard_had_found_is_known_to_who_takes_over(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, Lends)
    guard = bench.live()
    bench.die()
    bench.poll(1.0)
    assert bench.output.resumed == {"knob": 1.0}  # type: ignore[attr-defined]
    guard.give_back()
    assert bench.output.words == ["emergency_off", "give_back"]
    finish(bench)


def test_nothing_is_taken_over_of_a_process_that_never_had_the_link(bench: Bench) -> None:
    bench.die()
    assert "the output was never commanded" in bench.poll(0.1)[0]
    bench.poll(0.5)
    assert bench.output.told == [] and bench.output.polls == [] and len(bench.opens) == 1


@pytest.mark.parametrize(
    ("commanded", "off", "hangs", "waited", "killed"),
    [
        (False, False, False, [LEAVE_S, LEAVE_S], False),
        (False, False, True, [LEAVE_S, LEAVE_S, GO_ON_S], True),
        (True, True, True, [LEAVE_S, LEAVE_S, GO_ON_S], True),
        (True, False, True, [GO_ON_S], False),  # it goes on trying
        (True, False, False, [GO_ON_S], False),
    ],
)
def test_the_process_is_told_to_end_and_seen_to_unless_it_has_an_output_to_take_off(
    bench: Bench, commanded: bool, off: bool, hangs: bool, waited: list[float], killed: bool
) -> None:
    guard = bench.appointed()
    bench.say({**STATE, "commanded": commanded, "output_is_safe": off, "state": "safe"})
    guard.poll(bench.clock.now())
    bench.process.hangs = hangs
    guard.close()
    guard.close()
    assert bench.process.channel.receive()[-1:] == [{"do": "close"}]
    assert bench.process.channel.closed
    assert bench.process.waited[: len(waited)] == waited and bench.process.killed is killed
    assert bench.link_closed == 1


def test_a_process_that_was_lost_is_not_waited_for_longer_than_half_a_second(bench: Bench) -> None:
    guard = bench.live()
    bench.die()
    bench.poll(0.1)
    guard.close()
    assert bench.process.waited == [GO_ON_S] and bench.process.killed


@pytest.mark.skipif(not hasattr(socket, "send_fds"), reason="POSIX")
def test_log_and_monitor_are_handed_over_with_their_descriptors(bench: Bench) -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        bench.serve()
        bench.guard.log_to(Path("run.mcap"), theirs)
        bench.guard.lend_monitor(())  # none to lend: nothing is said
        bench.guard.lend_monitor((theirs.fileno(),))
        bench.serve()
        assert bench.asked[1:] == [{"do": "log", "path": "run.mcap"}, {"do": "monitor"}]
        assert len(bench.process.channel.handles) == 2
        for handle in bench.process.channel.handles:
            with socket.socket(fileno=handle) as end:
                end.send(b"x")
        assert ours.recv(4) == b"xx"


def test_a_start_that_fails_leaves_no_link_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Bench, "_start", lambda self, end: (_ for _ in ()).throw(OSError("no process")))
    seen: list[Bench] = []
    monkeypatch.setattr(Bench, "_close_link", lambda self: seen.append(self))
    with pytest.raises(OSError, match="no process"):
        Bench(monkeypatch)
    assert len(seen) == 1


def test_unknown_kinds_of_device_errors_stay_errors_of_a_device() -> None:
    packed = process.pack_error(DeviceError("hv", "what", "do this"))
    assert type(remote.unpack_error(packed)) is DeviceError
    assert AT_ONCE_S > ANSWER_S  # an answer is never waited for as long as an off
