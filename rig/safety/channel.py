"""Messages between engine and guard: JSON in frames with length and CRC-32, over a socket pair, never waiting.

A peer that has died shows as `Channel.closed`. A peer that is stopped does not hold us up: what it does not read is
kept, and beyond `LARGEST_OUTBOX` thrown away whole message by whole message.
"""

from __future__ import annotations

import json
import socket
import struct
import zlib
from contextlib import suppress
from typing import Any

Message = dict[str, Any]

LARGEST_OUTBOX = 1 << 20
LARGEST_MESSAGE = 1 << 20
_HEAD = struct.Struct("<II")  # length and CRC-32 of what follows


class ChannelDamaged(Exception):
    """Bytes that are no message: nothing that comes after them can be trusted."""


class Channel:
    """One end. ``thrown_away`` counts messages for which there was no room."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._socket = end
        self._inbox = bytearray()
        self._outbox = bytearray()
        self.closed = False
        self.thrown_away = 0
        self.handles: list[int] = []  # file descriptors that came with messages, in order

    def fileno(self) -> int:
        """For ``select``."""
        return self._socket.fileno()

    def send(self, message: Message) -> None:
        """Send as soon as there is room; a peer that is gone is noticed, not told."""
        if len(self._outbox) > LARGEST_OUTBOX:
            self.thrown_away += 1
        else:
            self._outbox += _pack(message)
        self.flush()

    def hand_over(self, message: Message, *handles: int) -> None:
        """Send a message with file descriptors, before there is other traffic. POSIX only."""
        socket.send_fds(self._socket, [_pack(message)], handles)

    def flush(self) -> None:
        """Send what there is room for."""
        while self._outbox and not self.closed:
            try:
                sent = self._socket.send(self._outbox)
            except BlockingIOError:
                return
            except OSError:
                self.closed = True
                return
            del self._outbox[:sent]

    def receive(self) -> list[Message]:
        """All messages that have arrived. What was under way when the peer died is still delivered.

        Raises
        ------
        ChannelDamaged
            Wrong length, checksum or content; the channel is closed then.
        """
        reset = False
        while self._socket.fileno() >= 0:
            try:
                data = self._read()
            except BlockingIOError:
                break
            except ConnectionResetError:  # said once, ahead of what can still be read
                self.closed = True
                if reset:
                    break
                reset = True
                continue
            except OSError:
                self.closed = True
                break
            if not data:
                self.closed = True
                break
            self._inbox += data
        return self._messages()

    def close(self) -> None:
        """Let the peer see the end. Calling it twice does no harm."""
        self.closed = True
        with suppress(OSError):
            self._socket.close()

    def _read(self) -> bytes:
        if not hasattr(socket, "recv_fds"):
            return self._socket.recv(1 << 16)
        data, handles, _, _ = socket.recv_fds(self._socket, 1 << 16, 4)
        self.handles += handles
        return data

    def _messages(self) -> list[Message]:
        messages: list[Message] = []
        while len(self._inbox) >= _HEAD.size:
            length, check = _HEAD.unpack_from(self._inbox)
            if length > LARGEST_MESSAGE:
                raise self._damaged(f"a message of {length} bytes")
            end = _HEAD.size + length
            if len(self._inbox) < end:
                break
            body = bytes(self._inbox[_HEAD.size : end])
            if zlib.crc32(body) != check:
                raise self._damaged("a wrong checksum")
            try:
                message = json.loads(body)
            except (ValueError, RecursionError):
                raise self._damaged("no JSON") from None
            if not isinstance(message, dict):
                raise self._damaged("no table")
            messages.append(message)
            del self._inbox[:end]
        return messages

    def _damaged(self, what: str) -> ChannelDamaged:
        self.close()
        return ChannelDamaged(f"{what} between engine and guard")


def _pack(message: Message) -> bytes:
    body = json.dumps(message, separators=(",", ":")).encode()
    return _HEAD.pack(len(body), zlib.crc32(body)) + body
