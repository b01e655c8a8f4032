"""Handling of the guard's process: whether it has ended is what it says, and killing one that is gone does no harm."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import pytest

from rig.safety import start
from rig.safety.start import ByMultiprocessing, BySubprocess


@pytest.mark.skipif(os.name != "posix", reason="descriptors by number are POSIX")
def test_a_program_of_its_own_is_waited_for_and_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[list[str], dict[str, Any]]] = []
    popen = subprocess.Popen

    def other(command: list[str], **how: Any) -> Any:
        asked.append((command, how))
        return popen(["sleep", "30"], **how)

    monkeypatch.setattr(start.subprocess, "Popen", other)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        process = start.start_guard(theirs)
        assert isinstance(process, BySubprocess)
        ((command, how),) = asked
        assert command == [sys.executable, "-P", "-m", "rig.safety.process", str(theirs.fileno())]
        assert how["pass_fds"] == [theirs.fileno()] and how["start_new_session"]
        assert os.getsid(process.pid) == process.pid  # out of the terminal's reach
        assert not process.wait(0.01) and process._process in BySubprocess._left
        process.kill()
        assert process.wait(10.0) and process._process not in BySubprocess._left
        process.kill()
        assert process.wait(0.0)


def test_where_descriptors_are_not_inherited_it_is_the_same() -> None:
    done: list[Any] = []
    fake: Any = SimpleNamespace(pid=5, exitcode=None, start=lambda: done.append("start"))
    fake.kill, fake.join = lambda: done.append("kill"), done.append
    process = ByMultiprocessing(fake)
    assert process.pid == 5 and not process.wait(0.2)
    process.kill()
    fake.exitcode = -9
    assert process.wait(0.3)
    assert done == ["start", 0.2, "kill", 0.3]
