"""A log as a bench in real time, where no two runs ask at the same instants.

How often an instrument is asked for its value between two commands is then left to chance. So a request is answered by
its like in the log: a question that the log repeats all the time by that which was asked nearest to the same time since
the last command. Everything else, commands above all, must come as it came then, in the same order. Only motions, which
follow from readings, are given some play: their places by a few steps, and one replaced at once may be missing.
"""

from __future__ import annotations

import math
import re
from collections import Counter, deque
from collections.abc import Callable
from typing import NamedTuple, NoReturn

REPEATED = 20  # a request that stands so often in a log is a question that is asked all the time
NEAR_STEPS = 20  # of the stage, about 10 um: by which the place of a motion may differ
AT_ONCE_S = 0.05  # a motion replaced so soon may as well not have begun: it is left to chance which reading came first
ANSWER_S = 0.5  # what comes later after a request comes by itself

_ZABER = re.compile(rb"/(\d+ \d+) (\d+) ?([^:\n]*)(?::[0-9A-F]{2})?\r?\n")
_ZABER_REPLY = re.compile(rb"@(\d+ \d+) (\d+)([^:\r\n]*)(:[0-9A-F]{2})?\r\n")
_ZABER_MOTION = re.compile(rb"(\d+ \d+ move abs) (-?\d+)")
_ZABER_HALT = re.compile(rb"\d+ \d+ (?:stop|move abs -?\d+)")
_GSV8_HEAD = 3  # prefix, kind with the number of data bytes, command; then data and suffix


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
    """What must be known of a protocol: where a request ends, what makes two the same, how an answer is given anew."""

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


class _Zaber(Dialect):
    """Requests are numbered, and the answer bears the number; both may end in a checksum."""

    def key(self, request: bytes) -> bytes:
        match = _ZABER.fullmatch(request)
        return request if match is None else match[1] + b" " + match[3]

    def alike(self, then: bytes, now: bytes) -> bool:
        one, other = _ZABER_MOTION.fullmatch(then), _ZABER_MOTION.fullmatch(now)
        if one is None or other is None:
            return then == now
        return one[1] == other[1] and abs(int(one[2]) - int(other[2])) <= NEAR_STEPS

    def replaces(self, earlier: bytes, later: bytes) -> bool:
        return _ZABER_MOTION.fullmatch(earlier) is not None and _ZABER_HALT.fullmatch(later) is not None

    def anew(self, exchange: Exchange, request: bytes) -> tuple[tuple[float, bytes], ...]:
        then, now = _ZABER.fullmatch(exchange.request.data), _ZABER.fullmatch(request)
        if then is None or now is None or not exchange.answers:
            return exchange.answers

        def renumber(match: re.Match[bytes]) -> bytes:
            number = now[2] if match[2] == then[2] else match[2]
            text = match[1] + b" " + number + match[3]
            return b"@" + text + (b":%02X" % (-sum(text) & 0xFF) if match[4] else b"") + b"\r\n"

        whole = b"".join(data for _, data in exchange.answers)
        return ((exchange.answers[-1][0], _ZABER_REPLY.sub(renumber, whole)),)


class _GSV8(Dialect):
    """Requests say how long they are."""

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        whole = []
        while len(data) > 1 and len(data) >= (length := _GSV8_HEAD + 1 + (data[1] & 0x0F)):
            whole.append(data[:length])
            data = data[length:]
        return whole, data


class _Frames(Dialect):
    """CAN frames come one by one."""

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        return [data], b""


DIALECTS: dict[str, Dialect] = {
    "zaber": _Zaber(b"\n"),
    "gsv8": _GSV8(b""),
    "keyence-lkg": Dialect(b"\r"),
    "shvps": Dialect(b"\r"),
    "iseg-edcp": _Frames(b""),
    "cia404": _Frames(b""),
}


class Lag:
    """By how much this run is behind the recorded one: one for all instruments, so that what they say fits together."""

    def __init__(self) -> None:
        self.s = 0.0


class ServedScript:
    """What passed on one wire, found by request."""

    def __init__(
        self, rows: list[Passed], depart: Callable[[float, bytes], NoReturn], dialect: Dialect, lag: Lag
    ) -> None:
        self.requests = 0
        self._lag = lag
        self._depart = depart
        self._dialect = dialect
        self._coming: deque[tuple[float, bytes]] = deque()  # by the time of this run
        self._stream: deque[tuple[float, bytes]] = deque()  # by the recorded time: what comes by itself
        self._exchanges: list[Exchange] = []
        answers: list[tuple[float, bytes]] = []
        for n, row in enumerate(rows):
            if row.sent:
                after = next((k for k in range(n + 1, len(rows)) if rows[k].sent), len(rows))
                answers = [(late.t - row.t, late.data) for late in rows[n + 1 : after]]
                self._exchanges.append(Exchange(row, dialect.key(row.data), tuple(answers)))
            elif not self._exchanges:
                self._stream.append((row.t, row.data))
        counts = Counter(exchange.key for exchange in self._exchanges)
        self._repeated = {key for key, count in counts.items() if count >= REPEATED}
        self._newest: dict[bytes, Exchange] = {}
        self._next = 0
        self._partial = b""

    @property
    def due(self) -> Passed | None:
        """The recorded request that must come next, whatever is asked before it; None when there is none."""
        for exchange in self._exchanges[self._next :]:
            if exchange.key not in self._repeated:
                return exchange.request
        return None

    def write(self, data: bytes, t: float) -> None:
        """Take what the host sends, in pieces of any size; raises where the log has no answer to it."""
        whole, self._partial = self._dialect.split(self._partial + data)
        for request in whole:
            self._answer(request, t)

    def read(self, t: float) -> list[bytes]:
        """What has arrived at the host by ``t``."""
        arrived = []
        while self._coming and self._coming[0][0] <= t:
            arrived.append(self._coming.popleft()[1])
        while self._stream and self._stream[0][0] + self._lag.s <= t:
            arrived.append(self._stream.popleft()[1])
        return arrived

    @property
    def next_arrival(self) -> float:
        coming = self._coming[0][0] if self._coming else math.inf
        return min(coming, self._stream[0][0] + self._lag.s if self._stream else math.inf)

    def _answer(self, request: bytes, t: float) -> None:
        key = self._dialect.key(request)
        found = self._nearest(key, t) if key in self._repeated else self._coming_up(key, t)
        if found is None:
            self._depart(t, request)
        self._newest[key] = found
        self.requests += 1
        for delay, data in self._dialect.anew(found, request):
            if delay <= ANSWER_S:
                self._coming.append((t + delay, data))
            elif key not in self._repeated:
                self._stream.append((found.request.t + delay, data))

    def _coming_up(self, key: bytes, t: float) -> Exchange | None:
        """The next exchange that cannot be left out, if it is this one; time goes on from there."""
        for n in range(self._next, len(self._exchanges)):
            exchange = self._exchanges[n]
            if self._dialect.alike(exchange.key, key):
                self._next = n + 1
                self._lag.s = t - exchange.request.t
                return exchange
            if exchange.key not in self._repeated and not self._replaced_at_once(n):
                break
        return None

    def _replaced_at_once(self, n: int) -> bool:
        now = self._exchanges[n]
        later = next((one for one in self._exchanges[n + 1 :] if one.key not in self._repeated), None)
        if later is None or later.request.t - now.request.t > AT_ONCE_S:
            return False
        return self._dialect.replaces(now.key, later.key)

    def _nearest(self, key: bytes, t: float) -> Exchange | None:
        """Of the exchanges up to the next that cannot be left out, and the newest, that which is nearest in time."""
        then = t - self._lag.s
        best, best_n = self._newest.get(key), self._next
        for n in range(self._next, len(self._exchanges)):
            exchange = self._exchanges[n]
            if exchange.key not in self._repeated:
                break
            if exchange.key == key:
                if best is not None and abs(best.request.t - then) <= abs(exchange.request.t - then):
                    break
                best, best_n = exchange, n + 1
        self._next = best_n
        return best
