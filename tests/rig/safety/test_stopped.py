"""What the system tells of another process: stopped, going on, ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from rig.safety.stopped import Peer

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="the system tells it under /proc")


def soon(true: Callable[[], bool]) -> bool:
    end = time.monotonic() + 10.0
    while not true() and time.monotonic() < end:
        time.sleep(1e-3)
    return true()


def test_only_a_process_that_was_stopped_counts_as_stopped() -> None:
    with subprocess.Popen(["sleep", "60"]) as other:
        peer = Peer(other.pid)
        assert not peer.stopped
        other.send_signal(signal.SIGSTOP)
        assert soon(lambda: peer.stopped)
        other.send_signal(signal.SIGCONT)
        assert soon(lambda: not peer.stopped)
        other.kill()
        other.wait()
        assert not peer.stopped
        peer.close()
        peer.close()
        assert not peer.stopped


def test_a_name_that_looks_like_a_state_deceives_nobody(tmp_path: Path) -> None:
    name = tmp_path / "x) T 1 ("
    name.symlink_to(sys.executable)
    with subprocess.Popen([name, "-c", "import time; time.sleep(60)"]) as other:
        peer = Peer(other.pid)
        assert soon(lambda: b") T 1 (" in Path(f"/proc/{other.pid}/stat").read_bytes())
        assert not peer.stopped
        other.kill()
    peer.close()


def test_a_process_that_is_not_there_is_not_stopped() -> None:
    peer = Peer(2**22 + 1 if os.name == "posix" else 1)
    assert not peer.stopped
