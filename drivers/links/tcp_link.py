"""TCP connections: never waiting once they are open, gone in one way only.

A connection that the other end closes, or that takes nothing for `TAKES_S`, is lost. Closing it changes nothing at the
other end: a device keeps its outputs.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from collections.abc import Callable, Sequence

from drivers.links.link import DeviceError, DeviceLost

OPEN_S = 3.0  # how long opening may wait for the device
TAKES_S = 0.5  # a connection that has taken nothing for so long, with bytes waiting, is lost
MOST_AT_ONCE = 65_536  # bytes of one read
MOST_WAITING = 65_536  # bytes not taken yet: far more than any dialogue has outstanding
LOOK_AGAIN_S = 0.5  # how often a lost connection is tried again


class TcpLink:
    """A `drivers.links.link.ByteLink` over a TCP connection.

    Parameters
    ----------
    name : str
        Name of the device that is on it, for messages.
    host, port : str, int
        Where it listens.
    adopt : sequence of int, optional
        Descriptor of a connection that another process has opened, in place of opening it.
    clock : callable
        Seconds; a real connection lives in real time.

    Raises
    ------
    DeviceError
        Nobody answers there, or the connection is refused.
    """

    def __init__(
        self,
        name: str,
        host: str,
        port: int,
        *,
        adopt: Sequence[int] = (),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name = f"{host}:{port}"
        self.settings = {"host": host, "tcp_port": str(port)}
        self.counters = {"reopened": 0}
        self._label = f"{name} ({self.name})"
        self._where = (host, port)
        self._clock = clock
        self._closed = False
        self._waiting = bytearray()
        self._taken_at = clock()
        self._next_look = clock()
        self._coming: socket.socket | None = None  # a connection that is being made again
        self._socket: socket.socket | None
        if adopt:
            self._socket = socket.socket(fileno=adopt[0])
        else:
            try:
                self._socket = socket.create_connection(self._where, timeout=OPEN_S)
            except OSError as error:
                raise DeviceError(
                    self._label,
                    f"no connection ({error.strerror or error or 'time-out'})",
                    "Check that it is switched on, its network cable and its address; end other programs that are "
                    "connected to it, for a device takes few connections at once.",
                ) from None
        _never_wait(self._socket)

    def read(self) -> bytes:
        """Everything that has arrived, at most `MOST_AT_ONCE` bytes; sends what waits."""
        try:
            connection = self._connected()
            self._send(connection)
            data = connection.recv(MOST_AT_ONCE)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self._lost(error.strerror or str(error)) from None
        if not data:
            self._shut()
            raise self._lost("the other end closed it")
        return data

    def write(self, data: bytes, *, behind: bytes | None = None) -> None:
        """Send ``data``, or keep what the connection does not take now; ``behind`` as `SerialLink.write` has it."""
        try:
            connection = self._connected()
            if not self._waiting:
                self._taken_at = self._clock()
            place = len(self._waiting) if behind is None else self._waiting.find(behind) + len(behind)
            self._waiting[place:place] = data
            self._send(connection)
        except OSError as error:
            raise self._lost(error.strerror or str(error)) from None

    def _send(self, connection: socket.socket) -> None:
        if not self._waiting:
            return
        taken = 0
        with contextlib.suppress(BlockingIOError):
            taken = connection.send(self._waiting)
        del self._waiting[:taken]
        now = self._clock()
        if taken:
            self._taken_at = now
        if len(self._waiting) > MOST_WAITING or (self._waiting and now - self._taken_at > TAKES_S):
            self._waiting.clear()
            raise OSError("it takes no more data")

    @property
    def descriptors(self) -> tuple[int, ...]:
        """Descriptor for another process's ``adopt``; empty where it cannot be handed over."""
        return () if self._socket is None or os.name != "posix" else (self._socket.fileno(),)

    def reopen(self) -> bool:
        """Try to connect again, without waiting, at most every `LOOK_AGAIN_S`; True when it is connected."""
        now = self._clock()
        if self._closed:
            return False
        if self._coming is None:
            if now < self._next_look:
                return False
            self._next_look = now + LOOK_AGAIN_S
            self._coming = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            self._coming.setblocking(False)
            self._coming.connect_ex(self._where)
        coming = self._coming
        ready = select.select([], [coming], [], 0)[1]
        if not ready and now < self._next_look:
            return False
        self._coming = None
        if not ready or coming.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            coming.close()
            return False
        self._shut()
        _never_wait(coming)
        self._socket = coming
        self._waiting.clear()
        self.counters["reopened"] += 1
        return True

    def resume(self) -> None:
        """Take it over from a process that may have died in the middle of a request: nothing to do for bytes."""

    def close(self) -> None:
        """Release the connection. Calling it twice does no harm."""
        self._closed = True
        if self._coming is not None:
            self._coming.close()
            self._coming = None
        self._shut()

    def _shut(self) -> None:
        connection, self._socket = self._socket, None
        if connection is not None:
            connection.close()

    def _connected(self) -> socket.socket:
        if self._socket is None:
            raise OSError("it was closed")
        return self._socket

    def _lost(self, why: str) -> DeviceLost:
        return DeviceLost(self._label, f"the connection is gone ({why})", "Check its network cable and its power.")


def _never_wait(connection: socket.socket) -> None:
    connection.setblocking(False)
    with contextlib.suppress(OSError):  # a pair of sockets in a test has no such option
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
