"""When an answer may come, learned from those before it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rig.safety.expected import FORGETS_S, SOONEST_PART, Expected


class Asked:
    """A device that is asked again as soon as it has answered, by a loop that polls it in between as well."""

    def __init__(self) -> None:
        self.device: Any = SimpleNamespace(counters={})
        self.expected = Expected(self.device)
        self.t = 0.0
        self.soonest = self.expected.after(self.t, awaits=True)

    def trip(self, seconds: float) -> None:
        self.expected.after(self.t + 0.5 * seconds, awaits=True)  # nothing came
        self.t += seconds
        self.device.counters["round_trips"] = self.device.counters.get("round_trips", 0) + 1
        self.soonest = self.expected.after(self.t, awaits=True)

    @property
    def expected_after(self) -> float:
        return self.soonest - self.t


def test_an_answer_is_expected_at_once_until_it_is_known_how_long_one_takes() -> None:
    asked = Asked()
    assert asked.expected_after == 0.0
    asked.trip(0.008)
    assert 0.0 < asked.expected_after <= FORGETS_S


def test_it_is_expected_a_little_before_the_soonest_of_late() -> None:
    asked = Asked()
    for _ in range(100):
        asked.trip(0.005)
        asked.trip(0.008)
    assert asked.expected_after == pytest.approx(SOONEST_PART * (0.005 + FORGETS_S))


def test_a_device_that_becomes_faster_is_looked_for_sooner_and_sooner() -> None:
    asked = Asked()
    for _ in range(100):
        asked.trip(0.008)
    for _ in range(20):  # it would answer at once, and is seen as soon as it is looked for
        asked.trip(max(asked.expected_after, 0.001))
    assert asked.expected_after <= 0.0012


def test_the_time_in_which_nothing_was_asked_counts_for_nothing() -> None:
    asked = Asked()
    for _ in range(100):
        asked.trip(0.005)
    asked.device.counters["round_trips"] += 1
    answered = asked.t + 0.005
    asked.expected.after(answered, awaits=False)
    asked.expected.after(answered + 1.0, awaits=False)
    asked.t = answered + 2.0
    asked.soonest = asked.expected.after(asked.t, awaits=True)
    assert asked.expected_after == pytest.approx(SOONEST_PART * 0.005)
