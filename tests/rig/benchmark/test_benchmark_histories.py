"""Films that take time: the row of the benchmark, and that both formulations come to the same forces."""

from __future__ import annotations

import pytest

from rig.benchmark.histories import OURS, SHOOTING, along_histories, table


@pytest.mark.slow
def test_both_methods_come_to_the_forces_of_an_independent_code_and_ours_is_quicker() -> None:
    rows = along_histories(full=False)
    ours = [row for row in rows if row.method == OURS]
    shot = [row for row in rows if row.method == SHOOTING]
    assert all(row.error < row.tolerance for row in rows)
    assert ours[-1].error < 0.1 * ours[0].error
    assert all(row.seconds < 0.5 * one.seconds for one in shot for row in ours if row.error < one.error)
    assert table(rows).row_count == len(rows)
