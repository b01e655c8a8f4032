"""Asking an instrument one question at a time, with deadline and retries, and never waiting for the answer.

A *script* is a generator that yields `Ask` and is sent the `Answer`; a set-up dialogue then reads from top to bottom::

    def _set_up(self) -> Script[str, Reply]:
        answer = yield Ask("get resolution")
        self._resolution = whole_number(answer.message)

The device's ``poll(now)`` reads the link, gives each decoded message to `Dialogue.offer`, and calls `Dialogue.run`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Generic, TypeVar

from drivers.heard import Heard
from drivers.links.link import ByteLink, DeviceSilent, FrameLink

Q = TypeVar("Q")
R = TypeVar("R")

# How soon to look again while an answer is outstanding, for loops that cannot wait on the port itself.
LOOK_AGAIN_S = 1e-3

# How soon to look whether a port that was lost is back.
LOST_AGAIN_S = 0.1


def label(name: str, link: ByteLink | FrameLink) -> str:
    """Name of a device for messages, with its port."""
    return name if link.name in ("", name) else f"{name} ({link.name})"


@dataclass(frozen=True, slots=True)
class Ask(Generic[Q]):
    """One request.

    ``repeat`` says that sending it twice does no harm: only then is it retried. ``timeout_s`` overrides the
    dialogue's own. It is sent ``delay_s`` after the step before it. For ``boot_s`` it is sent again and again, to a
    device that may still be starting.
    """

    request: Q
    repeat: bool = True
    timeout_s: float | None = None
    delay_s: float = 0.0
    boot_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Answer(Generic[R]):
    """What came back, with the times of the last transmission and of the arrival."""

    message: R
    sent: float
    received: float

    @property
    def t(self) -> float:
        """Midpoint of request and answer: the best guess of when the instrument looked."""
        return 0.5 * (self.sent + self.received)


Script = Generator[Ask[Q], Answer[R], None]


class Schedule:
    """Times ``period`` apart. Those that were missed are counted in ``counters["polls_missed"]``, not caught up.

    ``due`` is the next time; infinity until `start`.
    """

    def __init__(self, period: float, counters: dict[str, int]) -> None:
        self.due = math.inf
        self._period = period
        self._counters = counters
        counters.setdefault("polls_missed", 0)

    def start(self, now: float) -> None:
        """Due at once, and from then on at the rate."""
        self.due = now

    def take(self, now: float) -> bool:
        """True if a time has come; the next one is due then."""
        if now < self.due:
            return False
        missed = int((now - self.due) / self._period)
        self._counters["polls_missed"] += missed
        self.due += (missed + 1) * self._period
        return True


@dataclass(slots=True)
class _Outstanding(Generic[Q, R]):
    ask: Ask[Q]
    answers: Callable[[R], bool]
    sent: float
    deadline: float
    tries_left: int
    boots_until: float


class Dialogue(Generic[Q, R]):
    """Runs scripts one after the other over one link.

    Parameters
    ----------
    device : str
        Name for error messages.
    send : callable
        ``send(request)`` transmits and returns the test that recognises the answer to *this* transmission, so that a
        late answer to an earlier one is not taken for it where the protocol can tell.
    counters : dict
        The device's counters; gets ``retries``, ``unanswered``, ``round_trips``, ``round_trip_sum_us`` and
        ``round_trip_max_us``.
    timeout_s : float
        How long to wait for each answer.
    retries : int
        How often a repeatable request is sent again.
    describe : callable
        Says a request in words for the error message.
    advice : str
        What the operator should do when the device is silent.
    heard : Heard, optional
        What the device has read; told when an answer is missing.

    A request that stays unanswered throws `DeviceSilent` into its script, which may catch it (to ask for the state
    before a motion command is repeated, say); if it does not, the error leaves through `run`. A script that ends in
    an error is gone; the next one goes on at the next `run`.
    """

    def __init__(
        self,
        device: str,
        send: Callable[[Q], Callable[[R], bool]],
        counters: dict[str, int],
        *,
        timeout_s: float,
        retries: int = 2,
        describe: Callable[[Q], str] = str,
        advice: str = "Check that it is switched on, its cable, and the baud rate.",
        heard: Heard | None = None,
    ) -> None:
        self._device = device
        self._transmit = send
        self._counters = counters
        self._timeout_s = timeout_s
        self._retries = retries
        self._describe = describe
        self._advice = advice
        self._heard = heard or Heard()
        self._queue: deque[Script[Q, R]] = deque()
        self._script: Script[Q, R] | None = None
        self._delayed: tuple[float, Ask[Q]] | None = None
        self._outstanding: _Outstanding[Q, R] | None = None
        for key in ("retries", "unanswered", "round_trips", "round_trip_sum_us", "round_trip_max_us"):
            counters.setdefault(key, 0)

    @property
    def idle(self) -> bool:
        """True when nothing is queued, running or outstanding."""
        return self._script is None and not self._queue

    def next_poll(self, now: float) -> float:
        """When `run` should be called next, given that it was called at ``now``; infinity when idle."""
        if self._outstanding is not None:
            return min(self._outstanding.deadline, now + LOOK_AGAIN_S)
        if self._delayed is not None:
            return self._delayed[0]
        return math.inf if self.idle else now

    def begin(self, script: Script[Q, R]) -> None:
        """Queue a script; it starts at the next `run`, after those before it."""
        self._queue.append(script)

    def clear(self) -> None:
        """Drop the running script and all queued ones. An answer that is still on its way fits nothing any more."""
        if self._script is not None:
            self._script.close()
        self._script = self._delayed = self._outstanding = None
        self._queue.clear()

    def offer(self, message: R, now: float) -> bool:
        """Give a message that arrived at ``now``; False when it answers nothing."""
        out = self._outstanding
        if out is None or not out.answers(message):
            return False
        self._outstanding = None
        self._heard.clear()
        round_trip_us = round((now - out.sent) * 1e6)
        self._counters["round_trips"] += 1
        self._counters["round_trip_sum_us"] += round_trip_us
        self._counters["round_trip_max_us"] = max(self._counters["round_trip_max_us"], round_trip_us)
        answer = Answer(message, out.sent, now)
        self._step(lambda script: script.send(answer), now)
        return True

    def run(self, now: float) -> None:
        """Send what is due and retry or give up what is overdue."""
        out = self._outstanding
        if out is not None and now >= out.deadline:
            self._outstanding = None
            if out.tries_left > 0 or now < out.boots_until:
                self._counters["retries"] += 1
                self._send(out.ask, max(0, out.tries_left - 1), now, out.boots_until)
            else:
                self._counters["unanswered"] += 1
                waited = f" within {out.ask.boot_s:g} s" if out.ask.boot_s else ""
                what = f"no answer to {self._describe(out.ask.request)!r}{waited}{self._heard}"
                self._heard.clear()
                silent = DeviceSilent(self._device, what, self._advice)
                self._step(lambda script: script.throw(silent), now)
        if self._delayed is not None and now >= self._delayed[0]:
            ask, self._delayed = self._delayed[1], None
            self._send(ask, self._retries if ask.repeat else 0, now, now + ask.boot_s)
        while self._script is None and self._queue:
            self._script = self._queue.popleft()
            self._step(next, now)

    def _step(self, resume: Callable[[Script[Q, R]], Ask[Q]], now: float) -> None:
        script = self._script
        assert script is not None
        self._script = None  # so that a script which ends, well or badly, is gone
        try:
            ask = resume(script)
        except StopIteration:
            return
        self._script = script
        if ask.delay_s > 0:
            self._delayed = (now + ask.delay_s, ask)
        else:
            self._send(ask, self._retries if ask.repeat else 0, now, now + ask.boot_s)

    def _send(self, ask: Ask[Q], tries_left: int, now: float, boots_until: float) -> None:
        try:
            answers = self._transmit(ask.request)
        except BaseException:
            self._script = None
            raise
        timeout_s = self._timeout_s if ask.timeout_s is None else ask.timeout_s
        self._outstanding = _Outstanding(ask, answers, now, now + timeout_s, tries_left, boots_until)
