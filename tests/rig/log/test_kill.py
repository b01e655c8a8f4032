"""kill -9 of the process that records and of the process that writes, at random instants.

Both run the code of a real run, but as forks of one process that has loaded it, with an engine that only makes up
samples; and on a disk in memory, because how long a disk takes to confirm is not what is tested here. A witness that
only sleeps and wakes tells how long this machine keeps a process waiting for its turn; that is allowed for.
"""

import json
import random
import signal
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from rig.log.errors import LogError
from rig.log.reader import read_log

# Forks an engine and a writer for every case, SIDE_BY_SIDE cases at a time, and kills one of the two. The engine notes
# in shared memory when it handed each sample over, the witness when it woke.
NURSERY = """
import json, mmap, os, signal, socket, struct, sys, time
from pathlib import Path
from rig.base.clock import RealClock
from rig.log.errors import LogError
from rig.log.remote import RemoteLog
from rig.log.server import serve

REFUSED = 7


def engine(path, end, handed):
    log, clock, k = RemoteLog(path, end), RealClock(), 0
    try:
        while True:
            now = clock.now()
            while k * 1e-3 <= now:
                log.write("/raw/force/rx", {"t_s": k * 1e-3, "data": struct.pack("<I", k)}, k * 10**6, k * 10**6)
                fields = {"t_s": k * 1e-3, "reading": 0.1 * k, "force_N": -float(k), "flags": 0}
                log.write("/force/sample", fields, k * 10**6, k * 10**6)
                struct.pack_into("<q", handed, 8 * k, time.monotonic_ns())
                k += 1
            log.tick(now)
            clock.sleep_until(now + 0.003)
    except LogError:
        os._exit(REFUSED)


def witness(woken):
    for n in range(100_000):
        struct.pack_into("<q", woken, 8 * n, time.monotonic_ns())
        time.sleep(0.01)


def noted(shared):
    return [t for t, in struct.iter_unpack("<q", shared) if t]


def fork(work, *arguments):
    process = os.fork()
    if process == 0:
        work(*arguments)
        os._exit(0)
    return process


def start(path):
    handed = mmap.mmap(-1, 8 * 20_000)
    mine, its = socket.socketpair()
    processes = {"writer": fork(lambda: (mine.close(), serve(path, [its])))}
    processes["engine"] = fork(lambda: (its.close(), engine(path, mine, handed)))
    mine.close()
    its.close()
    return processes, handed


def wait(process):
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


SIDE_BY_SIDE = 20
folder, victim, delays = Path(sys.argv[1]), sys.argv[2], json.loads(sys.argv[3])
for first in range(0, len(delays), SIDE_BY_SIDE):
    some = delays[first : first + SIDE_BY_SIDE]
    batch = [(start(folder / f"{first + n}.mcap"), delay) for n, delay in enumerate(some)]
    woken = mmap.mmap(-1, 8 * 100_000)
    watching = fork(witness, woken)
    began = time.monotonic()
    for n, ((processes, handed), delay) in sorted(enumerate(batch), key=lambda item: item[1][1]):
        time.sleep(max(0.0, began + delay - time.monotonic()))
        at = time.monotonic_ns()
        os.kill(processes[victim], signal.SIGKILL)
        codes = {name: wait(process) for name, process in processes.items()}
        seen = [t for t in noted(woken) if at - 500_000_000 < t] + [time.monotonic_ns()]
        late = max(b - a for a, b in zip(seen, seen[1:])) - 10_000_000
        print(json.dumps({"n": first + n, "at": at, "codes": codes, "times": noted(handed), "late": late}), flush=True)
    os.kill(watching, signal.SIGKILL)
    wait(watching)
"""


@pytest.fixture
def disk():
    """A folder in memory where the system has one."""
    shared = Path("/dev/shm")
    with TemporaryDirectory(prefix="dea-rig-", dir=shared if shared.is_dir() else None) as folder:
        yield Path(folder)


def kill(folder, victim, count, allowed_s):
    """Kill ``count`` times: what was handed over longer than ``allowed_s`` before is in the log, and nothing wrong."""
    rng = random.Random(count)
    delays = json.dumps([rng.uniform(0.05, 0.9) for _ in range(count)])
    with subprocess.Popen([sys.executable, "-c", NURSERY, folder, victim, delays], stdout=subprocess.PIPE) as nursery:
        cases = [json.loads(line) for line in nursery.stdout]
    assert nursery.returncode == 0 and len(cases) == count
    lost_ms, late_ms = [], []
    for case in cases:
        times = np.array(case["times"])
        try:
            log = read_log(folder / f"{case['n']}.mcap.part")
            force, raw = log.columns("/force/sample"), log.columns("/raw/force/rx")
        except (LogError, FileNotFoundError):
            saved = 0  # killed before there was anything to keep
        else:
            saved = len(force["t_s"])
            k = np.arange(saved)
            np.testing.assert_array_equal(force["reading"], 0.1 * k)
            np.testing.assert_array_equal(force["force_N"], -k)
            assert [int.from_bytes(data, "little") for data in raw["data"][:saved]] == k.tolist()
            assert log.missing == {} and all(gap.reason.startswith("the file ends") for gap in log.gaps)
            assert log.ended == (victim == "engine") and log.outcome is None
        lost = times[saved:]
        lost_ms.append(1e-6 * (case["at"] - lost[0]) if len(lost) else 0.0)
        late_ms.append(1e-6 * case["late"])
        # the survivor: the writer ends in order, the engine is told at its next turn
        assert case["codes"] == {victim: -signal.SIGKILL, "writer" if victim == "engine" else "engine": 0} | (
            {"engine": 7} if victim == "writer" else {}
        )
    print(f"{count} kills of the {victim}: lost at most {max(lost_ms):.0f} ms, median {np.median(lost_ms):.0f} ms; "
          f"the machine was late by {np.median(late_ms):.0f} ms, at most {max(late_ms):.0f} ms")  # fmt: skip
    # the way of a sample to the file has three turns: the engine's, the writer's, and that of its chunk
    assert (np.array(lost_ms) <= 1e3 * allowed_s + 3 * np.array(late_ms)).all()


COUNTS = [
    pytest.param(10, id="some"),
    pytest.param(30, id="more", marks=pytest.mark.slow),
    pytest.param(200, id="many", marks=pytest.mark.long),
]


@pytest.mark.parametrize("count", COUNTS)
def test_kill_of_the_engine(disk, count):
    kill(disk, "engine", count, 0.1)


@pytest.mark.parametrize("count", COUNTS)
def test_kill_of_the_writer(disk, count):
    kill(disk, "writer", count, 0.2)
