"""Runs in real time, through real ports, with guard and log in processes of their own: they too can be replayed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import contextmanager

import pytest

from rig.replay.fixtures import LOGS
from rig.replay.recording import load_recording
from rig.replay.rerun import rerun
from rig.replay.verify import verify

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX"),
    pytest.mark.timeout(300),
]
DRIVERS = ("zaber", "gsv8", "iseg-edcp")


def dea_rig(*arguments):
    command = [sys.executable, "-m", "rig", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@contextmanager
def served(scene, folder):
    """The file with the ports at which ``dea-rig sim`` serves the scene."""
    with dea_rig("sim", scene) as bench:
        try:
            ports = folder / "ports.json"
            ports.write_text(bench.stdout.readline())
            yield ports
        finally:
            bench.terminate()
            bench.wait(20)


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """A run of the fixture without a laser, at two voltages, in real time."""
    folder = tmp_path_factory.mktemp("real")
    fixture = LOGS / "no-laser"
    text = (fixture / "scene.toml").read_text().replace('"../', f'"{fixture}/../')
    for driver in DRIVERS:  # patience with a busy machine
        text = text.replace(f'driver = "{driver}"', f'driver = "{driver}"\ntimeout_s = 2.0')
    scene, log = folder / "scene.toml", folder / "run.mcap"
    scene.write_text(text)
    with served(scene, folder) as ports:
        assert set(json.loads(ports.read_text())) == {"stage", "force", "hv"}
        arguments = ("run", scene, fixture / "protocol.toml", "-o", log, "--ports", ports, "--arm", "--yes")
        run = dea_rig(*arguments)
        _, errors = run.communicate(timeout=200)
    assert run.returncode == 0, errors
    return load_recording(log)


def test_every_sample_comes_out_of_its_bytes_again(real):
    found = verify(real)
    assert found.exit_code == 0, found.report
    assert found.samples == {role: real.log.topics[f"/{role}/sample"] for role in ("stage", "force", "hv")}


def test_the_run_asks_the_same_again_and_ends_the_same(real):
    assert not real.in_virtual_time
    found = rerun(real)
    assert found.exit_code == 0, found.report
    assert found.outcome.status == "complete" and found.outcome.safe
    for role in ("stage", "force"):  # the guard polls on until it is dismissed
        assert found.requests[role] == real.log.topics[f"/raw/{role}/tx"]
