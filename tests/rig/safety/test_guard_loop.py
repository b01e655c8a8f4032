"""How long the guard's loop waits: until an instant at which something is due, and without haste for what failed."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

from drivers.dialogue import LOOK_AGAIN_S
from rig.safety import process
from rig.safety.guard import GuardState
from rig.safety.process import Server

NOW = 100.0


def waits(
    monkeypatch: pytest.MonkeyPatch, *, alive: float, look: float, polled: float, wish: float = math.inf
) -> float:
    """How long it waits, the supply polled at ``polled``, a sign of life due at ``alive``, the film at ``look``."""
    return sum(seconds for _, seconds in waits_for(monkeypatch, alive=alive, look=look, polled=polled, wish=wish))


def waits_for(
    monkeypatch: pytest.MonkeyPatch,
    *,
    alive: float,
    look: float,
    polled: float,
    wish: float = math.inf,
    trip: float = 0.0,
) -> list[tuple[int, float]]:
    """On how many ends it waits, and how long; one is the engine's channel, the second the link of the supply.

    Answers of the supply have taken ``trip`` seconds.
    """
    asked: list[tuple[int, float]] = []

    def select(ends: Any, _w: Any, _x: Any, seconds: float) -> tuple[list[Any], list[Any], list[Any]]:
        asked.append((len(ends), seconds))
        return [], [], []

    server: Any = object.__new__(Server)
    server._clock = SimpleNamespace(now=lambda: NOW + sum(seconds for _, seconds in asked))
    server._words = SimpleNamespace(speak=lambda: True)
    server._tick_log = lambda now: None
    server._channel = SimpleNamespace(closed=False, flush=lambda: None)
    server._guard = SimpleNamespace(next_look=look, commanded=True, state=GuardState.LIVE, output_is_safe=False)
    server._supply = SimpleNamespace(next_poll=wish)
    server._expected = SimpleNamespace(after=lambda polled, awaits: polled + trip)
    server._polled_at, server._next_alive, server._descriptor = polled, alive, 3
    monkeypatch.setattr(process.select, "select", select)
    server._wait()
    return asked


@pytest.mark.parametrize(
    ("alive", "look", "wish", "seconds"),
    [
        (0.012, 0.03, math.inf, 0.012),
        (0.012, 0.007, math.inf, 0.007),
        (0.012, 0.03, 0.002, 0.002),
        (-0.5, 0.03, math.inf, process.LONGEST_TURN_S),  # overdue: a link that is gone fails turn after turn
        (0.012, -math.inf, math.inf, process.LONGEST_TURN_S),
        (0.012, 0.03, math.nan, 0.012),
        (0.012, 0.03, -math.inf, process.SHORTEST_TURN_S),
    ],
)
def test_it_waits_until_something_is_due_and_does_not_hurry_for_what_is_overdue(
    monkeypatch: pytest.MonkeyPatch, alive: float, look: float, wish: float, seconds: float
) -> None:
    found = waits(monkeypatch, alive=NOW + alive, look=NOW + look, polled=NOW - 0.01, wish=NOW + wish)
    assert found == pytest.approx(seconds, abs=1e-9)


def test_what_comes_unasked_is_read_no_sooner_than_five_milliseconds_after_the_last(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = waits_for(monkeypatch, alive=NOW + 0.02, look=NOW + 0.03, polled=NOW - 0.002)
    assert [ends for ends, _ in found] == [1, 2]
    assert [seconds for _, seconds in found] == pytest.approx([0.003, 0.017], abs=1e-9)


def test_an_answer_is_looked_for_no_sooner_than_answers_come(monkeypatch: pytest.MonkeyPatch) -> None:
    """The acknowledgement of an adapter, which comes before it, is read with it."""
    for polled, waits in ((NOW - 0.001, [0.003, 0.006]), (NOW - 0.005, [0.005])):
        wish = polled + LOOK_AGAIN_S
        found = waits_for(monkeypatch, alive=NOW + 0.02, look=NOW + 0.03, polled=polled, wish=wish, trip=0.004)
        assert [ends for ends, _ in found] == [1, 2][2 - len(waits) :]
        assert [seconds for _, seconds in found] == pytest.approx(waits, abs=1e-9)
