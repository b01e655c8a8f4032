"""What the benchmark of safety makes of its times; the times themselves are measured over real processes elsewhere."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from rich.console import Console

from rig.benchmark.safety import (
    ALLOWED_MS,
    BACK,
    BEATS,
    KILLED,
    MODEL,
    Report,
    Row,
    _keep,
    _kept,
    model_answers,
    render,
    save,
)
from rig.benchmark.stand import Stand


def test_the_report_tells_what_never_went_off(tmp_path: Path) -> None:
    rows = [Row(KILLED, [10.0, 20.0, 60.0], without=2, never=1, loads=[3.0]), Row(BEATS, [20.0, 21.0]), Row(MODEL)]
    report = Report(False, rows, {"processors": "2"})
    assert rows[0].quantile(0.5) == 20.0 and math.isnan(rows[2].quantile(0.5))
    save(report, tmp_path / "out")
    written = json.loads((tmp_path / "out" / "safety.json").read_text())
    assert written["rows"][0] == {
        "what": KILLED,
        "ms": [10.0, 20.0, 60.0],
        "without": 2,
        "never": 1,
        "loads": [3.0],
        "runs": 0,
    }
    assert written["allowed_ms"][KILLED] == 50.0
    assert (tmp_path / "out" / "safety.png").read_bytes().startswith(b"\x89PNG")
    console = Console(width=120, record=True, file=(tmp_path / "shown").open("w"))
    console.print(render(report))
    line = next(line for line in console.export_text().splitlines() if KILLED in line)
    assert [cell.strip() for cell in line.strip("│ ").split("│")] == [
        KILLED,
        "3",
        "2",
        "20",
        "56",
        "60",
        "50",
        "1",
        "3.0",
    ]
    console.file.close()


def test_what_was_measured_before_it_was_broken_off_is_kept(tmp_path: Path) -> None:
    numbers, rows = {KILLED: 3, BACK: 2}, [Row(KILLED, [10.0], loads=[1.0], runs=1), Row(BACK)]
    _keep(tmp_path / "parts.json", numbers, rows)
    assert _kept(tmp_path / "parts.json", numbers) == rows
    fresh = [Row(KILLED), Row(BACK)]
    assert _kept(tmp_path / "parts.json", {KILLED: 4, BACK: 2}) == [Row(KILLED), Row(BACK)]
    (tmp_path / "parts.json").write_text("[1")
    assert _kept(tmp_path / "parts.json", numbers) == _kept(tmp_path / "none.json", numbers) == fresh


def test_the_model_answers_the_guard_within_its_budget(tmp_path: Path) -> None:
    """Processor time, so that others on the machine do not count; a generous multiple all the same."""
    with Stand(tmp_path) as stand:
        row = model_answers(stand, 50)
    assert len(row.ms) == 50
    assert row.quantile(0.5) < 2 * ALLOWED_MS[MODEL]


def test_the_scene_of_the_runs_is_still_that_of_the_examples(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rig.benchmark.stand.CHANGES", {"no such key": ""})
        with pytest.raises(ValueError, match="no such key"):
            Stand(tmp_path)
