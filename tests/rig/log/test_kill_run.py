"""In the middle of a whole ``dea-rig run`` over pseudo-terminals: kill -9 of the engine, of the writer; a full disk."""

import os
import random
import resource
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from drivers.instruments.gsv8.codec import Decoder, Measured
from rig.benchmark.rates import FORCE_HZ, scene_text
from rig.log.reader import read_log
from rig.log.recover import recover

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform != "linux", reason="looks processes up in /proc")]
SOON_NS = 2 * 10**9  # the exact bounds are tested with an engine that keeps account
SHORT = Path(str(files("sim_fixtures"))) / "protocols" / "short.toml"


DEA_RIG = [sys.executable, "-m", "rig"]
TRIES = 3


@contextmanager
def under_voltage(folder):
    """A run that has come to 800 V, and its unfinished log; or, when the run gave up before, None and what it said."""
    folder.mkdir()
    scene, protocol, ports, log = (folder / name for name in ("scene.toml", "short.toml", "ports.json", "run.mcap"))
    scene.write_text(scene_text())
    assert "[0, 800]" in SHORT.read_text()
    protocol.write_text(SHORT.read_text().replace("[0, 800]", "[800]"))
    bench = subprocess.Popen([*DEA_RIG, "sim", scene], stdout=subprocess.PIPE, text=True)
    ports.write_text(bench.stdout.readline())
    arguments = ["run", scene, protocol, "-o", log, "--ports", ports, "--arm", "--yes"]
    run = subprocess.Popen([*DEA_RIG, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        said = []
        for line in run.stderr:
            said.append(line)
            if "800 V" in line and "sweep: 0 to" in line:
                yield run, log.with_name("run.mcap.part")
                break
        else:
            yield None, said
    finally:
        for process in (run, bench):
            process.terminate()
            process.communicate(timeout=30)


@pytest.fixture
def run(tmp_path, request):
    """A run with 800 V on, at an instant that differs. Guard and drivers give up, rightly, on a machine too busy."""
    reasons = []
    for n in range(TRIES):
        with under_voltage(tmp_path / str(n)) as (run, found):
            if run is not None:
                time.sleep(random.Random(request.param).uniform(0.0, 1.0))
                yield run, found
                return
            reasons.append(found)
    raise AssertionError(f"no run got there: {reasons}")


def writer_of(part):
    """The process that writes the log."""
    for process in Path("/proc").iterdir():
        if process.name.isdigit() and process.name != str(os.getpid()):
            words = (process / "cmdline").read_bytes().split(b"\0")
            if b"rig.log.server" in words and str(part)[:-5].encode() in words:
                return int(process.name)
    raise AssertionError("nobody writes the log")


def check_samples(log):
    """Every force sample is one that stands in the recorded bytes, in their order, and next to none is missing."""
    samples = log.columns("/force/sample")
    decoder, sent = Decoder(), []
    for data in log.columns("/raw/force/rx")["data"]:
        sent += [frame.values[0] for frame in decoder.feed(data) if isinstance(frame, Measured)]
    rest = iter(sent)
    assert all(reading in rest for reading in samples["reading"])
    assert log.missing == {}
    # of the bytes that are there, only those of the last turns may be without their samples
    assert len(list(rest)) <= 0.3 * FORCE_HZ
    assert (np.diff(samples["t_s"]) > 0).all()


@pytest.mark.parametrize("run", [1, pytest.param(2, marks=pytest.mark.long)], indirect=True)
def test_kill_of_the_engine(run):
    engine, part = run
    writer = writer_of(part)
    killed_ns = time.time_ns()
    engine.send_signal(signal.SIGKILL)
    end = time.monotonic() + 30
    while Path(f"/proc/{writer}").exists() and "Z" not in Path(f"/proc/{writer}/stat").read_text().rsplit(")")[1]:
        assert time.monotonic() < end, "the writer lives on without producers"
        time.sleep(0.05)
    log = read_log(part)
    assert log.ended and log.gaps == () and log.outcome is None and "cut" in log.metadata
    assert log.end_ns > killed_ns - SOON_NS
    check_samples(log)
    assert recover(part, part.with_name("saved.mcap")).exit_code == 3


@pytest.mark.parametrize("run", [3], indirect=True)
def test_kill_of_the_writer(run):
    engine, part = run
    killed_ns = time.time_ns()
    os.kill(writer_of(part), signal.SIGKILL)
    _, err = engine.communicate(timeout=60)
    assert engine.returncode == 4, err
    assert "the process that writes the log has ended" in err and "high voltage off, measured" in err
    log = read_log(part)
    assert not log.ended and log.gaps[-1].reason.startswith("the file ends")
    assert log.end_ns > killed_ns - SOON_NS
    check_samples(log)
    assert recover(part, part.with_name("saved.mcap")).exit_code == 3


@pytest.mark.parametrize("run", [4], indirect=True)
def test_a_disk_that_takes_nothing_more(run):
    engine, part = run
    most = part.stat().st_size + 3000
    resource.prlimit(writer_of(part), resource.RLIMIT_FSIZE, (most, most))
    _, err = engine.communicate(timeout=60)
    assert engine.returncode == 4, err
    assert "writing failed (File too large)" in err and "high voltage off, measured" in err
    log = read_log(part)
    assert [gap.reason for gap in log.gaps] == ["the file ends here without its end record"]
    check_samples(log)
