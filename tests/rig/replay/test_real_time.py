"""Runs in real time, through real ports, with guard and log in processes of their own: they too can be replayed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from contextlib import contextmanager

import pytest

from rig.benchmark.fixtures import LOGS
from rig.replay.recording import load_recording
from rig.replay.rerun import rerun
from rig.replay.verify import verify

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX"),
    pytest.mark.timeout(300),
]
DRIVERS = ("zaber", "gsv8", "keyence-lkg", "iseg-edcp")


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


@pytest.fixture(scope="module", params=["no-hv", "no-laser"])
def real(request, tmp_path_factory):
    """A fixture's run in real time: one without high voltage, and one with a guard in a process of its own."""
    for _ in range(3):  # a machine that holds up the engine for longer than the guard bears ends a run, as it should
        real = recorded(request.param, tmp_path_factory.mktemp("real"))
        if real.log.outcome["status"] == "complete":
            break
    return real


def recorded(name, folder):
    fixture = LOGS / name
    text = (fixture / "scene.toml").read_text().replace('"../', f'"{fixture}/../')
    for driver in DRIVERS:  # patience with a busy machine
        text = text.replace(f'driver = "{driver}"', f'driver = "{driver}"\ntimeout_s = 2.0')
    scene, log = folder / "scene.toml", folder / "run.mcap"
    scene.write_text(text)
    protocol = folder / "protocol.toml"
    protocol.write_text((fixture / "protocol.toml").read_text().replace("[0, 1000]", "[1000]"))  # one way up and down
    with served(scene, folder) as ports:
        arguments = ("run", scene, protocol, "-o", log, "--ports", ports, "--arm", "--yes")
        run = dea_rig(*arguments)
        _, errors = run.communicate(timeout=200)
    assert log.exists(), errors
    recording = load_recording(log)
    assert not recording.in_virtual_time
    return recording


def test_every_sample_comes_out_of_its_bytes_again(real):
    found = verify(real)
    assert found.exit_code == 0, found.report
    assert found.samples == {role: real.log.topics[f"/{role}/sample"] for role in found.samples}


def test_the_run_asks_the_same_again_and_ends_the_same(real):
    assert real.log.outcome["status"] == "complete"
    found = rerun(real)
    assert found.exit_code == 0, found.report
    assert found.outcome.status == "complete" and found.outcome.safe
    for role in found.requests.keys() - {"hv"}:  # the guard polls on until it is dismissed
        assert found.requests[role] == real.log.topics[f"/raw/{role}/tx"]


def on_its_log(name, folder):
    """The scene of a fixture with its log in place of the simulation, for ports."""
    fixture = LOGS / name
    text = (fixture / "scene.toml").read_text().split("# The truth.")[0].replace('"../', f'"{fixture}/../')
    for driver in DRIVERS:
        text = text.replace(f'driver = "{driver}"', f'driver = "{driver}"\ntimeout_s = 2.0')
    scene = folder / "scene.toml"
    scene.write_text(f'{text}\n[bench]\nbackend = "replay"\nlog = "{fixture}/log.mcap"\n')
    return scene


def test_a_log_served_on_ports_stands_in_for_the_bench(tmp_path):
    """The whole run, in real time, on what the instruments said then."""
    scene, log = on_its_log("no-hv", tmp_path), tmp_path / "run.mcap"
    with served(scene, tmp_path) as ports:
        run = dea_rig("run", scene, LOGS / "no-hv" / "protocol.toml", "-o", log, "--ports", ports)
        _, errors = run.communicate(timeout=200)
    assert run.returncode == 0, errors
    then, now = load_recording(LOGS / "no-hv" / "log.mcap").log, load_recording(log).log
    assert set(now.columns("/force/sample")["reading"]) <= set(then.columns("/force/sample")["reading"])
    # A reply may have become a sample now and none then: it came between two requests.
    wire = b"".join(bytes(m.fields["data"]) for m in then.messages("/raw/stage/rx"))
    said = {int(number) for number in re.findall(rb" (-?\d+)(?::|\r)", wire)}
    assert set(now.columns("/stage/sample")["raw_steps"].tolist()) <= said
    assert now.topics["/force/sample"] == pytest.approx(then.topics["/force/sample"], rel=0.2)
    references = [{m.fields["name"]: m.fields["value"] for m in one.messages("/reference")} for one in (then, now)]
    assert references[1]["contact_position"] == pytest.approx(references[0]["contact_position"], abs=5e-6)


def test_another_protocol_on_a_served_log_is_told_at_the_server(tmp_path):
    scene, protocol, log = on_its_log("no-hv", tmp_path), tmp_path / "protocol.toml", tmp_path / "run.mcap"
    text = (LOGS / "no-hv" / "protocol.toml").read_text()
    protocol.write_text(text.replace("speed_mm_per_s = 2.0", "speed_mm_per_s = 3.0"))  # of the approach
    with dea_rig("sim", scene) as bench:
        ports = tmp_path / "ports.json"
        ports.write_text(bench.stdout.readline())
        run = dea_rig("run", scene, protocol, "-o", log, "--ports", ports)
        _, errors = run.communicate(timeout=200)
        _, told = bench.communicate(timeout=30)
    assert run.returncode == 4 and "stage" in errors
    assert bench.returncode == 4
    assert "is not the recorded one" in told and "in step 3 (approach: advance to contact)" in told
    assert b"set maxspeed".hex(" ") in told.split("recorded ")[2] and b"set maxspeed".hex(" ") in told.split("made ")[1]
