"""Engines killed at many instants of their runs: nothing else runs beside them, three at a time as they are."""

import os
from pathlib import Path

import pytest

from rig.benchmark.safety import kill_many

KILLED_S = 0.5  # ten times what is required: a busy machine must not fail it


@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")
@pytest.mark.parametrize(
    ("number", "live"),
    [
        pytest.param(6, 1, marks=[pytest.mark.slow, pytest.mark.timeout(840)]),
        pytest.param(200, 80, marks=[pytest.mark.long, pytest.mark.timeout(3600)]),
    ],
)
def test_engine_killed_at_random_instants(tmp_path: Path, number: int, live: int) -> None:
    row = kill_many(tmp_path, number, at_once=3, seed=1)
    assert len(row.ms) + row.without == number
    assert len(row.ms) > live  # so many had voltage on, or on its way
    assert row.never == 0
    assert row.quantile(0.5) < 1e3 * KILLED_S
    assert max(row.ms) < 1e3 * 4 * KILLED_S
