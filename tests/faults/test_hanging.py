"""What hangs, is held by somebody else, or is gone: adapters, locks, descriptors, the log and its writer, the terminal.

Over real processes and pseudo-terminals; asserted is what the simulated supply's own output did. Times are multiples of
what is required, for a busy machine.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from rig.base.errors import RigError
from rig.benchmark.stand import Run, Stand
from rig.log.reader import read_log
from rig.protocol.experiment import SERVED_BY, SERVER
from rig.safety.guard import AT_ONCE_S
from rig.sim.bench import SimulatedBench

pytestmark = [
    pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="looks at processes in /proc"),
    pytest.mark.slow,
]
TRIES = 3
SOON_S = 2.5  # required is 1 s

# A C library in which waiting for a port to send never ends, as it does on some USB adapters.
DRAIN = """
#include <fcntl.h>
#include <unistd.h>
int tcdrain(int fd) {
    int said = open(WHERE, O_WRONLY | O_CREAT | O_APPEND, 0600);
    write(said, "tcdrain\\n", 8);
    for (;;) pause();
}
"""

# One that tells of every call that would wait: a port drained, a read where nothing is, a write where there is no room,
# on lines, sockets and pipes that are not told to return at once; and of every wait for a disk.
WAITS = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>
static void tell(const char *what, int fd) {
    char line[80];
    int said = syscall(SYS_openat, AT_FDCWD, WHERE, O_WRONLY | O_CREAT | O_APPEND, 0600);
    int n = snprintf(line, sizeof line, "%d %s %d\\n", getpid(), what, fd);
    syscall(SYS_write, said, line, n);
    syscall(SYS_close, said);
}
static int waits(int fd, short event) {
    struct stat is;
    struct pollfd now = {fd, event, 0};
    if (fstat(fd, &is) || S_ISREG(is.st_mode) || S_ISDIR(is.st_mode)) return 0;
    if (fcntl(fd, F_GETFL) & O_NONBLOCK) return 0;
    return poll(&now, 1, 0) == 0;
}
int tcdrain(int fd) { tell("tcdrain", fd); return 0; }
int fsync(int fd) { tell("fsync", fd); return syscall(SYS_fsync, fd); }
int fdatasync(int fd) { tell("fdatasync", fd); return syscall(SYS_fdatasync, fd); }
ssize_t read(int fd, void *to, size_t n) {
    if (waits(fd, POLLIN)) tell("read", fd);
    return syscall(SYS_read, fd, to, n);
}
ssize_t write(int fd, const void *from, size_t n) {
    if (waits(fd, POLLOUT)) tell("write", fd);
    return syscall(SYS_write, fd, from, n);
}
ssize_t recv(int fd, void *to, size_t n, int how) {
    if (!(how & MSG_DONTWAIT) && waits(fd, POLLIN)) tell("recv", fd);
    return syscall(SYS_recvfrom, fd, to, n, how, 0, 0);
}
"""
CHECK_WAITS = """
import os, socket, threading
a, b = socket.socketpair()
threading.Timer(0.5, b.send, [b"12"]).start()
a.recv(1)
os.read(a.fileno(), 1)
r, w = os.pipe()
threading.Timer(0.5, os.write, [w, b"1"]).start()
os.read(r, 1)
"""


def start_live(stand: Stand) -> Run:
    """A run with 800 V on. A machine too busy rightly ends some before: then another."""
    for _ in range(TRIES - 1):
        run = stand.start()
        with suppress(RigError):
            stand.wait_until_live(run, 780.0)
            return run
        stand.wait_until_alone(run)
    run = stand.start()
    stand.wait_until_live(run, 780.0)
    return run


def off_within(stand: Stand, at: float, seconds: float) -> None:
    stand.wait(lambda: stand.off_after(at) is not None, "the output's end")
    driven = stand.off_after(at)
    assert driven is not None and driven.t - at < seconds
    stand.wait(lambda: stand.bench.voltage() < 60.0, "the output's discharge")
    assert all(one.target == 0.0 for one in stand.bench.driven if one.t > driven.t)


@pytest.fixture(scope="module")
def stand(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stand]:
    with Stand(tmp_path_factory.mktemp("stand"), hold_s=30.0) as stand:
        yield stand


@pytest.fixture
def live(stand: Stand) -> Run:
    return start_live(stand)


# Calls that never return -------------------------------------------------------------------------------------------


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_nothing_waits_for_a_port_to_send(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a tcdrain that never returns, in guard and engine: a run whose guard is killed. A whole one: below."""
    called, source, library = tmp_path / "called", tmp_path / "drain.c", tmp_path / "drain.so"
    source.write_text(DRAIN.replace("WHERE", json.dumps(str(called))))
    subprocess.run(["cc", "-shared", "-fPIC", "-w", "-o", library, source], check=True)
    check = "import termios, os, threading; threading.Timer(1, os._exit, [7]).start(); termios.tcdrain(1)"
    preloaded = {**os.environ, "LD_PRELOAD": str(library)}
    assert subprocess.run([sys.executable, "-c", check], env=preloaded, check=False).returncode == 7
    assert called.read_text() == "tcdrain\n"  # it is found, and it blocks
    called.unlink()
    with monkeypatch.context() as patch, Stand(tmp_path / "stand", hold_s=2.0) as stand:
        patch.setenv("LD_PRELOAD", str(library))
        run = start_live(stand)
        at = stand.kill(run.guard)
        off_within(stand, at, SOON_S)
        stand.wait_until_alone(run)
        assert run.status == 4, run.said
    assert not called.exists()


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_neither_loop_makes_a_call_that_could_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A whole run with voltage: what guard and engine asked of the system, told by a C library in between."""
    called, source, library = tmp_path / "called", tmp_path / "waits.c", tmp_path / "waits.so"
    source.write_text(WAITS.replace("WHERE", json.dumps(str(called))))
    subprocess.run(["cc", "-shared", "-fPIC", "-w", "-o", library, source], check=True)
    preloaded = {**os.environ, "LD_PRELOAD": str(library)}
    subprocess.run([sys.executable, "-c", CHECK_WAITS], env=preloaded, check=True)
    assert [line.split()[1] for line in called.read_text().splitlines()] == ["recv", "read"]  # it tells of what waits
    called.unlink()
    with monkeypatch.context() as patch, Stand(tmp_path / "stand", hold_s=1.0) as stand:
        patch.setenv("LD_PRELOAD", str(library))
        run = start_live(stand)
        guard, engine = run.guard, run.engine
        assert all(str(library) in Path(f"/proc/{pid}/maps").read_text() for pid in (guard, engine))
        assert not called.exists() or "tcdrain" not in called.read_text()
        called.unlink(missing_ok=True)  # from here on: the loops, with voltage on
        stand.wait(lambda: stand.bench.voltage() < 60.0, "the output's end")
        told = called.read_text().splitlines() if called.exists() else []
        stand.wait_until_alone(run)
    assert run.status == 0, run.said
    assert not [line for line in told if int(line.split()[0]) in (guard, engine)]
    assert not called.exists() or "tcdrain" not in called.read_text()  # until the very end, in no process


def test_an_adapter_that_takes_nothing_is_lost_and_said(stand: Stand, live: Run) -> None:
    at = stand.bench.clock.now()
    stand.bench.stall("hv", True)
    try:
        stand.wait(lambda: live.status is not None, "the engine's end")
        assert stand.bench.clock.now() - at < AT_ONCE_S + 8.0  # the scene's time-out of 2 s for the supply among them
        assert live.status == 4 and "NOT SAFE" in live.said
        outcome = read_log(live.log).outcome
        assert outcome is not None and outcome["status"] == "NOT SAFE" and outcome["stage_standing"] == "yes"
    finally:
        back = stand.bench.clock.now()
        stand.bench.stall("hv", False)
    off_within(stand, back, SOON_S)  # the guard has gone on telling it
    stand.wait_until_alone(live)


def test_signals_work_while_the_adapter_takes_nothing(stand: Stand, live: Run) -> None:
    stand.bench.stall("hv", True)
    try:
        stand.kill(live.engine, signal.SIGTERM)
        stand.kill(live.engine, signal.SIGTERM)
        at = stand.bench.clock.now()
        stand.wait(lambda: live.status is not None, "the engine's end")
        assert stand.bench.clock.now() - at < AT_ONCE_S + 8.0
        assert live.status == 4 and "NOT SAFE" in live.said  # not 130: the worse of the two
    finally:
        stand.bench.stall("hv", False)
    stand.wait_until_alone(live)


# The way to off needs nobody's consent -----------------------------------------------------------------------------


def test_taking_over_needs_no_lock_no_file_and_no_descriptor(stand: Stand, live: Run) -> None:
    """Somebody holds every lock, no descriptor is left, and the guard dies."""
    resource = pytest.importorskip("resource")
    port = stand.ports()["hv"]["can_channel"]
    held = [os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)]
    for lock in Path(f"/proc/{live.engine}/fd").iterdir():
        with suppress(OSError):
            name = str(lock.readlink())
            if name.endswith(".lock"):
                held.append(os.open(name, os.O_RDWR))
    for fd in held:
        with suppress(OSError):
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    numbers = [int(one.name) for one in Path(f"/proc/{live.engine}/fd").iterdir()]
    free = next(k for k in range(len(numbers) + 1) if k not in numbers)
    resource.prlimit(live.engine, resource.RLIMIT_NOFILE, (free, free))
    at = stand.kill(live.guard)
    off_within(stand, at, SOON_S)
    stand.wait_until_alone(live)
    for fd in held:
        os.close(fd)
    assert live.status == 4


def test_an_output_that_creeps_and_says_ramping_is_taken_off(stand: Stand, live: Run) -> None:
    def creep(bench: SimulatedBench) -> None:
        supply = bench.instruments["hv"]
        supply.wrong_status = 1 << 4  # type: ignore[attr-defined]  # RAMPING
        bench.world.output.ramp(bench.now, 3000.0, 20.0)

    at = stand.bench.clock.now()
    stand.do(creep)
    highest = 0.0

    def off() -> bool:
        nonlocal highest
        highest = max(highest, stand.bench.voltage())
        return stand.off_after(at + 0.1) is not None

    stand.wait(off, "the output's end")
    assert highest < 900.0  # 800 V, 50 V of tolerance, and a busy machine
    stand.do(lambda bench: setattr(bench.instruments["hv"], "wrong_status", 0))
    stand.wait_until_alone(live)
    assert live.status == 4 and "risen to" in live.said


def test_a_bus_full_of_other_frames_delays_nothing(stand: Stand, live: Run) -> None:
    """1000 frames a second of somebody else's, all the time; then the engine is killed."""
    ending = threading.Event()

    def flood() -> None:
        while not ending.wait(0.01):
            stand.do(lambda bench: [bench.wire("hv").send((0x100 + k, bytes(8)), bench.now) for k in range(10)])

    thread = threading.Thread(target=flood)
    thread.start()
    try:
        now = stand.bench.clock.now()
        stand.wait(lambda: stand.bench.clock.now() > now + 1.0, "a second")
        assert live.status is None  # it bears it
        at = stand.kill(live.engine)
        off_within(stand, at, SOON_S)
        stand.wait_until_alone(live)
    finally:
        ending.set()
        thread.join()


# The log and its writer --------------------------------------------------------------------------------------------


def writer_of(engine: int) -> int:
    children = Path(f"/proc/{engine}/task/{engine}/children").read_text().split()
    return next(int(pid) for pid in children if b"rig.log.server" in Path(f"/proc/{pid}/cmdline").read_bytes())


def test_a_log_that_is_deleted_ends_the_run_at_once_and_is_saved(stand: Stand, live: Run) -> None:
    part = live.log.with_name(live.log.name + ".part")
    at = stand.bench.clock.now()
    part.unlink()
    off_within(stand, at, SOON_S)
    stand.wait_until_alone(live)
    assert live.status == 4 and "was deleted or moved while it was written" in live.said, live.said
    saved = Path(live.said.split("saved in ")[1].split()[0].rstrip("."))
    assert read_log(saved).topics["/hv/sample"] > 0


def test_a_writer_that_hangs_ends_the_run_and_is_not_left_behind(stand: Stand, live: Run) -> None:
    writer = writer_of(live.engine)
    at = stand.kill(writer, signal.SIGSTOP)
    off_within(stand, at, SOON_S)
    stand.wait_until_alone(live)
    assert live.status == 4 and "has not answered for" in live.said
    stand.wait(lambda: not Path(f"/proc/{writer}").exists(), "the writer's end")


# A terminal that takes nothing -------------------------------------------------------------------------------------


def test_a_pipe_that_nobody_reads_holds_up_neither_the_run_nor_its_end(stand: Stand) -> None:
    for _ in range(TRIES):
        stand.bench.power_cycle()
        ports, log = stand.folder / "pipe.json", stand.folder / "pipe.mcap"
        log.unlink(missing_ok=True)
        ports.write_text(json.dumps({**stand.bench.ports, SERVED_BY: SERVER}))
        reading, writing = os.pipe()
        os.set_blocking(writing, False)
        with suppress(BlockingIOError):
            while True:
                os.write(writing, bytes(4096))
        os.set_blocking(writing, True)
        command = [sys.executable, "-m", "rig", "run", str(stand.scene), str(stand.protocol), "-o", str(log)]
        command += ["--ports", str(ports), "--arm", "--yes"]
        engine = subprocess.Popen(command, stdout=writing, stderr=writing, stdin=subprocess.DEVNULL)
        ended = engine.poll
        os.close(writing)
        try:
            stand.wait(lambda ended=ended: ended() is not None or stand.bench.voltage() > 780.0, "high voltage")
            if engine.poll() is not None:
                continue
            at = stand.bench.clock.now()
            engine.send_signal(signal.SIGTERM)
            off_within(stand, at, SOON_S)
            assert engine.wait(30) == 130
            outcome = read_log(log).outcome
            assert outcome is not None and outcome["safe"] == "yes"
            return
        finally:
            os.close(reading)
            if engine.poll() is None:
                engine.kill()
                engine.wait(30)
    pytest.fail("no run came to its voltage")
