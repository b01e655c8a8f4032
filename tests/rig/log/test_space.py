"""Room on the disk: refused before a run, and a disk that is full during one all the same."""

import os
import resource
import subprocess
import time
from contextlib import contextmanager

import pytest

from rig.log import space
from rig.log.errors import LogError
from rig.log.process import LogProcess
from rig.log.reader import read_log

RATES = {"stage": 50.0, "force": 1000.0, "displacement": 50.0, "hv": 10.0}


def test_a_run_that_has_no_room_is_refused_with_numbers(tmp_path, monkeypatch):
    monkeypatch.setattr(space, "free", lambda folder: 500_000_000)
    space.check(tmp_path / "a.mcap", 600.0, RATES)
    with pytest.raises(LogError, match=r"500 MB free, but 7200 s of .*force 1000 Hz.* may take 1354 MB"):
        space.check(tmp_path / "a.mcap", 7200.0, RATES)


def test_a_folder_that_does_not_exist(tmp_path):
    with pytest.raises(LogError, match="No such file"):
        space.check(tmp_path / "missing" / "a.mcap", 1.0, RATES)


@contextmanager
def small_disk(tmp_path):
    """A disk of 256 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", folder]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True).returncode != 0:
        pytest.skip("only root may mount a disk")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


def record_until_it_fails(log, most_free=2**63):
    """Messages of 200 bytes that cannot be compressed, a millisecond apart; how many were taken."""
    for k in range(100_000):
        log.write("/raw/force/rx", {"t_s": k * 1e-3, "data": os.urandom(200)}, k * 10**6, k * 10**6)
        free = log.tick(k * 1e-3)
        assert free is None or free < most_free
        time.sleep(1e-3)


def check_kept(log, failure, most):
    assert failure.match("writing failed .* nothing more is written")
    assert str(log.part) in failure.value.__notes__[0]
    assert 0 < log.part.stat().st_size <= most
    kept = read_log(log.part)
    t = kept.columns("/raw/force/rx")["t_s"]
    assert len(t) > 50 and t.tolist() == [k * 1e-3 for k in range(len(t))]
    # whole chunks only: the one thing wrong with the file is that it has no end
    assert [gap.reason for gap in kept.gaps] == ["the file ends here without its end record"]


@pytest.mark.slow
def test_a_full_disk(tmp_path):
    with small_disk(tmp_path) as folder:
        with pytest.raises(LogError) as failure, LogProcess(folder / "a.mcap") as log:
            record_until_it_fails(log, 256 * 1024)
        assert "No space left on device" in str(failure.value)
        check_kept(log, failure, 256 * 1024)


@pytest.mark.parametrize("limit", [60_000, 60_001])
def test_a_file_that_may_not_grow(tmp_path, limit):
    """The same without root: the system refuses to let the file grow beyond a limit."""
    with pytest.raises(LogError) as failure, LogProcess(tmp_path / "a.mcap") as log:
        resource.prlimit(log.pid, resource.RLIMIT_FSIZE, (limit, limit))
        record_until_it_fails(log)
    assert "File too large" in str(failure.value)
    check_kept(log, failure, limit)
