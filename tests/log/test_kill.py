"""kill -9 of a process that writes a log in real time."""

import random
import signal
import subprocess
import sys

import pytest

from rig.clock import RealClock
from rig.log.reader import read_log

WRITE = """
import sys
from pathlib import Path
from rig.clock import RealClock
from rig.log.writer import LogWriter

clock = RealClock()
with LogWriter(Path(sys.argv[1])) as log:
    k = 0
    while True:
        ns = clock.epoch_ns(k * 1e-3)
        log.write("/force/sample", {"t_s": k * 1e-3, "reading": float(k), "force_N": -k, "flags": 0}, ns, ns)
        log.tick(clock.now())
        k += 1
        sys.stdout.buffer.write(k.to_bytes(4, "little"))  # what had been handed to the log
        sys.stdout.buffer.flush()
        clock.sleep_until(k * 1e-3)
"""


def kill_at(path, delay):
    """Kill a writer of 1000 messages a second after ``delay``: messages handed over, and the log left behind."""
    clock = RealClock()
    with subprocess.Popen([sys.executable, "-c", WRITE, path], stdout=subprocess.PIPE) as process:
        process.stdout.read(4)
        clock.sleep_until(clock.now() + delay)
        process.send_signal(signal.SIGKILL)
        rest = process.stdout.read()
    written = int.from_bytes(rest[len(rest) // 4 * 4 - 4 :][:4], "little")
    return written, read_log(path.with_name(path.name + ".part"))


def check(path, delay):
    written, log = kill_at(path, delay)
    columns = log.columns("/force/sample")
    saved = len(columns["t_s"])
    # the message after the last count may have reached the log too
    assert written - 100 <= saved <= written + 1
    assert (columns["reading"] == range(saved)).all()
    assert not log.ended and log.missing == {}


def test_kill(tmp_path):
    for n, delay in enumerate((0.25, 0.61)):
        check(tmp_path / f"{n}.mcap", delay)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_kill_at_random_instants(tmp_path):
    rng = random.Random(5)
    for n in range(40):
        check(tmp_path / f"{n}.mcap", rng.uniform(0.1, 0.6))
