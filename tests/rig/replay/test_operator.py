"""What the operator did to a run is done to it again."""

from __future__ import annotations

import contextlib

import pytest

from rig.base.errors import Stopped
from rig.benchmark.fixtures import LOGS
from rig.operator.control import Control
from rig.protocol.experiment import prepare
from rig.replay.recording import load_recording
from rig.replay.rerun import rerun
from rig.replay.verify import verify
from rig.run.resume import prepare_resumed
from rig.run.run import run


class Keys:
    """Lines typed at the bench's own times, in steps of the 50 ms at which the keyboard is looked at."""

    name = "the keyboard"

    def __init__(self, typed):
        self._typed = typed
        self._looks = 0

    def read(self, control):
        self._looks += 1
        return [self._typed[self._looks]] if self._looks in self._typed else []

    def close(self):
        pass


def recorded_with(typed, folder, monkeypatch):
    monkeypatch.setattr("rig.run.run.Control", lambda sources, answers, say, **_: Control([Keys(typed)], answers, say))
    experiment = prepare(LOGS / "no-laser" / "scene.toml", LOGS / "no-laser" / "protocol.toml")
    log = folder / "run.mcap"
    with contextlib.suppress(Stopped):
        run(experiment, log, lambda done, total, label: None)
    return load_recording(log)


@pytest.mark.slow
@pytest.mark.parametrize("steered", [pytest.param(False, marks=pytest.mark.long), True])
def test_a_stop(tmp_path, monkeypatch, steered):
    recording = recorded_with({211: "s"}, tmp_path, monkeypatch)
    assert recording.log.outcome["status"] == "stopped"
    assert verify(recording).exit_code == 0
    found = rerun(recording, steered=steered)
    assert found.exit_code == 0, found.report
    assert found.outcome.reason == recording.log.outcome["reason"]


@pytest.mark.slow
@pytest.mark.parametrize("steered", [False, True])
def test_a_pause_under_voltage(tmp_path, monkeypatch, steered):
    recording = recorded_with({245: "p", 345: "c"}, tmp_path, monkeypatch)
    said = [row.fields["message"] for row in recording.rows if row.topic == "/event"]
    assert any("paused by the keyboard" in message and "1000 V" in message for message in said)
    assert "continues" in said
    assert recording.log.outcome["status"] == "complete"
    assert verify(recording).exit_code == 0
    found = rerun(recording, steered=steered)
    assert found.exit_code == 0, found.report


@pytest.mark.slow
def test_a_run_that_took_up_another_one(tmp_path, monkeypatch):
    with monkeypatch.context() as once:
        recorded_with({211: "s"}, tmp_path, once)
    taken_up = tmp_path / "rest.mcap"
    run(prepare_resumed(tmp_path / "run.mcap"), taken_up, lambda done, total, label: None)
    recording = load_recording(taken_up)
    assert recording.log.metadata["resumed"]["log"] == "run.mcap"
    assert verify(recording).exit_code == 0
    found = rerun(recording)
    assert found.exit_code == 0, found.report
