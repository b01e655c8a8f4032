"""Engines killed at many instants of their runs: nothing else runs beside them, for these are six at a time already."""

import os
from pathlib import Path

import pytest

from rig.benchmark.safety import kill_many

KILLED_S = 0.5  # ten times what is required: a busy machine must not fail it


@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")
@pytest.mark.slow
@pytest.mark.timeout(840)
def test_engine_killed_at_200_random_instants(tmp_path: Path) -> None:
    row = kill_many(tmp_path, 200, at_once=6, seed=1)
    assert len(row.ms) + row.without == 200
    assert len(row.ms) > 30  # so many had voltage on, or on its way
    assert row.never == 0
    assert row.quantile(0.5) < 1e3 * KILLED_S
    assert max(row.ms) < 1e3 * 4 * KILLED_S
