"""A log that is written by a process of its own, so that it survives whatever happens to the one that records.

What has been handed over is written even when this process is killed the next moment; the disk is asked to confirm
every chunk, which may take long, without keeping this process waiting. See `rig.log.remote` for how a second process
records into the same log, and `rig.log.server` for the other side.
"""

from __future__ import annotations

import json
import select
import socket
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from rig.base.clock import RealClock
from rig.log import frames
from rig.log.errors import LogError
from rig.log.remote import RemoteLog

START_S = 20.0  # the new process must have made the file by then
FINISH_S = 30.0  # syncing a long log and waiting for a second producer
LEAVE_S = 2.0


class LogProcess(RemoteLog):
    """Writes ``path`` as `rig.log.writer.LogWriter` does, in another process; a context manager. POSIX only.

    Attributes
    ----------
    second : socket
        The end for one more producer in another process; close it here once that process has been started.
    pid : int
        Of the writer.
    part : Path
        Where the log is until it is finished.
    kept : Path or None
        Where the log stayed when the block ended without `finish`.
    """

    def __init__(self, path: Path) -> None:
        mine, its = socket.socketpair()
        self.second, its_second = socket.socketpair()
        self.part = path.with_name(path.name + ".part")
        self.kept: Path | None = None
        self._finished = False
        super().__init__(path, mine)
        for written_by_itself in ("log", "fields", "cut"):
            self._checks.metadata(written_by_itself, {})
        ends = [its.fileno(), its_second.fileno()]
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "rig.log.server", str(path), *map(str, ends)],
                pass_fds=ends,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # signals of the terminal are not for it
            )
        except OSError as error:
            self._close_ends()
            raise self._fail(f"the process that writes the log cannot be started ({error.strerror})", "") from error
        finally:
            its.close()
            its_second.close()
        self.pid = self._process.pid
        try:
            self._wait_for(frames.READY, START_S)
        except BaseException:
            self._close_ends()
            self._leave()
            raise

    def metadata(self, name: str, mapping: Mapping[str, str]) -> None:
        """Put a table of strings into the log."""
        self._check()
        self._checks.metadata(name, mapping)
        self._end_frame()
        self._waiting += frames.pack(frames.METADATA, json.dumps([name, dict(mapping)]).encode())
        self._send()

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Put a file into the log. Waits until the writer has it: not for use while the rig is driven."""
        self._check()
        self._checks.attachment(name, data)
        self._end_frame()
        self._waiting += frames.pack(frames.ATTACHMENT, json.dumps([name, media_type]).encode() + b"\n" + data)
        self._drain()

    def finish(self, outcome: Mapping[str, str]) -> None:
        """Write why and how the run ended as metadata ``outcome``, end the file, sync it, give it its final name.

        Waits for the writer. A second producer should have closed its end by now.
        """
        self._check()
        self._checks.metadata("outcome", outcome)
        self.second.close()
        self._end_frame()
        self._waiting += frames.pack(frames.FINISH, json.dumps(dict(outcome)).encode())
        self._drain()
        self._wait_for(frames.DONE, FINISH_S)
        self._finished = True
        self._failure = LogError(self.path, "is finished; nothing can be added")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._close_ends()
        self._leave()
        if not self._finished and self.part.exists():
            self.kept = self.part
            if error is not None:
                error.add_note(f"What was recorded is kept in {self.kept}.")

    def _close_ends(self) -> None:
        self.second.close()
        self.close()

    def _leave(self) -> None:
        """Wait for the writer to end; one that hangs is ended; what it has written stays."""
        try:
            self._process.wait(LEAVE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(LEAVE_S)

    def _wait_for(self, kind: int, seconds: float) -> None:
        clock = RealClock()
        while True:
            self._listen()
            if kind in self._heard:
                return
            if clock.now() > seconds:
                raise self._fail(f"the process that writes the log has not answered for {seconds:.0f} s", "")
            select.select([self._end], [], [], 0.1)
