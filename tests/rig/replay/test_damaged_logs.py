"""Logs that were cut, damaged, or written with another schema: verified as far as they are whole, or refused."""

from __future__ import annotations

from io import BytesIO

import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

from rig.benchmark.fixtures import LOGS
from rig.cli.app import main
from rig.log import schema
from rig.log.errors import LogError
from rig.log.reader import read_log
from rig.log.writer import LogWriter
from rig.replay.recording import load_recording
from rig.replay.rerun import rerun
from rig.replay.verify import verify

NO_HV = LOGS / "no-hv" / "log.mcap"


def replay(*arguments):
    return CliRunner().invoke(main, ["replay", *map(str, arguments)])


def check_part(path, before):
    """All that is left of the no-hv log before a hole is verified, and the hole is told of."""
    recording = load_recording(path)
    found = verify(recording)
    assert found.difference is None and found.exit_code == 3
    whole = read_log(NO_HV).columns("/force/sample")["t_s"]
    assert found.samples["force"] == pytest.approx((whole < found.until).sum(), abs=2)
    assert found.until < before
    again = rerun(recording)
    assert again.departure is None and again.exit_code == 3
    return found, again


def test_cut_anywhere_it_is_verified_up_to_there(tmp_path):
    data = NO_HV.read_bytes()
    cut = tmp_path / "cut.mcap"
    for share in (0.3, 0.6173, 0.9):
        cut.write_bytes(data[: int(share * len(data))])
        found, again = check_part(cut, 11.3 * (share + 0.15))
        assert "no further: it was cut short" in found.report
        assert "the file ends" in found.report
        assert "as far as the log goes" in again.report


def test_after_a_damaged_chunk_nothing_is_verified(tmp_path):
    data = bytearray(NO_HV.read_bytes())
    summary = make_reader(BytesIO(data)).get_summary()
    chunk = summary.chunk_indexes[len(summary.chunk_indexes) // 2]
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0x10
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data)
    gap = read_log(damaged).gaps[0]
    found, _ = check_part(damaged, 8.0)
    assert f"bytes {gap.start} to {gap.end} of the file" in found.report
    assert "something is missing after that" in found.report


def test_exit_codes(tmp_path, monkeypatch):
    good = replay(NO_HV)
    assert good.exit_code == 0
    assert "bit for bit" in good.output and "the same requests" in good.output
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(NO_HV.read_bytes()[:100_000])
    assert replay(cut, "--verify").exit_code == 3
    assert replay(tmp_path / "none.mcap").exit_code == 2
    monkeypatch.setattr("drivers.instruments.zaber.ZaberStage._speed_data", lambda self, speed: 1000)
    different = replay(NO_HV, "--verify", "--rerun")
    assert different.exit_code == 1
    assert different.output.count("DIFFERENT") == 2


@pytest.mark.parametrize(("version", "package"), [(1, "dearig.v1"), (3, "dearig.v3")])
def test_another_schema_version_is_refused(tmp_path, monkeypatch, version, package):
    path = tmp_path / "other.mcap"
    with monkeypatch.context() as patch:
        patch.setattr(schema, "SCHEMA_VERSION", version)
        patch.setattr(schema, "PACKAGE", package)
        for cached in (schema.schema_data, schema._pool, schema._coder):
            cached.cache_clear()
        with LogWriter(path) as log:
            log.write("/raw/stage/rx", {"t_s": 0.0, "data": b"@"}, 1, 1)
            log.finish({"status": "complete"})
    for cached in (schema.schema_data, schema._pool, schema._coder):
        cached.cache_clear()
    with pytest.raises(LogError, match=rf"written with schema version {version}, and this dea-rig reads version 2.*"):
        load_recording(path)
    refused = replay(path)
    assert refused.exit_code == 1
    assert "Read it with the version of dea-rig that wrote it" in refused.output


def test_a_log_without_wires_is_refused(tmp_path):
    path = tmp_path / "bare.mcap"
    with LogWriter(path) as log:
        log.write("/force/sample", {"t_s": 0.0, "reading": 1.0, "force_N": 1.0, "flags": 0}, 1, 1)
        log.finish({"status": "complete"})
    with pytest.raises(LogError, match="holds no bytes of any wire"):
        load_recording(path)


def test_a_log_without_its_scene_is_refused(tmp_path):
    path = tmp_path / "bare.mcap"
    with LogWriter(path) as log:
        log.write("/raw/stage/rx", {"t_s": 0.0, "data": b"@"}, 1, 1)
        log.finish({"status": "complete"})
    assert "no scene.toml inside" in replay(path).output
