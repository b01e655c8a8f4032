"""Around loss of convexity: one status and one force at every tolerance, in every order, alone or together."""

from __future__ import annotations

import pytest

from model.verification.search import run


@pytest.mark.slow
def test_fifty_states_around_loss_of_convexity() -> None:
    report = run(50, seed=1, truth=0)
    assert report.states == 50
    assert report.differences == []
    assert report.answered > 25
    assert report.unstable > 5  # it is about the end of branches


@pytest.mark.long
def test_few_hundred_states_around_loss_of_convexity_and_some_against_finite_elements() -> None:
    """All of them: ``python -m model.verification.search --states 20000 --truth 500``, some 25 minutes."""
    report = run(400, seed=500, truth=10)
    assert report.followed == 10
    assert report.differences == []
