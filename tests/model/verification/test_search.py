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


@pytest.mark.slow
def test_fifty_states_around_loss_of_convexity() -> None:
    assert_agreed(run(50, seed=1, truth=0), 50)


@pytest.mark.long
def test_few_states_around_loss_of_convexity_disagree() -> None:
    """The whole search is a command that takes a day:
    ``python -m model.verification.search --states 20000 --truth 500``.

    Known today: of 350 states one force differs, by 2.1 stated errors; of 250 others two. None
    disagrees with the finite elements, which is what must never happen.
    """
    report = run(150, seed=500, truth=3)
    assert report.states == 150
    assert len(report.statuses) + len(report.forces) <= 3
    assert report.truth == []
