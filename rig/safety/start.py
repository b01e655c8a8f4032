"""Starting the guard's process: a fresh interpreter in a session of its own, out of the terminal's reach."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from typing import Protocol


class Started(Protocol):
    """A process of ours."""

    pid: int

    def kill(self) -> None:
        """End it at once; returns without waiting for that."""
        ...

    def wait(self, seconds: float) -> bool:
        """Whether it has ended, after at most so long."""
        ...


class ByMultiprocessing:
    """Where descriptors are not inherited by number; also for processes that are forked from one made ready."""

    def __init__(self, process: BaseProcess) -> None:
        process.start()
        assert process.pid is not None
        self.pid = process.pid
        self._process = process

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()

    def wait(self, seconds: float) -> bool:
        """Whether it has ended, after at most so long."""
        self._process.join(seconds)
        return self._process.exitcode is not None


class BySubprocess:
    """As a program of its own, which may outlive this one."""

    _left: list[subprocess.Popen[bytes]] = []  # noqa: RUF012  # of all: those that were left to themselves

    def __init__(self, end: socket.socket) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "rig.safety.process", str(end.fileno())],
            pass_fds=[end.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
        )
        self.pid = self._process.pid
        self._left.append(self._process)  # no warning about one that goes on when this program ends

    def kill(self) -> None:
        """End it at once."""
        with suppress(ProcessLookupError):
            self._process.kill()

    def wait(self, seconds: float) -> bool:
        """Whether it has ended, after at most so long."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
            if self._process in self._left:
                self._left.remove(self._process)
        return self._process.returncode is not None


def start_guard(end: socket.socket) -> Started:
    """The guard's process, with ``end`` of the pair that it talks through. The caller closes ``end`` afterwards."""
    if os.name == "posix":
        return BySubprocess(end)
    from rig.safety import process

    return ByMultiprocessing(get_context("spawn").Process(target=process.serve, args=(end,), name="dea-rig guard"))
