"""Between engine and guard: whole messages, damage told, a peer that is dead or stopped."""

from __future__ import annotations

import os
import socket
import zlib
from collections.abc import Iterator

import pytest

from drivers.links.link import DeviceLost
from rig.base.errors import FaultError, LimitError, StaleData
from rig.safety import channel
from rig.safety.channel import Channel, ChannelDamaged
from rig.safety.process import pack_error
from rig.safety.remote import unpack_error


@pytest.fixture
def ends() -> Iterator[tuple[Channel, Channel]]:
    one, other = (Channel(end) for end in socket.socketpair())
    yield one, other
    one.close()
    other.close()


def test_messages_arrive_whole_and_in_order(ends: tuple[Channel, Channel]) -> None:
    one, other = ends
    sent = [{"n": n, "text": "x" * n, "nan": None} for n in range(300)]
    for message in sent:
        one.send(message)
    got: list[object] = []
    while len(got) < len(sent):
        got += other.receive()
        one.flush()
    assert got == sent
    assert not one.closed and not other.closed


def test_what_was_said_before_the_end_is_heard(ends: tuple[Channel, Channel]) -> None:
    one, other = ends
    other.send({"never": "read"})  # so that the end comes as a reset
    one.send({"last": "word"})
    one.close()
    assert other.receive() == [{"last": "word"}]
    assert other.closed
    other.send({"more": 1})  # does no harm


class Reset:
    """A socket whose peer died with something unread; some systems say so once, ahead of what can still be read."""

    def __init__(self, *what: bytes | type[OSError]) -> None:
        self._what = list(what)

    def setblocking(self, blocking: bool) -> None:
        assert not blocking

    def fileno(self) -> int:
        return 99

    def close(self) -> None:
        pass

    def recv(self, size: int) -> bytes:
        one = self._what.pop(0)
        if isinstance(one, bytes):
            return one
        raise one


@pytest.mark.parametrize(
    ("what", "read", "closed"),
    [
        ((b"", ConnectionResetError), [], True),
        ((ConnectionResetError, b"frame", b""), [{"last": "word"}], True),
        ((b"frame", ConnectionResetError, b"frame", ConnectionResetError), [{"last": "word"}] * 2, True),
        ((ConnectionResetError, b"frame", BlockingIOError), [{"last": "word"}], True),
        ((b"frame", OSError), [{"last": "word"}], True),
        ((b"frame", BlockingIOError), [{"last": "word"}], False),
        ((BlockingIOError,), [], False),
    ],
)
def test_a_reset_is_an_end_and_is_read_past_once(
    monkeypatch: pytest.MonkeyPatch, what: tuple[bytes | type[OSError], ...], read: list[object], closed: bool
) -> None:
    monkeypatch.delattr(socket, "recv_fds", raising=False)
    frame = channel._pack({"last": "word"})
    end = Channel(Reset(*(frame if one == b"frame" else one for one in what)))  # type: ignore[arg-type]
    assert end.receive() == read
    assert end.closed is closed


def test_a_message_that_is_longer_than_allowed_or_no_table_is_damage(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(socket, "recv_fds", raising=False)
    for body in (b" " * (channel.LARGEST_MESSAGE + 1), b"[1]", b"{", b"[" * 100_000):
        frame = channel._HEAD.pack(len(body), zlib.crc32(body)) + body
        end = Channel(Reset(frame, BlockingIOError))  # type: ignore[arg-type]
        with pytest.raises(ChannelDamaged):
            end.receive()
        assert end.closed


def test_a_stopped_peer_holds_nobody_up_and_gets_whole_messages(
    ends: tuple[Channel, Channel], monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = ends
    monkeypatch.setattr(channel, "LARGEST_OUTBOX", 100_000)
    for n in range(20_000):
        one.send({"n": n, "text": "x" * 100})
    assert one.thrown_away > 0
    got: list[dict[str, object]] = []
    while fresh := other.receive():
        got += fresh
        one.flush()
    assert [m["n"] for m in got] == list(range(len(got)))


@pytest.mark.parametrize("at", [0, 4, 8, 12])
def test_damage_is_told_and_ends_the_conversation(at: int) -> None:
    raw, end = socket.socketpair()
    damaged = Channel(end)
    frame = bytearray(channel._pack({"do": "call", "n": 1}))
    frame[at] ^= 0xFF
    with raw:
        raw.sendall(frame + bytes(300))
        with pytest.raises(ChannelDamaged):
            damaged.receive()
        assert damaged.closed


@pytest.mark.skipif(not hasattr(socket, "send_fds"), reason="POSIX")
def test_a_file_descriptor_goes_with_a_message(ends: tuple[Channel, Channel]) -> None:
    one, other = ends
    reading, writing = os.pipe()
    one.hand_over({"do": "log"}, writing)
    os.close(writing)
    assert other.receive() == [{"do": "log"}]
    os.write(other.handles[0], b"here")
    assert os.read(reading, 4) == b"here"
    os.close(reading)
    os.close(other.handles[0])


@pytest.mark.parametrize(
    "error",
    [
        LimitError("too much"),
        FaultError("broken"),
        StaleData("old"),
        DeviceLost("hv", "it is gone", "Plug it in."),
        KeyError("x"),
    ],
)
def test_errors_come_over_as_what_they_are(error: Exception) -> None:
    there = unpack_error(pack_error(error))
    if isinstance(error, KeyError):
        assert isinstance(there, FaultError) and "internal error of the guard" in str(there)
    else:
        assert type(there) is type(error) and str(there) == str(error)
