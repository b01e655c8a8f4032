"""A producer's end of the log's process: what goes at once, what waits, and when the writer is given up."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from rig.log import frames, remote, schema
from rig.log.errors import LogError
from rig.log.remote import BUSY_S, LISTEN_S, MOST_IN_FRAME, SILENCE_S, RemoteLog

LATER = 0.1  # seconds in which what waits is sent


class Writer:
    """The other end. ``rows``: topics and fields of what has come."""

    def __init__(self) -> None:
        ours, self.end = socket.socketpair()
        self.end.setblocking(False)
        self.log = RemoteLog(Path("run.mcap"), ours)
        self._unpack = frames.Unpacker()
        self.frames: list[int] = []

    def topics(self) -> list[str]:
        """What has come since the last call."""
        found = []
        data = b""
        with suppress(BlockingIOError):
            while more := self.end.recv(1 << 20):
                data += more
        for kind, body in self._unpack.feed(data):
            assert kind == frames.MESSAGES
            self.frames.append(len(body))
            while body:
                topic, _, _, length = frames.MESSAGE_HEAD.unpack_from(body)
                found.append(list(schema.CHANNELS)[topic])
                body = body[frames.MESSAGE_HEAD.size + length :]
        return found

    def alive(self, free: int = 5, busy: float = 0.0) -> None:
        self.end.send(frames.pack(frames.ALIVE, frames.STATE.pack(free, busy)))


@pytest.fixture
def writer() -> Iterator[Writer]:
    writer = Writer()
    yield writer
    writer.log.close()
    writer.end.close()


def sample(log: RemoteLog, n: int = 0) -> None:
    log.write("/force/sample", {"t_s": 1e-3 * n, "reading": 0.1, "force_N": 0.2, "flags": 0}, n, n)


def command(log: RemoteLog) -> None:
    log.write("/command", {"t_s": 0.0, "device": "hv", "command": "switch_on", "argument": ""}, 1, 1)


@pytest.mark.parametrize("topic", [topic for topic in schema.CHANNELS if topic == "/command" or topic.endswith("/tx")])
def test_a_command_and_bytes_for_a_wire_are_sent_before_they_take_effect(writer: Writer, topic: str) -> None:
    sample(writer.log)
    assert writer.topics() == []
    if topic == "/command":
        command(writer.log)
    else:
        writer.log.write(topic, {"t_s": 0.0, "data": b"x"}, 1, 1)
    assert writer.topics() == ["/force/sample", topic]  # what was said before it comes before it


@pytest.mark.parametrize("topic", ["/raw/hv/rx", "/raw/force/rx", "/event"])
def test_everything_else_goes_with_the_turn(writer: Writer, topic: str) -> None:
    fields = {"data": b"x"} if topic.startswith("/raw") else {"severity": "info", "source": "a", "message": "b"}
    writer.log.write(topic, {"t_s": 0.0, **fields}, 1, 1)
    sample(writer.log)
    assert writer.topics() == []
    writer.log.tick(0.0)
    writer.log.tick(LATER)
    assert writer.topics() == [topic, "/force/sample"]
    assert len(writer.frames) == 1


def test_a_torn_frame_takes_little_along(writer: Writer) -> None:
    for n in range(4000):
        sample(writer.log, n)
    writer.log.tick(0.0)
    writer.log.tick(LATER)
    assert len(writer.topics()) == 4000
    assert len(writer.frames) > 3 and max(writer.frames) < MOST_IN_FRAME + 200


def test_a_writer_that_takes_nothing_is_not_waited_for(writer: Writer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote, "MOST_WAITING", 2_000_000)
    with pytest.raises(LogError, match="does not keep up"):
        for n in range(100_000):
            sample(writer.log, n)
            if n % 100 == 0:
                command(writer.log)
    with pytest.raises(LogError, match="does not keep up"):
        command(writer.log)
    with pytest.raises(LogError, match="does not keep up"):
        writer.log.tick(0.0)


def ticks(writer: Writer, begin: float, end: float, *, step: float = 0.01, alive: bool = False) -> float:
    """The engine's turns from ``begin`` on; when the writer was given up, or ``end``."""
    for k in range(round((end - begin) / step) + 1):
        if alive:
            writer.alive()
        try:
            writer.log.tick(begin + k * step)
        except LogError:
            return begin + k * step
    return end


def test_a_writer_that_says_nothing_is_given_up_after_its_time(writer: Writer) -> None:
    writer.alive()
    ticks(writer, 0.0, 1.0, alive=True)
    assert SILENCE_S <= ticks(writer, 1.0, 3.0) - 1.0 <= SILENCE_S + LISTEN_S + 0.02


def test_a_writer_that_says_that_it_lives_is_not_given_up(writer: Writer) -> None:
    assert ticks(writer, 0.0, 3.0, alive=True) == 3.0
    assert writer.log.tick(3.0) == 5  # bytes free on its disk
    writer.alive(free=-1)
    assert writer.log.tick(3.1) is None  # it does not know


def test_a_turn_of_ours_that_was_long_is_not_its_silence(writer: Writer) -> None:
    ticks(writer, 0.0, 0.5, alive=True)
    writer.log.tick(2.0)
    given_up = ticks(writer, 2.06, 4.0)
    assert SILENCE_S - 0.15 <= given_up - 2.0 <= SILENCE_S + 0.05


@pytest.mark.parametrize(("busy", "ends"), [(0.99 * BUSY_S, False), (BUSY_S, True), (float("nan"), True)])
def test_a_writer_that_waits_for_its_disk_is_given_up_after_longer(writer: Writer, busy: float, ends: bool) -> None:
    writer.alive(busy=busy)
    if ends:
        with pytest.raises(LogError, match="waited for its disk"):
            writer.log.tick(0.0)
    else:
        assert writer.log.tick(0.0) == 5


def test_why_it_failed_and_that_it_has_ended_are_told_once_for_all(writer: Writer) -> None:
    writer.end.send(frames.pack(frames.FAILED, json.dumps(["a.mcap", "the disk is full", "Make room."]).encode()))
    for _ in range(2):
        with pytest.raises(LogError, match="the disk is full"):
            writer.log.tick(0.0)
    with pytest.raises(LogError, match="the disk is full"):
        command(writer.log)


@pytest.mark.parametrize("what", ["end", "damage"])
def test_the_end_of_the_writer_and_damage_are_told(writer: Writer, what: str) -> None:
    if what == "end":
        writer.end.close()
    else:
        writer.end.send(b"\xff" * 100)
    with pytest.raises(LogError, match="has ended" if what == "end" else "sends a frame"):
        writer.log.tick(0.0)


def test_closing_sends_what_waits(writer: Writer) -> None:
    sample(writer.log)
    writer.log.close()
    assert writer.topics() == ["/force/sample"]
