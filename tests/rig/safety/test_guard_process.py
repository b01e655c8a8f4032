"""What the guard's process does, in this process: its loop, an engine that speaks through a socket pair, an output.

One clock, which goes on where the loop waits. Asserted is what was told to the output and what stood there.
"""

from __future__ import annotations

import math
import select
import socket
from collections.abc import Callable, Iterator
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from drivers.links.link import DeviceError
from drivers.roles import MonitorSample
from rig.base.clock import RealClock
from rig.base.toml_file import parse_table
from rig.log.errors import LogError
from rig.safety import process
from rig.safety.channel import Channel, Message
from rig.safety.guard import AT_ONCE_S
from rig.safety.heartbeat import DEADLINE_S, INTERVAL_S, Heartbeat
from rig.safety.process import HUNG_S, INSIST_S, LONGEST_TURN_S, Server
from rig.scene.scene import Scene
from tests.rig.safety.output import PERIOD_S, Clock, Lends, Output

SCENES = Path(str(files("sim_fixtures"))) / "scenes"
RAMP = 1800.0  # V/s, so that nothing takes long
TEXT = (SCENES / "cone-4mm.toml").read_text().replace("ramp_V_per_s = 300.0", f"ramp_V_per_s = {RAMP}")
SCENE = parse_table(TEXT, Scene, "scene", "test")
METER = '[monitor]\ndriver = "scpi"\nquantity = "voltage"\nrate_Hz = 20.0\n\n[simulation]\n'
WATCHED = parse_table(TEXT.replace("[simulation]\n", METER), Scene, "scene", "test")
TURN_S = LONGEST_TURN_S

Story = Iterator[None]


class Log:
    """What the guard writes into its own end of the log."""

    def __init__(self) -> None:
        self.rows: list[tuple[str, dict[str, Any]]] = []
        self.closed = self.broken = False

    def write(self, topic: str, fields: dict[str, Any], log_ns: int, publish_ns: int) -> None:
        if self.broken:
            raise LogError(Path("run.mcap"), "it is gone", "")
        assert publish_ns <= log_ns
        self.rows.append((topic, fields))

    def tick(self, now: float) -> None:
        if self.broken:
            raise LogError(Path("run.mcap"), "it is gone", "")

    def close(self) -> None:
        self.closed = True

    def of(self, topic: str) -> list[dict[str, Any]]:
        return [fields for name, fields in self.rows if name == topic]


class Both:
    """The guard's loop and its engine. ``heard``: what the guard said, with the times; ``said``: at the terminal."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, kind: type[Output] = Output, scene: Scene = SCENE) -> None:
        self.clock = Clock()
        self.output = kind(self.clock)
        self.scene = scene
        self.log = Log()
        self.heard: list[tuple[float, Message]] = []
        self.said: list[str] = []
        self.beats = True
        self.marks: list[float] = []  # times that a story has noted
        self.number = self.beat = 0
        self._next_beat = math.inf
        ours, theirs = socket.socketpair()
        self.engine = Channel(ours)
        link: Any = SimpleNamespace(settings={"port": "x"}, reopen=self.output.reopen)
        peer: Any = SimpleNamespace(stopped=False, close=lambda: None)
        assert scene.hv is not None
        self.server: Any = Server(scene, scene.hv, link, Channel(theirs), self.clock, peer)  # type: ignore[arg-type]
        self.server._words = SimpleNamespace(say=self.said.append, speak=lambda: True)
        self.taps: Any = None

        def make_supply(table: Any, link: Any, tap: Any, when: Any) -> Any:
            self.taps = tap
            return self.output

        monkeypatch.setattr(process, "make_supply", make_supply)
        monkeypatch.setattr(process, "select", SimpleNamespace(select=self._wait))
        monkeypatch.setattr(process, "TRY_S", 6.0)

    def run(self, story: Callable[[Both], Story]) -> None:
        """Until the guard has ended; the engine's process ends with its ``story``, which yields once a turn."""
        self._story = story(self)
        try:
            self.server.run()
            self.listen()
            self.server.close()
        finally:
            self.server._channel.close()
            self.engine.close()

    def _wait(self, ends: Any, _w: Any, _x: Any, seconds: float) -> tuple[list[Any], list[Any], list[Any]]:
        self.clock.sleep_until(self.clock.now() + seconds)
        self.listen()
        now = self.clock.now()
        if self.beats and now >= self._next_beat:
            self._next_beat = now + INTERVAL_S
            self.heartbeat()
        if next(self._story, "over") == "over":
            self.engine.close()
        return [], [], []

    def listen(self) -> None:
        if not self.engine.closed:
            self.heard += [(self.clock.now(), message) for message in self.engine.receive()]

    # What an engine does ------------------------------------------------------------------------------------

    def appoint(self, gain: float = 1.0) -> None:
        fresh = {"force": 0.5}
        self._next_beat = self.clock.now()
        self.engine.send({"do": "appoint", "gain": gain, "second_gain": 1.01, "fresh": fresh})

    def heartbeat(self) -> None:
        self.beat += 1
        now = self.clock.now()
        data = Heartbeat(self.beat, now, math.nan, {"force": now}).encode()
        self.engine.send({"do": "heartbeat", "data": data.hex()})

    def ask(self, name: str, *arguments: Any, refused: str = "") -> Iterator[None]:
        """Ask and wait for the answer: no error, or one with this word in it."""
        self.number += 1
        self.engine.send({"do": "call", "n": self.number, "name": name, "args": list(arguments)})
        end = self.clock.now() + 2.0
        while not (answers := self.of("answer", self.number)):
            assert self.clock.now() < end, self.errors
            yield
        error = answers[0]["error"]
        assert (refused in str(error)) if refused else error is None, error

    def mark(self) -> None:
        self.marks.append(self.clock.now())

    def pause(self, seconds: float) -> Iterator[None]:
        end = self.clock.now() + seconds
        while self.clock.now() < end - 1e-9:
            yield

    def live(self, volts: float = 900.0) -> Iterator[None]:
        """Appointed, armed, and the output up."""
        self.appoint()
        yield from self.pause(0.1)
        yield from self.ask("arm")
        yield from self.ask("request", volts, 0.0)
        yield from self.pause(volts / RAMP + 0.3)
        assert self.output.voltage == volts

    def of(self, kind: str, number: int | None = None) -> list[Message]:
        return [m for _, m in self.heard if m["is"] == kind and (number is None or m["n"] == number)]

    @property
    def errors(self) -> list[str]:
        return [str(m["error"].get("text", m["error"])) for m in self.of("error")]


@pytest.fixture
def both(monkeypatch: pytest.MonkeyPatch) -> Both:
    return Both(monkeypatch)


def off_from(both: Both, at: float) -> None:
    """Nothing drives the output from ``at`` on, and it ends at nothing."""
    assert all(word in ("emergency_off", "switch_off", "give_back") for t, word, _ in both.output.told if t > at)
    assert both.output.voltage < 60.0


def test_a_run_in_order_ends_at_zero_and_the_guard_ends_with_it(both: Both) -> None:
    def story(both: Both) -> Story:
        yield from both.live()
        yield from both.ask("ramp_off", "done")
        yield from both.pause(900 / RAMP + 0.3)
        assert both.of("state")[-1]["output_is_safe"]
        both.engine.send({"do": "close"})
        yield from both.pause(1.0)

    both.run(story)
    assert both.output.words == ["set_ramp", "set_voltage", "switch_on", "switch_off"]
    assert both.output.voltage == 0.0
    assert both.said == [] and both.errors == []
    # Without an own end of the log every command is told to the engine, which writes it down.
    assert [m["command"] for m in both.of("command")] == ["arm", "set_voltage", "switch_on", "switch_off"]
    assert both.of("opened") == [{"is": "opened", "settings": {"port": "x"}}]


def test_an_output_that_was_never_commanded_is_left_alone_when_the_engine_dies(both: Both) -> None:
    def story(both: Both) -> Story:
        both.appoint()
        yield from both.pause(0.2)

    both.run(story)
    assert both.output.told == [] and both.said == []


def test_the_death_of_the_engine_takes_the_output_off_in_one_turn_and_is_told(
    both: Both,
) -> None:
    def story(both: Both) -> Story:
        yield from both.live()
        both.mark()

    both.run(story)
    (died,) = both.marks
    assert 0.0 <= both.output.when("emergency_off")[0] - died <= 2 * TURN_S
    off_from(both, died)
    (said,) = both.said
    assert said.startswith("dea-rig guard: the engine has ended without a shutdown message. The high voltage is off")
    volts = 900.0 * math.exp(-(both.clock.now() - died) / 0.1)
    assert f"measured {volts:.0f} V" in said or volts < 60.0


def test_what_the_guard_does_alone_is_in_its_own_end_of_the_log(both: Both) -> None:
    def story(both: Both) -> Story:
        both.server._log = both.log
        yield from both.live()
        both.mark()

    both.run(story)
    (died,) = both.marks
    assert [row["command"] for row in both.log.of("/command")] == ["arm", "set_voltage", "switch_on", "emergency_off"]
    assert {row["device"] for row in both.log.of("/command")} == {"hv"}
    alone = both.log.of("/hv/sample")
    assert alone and all(row["t_s"] >= died for row in alone)  # before, the engine writes them
    assert [row["voltage_V"] < 60.0 for row in alone[-3:]] == [False, True, True]
    (event,) = both.log.of("/event")
    assert event["severity"] == "error" and "is off, measured" in event["message"]
    assert both.log.closed


def test_a_log_that_is_gone_holds_up_nothing(both: Both) -> None:
    def story(both: Both) -> Story:
        both.server._log = both.log
        yield from both.live()
        both.log.broken = True

    both.run(story)
    off_from(both, both.output.when("emergency_off")[0])
    assert "is off, measured" in both.said[0]


@pytest.mark.parametrize("gain", [1.0, 0.5])
def test_samples_go_to_the_engine_as_the_supply_states_them_and_are_judged_by_the_certificate(
    both: Both, gain: float
) -> None:
    def story(both: Both) -> Story:
        both.appoint(gain)
        both.output.voltage = 100.0  # measured off only where the certificate halves it
        yield from both.pause(0.2)

    both.run(story)
    samples = both.of("sample")
    assert samples[0]["values"][1] == pytest.approx(100.0, rel=0.2)  # discharging
    judged = [t for t, m in both.heard if m["is"] == "state" and m["output_is_safe"]]
    begun = samples[0]["values"][0]
    # It falls below 60 V, or 120 V, after ln(100/60) time constants, or at once; two samples in a row must say so.
    needed = 0.1 * math.log(100.0 * gain / 60.0) if gain == 1.0 else 0.0
    assert needed <= judged[0] - begun <= needed + 2 * PERIOD_S + 3 * TURN_S


def test_a_silent_engine_is_given_its_time_and_no_more(both: Both) -> None:
    def story(both: Both) -> Story:
        yield from both.live()
        both.beats = False
        both.mark()
        yield from both.pause(1.5)
        assert both.of("state")[-1]["state"] == "safe" and "silent" in both.of("state")[-1]["cause"]

    both.run(story)
    late = both.output.when("emergency_off")[0] - both.marks[0]
    assert DEADLINE_S - INTERVAL_S <= late <= DEADLINE_S + 2 * TURN_S
    assert any("silent" in text for text in both.errors)


def test_signs_of_life_that_came_while_the_guard_was_held_up_are_heard_first(both: Both) -> None:
    def story(both: Both) -> Story:
        yield from both.live()
        both.clock.sleep_until(both.clock.now() + 3 * DEADLINE_S)  # both were held up, and the engine goes on first
        both.heartbeat()
        yield from both.pause(1.0)
        assert both.of("state")[-1]["state"] == "live"

    both.run(story)


def test_the_time_of_its_own_answer_is_not_the_engines_silence(both: Both, monkeypatch: pytest.MonkeyPatch) -> None:
    def story(both: Both) -> Story:
        yield from both.live()
        calls = both.output.set_voltage

        def slowly(volts: float) -> None:
            both.clock.sleep_until(both.clock.now() + 2.0 * DEADLINE_S)
            calls(volts)

        monkeypatch.setattr(both.output, "set_voltage", slowly)
        yield from both.ask("request", 950.0, 0.0)
        yield from both.pause(0.3)
        assert both.of("state")[-1]["state"] == "live"

    both.run(story)
    assert not [text for text in both.errors if "silent" in text]


def test_an_off_that_is_not_measured_is_sent_every_second_and_called_not_safe_once(both: Both) -> None:
    def story(both: Both) -> Story:
        yield from both.live()
        both.output.deaf_from, both.output.deaf_until = both.clock.now(), both.clock.now() + 7.5
        yield from both.ask("kill", "a test")
        yield from both.pause(9.0)

    both.run(story)
    sent = both.output.when("emergency_off")
    assert len(sent) == 9  # at once, then seven times a second apart in vain, then one that is heard
    for one, other in pairwise(sent):
        assert INSIST_S <= other - one <= INSIST_S + 2 * TURN_S + (INSIST_S if other - sent[0] > AT_ONCE_S else 0.0)
    words = [text for text in both.said if "NOT SAFE" in text]
    assert len(words) == 1
    events = [(t, m) for t, m in both.heard if m["is"] == "event" and "NOT SAFE" in m["message"]]
    assert len(events) == 1 and AT_ONCE_S < events[0][0] - sent[0] <= AT_ONCE_S + 3 * TURN_S
    assert both.output.voltage < 60.0


def test_an_emergency_off_after_a_ramp_has_its_own_limit_in_time(both: Both) -> None:
    """A ramp from 900 V may take 1.5 times 0.5 s and 10 s; an emergency off 4 s, counted from its command."""

    def story(both: Both) -> Story:
        yield from both.live()
        yield from both.ask("ramp_off", "an order")
        yield from both.pause(0.2)
        both.output.deaf_from = both.clock.now()
        both.mark()
        yield from both.ask("kill", "a second thought")
        yield from both.pause(AT_ONCE_S - 0.1)
        assert not both.said
        yield from both.pause(0.2)
        assert "NOT SAFE" in both.said[0]
        both.output.deaf_until = both.clock.now()

    both.run(story)
    sent = both.output.when("emergency_off")
    assert [t - both.marks[0] for t in sent[:4]] == pytest.approx([0.0, 1.0, 2.0, 3.0], abs=6 * TURN_S)
    off_from(both, sent[0])


def test_a_ramp_down_that_stands_still_is_cut_short(both: Both) -> None:
    def story(both: Both) -> Story:
        yield from both.live()
        both.output.deaf_from, both.output.deaf_until = both.clock.now(), both.clock.now() + 0.2
        both.mark()
        yield from both.ask("ramp_off", "an order")
        yield from both.pause(2.5)
        assert "hastened" in both.of("state")[-1]["cause"]

    both.run(story)
    (begun,) = both.marks
    sent = both.output.when("emergency_off")
    # At 0.6 times the rate, half a second late, it may be 50 V and 5 % (of the larger end) above its ramp.
    assert 0.3 < sent[0] - begun < 2.0
    assert len(both.output.when("switch_off")) == 1
    off_from(both, begun)


def test_a_ramp_down_that_ends_above_zero_is_cut_short_when_its_time_is_over(
    both: Both, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Near 60 V nothing says that it is wrong but the time: 1.5 times that of the ramp and a grace, here of 2 s."""

    def story(both: Both) -> Story:
        yield from both.live(360.0)
        move = both.output._move

        def hangs(now: float) -> None:
            move(now)
            if both.output.when("switch_off") and not both.output.when("emergency_off"):
                both.output.voltage = max(both.output.voltage, 70.0 + 0.1 * math.sin(now * 37.0))  # not frozen

        monkeypatch.setattr(both.output, "_move", hangs)
        monkeypatch.setattr("rig.safety.commanded.DEVIATION_V", 80.0)
        monkeypatch.setattr("rig.safety.commanded.RAMP_GRACE_S", 2.0)
        both.mark()
        yield from both.ask("ramp_off", "an order")
        yield from both.pause(3.0)

    both.run(story)
    (begun,) = both.marks
    assert both.output.when("emergency_off")[0] - begun == pytest.approx(1.5 * 360.0 / RAMP + 2.0, abs=0.1)
    assert "hastened, the ramp has taken 2 s" in both.of("state")[-1]["cause"]
    off_from(both, begun)


def test_a_supply_that_fails_while_it_ramps_down_is_taken_off_at_once(both: Both) -> None:
    def story(both: Both) -> Story:
        yield from both.live()
        yield from both.ask("ramp_off", "an order")
        yield from both.pause(0.2)
        both.mark()
        both.output.silent = True
        yield from both.pause(0.05)
        both.output.silent = False
        yield from both.pause(0.5)

    both.run(story)
    assert 0.0 <= both.output.when("emergency_off")[0] - both.marks[0] <= 2 * TURN_S
    assert "an order; hastened" in both.of("state")[-1]["cause"]


def test_an_off_that_failed_at_the_port_is_given_again_after_a_tenth_of_a_second(both: Both) -> None:
    def story(both: Both) -> Story:
        yield from both.live()
        both.output.deaf_from = both.clock.now()
        yield from both.ask("kill", "a test")
        yield from both.pause(0.1)
        both.mark()
        both.output.silent = True
        yield from both.pause(0.5)
        both.output.silent = False
        both.output.deaf_until = both.clock.now()
        yield from both.pause(0.5)

    both.run(story)
    again = [t - both.marks[0] for t in both.output.when("emergency_off")][1:5]
    assert again[0] == pytest.approx(process.AGAIN_S, abs=3 * TURN_S)
    assert [b - a for a, b in pairwise(again)] == pytest.approx([0.1] * 3, abs=3 * TURN_S)
    # What went wrong on the wire is in the log as such.
    assert {m["way"] for m in both.of("wire")} == {"failed"}


def test_a_link_that_was_lost_is_opened_again_and_the_off_is_sent_at_once(both: Both) -> None:
    def story(both: Both) -> Story:
        yield from both.live()
        both.mark()
        both.output.gone_from, both.output.back_at = both.clock.now(), both.clock.now() + 0.737
        yield from both.pause(2.0)

    both.run(story)
    (gone,) = both.marks
    (back,) = both.output.reopened
    assert 0.737 <= back - gone <= 0.737 + 2 * TURN_S
    off = both.output.when("emergency_off")
    assert off[0] - back <= 2 * TURN_S
    off_from(both, gone)
    told = [m["message"] for m in both.of("event")]
    assert any("was gone for 0.7" in text and "is open again" in text for text in told), told


def test_a_link_that_is_lost_for_good_is_not_told_as_off(both: Both) -> None:
    def story(both: Both) -> Story:
        yield from both.live()
        both.output.gone_from = both.clock.now()
        yield from both.pause(0.1)

    both.run(story)
    assert both.output.when("emergency_off") == []
    assert "NOT SAFE" in both.said[0]
    assert "NOT SAFE: high voltage last measured 900 V" in both.said[-1] and "The guard has ended" in both.said[-1]


def test_an_engine_that_takes_its_leave_before_off_was_measured_does_not_end_the_guard(both: Both) -> None:
    def story(both: Both) -> Story:
        both.server._log = both.log
        yield from both.live()
        both.output.deaf_from, both.output.deaf_until = both.clock.now(), both.clock.now() + 1.2
        yield from both.ask("kill", "a test")
        both.engine.send({"do": "close"})
        both.mark()
        yield from both.pause(5.0)

    both.run(story)
    off = both.output.when("emergency_off")
    assert [t - both.marks[0] for t in off] == pytest.approx([0.0, 0.0, 1.0, 2.0], abs=6 * TURN_S) or len(off) >= 3
    off_from(both, both.marks[0])
    assert "before the output was measured off, after a test. The high voltage is off" in both.said[-1]
    assert both.log.closed and not [row for row in both.log.of("/event") if "is off, measured" in row["message"]]


def test_what_arming_has_changed_is_given_back_when_the_engine_has_died(monkeypatch: pytest.MonkeyPatch) -> None:
    both = Both(monkeypatch, Lends)

    def story(both: Both) -> Story:
        yield from both.live()
        assert both.of("state")[-1]["found"] == {"knob": 1.0} and not both.of("state")[-1]["given_back"]
        both.mark()

    both.run(story)
    assert both.output.words[-2:] == ["emergency_off", "give_back"]
    assert both.output.given_back  # type: ignore[attr-defined]
    assert both.output.voltage < 60.0
    # Until the supply has said so it is waited for, and no longer.
    told = both.output.when("give_back")[0]
    assert 0.1 <= both.clock.now() - told <= 0.1 + 2 * TURN_S


def test_a_supply_that_keeps_its_settings_is_waited_for_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Lends, "takes_s", math.inf)
    both = Both(monkeypatch, Lends)
    both.run(lambda both: both.live())
    told = both.output.when("give_back")[0]
    assert both.clock.now() - told == pytest.approx(process.GIVE_BACK_S, abs=2 * TURN_S)


def test_the_engine_hears_how_it_stands_and_that_it_turns(both: Both) -> None:
    def story(both: Both) -> Story:
        yield from both.live()
        both.output._next = math.inf  # no samples, which bring its state at once
        both.mark()
        yield from both.pause(0.4)
        both.mark()

    both.run(story)
    begun, end = both.marks
    states = [t for t, m in both.heard if m["is"] == "state" and begun + 0.1 <= t < end]
    any_ = [t for t, m in both.heard if m["is"] in ("state", "alive") and begun + 0.1 <= t < end]
    assert max(b - a for a, b in pairwise(states)) <= process.STATE_S + 2 * TURN_S
    assert min(b - a for a, b in pairwise(states)) >= process.STATE_S - 1e-9
    gaps = [b - a for a, b in pairwise(any_)]
    assert max(gaps) <= process.ALIVE_S + 2 * TURN_S
    last = both.of("state")[-1]
    assert last["setpoint"] == 900.0 and last["commanded"] and last["ready"]
    assert last["ramp_duration"] == pytest.approx(900.0 / SCENE.hv.ramp_V_per_s)  # type: ignore[union-attr]
    assert last["identity"] == ["an output", "7", "1.0"] and last["settings"] == {"speed": "250"}
    assert last["counters"]["errors"] == 3
    assert 1e6 * INTERVAL_S <= last["counters"]["heartbeat_gap_max_us"] <= 1e6 * (INTERVAL_S + 2 * TURN_S)


def test_a_guard_does_nothing_that_it_may_not_be_asked_for(both: Both) -> None:
    def story(both: Both) -> Story:
        yield from both.ask("arm", refused="before it was appointed")
        yield from both.live()
        for name in ("turn", "heartbeat", "_latch", "on_sample", "excuse", "no_such"):
            yield from both.ask(name, refused=f"cannot be asked for {name!r}")
        yield from both.ask("request", 1e5, 0.0, refused="LimitError")
        yield from both.ask("ramp_off", "done")
        yield from both.pause(1.0)
        both.engine.send({"do": "close"})
        yield from both.pause(0.1)

    both.run(story)
    assert both.output.words == ["set_ramp", "set_voltage", "switch_on", "switch_off"]


@pytest.mark.parametrize("message", [{"do": "dance"}, {}, {"do": "heartbeat", "data": "00"}, {"do": "appoint"}])
def test_what_it_does_not_understand_takes_the_output_off(both: Both, message: Message) -> None:
    def story(both: Both) -> Story:
        yield from both.live()
        both.mark()
        both.engine.send(message)
        yield from both.pause(1.0)

    both.run(story)
    assert both.output.when("emergency_off")[0] - both.marks[0] <= 2 * TURN_S
    off_from(both, both.marks[0])
    assert both.errors


def test_bytes_that_are_no_message_take_the_output_off_and_end_the_conversation(both: Both) -> None:
    def story(both: Both) -> Story:
        yield from both.live()
        both.mark()
        both.engine._socket.send(bytes(64))
        yield from both.pause(0.5)

    both.run(story)
    assert both.output.when("emergency_off")[0] - both.marks[0] <= 2 * TURN_S
    off_from(both, both.marks[0])


class Lent:
    """The monitor of the voltage in place of the engine's: when it was read, and when it was left to the engine."""

    def __init__(self, both: Both) -> None:
        self.gain = 1.0
        self.read: list[float] = []
        self.left: list[float] = []
        self.role = both.scene.second_reading
        self._both = both
        self._next = 0.0

    def poll(self, now: float) -> list[MonitorSample]:
        self.read.append(now)
        if now < self._next:
            return []
        self._next = now + 0.05
        return [MonitorSample(now, self.role, "voltage", self._both.output.voltage)]

    def leave(self) -> None:
        self.left.append(self._both.clock.now())


def watched(monkeypatch: pytest.MonkeyPatch) -> tuple[Both, Lent]:
    both = Both(monkeypatch, scene=WATCHED)
    lent = Lent(both)
    monkeypatch.setattr(process, "TakenOver", lambda scene, handles: lent)
    both.server._log = both.log
    return both, lent


def with_readings(both: Both, story: Story, *, factor: float = 1.0) -> Story:
    """The engine reads the monitor itself and passes the readings on."""
    following = 0.0
    for _ in story:
        if both.clock.now() >= following and both.beats:
            following = both.clock.now() + 0.05
            both.engine.send({"do": "reading", "values": [both.clock.now(), factor * both.output.voltage, 0]})
        yield


def test_the_monitor_is_read_here_only_while_the_engine_hangs_and_the_output_is_not_proven_off(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    both, lent = watched(monkeypatch)

    def story(both: Both) -> Story:
        both.engine.send({"do": "monitor"})
        yield from both.live(600.0)
        assert not lent.read
        both.mark()
        both.beats = False
        yield from both.pause(2.0)
        both.mark()
        both.beats = True
        yield from both.pause(1.0)
        both.mark()

    both.run(lambda both: with_readings(both, story(both)))
    hung, back, died = both.marks
    assert hung - INTERVAL_S - 2 * TURN_S + HUNG_S <= lent.read[0] <= hung + HUNG_S + INTERVAL_S + 3 * TURN_S
    assert [t for t in lent.left if t < died] == pytest.approx([back], abs=2 * TURN_S)
    assert not [t for t in lent.read if back + 2 * TURN_S < t < died]
    assert lent.gain == 1.01
    rows = both.log.of(f"/{lent.role}/sample")
    assert rows and rows[-1]["voltage_V"] < 60.0 and all(row["t_s"] >= lent.read[0] for row in rows)
    off_from(both, hung)


def test_off_is_what_the_lent_monitor_shows_too_when_the_engine_has_died(monkeypatch: pytest.MonkeyPatch) -> None:
    both, lent = watched(monkeypatch)

    def story(both: Both) -> Story:
        both.engine.send({"do": "monitor"})
        yield from both.live(600.0)
        both.mark()

    both.run(lambda both: with_readings(both, story(both)))
    assert both.marks[0] <= lent.read[0] <= both.marks[0] + 2 * TURN_S
    assert "is off, measured" in both.said[-1] and f"({lent.role}) shows" in both.said[-1]
    assert both.clock.now() - both.marks[0] < 2.0


def test_a_monitor_that_does_not_agree_takes_the_output_off(monkeypatch: pytest.MonkeyPatch) -> None:
    both, _ = watched(monkeypatch)

    def story(both: Both) -> Story:
        both.engine.send({"do": "monitor"})
        both.appoint()
        yield from both.pause(0.2)
        yield from both.ask("arm")
        yield from both.ask("request", 600.0, 0.0)
        yield from both.pause(3.0)

    both.run(lambda both: with_readings(both, story(both), factor=0.5))
    assert both.output.when("emergency_off")
    assert any("supply and monitor disagree" in text for text in both.errors)
    off_from(both, both.output.when("emergency_off")[0])


# The beginning -----------------------------------------------------------------------------------------------------


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Channel, socket.socket]]:
    monkeypatch.setattr(process, "_detach", lambda: None)
    ours, theirs = socket.socketpair()
    engine = Channel(ours)
    yield engine, theirs
    engine.close()
    theirs.close()


def begin(engine: Channel, clock: Clock) -> None:
    configuration = process.config(SCENE, clock).decode()  # type: ignore[arg-type]
    engine.send({"do": "begin", "config": configuration, "engine": 1})


def test_what_the_process_is_told_is_the_scene_and_the_engines_clock(
    ends: tuple[Channel, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    engine, theirs = ends
    seen: list[Any] = []
    closed: list[str] = []
    link = SimpleNamespace(close=lambda: closed.append("link"))
    monkeypatch.setattr(type(SCENE.hv), "open", lambda self, role, handles: (seen.append((role, handles)), link)[1])

    class Seen:
        def __init__(self, *known: Any) -> None:
            seen.append(known)

        def run(self) -> None:
            raise KeyboardInterrupt

        def close(self) -> None:
            closed.append("server")

    monkeypatch.setattr(process, "Server", Seen)
    begin(engine, Clock())
    with pytest.raises(KeyboardInterrupt):
        process.serve(theirs)
    assert seen[0] == ("hv", ())
    scene, table, got, channel, clock, peer, descriptor = seen[1]
    assert scene == SCENE and table == SCENE.hv and got is link and descriptor is None
    assert (clock.zero, clock.started_ns) == (Clock.zero, Clock.started_ns) and isinstance(clock, RealClock)
    peer.close()
    assert closed == ["link", "server"] and channel.closed  # whatever ended it


def test_a_link_that_cannot_be_opened_is_told_to_the_engine(
    ends: tuple[Channel, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    engine, theirs = ends

    def refuse(self: Any, role: str, handles: Any) -> Any:
        raise DeviceError("hv (can0)", "there is no can0", "Bring it up.")

    monkeypatch.setattr(type(SCENE.hv), "open", refuse)
    begin(engine, Clock())
    process.serve(theirs)
    (said,) = engine.receive()
    assert said["is"] == "error" and said["error"]["what"] == "there is no can0"
    assert said["error"]["advice"] == "Bring it up."


@pytest.mark.parametrize("dead", [True, False])
def test_an_engine_that_says_nothing_or_has_died_is_not_waited_for(
    ends: tuple[Channel, socket.socket], monkeypatch: pytest.MonkeyPatch, dead: bool
) -> None:
    engine, theirs = ends
    clock = Clock()
    monkeypatch.setattr(process, "RealClock", lambda: clock)

    def wait(ends: Any, _w: Any, _x: Any, seconds: float) -> Any:
        assert clock.now() < process.BEGIN_S
        clock.sleep_until(clock.now() + seconds)
        return select.select(ends, [], [], 0.0)

    monkeypatch.setattr(process, "select", SimpleNamespace(select=wait))
    if dead:
        engine.close()
    process.serve(theirs)
    assert (clock.now() == pytest.approx(0.5)) if dead else (clock.now() >= process.BEGIN_S)
