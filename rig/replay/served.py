"""A log as a bench in real time, where no two runs ask at the same instants.

How often an instrument is asked for its value between two commands is then left to chance. So a request is answered by
its like in the log: a question that the log repeats all the time by that which was asked nearest to the same time since
the last command. Everything else, commands above all, must come as it came then, in the same order. Only motions, which
follow from readings, are given some play: their places by a few steps, and one replaced at once may be missing, or be
made where the log has none.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from typing import NoReturn

from drivers.recorded import Dialect, Exchange, Passed

REPEATED = 20  # a request that stands so often in a log is a question that is asked all the time
AT_ONCE_S = 0.05  # a motion replaced so soon may as well not have begun: it is left to chance which reading came first
ANSWER_S = 0.5  # what comes later after a request comes by itself


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
            if refusal := self._dialect.unknown(request):
                self._coming.append((t, refusal))
                return
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
                return self._to_be_replaced(key, exchange, t)
        return None

    def _to_be_replaced(self, key: bytes, coming: Exchange, t: float) -> Exchange | None:
        """For a motion that the log does not have, since it would have been replaced at once: the newest one it has."""
        if abs(coming.request.t + self._lag.s - t) > AT_ONCE_S or not self._dialect.replaces(key, coming.key):
            return None
        before = (one for one in reversed(self._exchanges[: self._next]) if one.key not in self._repeated)
        return next((one for one in before if self._dialect.replaces(one.key, coming.key)), None)

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
