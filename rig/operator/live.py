"""The side of another terminal: find the run that is going on, and speak to it.

Imports little beside the standard library, so that ``dea-rig stop`` acts at once.
"""

from __future__ import annotations

import json
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.links.own_directory import user_directory
from rig.base.errors import ConfigError

LONGEST = 1024  # bytes of a request
REPLY_S = 3.0  # the loop looks twenty times a second, unless it hangs


def run_directory() -> Path:
    """The directory in which this user's live runs are announced; made when it does not exist.

    It belongs to this user alone. One of its name that somebody else has made, or that others may use, is not used.

    Raises
    ------
    ConfigError
        When it cannot be made.
    """
    try:
        return user_directory()
    except OSError as error:
        raise ConfigError(f"Nobody could stop the run from another terminal: {error}.") from None


@dataclass(frozen=True)
class LiveRun:
    """A run that somebody may talk to."""

    file: Path
    pid: int
    port: int
    token: str
    log: str

    def send(self, text: str, source: str = "terminal") -> dict[str, str]:
        """One request and its reply; ``source`` is a key of `rig.operator.remote.SOURCES`.

        Raises
        ------
        ConnectionError
            Nobody listens there any more.
        ConfigError
            The run does not answer, or its answer is not one.
        """
        try:
            with socket.create_connection(("127.0.0.1", self.port), timeout=REPLY_S) as line:
                line.sendall(f"{self.token} {source} {' '.join(text.split())}\n".encode())
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
    runs = live_runs()
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


def live_runs() -> list[LiveRun]:
    """All runs of this user that are going on. Raises `ConfigError` as `run_directory`."""
    return [run for file in sorted(run_directory().glob("[0-9]*.json")) if (run := _announced(file)) and run.live]


def _announced(file: Path) -> LiveRun | None:
    try:
        about: dict[str, Any] = json.loads(file.read_text())
        return LiveRun(file, int(about["pid"]), int(about["port"]), str(about["token"]), str(about["log"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None
