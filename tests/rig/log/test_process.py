"""The writer in a process of its own: same log as in one process, and what happens when one of the two fails."""

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from rig.base.clock import RealClock
from rig.log import frames
from rig.log.errors import LogError
from rig.log.process import LogProcess
from rig.log.reader import read_log
from rig.log.recover import recover
from rig.log.remote import MOST_WAITING, SEND_S, SILENCE_S, RemoteLog
from rig.log.writer import LogWriter


def record(log, n=50, start=0):
    for k in range(start, start + n):
        log.write("/force/sample", {"t_s": k * 1e-3, "reading": 0.1 * k, "force_N": -k, "flags": 0}, k * 10**6, k)
        log.tick(k * 1e-3)


def until(condition, seconds=30.0):
    """Wait for something that another process does."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_the_same_log_as_in_one_process(tmp_path):
    for path, kind in ((tmp_path / "a.mcap", LogWriter), (tmp_path / "b.mcap", LogProcess)):
        with kind(path) as log:
            log.attach("scene.toml", "application/toml", bytes(3_000_000))  # more than a socket holds
            log.metadata("run", {"scene": "é"})
            record(log)
            assert not path.exists() and log.part.exists()
            log.finish({"status": "complete"})
        assert path.exists() and not log.part.exists() and log.kept is None
    a, b = read_log(tmp_path / "a.mcap"), read_log(tmp_path / "b.mcap")
    assert b.whole
    assert (a.metadata, a.attachments, a.topics) == (b.metadata, b.attachments, b.topics)
    assert list(a.messages("/force/sample")) == list(b.messages("/force/sample"))


BAD = (
    lambda log: log.write("/force/sampel", {}, 0, 0),
    lambda log: log.write("/force/sample", {"t_s": 0.0}, 0, 0),
    lambda log: log.write("/event", {"t_s": 0.0, "severity": "", "source": "", "message": ""}, -1, 0),
    lambda log: log.attach("../../etc/passwd", "text/plain", b""),
    lambda log: log.metadata("log", {}),
    lambda log: log.metadata("run", {"n": 3}),
    lambda log: log.finish({"duration": 3.0}),
)


def test_bad_input_is_refused_here_and_reaches_no_file(tmp_path):
    with LogProcess(tmp_path / "a.mcap") as log:
        record(log)
        for number, call in enumerate(BAD, start=1):
            with pytest.raises(LogError):
                call(log)
            record(log, start=50 * number)
        log.finish({})
    found = read_log(tmp_path / "a.mcap")
    assert found.whole
    assert found.topics == {"/force/sample": 50 * (len(BAD) + 1)} and not found.attachments
    assert "run" not in found.metadata


@pytest.mark.parametrize("existing", ["a.mcap", "a.mcap.part"])
def test_nothing_is_overwritten(tmp_path, existing):
    (tmp_path / existing).write_text("precious")
    with pytest.raises(LogError, match=f"{existing}: exists already"):
        LogProcess(tmp_path / "a.mcap")
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {existing: "precious"}


def test_an_exception_keeps_what_was_recorded(tmp_path):
    path = tmp_path / "a.mcap"
    with pytest.raises(RuntimeError) as caught, LogProcess(path) as log:
        record(log)
        raise RuntimeError("the stage is on fire")
    assert log.kept == log.part
    assert caught.value.__notes__ == [f"What was recorded is kept in {log.part}."]
    kept = read_log(log.part)
    assert kept.topics == {"/force/sample": 50}
    assert kept.ended and kept.outcome is None and "cut" in kept.metadata
    recovery = recover(log.part, tmp_path / "b.mcap")
    assert recovery.exit_code == 3
    assert "ended without finishing" in recovery.report


def test_a_log_without_messages_leaves_no_file(tmp_path):
    with pytest.raises(RuntimeError), LogProcess(tmp_path / "a.mcap") as log:
        log.attach("scene.toml", "application/toml", b"x")
        raise RuntimeError("no such port")
    assert list(tmp_path.iterdir()) == []


def test_signals_are_not_for_the_writer(tmp_path):
    with LogProcess(tmp_path / "a.mcap") as log:
        record(log)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
            os.kill(log.pid, number)
        record(log, start=50)
        log.finish({})
    assert read_log(tmp_path / "a.mcap").topics == {"/force/sample": 100}


def test_a_writer_that_dies_is_an_error_when_rows_are_sent_next(tmp_path):
    with pytest.raises(LogError, match="has ended") as caught, LogProcess(tmp_path / "a.mcap") as log:
        record(log)
        until(lambda: read_log(log.part).topics)
        os.kill(log.pid, signal.SIGKILL)
        log._process.wait()
        with pytest.raises(LogError, match=r"recover .*a\.mcap\.part"):
            record(log, 1 + round(SEND_S * 1e3), start=50)
        record(log, 1)  # and so is every later call
    assert str(log.part) in caught.value.__notes__[0]
    assert read_log(log.part).topics["/force/sample"] > 0


def test_rows_wait_for_others_but_not_for_long_and_commands_for_nobody():
    mine, its = socket.socketpair()
    log = RemoteLog(Path("a.mcap"), mine)
    record(log)  # 50 ms
    its.setblocking(False)
    sent = frames.Unpacker().feed(its.recv(1 << 16))
    assert {kind for kind, _ in sent} == {frames.MESSAGES} and 3 <= len(sent) <= 50e-3 / SEND_S
    log.write("/raw/force/rx", {"t_s": 0.0, "data": b"a"}, 0, 0)
    with pytest.raises(BlockingIOError):
        its.recv(1)
    log.write("/raw/force/tx", {"t_s": 0.0, "data": b"a"}, 0, 0)
    assert its.recv(1 << 16)
    log.close()
    its.close()


def test_a_writer_that_hangs_blocks_nobody(tmp_path):
    path = tmp_path / "a.mcap"
    with pytest.raises(LogError, match="not answered"), LogProcess(path) as log:
        record(log)
        os.kill(log.pid, signal.SIGSTOP)
        try:
            record(log, 100, start=50)  # the first turns: what was said before may still come in
            for k in range(round(SILENCE_S / 0.02) + 5):  # twenty milliseconds a turn, as a loop does
                log.tick(0.15 + 0.02 * k)
        finally:
            os.kill(log.pid, signal.SIGCONT)
    # it went on, and saved what had been sent
    until(lambda: read_log(log.part).ended)
    assert read_log(log.part).topics == {"/force/sample": 150}


@pytest.mark.slow
def test_a_writer_that_was_stopped_for_good_is_ended(tmp_path):
    with pytest.raises(LogError, match=r"not answered for 0\.8 s"), LogProcess(tmp_path / "a.mcap") as log:
        record(log)
        os.kill(log.pid, signal.SIGSTOP)
        for k in range(60):
            log.tick(0.15 + 0.02 * k)
    assert log._process.returncode == -signal.SIGKILL  # no orphan


def test_a_loop_of_ours_that_was_held_up_is_not_the_writers_silence(tmp_path):
    with LogProcess(tmp_path / "a.mcap") as log:
        record(log)
        log.tick(0.1)
        log.tick(10.0)
        log.finish({})


@pytest.mark.parametrize("how", ["deleted", "replaced", "moved away with its folder"])
def test_a_log_that_is_deleted_while_it_is_written_is_noticed_and_saved(tmp_path, monkeypatch, how):
    folder = tmp_path / "logs"
    folder.mkdir()
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    with pytest.raises(LogError, match="while it was written") as caught, LogProcess(folder / "a.mcap") as log:
        record(log)
        until(lambda: read_log(log.part).topics)
        log.part.unlink()
        if how == "replaced":
            log.part.write_bytes(b"another")
        elif how != "deleted":
            folder.rmdir()
        began = RealClock()
        while True:
            assert began.now() < 30.0
            log.tick(began.now())
            time.sleep(0.01)
    assert began.now() < 10.0
    saved = Path(str(caught.value).split("saved in ")[1].rstrip("."))
    assert read_log(saved).topics["/force/sample"] > 0
    assert saved.parent == (folder if how in ("deleted", "replaced") else tmp_path / "tmp")


def test_what_waits_for_a_hanging_writer_is_bounded(tmp_path):
    data = {"t_s": 0.0, "data": bytes(60_000)}
    with pytest.raises(LogError, match="does not keep up"), LogProcess(tmp_path / "a.mcap") as log:
        os.kill(log.pid, signal.SIGSTOP)
        try:
            for k in range(MOST_WAITING // 60_000 + 100):
                log.write("/raw/force/rx", data, k, k)
        finally:
            os.kill(log.pid, signal.SIGCONT)


SECOND = """
import socket, sys, time
from pathlib import Path
from rig.log.remote import RemoteLog

log = RemoteLog(Path("a.mcap"), socket.socket(fileno=int(sys.argv[1])))
print("ready", flush=True)
sys.stdin.readline()  # until the first producer is dead
for k in range(100):
    log.write("/command", {"t_s": 1.0 + k, "device": "hv", "command": "off", "argument": ""}, 10**9 + k, 10**9 + k)
    log.tick(k * 1e-3)
log.close()
"""

FIRST = """
import os, signal, subprocess, sys
from pathlib import Path
from rig.log.process import LogProcess

log = LogProcess(Path(sys.argv[1]))
end = log.second.fileno()
second = subprocess.Popen([sys.executable, "-c", sys.argv[2], str(end)], pass_fds=[end], stdout=subprocess.PIPE)
log.second.close()
second.stdout.readline()
for k in range(50):
    log.write("/force/sample", {"t_s": k * 1e-3, "reading": 0.1 * k, "force_N": -k, "flags": 0}, k, k)
log.tick(0.0)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_second_producer_records_on_after_the_death_of_the_first(tmp_path):
    path = tmp_path / "a.mcap"
    with subprocess.Popen([sys.executable, "-c", FIRST, path, SECOND], stdin=subprocess.PIPE) as first:
        first.wait(60)
        part = tmp_path / "a.mcap.part"
        until(lambda: read_log(part).topics == {"/force/sample": 50})
        assert not read_log(part).ended  # the writer is still there for the other one
        first.stdin.write(b"\n")
    until(lambda: read_log(part).ended)
    assert read_log(part).topics == {"/force/sample": 50, "/command": 100}
    assert "cut" in read_log(part).metadata


def test_finish_waits_for_the_second_producer(tmp_path):
    with LogProcess(tmp_path / "a.mcap") as log:
        second = RemoteLog(log.path, socket.socket(fileno=os.dup(log.second.fileno())))
        record(log)
        record(second, start=50)
        second.close()
        log.finish({})
    assert read_log(tmp_path / "a.mcap").topics == {"/force/sample": 100}


def test_frames_split_anywhere_and_a_flip_anywhere():
    stream = b"".join(frames.pack(kind, bytes([kind]) * kind) for kind in (1, 2, 3))
    whole = [(kind, bytes([kind]) * kind) for kind in (1, 2, 3)]
    for at in range(len(stream) + 1):
        unpack = frames.Unpacker()
        assert unpack.feed(stream[:at]) + unpack.feed(stream[at:]) == whole
    for at in range(len(stream)):
        flipped = bytearray(stream)
        flipped[at] ^= 0x10
        unpack, found = frames.Unpacker(), []
        with suppress(ValueError):  # none: it waits for the rest of a longer frame
            for _ in range(2):
                found += unpack.feed(bytes(flipped))
                flipped.clear()
        assert found == whole[: len(found)] and len(found) < 3


def test_what_a_producer_sends_is_checked_by_the_writer(tmp_path):
    """A frame that was damaged on its way ends the producer's part, not the log."""
    with LogProcess(tmp_path / "a.mcap") as log:
        end = os.dup(log.second.fileno())
        with socket.socket(fileno=end) as second:
            good = frames.pack(frames.METADATA, b'["note", {"a": "b"}]')
            second.sendall(good + good[:-3] + b"xyz" + good)
            record(log)
            log.finish({})
    found = read_log(tmp_path / "a.mcap")
    assert found.whole and found.topics == {"/force/sample": 50}
    assert found.metadata["note"] == {"a": "b"}


def test_what_was_written_last_is_with_the_writer_when_the_log_is_closed(tmp_path):
    """The guard's last word, told after its last turn."""
    ours, writers = socket.socketpair()
    with writers:
        log = RemoteLog(tmp_path / "run.mcap", ours)
        fields = {"t_s": 1.0, "severity": "warning", "source": "guard", "message": "the last word"}
        log.write("/event", fields, 10**18, 10**18)
        log.close()
        arrived = writers.recv(65536)
    assert b"the last word" in arrived
