"""Serial ports through pyserial: never waiting, opened for us alone, and gone in one way only.

What is framed, and how, is the codecs' business: `SerialLink.read` returns whatever has arrived.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.links.link import DeviceError, DeviceLost

if TYPE_CHECKING:
    import serial

# The one place for what only some operating systems have. pyserial's own exceptions are OSErrors, except that on POSIX
# it lets termios.error through, which is none.
_GONE: tuple[type[Exception], ...]
if sys.platform == "win32":
    import msvcrt

    _GONE = (OSError,)

    def _lock(fd: int) -> None:
        os.lseek(fd, 4096, os.SEEK_SET)  # beyond the text, which others may read
        try:
            msvcrt.locking(fd, msvcrt.LK_NBLCK, 1)
        finally:
            os.lseek(fd, 0, os.SEEK_SET)

    def _send(port: serial.Serial, data: bytes) -> int:
        return port.write(data) or 0

else:
    import fcntl
    import termios

    _GONE = (OSError, termios.error)

    def _lock(fd: int) -> None:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def _send(port: serial.Serial, data: bytes) -> int:
        # pyserial would call a process that was kept waiting for the processor a port that takes no data.
        try:
            return os.write(port.fileno(), data)
        except BlockingIOError:
            return 0


# pyserial raises the last one for a baud rate or a setting that this system's ports cannot have.
_UNUSABLE: tuple[type[Exception], ...] = (*_GONE, ValueError, NotImplementedError)


class PortLock:
    """Keeps other processes, and this one, from opening the same port twice.

    The operating system holds the lock on a file in the temporary directory, and lets go of it when the process that
    had it dies, however it dies: a file that is left behind locks nothing. The file says who holds it.

    Raises
    ------
    DeviceError
        Somebody else has the port.
    """

    def __init__(self, device: str, port: str) -> None:
        real = os.path.realpath(port) if os.sep in port else port.upper()
        key = hashlib.sha256(real.encode()).hexdigest()[:12]
        plain = re.sub(r"[^A-Za-z0-9]+", "-", Path(real).name)
        self.path = Path(tempfile.gettempdir()) / f"dea-rig-{plain}-{key}.lock"
        no_follow = getattr(os, "O_NOFOLLOW", 0)
        try:
            try:
                self._fd = os.open(self.path, os.O_RDWR | os.O_CREAT | no_follow, 0o666)
                ours = True
            except PermissionError:  # left by another user; it can be locked all the same
                self._fd = os.open(self.path, os.O_RDONLY | no_follow)
                ours = False
        except OSError as error:
            raise DeviceError(
                device, f"the lock file {self.path} cannot be opened ({error.strerror})", "Remove it."
            ) from None
        try:
            _lock(self._fd)
        except OSError:
            holder = os.read(self._fd, 20).decode("ascii", "replace").strip()
            os.close(self._fd)
            who = f"process {holder}" if holder.isdecimal() else "another process"
            raise DeviceError(
                device, f"port {port} is in use by {who}", "End that program, or name another port in the scene."
            ) from None
        if ours:
            os.ftruncate(self._fd, 0)
            os.write(self._fd, f"{os.getpid()}\n".encode())

    def release(self) -> None:
        """Let others have the port. Calling it twice does no harm."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


class SerialLink:
    """A `drivers.links.link.ByteLink` over a serial port, 8N1.

    Parameters
    ----------
    name : str
        Name of the device that is on it, for messages.
    port : str
        ``/dev/ttyUSB0``, ``COM3``; the link's own ``name``.
    baud : int
        Bits per second.

    A command always fits an empty buffer, so a port that does not take all of one at once counts as lost.

    ``settings`` says what was set and what the adapter made of it: adapters that collect bytes for up to 16 ms before
    they hand them on are asked not to.

    Raises
    ------
    DeviceError
        The port does not exist, is in use, or may not be opened.
    """

    def __init__(self, name: str, port: str, baud: int) -> None:
        import serial

        self.name = port
        self._label = f"{name} ({port})"
        self._closed = False
        self._lock = PortLock(self._label, port)
        try:
            self._serial = serial.Serial(port, baud, timeout=0, write_timeout=0, exclusive=True)
        except _UNUSABLE as error:
            self._lock.release()
            raise _not_opened(self._label, port, error) from None
        self.settings = {"port": port, "baud": str(baud), "low_latency": _ask_low_latency(self._serial)}
        timer = Path("/sys/class/tty", Path(os.path.realpath(port)).name, "device/latency_timer")
        if timer.is_file():  # FTDI adapters on Linux
            self.settings["latency_timer_ms"] = timer.read_text().strip()

    def read(self) -> bytes:
        try:
            self._check_open()
            waiting = self._serial.in_waiting
            return bytes(self._serial.read(waiting)) if waiting else b""
        except _GONE as error:
            raise self._lost("reading", error) from None

    def write(self, data: bytes) -> None:
        try:
            self._check_open()
            sent = _send(self._serial, data)
        except _GONE as error:
            raise self._lost("writing", error) from None
        if sent < len(data):
            raise DeviceLost(
                self._label,
                "the port takes no more data",
                "The adapter or the device hangs: unplug it and plug it in again.",
            )

    def fileno(self) -> int:
        """File descriptor to wait on with ``select``, on systems where serial ports have one."""
        try:
            return int(self._serial.fileno())
        except _GONE as error:
            raise self._lost("waiting", error) from None

    def close(self) -> None:
        self._closed = True
        try:
            self._serial.close()
        except _GONE:
            pass  # it is gone, which is what was wanted
        finally:
            self._lock.release()

    def _check_open(self) -> None:
        if self._closed:  # pyserial would let a TypeError through
            raise OSError("it was closed")

    def _lost(self, doing: str, error: Exception) -> DeviceLost:
        return DeviceLost(
            self._label, f"the port is gone ({doing}: {_reason(error)})", "Plug it in again, check its cable and power."
        )


def ports() -> list[str]:
    """Names of the serial ports that this machine has."""
    from serial.tools import list_ports

    return sorted(port.device for port in list_ports.comports())


def _not_opened(label: str, port: str, error: Exception) -> DeviceError:
    number = getattr(error, "errno", None)
    existing = ports()
    there = f"Ports on this machine: {', '.join(existing)}." if existing else "This machine has no serial port."
    if isinstance(error, ValueError):
        return DeviceError(label, f"port {port} cannot be set up ({error})", "Check the baud rate in the scene.")
    if os.sep in port and not Path(port).exists():
        return DeviceError(label, f"port {port} does not exist", there)
    if number == 13:  # EACCES
        return DeviceError(
            label,
            f"port {port} may not be opened by this user",
            "On Linux, become a member of the group that owns it (dialout, uucp) and log in again.",
        )
    return DeviceError(label, f"port {port} cannot be opened ({_reason(error)})", there)


def _reason(error: Exception) -> str:
    number = getattr(error, "errno", None)
    return os.strerror(number) if number else str(error) or type(error).__name__


def _ask_low_latency(port: serial.Serial) -> str:
    if not hasattr(port, "set_low_latency_mode"):
        return "not available (not on this operating system)"
    try:
        port.set_low_latency_mode(True)
    except _UNUSABLE as error:
        return f"not available ({_reason(error)})"
    return "on"
