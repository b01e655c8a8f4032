"""This user's own directory for what running programs leave for each other, and locks on ports in it.

The directory belongs to the user alone (0700). Where the system has one for such files (``XDG_RUNTIME_DIR``,
``/run/user/UID``, ``LOCALAPPDATA``) it is there; otherwise it is made in the temporary directory with a name that
nobody can guess, so that another user can neither read it nor make it first.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import stat
import tempfile
from pathlib import Path

from drivers.links.link import DeviceError
from drivers.links.system import lock, user_number

NAME = "dea-rig"
_COM = re.compile(r"(?:\\\\\.\\|//\./)?(com[0-9]+):?", re.IGNORECASE)
_TRIES = 20  # another program may remove a lock or the directory at the moment in which it is looked at


def user_directory() -> Path:
    """The user's own directory; made when it does not exist.

    Raises
    ------
    OSError
        It cannot be made.
    """
    user = user_number()
    for base in (os.environ.get("XDG_RUNTIME_DIR"), os.environ.get("LOCALAPPDATA"), f"/run/user/{user}"):
        if not base or not Path(base).is_dir():
            continue
        folder = Path(base) / NAME
        with contextlib.suppress(OSError):
            folder.mkdir(mode=0o700, exist_ok=True)
        if _is_ours(folder, user):
            return folder
    temporary = Path(tempfile.gettempdir())
    existing = _ours_in(temporary, user)
    if existing is None:
        tempfile.mkdtemp(prefix=f"{NAME}-{user}-", dir=temporary)
        existing = _ours_in(temporary, user)  # of two programs that start together both take the first
    if existing is None:
        raise OSError(0, f"no directory of this user's own can be made in {temporary}")
    return existing


def remove_if_empty(folder: Path) -> None:
    """Remove the user's directory when nothing is left in it."""
    with contextlib.suppress(OSError):
        folder.rmdir()


def _ours_in(temporary: Path, user: int) -> Path | None:
    return min((one for one in temporary.glob(f"{NAME}-{user}-*") if _is_ours(one, user)), default=None)


def _is_ours(folder: Path, user: int) -> bool:
    """Whether it is a true directory of this user, closed to everybody else."""
    try:
        found = folder.lstat()
    except OSError:
        return False
    if os.name != "posix":
        return stat.S_ISDIR(found.st_mode)
    return stat.S_ISDIR(found.st_mode) and found.st_uid == user and not found.st_mode & 0o077


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
                    device, f"the lock file of port {port} cannot be opened ({error.strerror or error})", "Remove it."
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
