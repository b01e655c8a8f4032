"""Estimates held to the truth over random films, against a formulation that the solver has nothing in common with."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

_spec = importlib.util.spec_from_file_location("films", Path(__file__).with_name("films.py"))
assert _spec is not None
assert _spec.loader is not None
films = importlib.util.module_from_spec(_spec)
sys.modules["films"] = films
_spec.loader.exec_module(films)


def test_errors_are_below_their_estimates() -> None:
    cases = films.random_cases(6, seed=5)
    films.assert_honest(cases, (1e-6, 1e-9), "plain")


@pytest.mark.parametrize(
    "count",
    [
        pytest.param(16, marks=pytest.mark.slow),
        pytest.param(520, marks=[pytest.mark.long, pytest.mark.timeout(1200)]),
    ],
)
@pytest.mark.parametrize("wrinkling", ["plain", "tension_field"])
def test_errors_of_many_films_are_below_their_estimates(wrinkling: str, count: int) -> None:
    cases = films.random_cases(count, seed=1)
    films.assert_honest(cases, (1e-6, 1e-8, 1e-10), wrinkling)
