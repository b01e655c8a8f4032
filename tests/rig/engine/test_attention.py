"""Who is polled in a turn, and how long the loop waits: on sockets, in real time."""

from __future__ import annotations

import math
import os
import socket
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import cast

import pytest

from drivers.dialogue import LOOK_AGAIN_S
from rig.base.clock import RealClock
from rig.bench.bench import Bench
from rig.engine.attention import IDLE_S, LONGEST_S, STREAM_S, TOGETHER_S, Attention

pytestmark = pytest.mark.skipif(os.name != "posix", reason="descriptors that can be waited on are POSIX")
SOON, LATE = 0.02, 1.0


class Instrument:
    """One end of a socket; what is written to ``other`` has come for it."""

    def __init__(self) -> None:
        self.mine, self.other = socket.socketpair()
        self.next_poll = math.inf

    def close(self) -> None:
        self.mine.close()
        self.other.close()


class Fake:
    """A bench of instruments on sockets; roles in ``without`` have no descriptor."""

    def __init__(self, devices: dict[str, Instrument], *without: str, channel: str = "") -> None:
        self.clock = RealClock()
        self.devices = devices
        self._without, self._channel = without, channel

    def has_link(self, role: str) -> bool:
        return role != self._channel

    def descriptor(self, role: str) -> int | None:
        return None if role in self._without else self.devices[role].mine.fileno()


@pytest.fixture
def devices() -> Iterator[dict[str, Instrument]]:
    found = {role: Instrument() for role in ("stage", "force")}
    yield found
    for one in found.values():
        one.close()


def attention_of(devices: dict[str, Instrument], *without: str, channel: str = "") -> tuple[Attention, RealClock]:
    fake = Fake(devices, *without, channel=channel)
    return Attention(cast(Bench, fake)), fake.clock


def test_on_a_bench_in_memory_all_are_polled_in_every_turn(devices: dict[str, Instrument]) -> None:
    attention, _ = attention_of(devices, "stage", "force")
    for now in (0.0, 1e-6, 1.0):
        assert list(attention.wanted(now)) == ["stage", "force"]
    devices["stage"].next_poll = 2.0
    assert attention.next() == (2.0, []) and attention.puts_off == 0.0


def test_an_answer_that_another_one_has_read_is_looked_for_when_its_instrument_wishes(
    devices: dict[str, Instrument],
) -> None:
    """Two on one connection: the system knows of nothing any more."""
    devices["force"].mine.close()
    devices["force"].mine = devices["stage"].mine
    attention, _ = attention_of(devices)
    for role, device in devices.items():
        attention.polled(role, 1.0)
        device.next_poll = 1.0 + LOOK_AGAIN_S
    assert attention.wanted(1.0 + 0.5 * LOOK_AGAIN_S) == []
    due, awaited = attention.next()
    assert due == 1.0 + LOOK_AGAIN_S and awaited == []
    assert list(attention.wanted(due)) == ["stage", "force"]


def test_where_a_descriptor_was_closed_all_are_polled(devices: dict[str, Instrument]) -> None:
    """A port that was lost and opened again has another one."""
    attention, _ = attention_of(devices)
    for role, device in devices.items():
        attention.polled(role, 1.0)
        device.next_poll = math.inf
    assert attention.wanted(1.005) == []
    devices["stage"].mine.close()
    assert list(attention.wanted(1.0051)) == ["stage", "force"]


def test_who_awaits_an_answer_is_polled_when_it_has_come_and_not_before(devices: dict[str, Instrument]) -> None:
    attention, _ = attention_of(devices)
    for role in devices:
        attention.polled(role, 1.0)
    devices["stage"].next_poll = 1.0 + LOOK_AGAIN_S
    devices["force"].next_poll = math.inf
    assert attention.wanted(1.005) == []
    devices["stage"].other.send(b"answer")
    assert attention.wanted(1.0051) == ["stage"]


def test_an_answer_wakes_the_loop_but_not_before_the_shortest_turn(devices: dict[str, Instrument]) -> None:
    attention, clock = attention_of(devices)
    attention.polled("stage", 0.5)
    devices["stage"].next_poll = 0.5 + LOOK_AGAIN_S
    due, awaited = attention.next()
    assert due == math.inf and awaited == [devices["stage"].mine.fileno()]
    timer = threading.Timer(SOON, devices["stage"].other.send, [b"answer"])
    began = clock.now()  # before the timer: a busy machine may hold this thread up between the two
    timer.start()
    attention.wait(began, began + LATE, awaited)
    assert 0.9 * SOON <= clock.now() - began < LATE  # no answer, no waking; an answer, no waiting
    timer.join()
    began = clock.now()
    attention.wait(began + SOON, began + LATE, awaited)
    assert SOON <= clock.now() - began < LATE
    devices["stage"].mine.recv(100)
    began = clock.now()
    attention.wait(began, began + SOON, awaited)
    assert clock.now() - began >= 0.9 * SOON


def test_what_wants_to_be_polled_is_and_what_never_says_so_is_now_and_then(devices: dict[str, Instrument]) -> None:
    attention, _ = attention_of(devices)
    for role in devices:
        attention.polled(role, 1.0)
    devices["stage"].next_poll = 1.004
    assert attention.wanted(1.003) == []
    assert attention.wanted(1.004) == ["stage"]
    assert attention.next() == (1.004 + TOGETHER_S, [])
    devices["stage"].next_poll = devices["force"].next_poll = math.nan  # of a driver that cannot say when
    assert attention.wanted(1.0 + 0.9 * LONGEST_S) == []
    assert attention.wanted(1.0 + 1.1 * LONGEST_S) == ["stage", "force"]


def test_who_waits_for_his_time_is_left_alone_until_then_but_not_for_long(devices: dict[str, Instrument]) -> None:
    attention, _ = attention_of(devices)
    for role, device in devices.items():
        attention.polled(role, 1.0)
        device.next_poll = 1.0 + 2 * IDLE_S
    devices["force"].next_poll = math.inf
    assert attention.wanted(1.0 + 0.9 * IDLE_S) == []
    assert attention.wanted(1.0 + 1.1 * IDLE_S) == ["stage", "force"]


def test_what_comes_unasked_or_streams_is_read_every_few_milliseconds(devices: dict[str, Instrument]) -> None:
    attention, _ = attention_of(devices)
    for role in devices:
        attention.polled(role, 1.0)
    devices["force"].other.send(b"frame")
    assert attention.wanted(1.0 + 0.5 * STREAM_S) == []
    assert attention.wanted(1.0 + 1.1 * STREAM_S) == ["force"]


def test_a_device_that_is_no_link_awaits_nothing(devices: dict[str, Instrument]) -> None:
    """The guard of the supply: its channel may be closed at any time."""
    attention, _ = attention_of(devices, channel="stage")
    attention.polled("stage", 1.0)
    devices["stage"].next_poll = 1.0 + LOOK_AGAIN_S
    assert attention.next() == (1.0 + LOOK_AGAIN_S, [])
    assert "stage" in attention.wanted(1.0 + LOOK_AGAIN_S)


def test_a_link_that_is_closed_meanwhile_ends_nothing(devices: dict[str, Instrument]) -> None:
    attention, clock = attention_of(devices)
    attention.polled("stage", 0.0)
    devices["stage"].next_poll = LOOK_AGAIN_S
    _, awaited = attention.next()
    devices["stage"].close()
    attention.wait(0.0, clock.now() + SOON, awaited)
    assert "stage" in attention.wanted(clock.now())


def test_instruments_on_one_connection_are_polled_together() -> None:
    one = Instrument()
    both = cast("dict[str, Instrument]", {role: SimpleNamespace(mine=one.mine, next_poll=9.0) for role in ("a", "b")})
    attention, _ = attention_of(both)
    for role in both:
        attention.polled(role, 1.0)
    both["b"].next_poll = 1.002
    assert list(attention.wanted(1.001)) == []
    assert list(attention.wanted(1.002)) == ["a", "b"]
    one.close()
