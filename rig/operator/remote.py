"""Wishes for a run from another terminal: a socket on 127.0.0.1, announced with a token in the user's run directory.

The run writes ``<pid>.json`` there, readable by its user alone; ``dea-rig stop``, ``pause`` and ``continue`` find it. A
request is one line, ``token word [text]``; the reply is one line of JSON. Nothing here waits or raises on the side of
the run: it is never ended by somebody who talks to it badly.
"""

from __future__ import annotations

import contextlib
import hmac
import json
import os
import secrets
import socket
import stat
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rig.base.errors import ConfigError
from rig.operator.control import Control

LONGEST = 1024  # bytes of a request
MOST = 8  # connections at a time
PATIENCE_S = 3.0  # for a reply: the loop looks twenty times a second, unless it hangs


def run_directory() -> Path:
    """The directory in which this user's live runs are announced; made when it does not exist.

    Raises
    ------
    ConfigError
        When it belongs to somebody else or others may write to it.
    """
    base = os.environ.get("XDG_RUNTIME_DIR") or os.environ.get("LOCALAPPDATA")
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = Path(base) / "dea-rig" if base else Path(tempfile.gettempdir()) / f"dea-rig-{user}"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made, so nobody could stop the run from there: {error}.") from None
    if not stat.S_ISDIR(found.st_mode) or (os.name == "posix" and (found.st_uid != user or found.st_mode & 0o077)):
        raise ConfigError(f"{folder}: is not a directory that only you may use. Remove it and start again.")
    return folder


class Remote:
    """The run's end: a `rig.operator.control.Source`."""

    name = "another terminal"

    def __init__(self, log: Path) -> None:
        self._token = secrets.token_hex(16)
        self._socket = socket.create_server(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._callers: dict[socket.socket, bytes] = {}
        self._file = run_directory() / f"{os.getpid()}.json"
        about = {"pid": os.getpid(), "port": self._socket.getsockname()[1], "token": self._token, "log": str(log)}
        self._file.unlink(missing_ok=True)  # of a dead process with our number
        with os.fdopen(os.open(self._file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            json.dump(about, file)

    def read(self, control: Control) -> list[str]:
        """Serve who has called. Replies are given at once, so there is nothing left to be said here."""
        with contextlib.suppress(OSError):
            while True:
                caller, _ = self._socket.accept()
                caller.setblocking(False)
                self._callers[caller] = b""
                if len(self._callers) > MOST:
                    self._hang_up(next(iter(self._callers)))
        for caller in list(self._callers):
            self._hear(caller, control)
        return []

    def _hear(self, caller: socket.socket, control: Control) -> None:
        try:
            data = caller.recv(LONGEST)
        except BlockingIOError:
            return
        except OSError:
            self._hang_up(caller)
            return
        heard = self._callers[caller] = self._callers[caller] + data
        if b"\n" in heard:
            with contextlib.suppress(OSError):
                caller.send(json.dumps(self._reply(heard, control)).encode() + b"\n")
            self._hang_up(caller)
        elif not data or len(heard) > LONGEST:
            self._hang_up(caller)

    def _reply(self, line: bytes, control: Control) -> dict[str, str]:
        token, _, rest = line.partition(b"\n")[0].partition(b" ")
        if not hmac.compare_digest(token, self._token.encode()):
            return {"said": "Refused: this is not the token of this run."}
        text = rest.decode(errors="replace")
        said = control.take(text, self.name) if text != "status" else ""
        return {"said": said, **control.describe()}

    def _hang_up(self, caller: socket.socket) -> None:
        self._callers.pop(caller, None)
        caller.close()

    def close(self) -> None:
        for caller in list(self._callers):
            self._hang_up(caller)
        self._socket.close()
        with contextlib.suppress(OSError):
            self._file.unlink(missing_ok=True)


@dataclass(frozen=True)
class LiveRun:
    """A run that somebody may talk to."""

    file: Path
    pid: int
    port: int
    token: str
    log: str

    def send(self, text: str) -> dict[str, str]:
        """One request and its reply.

        Raises
        ------
        ConnectionError
            Nobody listens there any more.
        ConfigError
            The run does not answer, or its answer is not one.
        """
        try:
            with socket.create_connection(("127.0.0.1", self.port), timeout=PATIENCE_S) as line:
                line.sendall(f"{self.token} {' '.join(text.split())}\n".encode())
                reply = json.loads(b"".join(iter(lambda: line.recv(LONGEST), b"")))
                return {str(key): str(value) for key, value in reply.items()}
        except ConnectionError:
            raise
        except (OSError, ValueError, AttributeError):
            raise ConfigError(
                f"The run of {self.log} (process {self.pid}) does not answer. Use the emergency stop; then end the "
                f"process: kill {self.pid}"
            ) from None

    @property
    def live(self) -> bool:
        """Whether somebody listens. The announcement of a run that was killed is removed."""
        try:
            self.send("status")
        except ConnectionError:
            self.file.unlink(missing_ok=True)
            return False
        except ConfigError:
            return True  # it hangs; who wants to stop it must be told
        return True


def live_run(log: Path | None = None) -> LiveRun:
    """The one run of this user that is going on; ``log`` names it when there are several.

    Raises
    ------
    ConfigError
        When there is none, or it is not clear which one is meant.
    """
    runs = [run for file in sorted(run_directory().glob("*.json")) if (run := _announced(file)) and run.live]
    if log is not None:
        runs = [run for run in runs if Path(run.log) == log.resolve()]
    if not runs:
        raise ConfigError(
            "No run of yours is going on" + (f" that writes {log}." if log else ".") + " Nothing was done."
        )
    if len(runs) > 1:
        listing = "\n".join(f"  {run.log}" for run in runs)
        raise ConfigError(f"Several runs are going on; name the log of the one that is meant:\n{listing}")
    return runs[0]


def _announced(file: Path) -> LiveRun | None:
    try:
        about: dict[str, Any] = json.loads(file.read_text())
        return LiveRun(file, int(about["pid"]), int(about["port"]), str(about["token"]), str(about["log"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None
