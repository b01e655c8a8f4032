"""Locks on ports, in this user's own directory."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
from pathlib import Path

from drivers.links.link import DeviceError
from drivers.links.own_directory import remove_if_empty, user_directory
from drivers.links.system import lock

_COM = re.compile(r"(?:\\\\\.\\|//\./)?(com[0-9]+):?", re.IGNORECASE)
_TRIES = 20  # another program may remove a lock or the directory at the moment in which it is looked at


def one_name(port: str) -> str:
    r"""The one name of a port that has several, so that all of them lock the same.

    A link leads to its target; ``/dev/tty.*`` and ``/dev/cu.*`` are the two doors of one port on macOS; ``COM3``,
    ``com3:`` and ``\\.\COM3`` are one on Windows.
    """
    if plain := _COM.fullmatch(port):
        return plain[1].upper()
    if "://" in port:
        return port.lower()
    real = os.path.realpath(port) if os.sep in port else port.upper()
    return real.replace("/dev/tty.", "/dev/cu.", 1) if real.startswith("/dev/tty.") else real


class PortLock:
    """Keeps other programs of this user, and this one, from opening the same port twice.

    The operating system holds the lock on a file, and lets go of it when the last process that has it dies, however it
    dies: a file that is left behind locks nothing. The file says who holds it, and is removed by `release`. Needed to
    begin with a port; never on the way to "off".

    Raises
    ------
    DeviceError
        Somebody else has the port.
    """

    def __init__(self, device: str, port: str) -> None:
        real = one_name(port)
        key = hashlib.sha256(real.encode()).hexdigest()[:12]
        plain = re.sub(r"[^A-Za-z0-9]+", "-", Path(real).name)
        self.fd = -1
        for _ in range(_TRIES):
            try:
                self.path = user_directory() / f"{plain}-{key}.lock"
                fd = os.open(self.path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o600)
            except FileNotFoundError:
                continue
            except OSError as error:
                raise DeviceError(
                    device,
                    f"the lock file of port {port} cannot be opened ({error.strerror or error})",
                    "Remove it, or give this user a directory of its own (XDG_RUNTIME_DIR, TMPDIR).",
                ) from None
            try:
                lock(fd)
            except OSError:
                holder = os.read(fd, 20).decode("ascii", "replace").strip()
                os.close(fd)
                who = f"process {holder}" if holder.isdecimal() else "another process"
                raise DeviceError(
                    device, f"port {port} is in use by {who}", "End that program, or name another port in the scene."
                ) from None
            if self._is_current(fd):
                self.fd = fd
                break
            os.close(fd)  # whoever had it before has removed it meanwhile
        else:
            raise DeviceError(device, f"the lock file of port {port} changes all the time", "Try again.")
        with contextlib.suppress(OSError):  # a full disk: the lock holds, only its text is missing
            os.ftruncate(fd, 0)
            os.write(fd, f"{os.getpid()}\n".encode())

    def _is_current(self, fd: int) -> bool:
        try:
            there, here = self.path.stat(), os.fstat(fd)
        except OSError:
            return False
        return os.name != "posix" or (there.st_ino, there.st_dev) == (here.st_ino, here.st_dev)

    def release(self) -> None:
        """Let others have the port. Calling it twice does no harm."""
        if self.fd >= 0:
            fd, self.fd = self.fd, -1
            if os.name == "posix":  # elsewhere an open file cannot be removed
                with contextlib.suppress(OSError):
                    self.path.unlink()
            os.close(fd)
            remove_if_empty(self.path.parent)
