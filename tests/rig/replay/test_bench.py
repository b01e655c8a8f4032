"""A log as a bench: `backend = "replay"` in a scene."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from drivers.instruments.zaber.device import ZaberStage
from rig.base.errors import ConfigError
from rig.benchmark.fixtures import LOGS
from rig.cli.app import main
from rig.log.reader import read_log
from rig.replay.bench import ReplayError
from rig.replay.recording import load_recording
from rig.replay.rerun import rerun
from rig.run.backend import open_bench
from rig.scene.scene import load_scene

NO_HV = LOGS / "no-hv"


def replaying(folder: Path, tmp_path: Path, old: str = "", new: str = "") -> Path:
    """The scene of a fixture with its log in place of the simulation."""
    text = (folder / "scene.toml").read_text().split("# The truth.")[0]
    assert old in text
    text = text.replace('"../', f'"{folder}/../').replace(old, new)
    scene = tmp_path / "scene.toml"
    scene.write_text(f'{text}\n[bench]\nbackend = "replay"\nlog = "{folder}/log.mcap"\n')
    return scene


def run(scene, protocol, log):
    return CliRunner().invoke(main, ["run", str(scene), str(protocol), "-o", str(log)])


@pytest.mark.parametrize("name", ["no-hv", pytest.param("paper", marks=pytest.mark.slow)])
def test_the_same_protocol_gives_the_same_samples(tmp_path, name):
    log = tmp_path / "again.mcap"
    done = run(replaying(LOGS / name, tmp_path), LOGS / name / "protocol.toml", log)
    assert done.exit_code == 0, done.output
    then, now = load_recording(LOGS / name / "log.mcap"), load_recording(log)
    assert now.log.metadata["run"]["bench"] == "replay of log.mcap"
    # Who answered, settings, counters and the operator's acts stand in sentences in older logs, in fields today.
    told = {"/event", "/identity", "/setting", "/counter", "/certificate_problem", "/operator"}
    today, recorded = ([(row.topic, row.payload) for row in one.rows if row.topic not in told] for one in (now, then))
    assert today == recorded and len(today) > 1000


def test_another_request_is_refused_with_both_and_the_step(tmp_path):
    protocol = tmp_path / "protocol.toml"
    text = (NO_HV / "protocol.toml").read_text()
    assert "displacement_mm = 11.0" in text
    protocol.write_text(text.replace("displacement_mm = 11.0", "displacement_mm = 10.0"))
    log = tmp_path / "again.mcap"
    done = run(replaying(NO_HV, tmp_path), protocol, log)
    assert done.exit_code == 4
    moves = [
        row.fields["data"]
        for row in load_recording(NO_HV / "log.mcap").rows
        if row.topic == "/raw/stage/tx" and b"move abs" in row.fields["data"]
    ]
    sweep = moves[-3]  # up, down, and back from the film
    assert f"recorded {sweep.hex(' ')}" in done.output
    assert b"move abs".hex(" ") in done.output.split("made ")[1]
    assert "in step 4 (sweep: 0 to 11 mm at 0 V)" in done.output
    assert read_log(log).outcome["status"] == "fault"


def test_a_changed_driver_is_told_by_the_rerun(recorded, monkeypatch):
    monkeypatch.setattr(ZaberStage, "_speed_data", lambda self, speed: round(speed / self._step * 1.6384) + 1)
    found = rerun(recorded("no-hv"))
    departure = found.departure
    assert departure is not None and found.exit_code == 1
    assert departure.role == "stage"
    assert b"set maxspeed" in departure.recorded and b"set maxspeed" in departure.made
    assert departure.recorded != departure.made
    for part in (departure.recorded.hex(" "), departure.made.hex(" "), "in step 3 (approach: advance to contact)"):
        assert part in found.report


def test_a_request_left_out_is_told_by_the_rerun(recorded, monkeypatch):
    monkeypatch.setattr(ZaberStage, "given_back", True)  # and so it is not asked to give anything back
    monkeypatch.setattr(ZaberStage, "close", lambda self: None)
    found = rerun(recorded("no-hv"))
    assert found.exit_code == 1
    assert found.departure.made is None
    assert "made none" in found.report


def test_requests_that_are_late_are_answered_late(recorded):
    """What belongs to a request comes as long after it as it did then."""
    from rig.replay.bench import ReplayBench

    bench = ReplayBench(recorded("no-hv"))
    wire = bench.wire("stage")
    rows = [row for row in recorded("no-hv").rows if row.topic.startswith("/raw/stage")]
    asked, answered = rows[0], rows[1]
    assert (asked.topic, answered.topic) == ("/raw/stage/tx", "/raw/stage/rx")
    wire.host_write(asked.fields["data"], asked.t + 2.0)
    assert wire.host_read(answered.t + 1.999) == b""
    assert wire.host_read(answered.t + 2.0) == answered.fields["data"]
    with pytest.raises(ReplayError, match="request 2 to the stage is not the recorded one"):
        wire.host_write(b"/1 1 0 home\n", 3.0)


def test_a_log_of_other_instruments_is_refused(tmp_path):
    scene = replaying(NO_HV, tmp_path)
    text = scene.read_text()
    laser = text[text.index("[displacement]") : text.index("[bench]")]
    scene.write_text(text.replace(laser, ""))
    with pytest.raises(ConfigError, match=r"recorded with other instruments.*displacement keyence-lkg"):
        open_bench(load_scene(scene)[0])


def test_ports_and_a_log_exclude_each_other(tmp_path):
    scene = replaying(NO_HV, tmp_path, 'driver = "zaber"', 'driver = "zaber"\nport = "/dev/x"')
    text = scene.read_text().replace('driver = "gsv8"', 'driver = "gsv8"\nport = "/dev/y"')
    scene.write_text(text.replace('driver = "keyence-lkg"', 'driver = "keyence-lkg"\nport = "/dev/z"'))
    with pytest.raises(ConfigError, match="leave one out"):
        load_scene(scene)
