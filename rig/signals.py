"""Signals become a request that the engine looks at once a turn; they never interrupt the way to the safe state."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")  # the last two do not exist on Windows


@dataclass
class StopRequest:
    """How often, and by what, the run was asked to end."""

    count: int = 0
    source: str = ""

    def ask(self, source: str) -> None:
        """One more request."""
        self.count += 1
        self.source = source


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Within this context Ctrl-C, SIGTERM and SIGHUP only ask; the first ends the run, further ones hasten it."""
    request = StopRequest()
    numbers = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]

    def handler(number: int, frame: FrameType | None) -> None:
        request.ask("the operator (Ctrl-C)" if number == signal.SIGINT else signal.Signals(number).name)

    before = [(number, signal.signal(number, handler)) for number in numbers]
    try:
        yield request
    finally:
        for number, previous in before:
            signal.signal(number, previous)
