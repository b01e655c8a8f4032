import csv
import math

import pyarrow.parquet
import pytest

from rig.log.errors import LogError
from rig.log.export import export
from rig.log.reader import read_log
from rig.log.writer import LogWriter


@pytest.fixture
def run(tmp_path):
    path = tmp_path / "run.mcap"
    with LogWriter(path) as log:
        for k in range(5):
            ns = k * 10**8
            if k == 1:
                phase = {"step": 2, "kind": "ramp", "label": "=HYPERLINK()", "cycle": 1, "direction": 1}
                log.write("/phase", {"t_s": 0.1, **phase, "voltage_V": 500.0, "record": True}, ns, ns)
            force = {"reading": 0.1, "force_N": math.nan if k == 0 else 0.1 * k, "flags": 4 * (k == 3)}
            log.write("/force/sample", {"t_s": 0.1 * k, **force}, ns, ns)
            laser = {"reading_m": 0.0, "displacement_m": 1e-4 * k, "flags": 0}
            log.write("/displacement/sample", {"t_s": 0.1 * k, **laser}, ns, ns)
        log.write("/raw/force/rx", {"t_s": 0.0, "data": b"\x00=\xff"}, 0, 0)
        log.finish({})
    return path


HEADER = [
    "t_s",
    "displacement_m",
    "force_N",
    "voltage_V",
    "flagged",
    "step",
    "kind",
    "label",
    "cycle",
    "direction",
    "nominal_voltage_V",
    "record",
]


def test_csv_of_the_run(run, tmp_path):
    out = tmp_path / "run.csv"
    assert export(run, out) == 5
    with out.open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0] == HEADER
    assert rows[1] == ["0.0", "0.0", "", "0.0", "0", "-1", "", "", "0", "0", "0.0", "0"]
    assert rows[4][:5] == ["0.30000000000000004", "0.00030000000000000003", "0.30000000000000004", "0.0", "1"]
    assert rows[4][5:8] == ["2", "ramp", "'=HYPERLINK()"]
    assert rows[4][8:] == ["1", "1", "500.0", "1"]


def test_parquet_of_the_run(run, tmp_path):
    assert export(run, tmp_path / "run.parquet") == 5
    table = pyarrow.parquet.read_table(tmp_path / "run.parquet")
    assert table.column_names == HEADER
    assert table["label"].to_pylist() == [""] + ["=HYPERLINK()"] * 4
    assert table["force_N"].to_pylist()[1:] == [0.1 * k for k in range(1, 5)]
    assert math.isnan(table["force_N"].to_pylist()[0])
    assert table["record"].to_pylist() == [False] + [True] * 4


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_one_topic_as_recorded(small, tmp_path, ending, samples):
    out = tmp_path / f"out.{ending}"
    for topic in samples:
        assert export(small, out, topic) == 20
        names = (
            out.read_text().splitlines()[0].split(",")
            if ending == "csv"
            else pyarrow.parquet.read_table(out).column_names
        )
        assert names == list(read_log(small).columns(topic))
        out.unlink()


def test_bytes_are_hexadecimal(run, tmp_path):
    export(run, tmp_path / "raw.csv", "/raw/force/rx")
    assert (tmp_path / "raw.csv").read_text().splitlines() == ["log_ns,publish_ns,t_s,data", "0,0,0.0,003dff"]


def test_what_cannot_be_exported_leaves_nothing(run, tmp_path):
    with pytest.raises(LogError, match=r"Allowed: \.csv and \.parquet"):
        export(run, tmp_path / "run.xlsx")
    with pytest.raises(LogError, match="no log has a topic"):
        export(run, tmp_path / "run.csv", "/force/sampel")
    (tmp_path / "there.csv").write_text("precious")
    with pytest.raises(LogError, match="exists already"):
        export(run, tmp_path / "there.csv")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.mcap", "there.csv"]
