"""The power fails while a log is being written: what the disk had confirmed comes back, and nothing wrong.

The calls with which the process that writes a log drives the disk are recorded. From them follow the states in which
a disk may be found afterwards: of what it had not confirmed, any sector may be there, missing or torn, in any order.
"""

import itertools
import os
import random
import socket
import stat
import struct
import threading
import time
from typing import NamedTuple

import numpy as np
import pytest

from rig.log import frames, part_file
from rig.log.errors import LogError
from rig.log.reader import read_log
from rig.log.recover import recover
from rig.log.remote import RemoteLog
from rig.log.server import serve

SECTOR = 512


class Recorded(NamedTuple):
    """What was written in all, and after each call: its name, bytes written, bytes confirmed."""

    content: bytes
    calls: list[tuple[str, int, int]]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A second of a run at 1 kHz, by the real writer with its own clock."""
    calls, content = [], bytearray()

    def note(name, written=b"", confirmed=None):
        content.extend(written)
        calls.append((name, len(content), calls[-1][2] if confirmed is None and calls else confirmed or 0))

    def is_file(fd):
        return stat.S_ISREG(os.fstat(fd).st_mode)

    def write(fd, data):
        n = real.write(fd, data)
        note("write", bytes(data[:n]))
        return n

    def sync(fd):
        real.fsync(fd)
        note("sync", confirmed=len(content)) if is_file(fd) else note("sync of folder")

    def rename(old, new):
        note("rename")
        real.rename(old, new)

    class Real(NamedTuple):
        write: object
        fsync: object
        rename: object

    real = Real(os.write, os.fsync, os.rename)
    path = tmp_path_factory.mktemp("power") / "a.mcap"
    mine, its = socket.socketpair()
    second, its_second = socket.socketpair()
    second.close()
    with pytest.MonkeyPatch.context() as patch:
        for name, function in (("write", write), ("fsync", sync), ("fdatasync", sync), ("rename", rename)):
            patch.setattr(part_file.os, name, function)
        thread = threading.Thread(target=serve, args=(path, [its, its_second]))
        thread.start()
        log = RemoteLog(path, mine)
        for k in range(1000):
            log.write("/force/sample", {"t_s": k * 1e-3, "reading": float(k), "force_N": -k, "flags": k}, k, k)
            log.write("/raw/force/rx", {"t_s": k * 1e-3, "data": struct.pack("<I", k)}, k, k)
            if k % 5 == 0:
                log.tick(k * 1e-3)
                time.sleep(0.005)
        log.tick(1.0)
        assert not log._waiting
        mine.setblocking(True)
        mine.sendall(frames.pack(frames.FINISH, b"{}"))
        thread.join()
        log.close()
    its.close()
    its_second.close()
    assert path.read_bytes() == content
    assert read_log(path).topics == {"/force/sample": 1000, "/raw/force/rx": 1000}
    return Recorded(bytes(content), calls)


def test_the_disk_is_asked_to_confirm_in_the_right_places(recorded):
    names = [name for name, _, _ in recorded.calls]
    assert names[0] == "sync of folder"  # the new file's name, before anything is in it
    assert names[-3:] == ["sync", "rename", "sync of folder"]
    waiting = [written - confirmed for name, written, confirmed in recorded.calls if name == "sync"]
    assert len(waiting) > 8 and set(waiting) == {0}  # each confirms all that was written
    # between its beginning and its end, no two chunks are written without asking
    middle = names[6:-6]
    assert ("write", "write") not in itertools.pairwise(middle)


def numbers(path):
    """The ``k`` of the messages in the log at ``path``, checked against all that goes with them."""
    log = read_log(path)
    force, raw = log.columns("/force/sample"), log.columns("/raw/force/rx")
    k = force["reading"]
    assert (np.diff(k) > 0).all() and (k == np.round(k)).all() and not log.unknown
    np.testing.assert_array_equal(force["t_s"], k * 1e-3)
    np.testing.assert_array_equal(force["force_N"], -k)
    for name in ("flags", "log_ns", "publish_ns"):
        np.testing.assert_array_equal(force[name], k)
    of_raw = np.array([struct.unpack("<I", data)[0] for data in raw["data"]])
    np.testing.assert_array_equal(raw["log_ns"], of_raw)
    assert (np.diff(of_raw) > 0).all()
    return k, of_raw


def state(recorded, rng):
    """A file as a power cut may leave it, and how much of it the disk had confirmed."""
    _, written, confirmed = rng.choice(recorded.calls[3:])
    if rng.random() < 0.3:  # in the middle of a write
        written = rng.randint(confirmed, written)
    size = rng.choice((written, rng.randint(confirmed, written)))
    found = bytearray(recorded.content[:confirmed] + bytes(size - confirmed))
    likely = rng.random()
    for sector in range(confirmed // SECTOR * SECTOR, size, SECTOR):
        start, end = max(sector, confirmed), min(sector + SECTOR, size)
        chance = rng.random()
        if chance < likely:
            found[start:end] = recorded.content[start:end]
        elif chance < likely + 0.1:
            torn = rng.randint(start, end)
            found[start:torn] = recorded.content[start:torn]
        elif chance < likely + 0.15:
            found[start:end] = rng.randbytes(end - start)
    return bytes(found) + bytes(rng.choice((0, 0, 700, 4096, 40_000))), confirmed


@pytest.mark.parametrize("count", [pytest.param(60, id="60"), pytest.param(600, id="600", marks=pytest.mark.long)])
def test_power_cuts(recorded, tmp_path, count):
    rng = random.Random(count)
    path = tmp_path / "cut.mcap.part"
    promised: dict[int, int] = {}  # messages on each topic, by bytes confirmed
    for confirmed in sorted({confirmed for _, _, confirmed in recorded.calls}):
        path.write_bytes(recorded.content[:confirmed])
        try:
            promised[confirmed] = len(numbers(path)[0])
        except LogError:
            promised[confirmed] = 0
    assert len(set(promised.values())) > 8
    losses = 0
    for n in range(count):
        content, confirmed = state(recorded, rng)
        path.write_bytes(content)
        try:
            found = numbers(path)
        except LogError:
            assert promised[confirmed] == 0
            continue
        for k in found:
            assert k[: promised[confirmed]].tolist() == list(range(promised[confirmed]))
        losses += len(found[0]) < 1000
        if n % 20 == 0 and promised[confirmed]:
            out = tmp_path / f"{n}.mcap"
            code = recover(path, out).exit_code
            # all data may be there, and only the summary behind them not
            assert code == 3 or (code == 0 and [len(k) for k in found] == [1000, 1000])
            assert code == 0 or content != recorded.content
            assert [k.tolist() for k in numbers(out)] == [k.tolist() for k in found]
    assert losses > count / 2
