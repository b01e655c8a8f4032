"""Around loss of convexity: one status and one force at every tolerance, in every order, alone or together."""

from __future__ import annotations

import pytest

from model.verification.search import Report, run


def assert_agreed(report: Report, states: int) -> None:
    assert report.states == states
    assert report.statuses == []
    assert report.forces == []
    assert report.truth == []
    assert report.answered > 0.5 * states
    assert report.unstable > 0.1 * states  # it is about the end of branches


def test_fifty_states_around_loss_of_convexity() -> None:
    assert_agreed(run(50, seed=1, truth=0), 50)


@pytest.mark.slow
@pytest.mark.timeout(24 * 3600)
def test_twenty_thousand_states_around_loss_of_convexity() -> None:
    assert_agreed(run(20000, seed=100, truth=500), 20000)
