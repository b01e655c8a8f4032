"""``dea-rig analyse cycles``: tables out of logs of known cycles; what is lost or there twice is told."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from rig.analysis.cycles import read_cycles
from rig.base.errors import DataError
from rig.cli.app import main
from rig.log.writer import LogWriter

EPOCH = 1_700_000_000_000_000_000


def summary(number: int, t: float, **changes: float | bool) -> dict[str, float | int | bool]:
    """A film that softens by 10 % a decade."""
    stiffness = 20.0 * (1.0 - 0.1 * math.log10(number))
    return {
        "t_s": t, "step": 4, "cycle": number, "whole": True, "kept": number <= 10, "begin_s": t - 1.0, "samples": 100,
        "force_valley_N": 0.0, "force_peak_N": stiffness * 4e-3, "displacement_valley_m": 0.0,
        "displacement_peak_m": 4e-3, "voltage_valley_V": math.nan, "voltage_peak_V": math.nan,
        "current_valley_A": math.nan, "current_peak_A": math.nan, "stiffness_N_per_m": stiffness,
        "actuation_N_per_V2": math.nan, "work_J": 1e-6, "electric_J": math.nan, "leakage_A": math.nan,
        **changes,
    }  # fmt: skip


def a_log(path: Path, numbers: list[int], begin_s: int = 0, short: int | None = None) -> Path:
    """A log with these whole cycles and perhaps one that was cut short."""
    with LogWriter(path) as log:
        log.attach("protocol.toml", "application/toml", b"[[step]]")

        def write(topic: str, t: float, fields: Mapping[str, object]) -> None:
            ns = EPOCH + round((begin_s + t) * 1e9)
            log.write(topic, {**fields, "t_s": t}, ns, ns)

        began = {"step": 4, "kind": "cycle", "label": "", "cycle": 0, "direction": 0, "voltage_V": 0.0, "record": False}
        reference = {"name": "cycle_response", "value": 20.0, "standard_uncertainty": math.nan, "unit": "N/m"}
        write("/phase", 0.0, began)
        write("/reference", 0.5, reference)
        for k, number in enumerate(numbers):
            write("/cycle", 1.0 + k, summary(number, 1.0 + k))
        if short is not None:
            write("/cycle", 1e3, summary(short, 1e3, whole=False))
        log.finish({})
    return path


def test_cycles_of_a_run_and_of_the_one_that_went_on_are_one_table(tmp_path: Path) -> None:
    later = a_log(tmp_path / "a.mcap", list(range(301, 1001)), begin_s=5000)
    first = a_log(tmp_path / "b.mcap", list(range(1, 301)), short=301)
    found = read_cycles([later, first])
    assert found.whole["cycle"].tolist() == list(range(1, 1001)) and len(found.columns["cycle"]) == 1001
    assert not found.missing.size and not found.twice.size and found.reference == 20.0
    assert "1000 whole cycles in 2 logs, 1 to 1000" in found.remarks[0] and found.remarks[1] == "Each is there once."
    assert "1 more were cut short" in found.remarks[2]
    assert (np.diff(found.columns["date_s"]) > 0).all() and found.columns["log"].tolist() == [1] * 301 + [2] * 700


def test_a_cycle_that_is_missing_or_there_twice_is_named(tmp_path: Path) -> None:
    one = a_log(tmp_path / "a.mcap", [1, 2, 4, 5])
    two = a_log(tmp_path / "b.mcap", [5, 6], begin_s=1000)
    found = read_cycles([one, two])
    assert found.missing.tolist() == [3] and found.twice.tolist() == [5]
    assert found.remarks[1:] == ["NOT each is there once.", "1 missing: 3.", "1 there twice: 5."]


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_the_table_is_one_row_a_cycle_and_there_is_a_picture(tmp_path: Path, ending: str) -> None:
    log, out, plot = a_log(tmp_path / "a.mcap", list(range(1, 5001))), tmp_path / f"t.{ending}", tmp_path / "p.png"
    words = ["analyse", "cycles", str(log), "-o", str(out), *(["--plot", str(plot)] if ending == "csv" else [])]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 0, done.output
    assert "5000" in done.output and "63.0 %" in done.output  # 1 - 0.1 lg 5000
    if ending == "csv":
        with out.open() as text:
            rows = list(csv.DictReader(text))
        assert plot.stat().st_size > 10_000
    else:
        import pyarrow.parquet  # type: ignore[import-untyped]

        rows = pyarrow.parquet.read_table(out).to_pylist()
    assert len(rows) == 5000
    assert float(rows[999]["stiffness_N_per_m"]) == pytest.approx(14.0) and int(rows[999]["cycle"]) == 1000


def test_what_is_no_test_of_endurance_is_said(tmp_path: Path) -> None:
    with pytest.raises(DataError, match='step do = "cycle" writes them'):
        read_cycles([a_log(tmp_path / "a.mcap", [])])
    log = a_log(tmp_path / "b.mcap", [1])
    with pytest.raises(DataError, match=r"Step 3 has no cycles\. There are: 4"):
        read_cycles([log], 3)
