"""Which ports lead to a simulated bench, provably: said by the process that serves it, while it does.

The server keeps a file in this user's own directory, which nobody else can write: its process number, when that process
began, and the terminals and TCP ports of this machine that it serves. It counts only while that very process lives and,
where the system tells (Linux), has the other ends of these terminals open and listens on these ports. A list of ports
that was printed once proves nothing later: the system gives the same names to others.
"""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path

from drivers.links.own_directory import remove_if_empty, user_directory

LARGEST = 4096  # bytes of such a file
LOOPBACK = "127.0.0.1"
_TCP = f"tcp:{LOOPBACK}:"
_LISTENING = "0A"  # in /proc/net/tcp
_numbers = itertools.count()


class Announcement:
    """What one server says of itself. Where no file can be kept its ports count as real."""

    def __init__(self) -> None:
        self._path: Path | None = None

    def say(self, ports: Iterable[str]) -> None:
        """These are its terminals from now on."""
        content = {
            "pid": os.getpid(),
            "began": _began(os.getpid()),
            "ports": [_name(port) for port in ports],
        }
        with suppress(OSError):
            path = self._path or user_directory() / f"served-{os.getpid()}-{next(_numbers)}.json"
            part = path.with_suffix(".part")
            part.write_text(json.dumps(content), encoding="utf-8")
            part.replace(path)
            self._path = path

    def withdraw(self) -> None:
        """It serves no more."""
        path, self._path = self._path, None
        if path is not None:
            with suppress(OSError):
                path.unlink(missing_ok=True)
                remove_if_empty(path.parent)


def are_served(ports: Iterable[str]) -> bool:
    """Whether each of these ports, behind whatever name, is served by a simulated bench at this moment."""
    wanted = {_name(port) for port in ports}
    try:
        files = sorted(user_directory().glob("served-*.json"))
    except OSError:
        return False
    for file in files:
        with suppress(OSError, ValueError, KeyError, TypeError):
            said = json.loads(file.read_bytes()[:LARGEST])
            if wanted <= set(said["ports"]) and _is_true(int(said["pid"]), str(said["began"]), wanted):
                return True
    return False


def _is_true(pid: int, began: str, ports: set[str]) -> bool:
    try:
        os.kill(pid, 0)
    except OSError:
        return False
    if _began(pid) != began:
        return False
    terminals, numbers = _terminals_of(pid), _listening(pid)
    known = {port for port in ports if (numbers if port.startswith(_TCP) else terminals) is None}
    return ports <= known | (terminals or set()) | (numbers or set())


def tcp_port(number: int) -> str:
    """How a TCP port of this machine is called here."""
    return f"{_TCP}{number}"


def _name(port: str) -> str:
    return port if port.startswith(_TCP) else os.path.realpath(port)


def _listening(pid: int) -> set[str] | None:
    """The TCP ports of the loopback on which the process listens; None where the system does not say."""
    try:
        lines = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    except OSError:
        return None
    sockets = set()
    with suppress(OSError):
        for one in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(OSError):  # it was closed meanwhile
                sockets.add(str(one.readlink()))
    return {
        tcp_port(int(line[1].partition(":")[2], 16))
        for line in lines
        if line[3] == _LISTENING and line[1].startswith("0100007F:") and f"socket:[{line[9]}]" in sockets
    }


def _began(pid: int) -> str:
    """When the process began, in whatever unit the system has; empty where it does not say."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return ""


def _terminals_of(pid: int) -> set[str] | None:
    """The pseudo-terminals whose other ends the process has open; None where the system does not say."""
    if not _system_tells():
        return None
    found = set()
    for one in Path(f"/proc/{pid}/fdinfo").iterdir():
        with suppress(OSError, ValueError):
            found |= {f"/dev/pts/{number}" for number in _terminals_in(one)}
    return found


def _terminals_in(file: Path) -> list[int]:
    lines = file.read_text().splitlines()
    return [int(line.split()[1]) for line in lines if line.startswith("tty-index:")]


@cache
def _system_tells() -> bool:
    """Whether the system says of an open descriptor to which pseudo-terminal it is the other end."""
    if os.name != "posix":
        return False
    try:
        master, slave = os.openpty()
    except OSError:
        return False
    try:
        return bool(_terminals_in(Path(f"/proc/self/fdinfo/{master}")))
    except (OSError, ValueError):
        return False
    finally:
        os.close(master)
        os.close(slave)
