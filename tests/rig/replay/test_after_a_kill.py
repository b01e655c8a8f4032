"""A run that takes up what a killed one had left changed in stage and amplifier: it is the same when run again."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from rig.base.clock import RealClock
from rig.benchmark.fixtures import LOGS
from rig.replay.recording import load_recording
from rig.replay.rerun import rerun
from tests.rig.replay.test_real_time import DRIVERS, dea_rig, served

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")]

PROTOCOL = """
[[step]]
do = "home"
[[step]]
do = "zero"
"""
WAIT_S = 120.0
HOMING_S = 3.0  # a stage changes its settings when it is first moved


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Scene and protocol; what runs keep for the next is in a directory of this test."""
    own = tmp_path / "own"
    own.mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(own))
    fixture = LOGS / "no-hv"
    text = (fixture / "scene.toml").read_text().replace('"../', f'"{fixture}/../')
    for driver in DRIVERS:
        text = text.replace(f'driver = "{driver}"', f'driver = "{driver}"\ntimeout_s = 2.0')
    scene, protocol = tmp_path / "scene.toml", tmp_path / "protocol.toml"
    scene.write_text(text)
    return scene, protocol


def kept(own: Path) -> dict[Path, str]:
    return {path: path.read_text() for role in ("stage", "force") for path in own.rglob(f"{role}-*.json")}


def test_a_run_after_a_kill_is_replayed_and_leaves_the_files_of_runs_alone(
    places: tuple[Path, Path], tmp_path: Path
) -> None:
    scene, protocol = places
    with served(scene, tmp_path) as ports:

        def start(log: str, zero_s: float):  # type: ignore[no-untyped-def] # a Popen of text
            protocol.write_text(PROTOCOL + f"duration_s = {zero_s:g}\n")
            words = ("run", scene, protocol, "-o", tmp_path / log, "--ports", ports, "--yes")
            return dea_rig(*words)

        killed, clock = start("killed.mcap", 60.0), RealClock()
        while len(kept(tmp_path / "own")) < 2:
            assert killed.poll() is None, killed.communicate()
            assert clock.now() < WAIT_S
            time.sleep(0.05)
        time.sleep(HOMING_S)
        killed.send_signal(signal.SIGKILL)
        killed.communicate()
        left = kept(tmp_path / "own")
        assert left
        second = start("second.mcap", 0.5)
        _, errors = second.communicate(timeout=WAIT_S)
    recording = load_recording(tmp_path / "second.mcap")
    taken = [
        row.fields for row in recording.rows if row.topic == "/command" and row.fields["command"] == "resume_found"
    ]
    assert taken, errors
    assert "given back after this one" in "".join(m.fields["message"] for m in recording.log.messages("/event"))
    assert not kept(tmp_path / "own")
    for path, text in left.items():  # as if a real run were going on
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    found = rerun(recording)
    assert found.exit_code == 0, found.report
    assert kept(tmp_path / "own") == left  # a replay keeps nothing and takes nothing away
