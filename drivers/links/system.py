"""What only some operating systems have: open ports that never wait, and locks on files. The one place for it."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import serial

MOST_AT_ONCE = 65536  # bytes of one read
LAST_BYTES_S = 0.2  # how long a close may wait for what was sent last


class Port(Protocol):
    """An open port; every method returns at once and raises one of `GONE` when the port is not there any more."""

    def read(self) -> bytes: ...

    def write(self, data: bytes) -> int:
        """How many bytes were taken."""
        ...

    def fileno(self) -> int: ...

    def close(self) -> None: ...


# pyserial's own exceptions are OSErrors, except that on POSIX
# it lets termios.error through, which is none.
GONE: tuple[type[Exception], ...]
if sys.platform == "win32":
    import msvcrt

    GONE = (OSError,)

    class _PyserialPort:
        """Through pyserial, whose overlapped writes do not wait when ``write_timeout`` is 0."""

        def __init__(self, port: serial.Serial) -> None:
            self._serial = port

        def read(self) -> bytes:
            waiting = min(self._serial.in_waiting, MOST_AT_ONCE)
            return bytes(self._serial.read(waiting)) if waiting else b""

        def write(self, data: bytes) -> int:
            return self._serial.write(data) or 0

        def fileno(self) -> int:
            return int(self._serial.fileno())

        def close(self) -> None:
            self._serial.close()

    def open_port(opened: serial.Serial) -> Port:
        """The port that pyserial has opened and set up."""
        return _PyserialPort(opened)

    def adopted_port(descriptor: int) -> Port:
        """A port that another process has opened."""
        raise OSError("descriptors of ports cannot be adopted here")

    def user_number() -> int:
        """Number of the user whose program this is; 0 where users have none."""
        return 0

    def lock(fd: int) -> None:
        """Lock an open file for this process, or raise OSError at once."""
        os.lseek(fd, 4096, os.SEEK_SET)  # beyond the text, which others may read
        try:
            msvcrt.locking(fd, msvcrt.LK_NBLCK, 1)
        finally:
            os.lseek(fd, 0, os.SEEK_SET)

else:
    import fcntl
    import struct
    import termios

    GONE = (OSError, termios.error)

    class DescriptorPort:
        """The bare descriptor of a port that has been set up; not waiting is a property of the open file."""

        def __init__(self, descriptor: int) -> None:
            self._fd = descriptor

        def read(self) -> bytes:
            # A vanished USB port reads as empty for ever; only this call says that it is gone.
            (waiting,) = struct.unpack("i", fcntl.ioctl(self._fd, termios.FIONREAD, bytes(4)))
            if not waiting:
                return b""
            try:
                data = os.read(self._fd, min(waiting, MOST_AT_ONCE))
            except BlockingIOError:
                return b""
            if not data:
                raise OSError("it says that bytes are waiting, and gives none")
            return data

        def write(self, data: bytes) -> int:
            try:
                return os.write(self._fd, data)
            except BlockingIOError:
                return 0

        def fileno(self) -> int:
            if self._fd < 0:
                raise OSError("it was closed")
            return self._fd

        def close(self) -> None:
            fd, self._fd = self._fd, -1
            if fd >= 0:
                with contextlib.suppress(*GONE):
                    _drop_what_hangs(fd)
                os.close(fd)

    def _drop_what_hangs(fd: int) -> None:
        """The last close of a port waits half a minute for bytes that it cannot send: such are dropped before."""
        left = LAST_BYTES_S
        while struct.unpack("i", fcntl.ioctl(fd, termios.TIOCOUTQ, bytes(4)))[0]:
            if left <= 0:
                termios.tcflush(fd, termios.TCOFLUSH)
                return
            time.sleep(0.01)
            left -= 0.01

    def open_port(opened: serial.Serial) -> Port:
        """The port that pyserial has opened and set up."""
        descriptor = os.dup(opened.fileno())
        opened.close()  # with it go the four pipes that pyserial needs for its own reading
        return DescriptorPort(descriptor)

    def adopted_port(descriptor: int) -> Port:
        """A port that another process has opened."""
        return DescriptorPort(descriptor)

    def user_number() -> int:
        """Number of the user whose program this is."""
        return os.getuid()

    def lock(fd: int) -> None:
        """Lock an open file for those who share it, or raise OSError at once."""
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
