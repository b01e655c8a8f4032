"""How discovery asks for an instrument: the port or bus on which questions are asked, and what comes of them.

A probe only asks, it never commands: whatever instrument is on the port gets the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

from drivers.links.link import ByteLink, CanFrame, FrameLink
from drivers.roles import Identity

M = TypeVar("M")
T = TypeVar("T")

ANSWER_S = 0.15
"""Longer than any of these instruments takes, with an adapter's 16 ms each way."""

LOOK_S = 2e-3

FORCE_CERTIFICATE = "force.toml"
"""What stands in the proposed lines where the file of the sensor's own certificate must be named."""

Keys = dict[str, str | int]


class Clock(Protocol):
    """The part of a clock that is needed to wait."""

    def now(self) -> float: ...

    def sleep_until(self, t: float) -> None: ...


@dataclass(frozen=True, slots=True)
class Answered:
    """Somebody answered.

    ``keys`` are what a scene must say of it beside its port or bus. ``usable`` is False when it is nothing that a scene
    can name: a switchboard, a node of another kind.
    """

    identity: Identity
    keys: Keys
    remark: str = ""
    usable: bool = True


class Line:
    """A serial port on which questions are asked."""

    def __init__(self, clock: Clock, port: str, baud: int, link: ByteLink) -> None:
        self.port, self.baud = port, baud
        self._clock = clock
        self._link = link

    def ask(self, data: bytes, feed: Callable[[bytes], Sequence[M]]) -> Iterator[M]:
        """Send ``data`` and give each message that comes within the time for an answer."""
        self._link.write(data)
        end = self._clock.now() + ANSWER_S
        while True:
            yield from feed(self._link.read())
            now = self._clock.now()
            if now >= end:
                return
            self._clock.sleep_until(min(now + LOOK_S, end))


class Network:
    """A CAN bus on which questions are asked.

    ``process_data`` are identifiers that belong to the process data of nodes that have answered: nothing else may be
    sent with them.
    """

    def __init__(self, clock: Clock, link: FrameLink) -> None:
        self.process_data: set[int] = set()
        self._clock = clock
        self._link = link

    def send(self, frame: CanFrame) -> None:
        self._link.write(frame)

    def listen(self, seconds: float) -> Iterator[CanFrame]:
        """Every frame that comes within the time."""
        end = self._clock.now() + seconds
        while (now := self._clock.now()) < end:
            yield from self._link.read()
            self._clock.sleep_until(min(now + LOOK_S, end))

    def ask(self, request: CanFrame, pick: Callable[[CanFrame], T | None]) -> T | None:
        """Send a request; the first answer that ``pick`` recognises."""
        self.send(request)
        return next((answer for frame in self.listen(ANSWER_S) if (answer := pick(frame)) is not None), None)

    def ask_all(self, requests: Sequence[CanFrame]) -> Iterator[CanFrame]:
        """Send all requests, no faster than a bus at 125 kbit/s takes them, and give what comes meanwhile."""
        for request in requests:
            self.send(request)
            yield from self.listen(LOOK_S)
        yield from self.listen(ANSWER_S)


@dataclass(frozen=True, slots=True)
class SerialProbe:
    """How it is asked for on a serial port.

    ``bauds`` are the line rates that such instruments come with. On each port the probes are tried by rising ``order``
    until one gets an answer: the smaller, the less harm its question does to other instruments. ``renumber`` gives
    each instrument on a line an address of its own, and is a command: it is sent on demand only. False: nobody there.
    """

    ask: Callable[[Line], list[Answered]]
    bauds: tuple[int, ...] = (115_200,)
    order: int = 50
    renumber: Callable[[Line], bool] | None = None


def _hears_nobody(network: Network, frame: CanFrame) -> Answered | None:
    return None


@dataclass(frozen=True, slots=True)
class BusProbe:
    """How it is asked for on a CAN bus.

    All probes are tried, by rising ``order``. If nobody answers, the bus is listened to, and ``hear`` says of each
    frame whether such an instrument announces itself with it.
    """

    ask: Callable[[Network], list[Answered]]
    hear: Callable[[Network, CanFrame], Answered | None] = _hears_nobody
    order: int = 50
