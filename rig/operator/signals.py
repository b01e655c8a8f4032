"""Signals become a request that the engine looks at once a turn; they never interrupt the way to the safe state."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

_STOPPING = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")  # the last two do not exist on Windows
# A process in the background that reads or writes its terminal is stopped by these; a run must never stand still.
_IGNORED = ("SIGTTIN", "SIGTTOU")


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
def stop_on_signals(
    request: StopRequest | None = None, pause: Callable[[str], None] | None = None
) -> Iterator[StopRequest]:
    """Within this context Ctrl-C, SIGTERM and SIGHUP only ask; the first ends the run, further ones hasten it.

    With ``pause`` Ctrl-Z asks for a pause in place of stopping the process: a process that stands still with voltage
    on watches nothing.
    """
    request = StopRequest() if request is None else request

    def stop(number: int, frame: FrameType | None) -> None:
        request.ask("the operator (Ctrl-C)" if number == signal.SIGINT else signal.Signals(number).name)

    handlers: dict[str, object] = dict.fromkeys(_STOPPING, stop)
    if pause is not None:
        handlers |= dict.fromkeys(_IGNORED, signal.SIG_IGN)
        handlers["SIGTSTP"] = lambda number, frame: pause("the operator (Ctrl-Z)")
    before = [
        (number, signal.signal(number, handler))  # type: ignore[arg-type] # a function or SIG_IGN
        for name, handler in handlers.items()
        if (number := getattr(signal, name, None)) is not None
    ]
    try:
        yield request
    finally:
        for number, previous in before:
            signal.signal(number, previous)
