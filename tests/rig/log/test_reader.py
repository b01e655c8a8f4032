import math
from pathlib import Path

import numpy as np
import pytest

from rig.log.errors import LogError
from rig.log.reader import read_log
from rig.log.writer import LogWriter


def test_everything_comes_back(small, samples):
    log = read_log(small)
    assert log.whole and log.ended and log.gaps == () and log.missing == {}
    assert log.topics == dict.fromkeys(samples, 20)
    assert log.attachments["scene.toml"].data == b'title = "small"\n'
    assert log.metadata["run"] == {"scene": "small"}
    assert log.outcome == {"reason": "complete"}
    assert (log.end_ns - log.start_ns) == 19 * 40_000_000
    for topic, fields in samples.items():
        messages = list(log.messages(topic))
        assert len(messages) == 20
        for k, message in enumerate(messages):
            assert message.log_ns == message.publish_ns + 7
            assert message.fields == {"t_s": k * 0.04, **fields}


def test_columns_agree_with_messages(small, samples):
    """The fast road (fixed layout, no loop) against the protobuf library, row by row."""
    log = read_log(small)
    tables = log.tables(list(samples))
    for topic in samples:
        columns = tables[topic]
        for k, message in enumerate(log.messages(topic)):
            assert (columns["log_ns"][k], columns["publish_ns"][k]) == (message.log_ns, message.publish_ns)
            assert {name: columns[name][k] for name in message.fields} == message.fields
        for name, column in log.columns(topic).items():
            assert column.dtype == columns[name].dtype
            assert (column == columns[name]).all()


def test_column_types(small):
    log = read_log(small)
    stage, force, phase = log.columns("/stage/sample"), log.columns("/force/sample"), log.columns("/phase")
    assert [stage[n].dtype for n in ("position_m", "moving", "raw_steps")] == [np.float64, np.bool_, np.int64]
    assert force["flags"].dtype == np.uint32
    assert phase["direction"].dtype == np.int32


def test_rows_with_and_without_text_mix(tmp_path):
    """Empty text takes the fast road, other text the slow one; they must end up in the right rows."""
    path = tmp_path / "a.mcap"
    warnings = ["", "WR", "", "", "FQ WR", ""]
    with LogWriter(path) as log:
        for k, warning in enumerate(warnings):
            fields = {"position_m": 0.5 * k, "moving": k % 2 == 0, "referenced": True, "raw_steps": 2**40 + k}
            log.write("/stage/sample", {"t_s": float(k), **fields, "warnings": warning}, k, k)
        log.finish({})
    columns = read_log(path).columns("/stage/sample")
    assert list(columns["warnings"]) == warnings
    assert list(columns["raw_steps"]) == [2**40 + k for k in range(6)]
    assert list(columns["moving"]) == [True, False] * 3
    assert list(columns["position_m"]) == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5]


def test_special_floats(tmp_path):
    path = tmp_path / "a.mcap"
    values = [math.nan, math.inf, -math.inf, -0.0, 5e-324]
    with LogWriter(path) as log:
        for k, value in enumerate(values):
            log.write("/force/sample", {"t_s": 0.0, "reading": value, "force_N": value, "flags": 0}, k, k)
        log.finish({})
    column = read_log(path).columns("/force/sample")["force_N"]
    assert column.tobytes() == np.array(values).tobytes()


def test_a_topic_that_is_not_in_the_log_is_empty(tmp_path):
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        log.write("/event", {"t_s": 0.0, "severity": "info", "source": "x", "message": "y"}, 0, 0)
        log.finish({})
    log = read_log(path)
    assert list(log.messages("/hv/sample")) == []
    columns = log.columns("/hv/sample")
    assert set(columns) == {"log_ns", "publish_ns", "t_s", "voltage_V", "current_A", "setpoint_V", "flags"}
    assert all(column.shape == (0,) for column in columns.values())
    with pytest.raises(LogError, match="no log has a topic /hv/sampel"):
        log.columns("/hv/sampel")


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", "is empty"),
        (b"time,force\n0,1\n", "is not a log"),
        (b"\x89MCAP1\r\n" + bytes(100), "is not a log"),
        (b"\x89MCAP0\r\n", "holds nothing that dea-rig wrote"),
        (b"\x89MCAP0\r\n" + bytes(1000), "holds nothing that dea-rig wrote"),
        (b"\x89MCAP", "is not a log"),
    ],
)
def test_what_is_not_a_log(tmp_path, content, what):
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=what) as caught:
        read_log(path)
    assert str(path) in str(caught.value)


def test_no_file_and_directory(tmp_path):
    with pytest.raises(LogError, match="there is no such file"):
        read_log(tmp_path / "a.mcap")
    with pytest.raises(LogError, match="is not a file"):
        read_log(tmp_path)
    with pytest.raises(LogError, match="cannot be opened"):
        read_log(Path(tmp_path, "x" * 300))


def test_an_unfinished_log(tmp_path):
    """What has reached the file while the writer is still at work."""
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        for k in range(1000):
            log.write("/raw/force/rx", {"t_s": k * 1e-3, "data": b"x"}, k, k)
            log.tick(k * 1e-3)
        part = read_log(tmp_path / "a.mcap.part")
        log.finish({})
    assert not part.ended and not part.whole and part.outcome is None
    assert part.missing == {}
    assert 900 <= part.topics["/raw/force/rx"] < 1000
    assert [gap.reason for gap in part.gaps] == ["the file ends here without its end record"]


def test_another_schema_version_is_refused(small, monkeypatch):
    from rig.log import schema

    fields = schema.CHANNELS["/force/sample"].fields
    changed = schema.Channel("ForceSample", (fields[0], fields[2], fields[1], fields[3]))
    monkeypatch.setitem(schema.CHANNELS, "/force/sample", changed)
    schema.schema_data.cache_clear()
    try:
        with pytest.raises(LogError, match=rf"/force/sample are of another kind .* version {schema.SCHEMA_VERSION}"):
            read_log(small)
    finally:
        monkeypatch.undo()
        schema.schema_data.cache_clear()


def test_a_file_that_changes_between_reading_and_decoding(small):
    log = read_log(small)
    content = bytearray(small.read_bytes())
    content[content.index(b"zstd") + 60] ^= 1  # inside the first chunk
    small.write_bytes(content)
    with pytest.raises(LogError, match="changed while it was read"):
        for topic in log.topics:
            log.columns(topic)
    small.write_bytes(content[: len(content) // 2])
    log = read_log(small)
    small.write_bytes(content[: len(content) // 4])
    with pytest.raises(LogError):
        for topic in log.topics:
            log.columns(topic)
