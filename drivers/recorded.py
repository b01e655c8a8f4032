"""How a recorded dialogue is served: what a log must know of a protocol to answer in an instrument's place.

See `rig.replay.served`, which finds for each request of a new run its like in the log.
"""

from __future__ import annotations

from typing import NamedTuple


class Passed(NamedTuple):
    """What passed on a wire at ``t``: sent by the host, or read by it."""

    t: float
    sent: bool
    data: bytes


class Exchange(NamedTuple):
    """A request, and what came after it until the next, each with its delay."""

    request: Passed
    key: bytes
    answers: tuple[tuple[float, bytes], ...]


class Dialect:
    """Where a request ends, what makes two the same, how an answer is given anew; here of lines that end in ``end``."""

    def __init__(self, end: bytes) -> None:
        self._end = end

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        """The whole requests in ``data``, and what is left."""
        *whole, rest = data.split(self._end)
        return [request + self._end for request in whole], rest

    def key(self, request: bytes) -> bytes:
        """What two requests have in common that ask the same."""
        return request

    def alike(self, then: bytes, now: bytes) -> bool:
        """Whether a command with the key ``now`` is that which had the key ``then``."""
        return then == now

    def replaces(self, earlier: bytes, later: bytes) -> bool:
        """Whether a command with the key ``later`` takes the place of one with the key ``earlier``."""
        return False

    def anew(self, exchange: Exchange, request: bytes) -> tuple[tuple[float, bytes], ...]:
        """The answers of ``exchange``, given to ``request``."""
        return exchange.answers

    def unknown(self, request: bytes) -> bytes:
        """What it says to a request that only later releases make, where the log has none; empty: nothing is known."""
        return b""


class Frames(Dialect):
    """CAN frames come one by one."""

    def __init__(self) -> None:
        super().__init__(b"")

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        return [data], b""
