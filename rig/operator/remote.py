"""Wishes for a run from another terminal: a socket on 127.0.0.1, announced with a token in the user's run directory.

The run writes ``<pid>.json`` there, readable by its user alone; ``dea-rig stop``, ``pause`` and ``continue`` find it. A
request is one line, ``token source word [text]``; the reply is one line of JSON. Nothing here waits or raises on the
side of the run: it is never ended by somebody who talks to it badly.
"""

from __future__ import annotations

import contextlib
import hmac
import json
import os
import secrets
import socket
from pathlib import Path

from drivers.links.own_directory import remove_if_empty
from rig.operator.control import Control
from rig.operator.live import LONGEST, run_directory

MOST = 8  # connections at a time
TRIES = 20


# Who may speak, and what the log calls him.
SOURCES = {"terminal": "another terminal", "panel": "the panel"}


class Remote:
    """The run's end: a `rig.operator.control.Source`."""

    name = SOURCES["terminal"]

    def __init__(self, log: Path) -> None:
        self._token = secrets.token_hex(16)
        self._socket = socket.create_server(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._callers: dict[socket.socket, bytes] = {}
        about = {"pid": os.getpid(), "port": self._socket.getsockname()[1], "token": self._token, "log": str(log)}
        for left in reversed(range(TRIES)):
            self._file = run_directory() / f"{os.getpid()}.json"
            try:
                self._file.unlink(missing_ok=True)  # of a dead process with our number
                with os.fdopen(os.open(self._file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
                    json.dump(about, file)
                return
            except FileNotFoundError:  # another program has just removed the directory, which was empty
                if not left:
                    raise

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
        source, _, text = rest.decode(errors="replace").partition(" ")
        said = control.take(text, SOURCES.get(source, self.name)) if text != "status" else ""
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
            remove_if_empty(self._file.parent)
