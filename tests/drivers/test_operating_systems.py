"""What only POSIX systems have stands in guarded places; and the serial link as Windows would have it."""

from __future__ import annotations

import ast
import errno
import importlib.util
import io
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from drivers.links.link import DeviceError, DeviceLost

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("drivers", "rig", "calibration", "model", "sim_fixtures")
# What is not there on Windows.
MODULES = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}
NAMES = {
    "os": {
        *("fork", "forkpty", "openpty", "ttyname", "tcgetpgrp", "ctermid", "setsid", "setpgid", "getpgid", "killpg"),
        *("getuid", "geteuid", "getgid", "chown", "fchmod", "mkfifo", "mknod", "nice", "statvfs", "fstatvfs", "uname"),
        *("pread", "pwrite", "preadv", "pwritev", "fdatasync", "posix_fallocate", "sendfile", "wait", "WNOHANG"),
        *("getloadavg", "sched_yield", "sched_setaffinity", "pidfd_open", "O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC"),
    },
    "signal": {
        *("SIGHUP", "SIGQUIT", "SIGKILL", "SIGSTOP", "SIGTSTP", "SIGCONT", "SIGUSR1", "SIGUSR2", "SIGALRM", "SIGCHLD"),
        *("SIGPIPE", "alarm", "setitimer", "pthread_sigmask", "sigwait", "siginterrupt", "pause"),
    },
    "socket": {"AF_UNIX", "SCM_RIGHTS"},
    "select": {"poll", "epoll", "kqueue"},
}
NAMED = re.compile(rf"\b({'|'.join(sorted(MODULES.union(*NAMES.values())))})\b")
ASKS = ("sys.platform", "os.name", "platform.system", "hasattr(")


def used(path: Path) -> Iterator[tuple[str, bool]]:
    """(POSIX-only name, whether the block, function or class around it asks for the system) of one module."""
    source = path.read_text(encoding="utf-8")
    if not NAMED.search(source):
        return  # most modules: nothing to parse
    lines = source.splitlines()
    for block in ast.parse(source).body:
        text = "\n".join(lines[block.lineno - 1 : block.end_lineno])
        guarded = any(word in text for word in ASKS)
        for node in ast.walk(block):
            match node:
                case ast.Import(names):
                    yield from ((alias.name, guarded) for alias in names if alias.name in MODULES)
                case ast.ImportFrom(module=str(module)) if module in MODULES:
                    yield module, guarded
                case ast.Attribute(value=ast.Name(id=owner), attr=name) if name in NAMES.get(owner, ()):
                    yield f"{owner}.{name}", guarded


def posix_only(path: Path) -> bool:
    """Whether a module says of itself that it needs POSIX."""
    return "POSIX only" in (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "")


def test_drivers_ask_for_the_system_in_one_place() -> None:
    found = {path.name: list(used(path)) for path in sorted((ROOT / "drivers").rglob("*.py"))}
    places = {name: names for name, names in found.items() if names}
    assert set(places) == {"system.py"}
    assert all(guarded for _, guarded in places["system.py"])
    assert {"fcntl", "termios"} <= {name for name, _ in places["system.py"]}  # it does find them


def test_nothing_else_needs_posix_without_asking_or_saying_so() -> None:
    naked: dict[str, list[str]] = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            names = sorted({name for name, guarded in used(path) if not guarded})
            if names and not posix_only(path):
                naked[str(path.relative_to(ROOT))] = names
    assert naked == {}


# -- the serial link as Windows would have it --------------------------------------------------------------------------


class Msvcrt(ModuleType):
    """Locks of byte ranges, as Windows has them: by file and owner, refused at once."""

    LK_NBLCK = 2

    def __init__(self) -> None:
        super().__init__("msvcrt")
        self.locked: set[tuple[int, int]] = set()
        self.at: list[int] = []

    def locking(self, descriptor: int, mode: int, count: int) -> None:
        assert mode == self.LK_NBLCK and count == 1
        self.at.append(os.lseek(descriptor, 0, os.SEEK_CUR))
        file = os.fstat(descriptor)
        key = (file.st_dev, file.st_ino)
        if key in self.locked:
            raise OSError(errno.EACCES, "Permission denied")
        self.locked.add(key)


class Port:
    """pyserial's port on Windows: no file descriptor, no low-latency mode."""

    def __init__(self, port: str, baud: int, **options: Any) -> None:
        if port == "COM9":
            raise OSError(errno.ENOENT, "could not open port 'COM9': FileNotFoundError")
        assert options == {"timeout": 0, "write_timeout": 0, "exclusive": True}
        self.sent = b""
        self.takes = 1000
        self.gone = False
        self.closed = False

    @property
    def in_waiting(self) -> int:
        if self.gone:
            raise OSError(errno.EIO, "ClearCommError failed")
        return 3

    def read(self, count: int) -> bytes:
        return b"abc"[:count]

    def write(self, data: bytes) -> int:
        if self.gone:
            raise OSError(errno.EIO, "WriteFile failed")
        self.sent += data[: self.takes]
        return len(data[: self.takes])

    def fileno(self) -> int:
        raise io.UnsupportedOperation("fileno")

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """`drivers.links.serial_link`, imported anew as if on Windows."""
    import tempfile

    import serial
    import serial.tools.list_ports

    monkeypatch.setattr(sys, "platform", "win32")
    for name in ("fcntl", "termios"):
        monkeypatch.setitem(sys.modules, name, None)  # importing it fails
    monkeypatch.setitem(sys.modules, "msvcrt", Msvcrt())
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(serial, "Serial", Port)
    monkeypatch.setattr(serial.tools.list_ports, "comports", list)
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    for name in ("system", "port_lock", "serial_link"):
        full = f"drivers.links.{name}"
        spec = importlib.util.spec_from_file_location(full, ROOT / "drivers" / "links" / f"{name}.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, full, module)
        spec.loader.exec_module(module)
    return module


def test_on_windows_a_port_is_read_written_and_locked(windows: ModuleType) -> None:
    link = windows.SerialLink("stage", "COM3", 115_200)
    assert link.settings["low_latency"].startswith("not available")
    link.write(b"/1 get pos\n")
    assert link.read() == b"abc" and link._port._serial.sent == b"/1 get pos\n"
    assert sys.modules["msvcrt"].at == [4096]  # beyond the text, which others may read
    with pytest.raises(DeviceError, match=f"com3 is in use by process {os.getpid()}"):
        windows.SerialLink("other", "com3", 115_200)  # names of ports know no case
    device = link._port._serial
    device.takes = 2
    now = [0.0]
    link._clock = lambda: now[0]
    link.write(b"/1 get pos\n")  # the rest goes out later
    link.read()
    assert device.sent.endswith(b"/1 g")
    device.takes = 0
    link.read()
    now[0] += 1.0
    with pytest.raises(DeviceLost, match="takes no more data"):
        link.read()
    link.close()
    link.close()
    assert device.closed
    with pytest.raises(DeviceLost, match="gone"):
        link.read()


def test_on_windows_a_port_that_goes_is_one_error(windows: ModuleType) -> None:
    link = windows.SerialLink("stage", "COM4", 115_200)
    link._port._serial.gone = True
    for act in (link.read, lambda: link.write(b"x"), link.fileno):
        with pytest.raises(DeviceLost, match="gone"):
            act()


def test_on_windows_a_port_that_is_not_there_is_told(windows: ModuleType) -> None:
    with pytest.raises(DeviceError, match="COM9 cannot be opened"):
        windows.SerialLink("stage", "COM9", 115_200)
