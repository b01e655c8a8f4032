"""Each signal that ends programs becomes a request, the first as the tenth, and only within the context."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from rig.operator.signals import stop_on_signals

# Windows has neither of the last two, and os.kill ends the process there.
pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals are sent as POSIX does it")


@contextmanager
def caught(number: int) -> Iterator[list[int]]:
    """What came through to a handler that was there before."""
    came: list[int] = []
    before = signal.signal(number, lambda number, frame: came.append(number))
    try:
        yield came
    finally:
        signal.signal(number, before)


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("SIGINT", "the operator (Ctrl-C)"),
        ("SIGTERM", "SIGTERM"),
        ("SIGHUP", "SIGHUP"),
        ("SIGQUIT", "SIGQUIT"),
    ],
)
def test_it_asks_every_time_and_only_within(name: str, source: str) -> None:
    number = signal.Signals[name]
    with caught(number) as came:
        with stop_on_signals() as stop:
            for count in (1, 2):
                os.kill(os.getpid(), number)
                assert (stop.count, stop.source) == (count, source)
        assert not came
        os.kill(os.getpid(), number)
        assert came == [number]
