"""Wires between the host and a simulated instrument: what is written at one end arrives at the other, later.

The host's methods are ``host_write`` and ``host_read``; the instrument's are ``send`` and ``deliveries``. Time is
always an argument. Nothing is read before it has arrived, and order is kept.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable

# As many bytes as a Linux pseudo-terminal holds before it refuses more.
CAPACITY = 20_480
CAN_CAPACITY = 512

Frame = tuple[int, bytes]


class WireGone(Exception):
    """The port or bus is not there (any more)."""


class ByteWire:
    """A serial line.

    Parameters
    ----------
    latency : float
        Seconds that every byte takes, each way, besides the line rate.
    baud : int
        Line rate in bits per second with ten bits to the byte; 0 for a line that takes no time (USB).
    capacity : int
        Bytes that may wait for the host. What does not fit is lost as a whole message, and counted.

    Attributes
    ----------
    upset_from_device, upset_to_device : callable or None
        Faults: ``(message, t) -> [(t, message), ...]``, applied to what is sent.
    """

    def __init__(self, latency: float = 0.0, baud: int = 0, capacity: int = CAPACITY) -> None:
        self._latency = latency
        self._byte_time = 10.0 / baud if baud else 0.0
        self._capacity = capacity
        self._to_host: deque[tuple[float, bytes]] = deque()  # when its first bit leaves (latency added), message
        self._to_host_free = 0.0
        self._waiting = 0
        self._to_device: deque[tuple[float, bytes]] = deque()  # when its last bit has arrived, message
        self._to_device_free = 0.0
        self.gone = False
        self.lost_bytes = 0
        self.upset_from_device: Callable[[bytes, float], Iterable[tuple[float, bytes]]] | None = None
        self.upset_to_device: Callable[[bytes, float], Iterable[tuple[float, bytes]]] | None = None

    def host_write(self, data: bytes, t: float) -> None:
        """Send ``data`` from the host at time ``t``."""
        if self.gone:
            raise WireGone
        pieces = [(t, data)] if self.upset_to_device is None else self.upset_to_device(data, t)
        for start, piece in pieces:
            self._to_device_free = max(start, self._to_device_free) + len(piece) * self._byte_time
            self._to_device.append((self._to_device_free + self._latency, piece))

    def host_read(self, t: float) -> bytes:
        """Everything that has arrived at the host by time ``t``."""
        if self.gone:
            raise WireGone
        out = bytearray()
        queue = self._to_host
        while queue:
            start, data = queue[0]
            if self._byte_time:
                arrived = min(len(data), math.floor((t - start) / self._byte_time + 1e-9))
            else:
                arrived = len(data) if start <= t else 0
            if arrived <= 0:
                break
            out += data[:arrived]
            if arrived < len(data):
                queue[0] = (start + arrived * self._byte_time, data[arrived:])
                break
            queue.popleft()
        self._waiting -= len(out)
        return bytes(out)

    def send(self, data: bytes, t: float) -> bool:
        """Send ``data`` from the instrument at time ``t``; False when it was lost because nobody reads."""
        if self.upset_from_device is None:
            return self._send(data, t)
        ok = True
        for start, piece in self.upset_from_device(data, t):
            ok &= self._send(piece, start)
        return ok

    def _send(self, data: bytes, t: float) -> bool:
        if self.gone or self._waiting + len(data) > self._capacity:
            self.lost_bytes += len(data)
            return False
        start = max(t + self._latency, self._to_host_free)
        self._to_host.append((start, data))
        self._to_host_free = start + len(data) * self._byte_time
        self._waiting += len(data)
        return True

    def deliveries(self, t: float) -> list[tuple[float, bytes]]:
        """Messages that have arrived at the instrument by ``t``, each with the time of its last bit."""
        out = []
        while self._to_device and self._to_device[0][0] <= t:
            out.append(self._to_device.popleft())
        return out

    @property
    def next_delivery(self) -> float:
        """When the next message arrives at the instrument; inf when none is under way."""
        return self._to_device[0][0] if self._to_device else math.inf

    @property
    def next_arrival(self) -> float:
        """When the next byte arrives at the host; inf when none is under way."""
        return self._to_host[0][0] + self._byte_time if self._to_host else math.inf

    def cut(self) -> None:
        """Pull the plug: what is under way is lost, both ends see it at once."""
        self.gone = True
        self._to_host.clear()
        self._to_device.clear()
        self._waiting = 0

    def restore(self) -> None:
        """Put the plug back."""
        self.gone = False


class TcpWire(ByteWire):
    """A TCP connection: bytes, as on a serial line."""


class FrameWire:
    """A CAN bus with the host and one node on it; classic frames ``(id, data)`` with 11-bit identifiers.

    A frame of n bytes occupies the bus for 47 + 8 n bits (stuff bits left out), one frame at a time in either
    direction.
    """

    def __init__(self, latency: float = 0.0, bitrate: int = 125_000, capacity: int = CAN_CAPACITY) -> None:
        self.bitrate = bitrate
        self._latency = latency
        self._capacity = capacity
        self._to_host: deque[tuple[float, Frame]] = deque()
        self._to_device: deque[tuple[float, Frame]] = deque()
        self._bus_free = 0.0
        self.gone = False
        self.lost_frames = 0
        self.upset_from_device: Callable[[Frame, float], Iterable[tuple[float, Frame]]] | None = None
        self.upset_to_device: Callable[[Frame, float], Iterable[tuple[float, Frame]]] | None = None

    def _occupy(self, frame: Frame, t: float) -> float:
        self._bus_free = max(t, self._bus_free) + (47 + 8 * len(frame[1])) / self.bitrate
        return self._bus_free

    def host_write(self, frame: Frame, t: float) -> None:
        """Send one frame from the host at time ``t``."""
        if self.gone:
            raise WireGone
        identifier, data = frame
        frame = (identifier, bytes(data))
        pieces = [(t, frame)] if self.upset_to_device is None else self.upset_to_device(frame, t)
        for start, piece in pieces:
            self._to_device.append((self._occupy(piece, start) + self._latency, piece))

    def host_read(self, t: float) -> list[Frame]:
        """All frames that have arrived at the host by time ``t``, in order."""
        if self.gone:
            raise WireGone
        out = []
        while self._to_host and self._to_host[0][0] <= t:
            out.append(self._to_host.popleft()[1])
        return out

    def send(self, frame: Frame, t: float) -> bool:
        """Send one frame from the node at time ``t``; False when it was lost because nobody reads."""
        ok = True
        pieces = [(t, frame)] if self.upset_from_device is None else self.upset_from_device(frame, t)
        for start, piece in pieces:
            if self.gone or len(self._to_host) >= self._capacity:
                self.lost_frames += 1
                ok = False
            else:
                self._to_host.append((self._occupy(piece, start) + self._latency, piece))
        return ok

    def deliveries(self, t: float) -> list[tuple[float, Frame]]:
        """Frames that have arrived at the node by ``t``, each with its time."""
        out = []
        while self._to_device and self._to_device[0][0] <= t:
            out.append(self._to_device.popleft())
        return out

    @property
    def next_delivery(self) -> float:
        """When the next frame arrives at the node; inf when none is under way."""
        return self._to_device[0][0] if self._to_device else math.inf

    @property
    def next_arrival(self) -> float:
        """When the next frame arrives at the host; inf when none is under way."""
        return self._to_host[0][0] if self._to_host else math.inf

    def cut(self) -> None:
        """Take the bus away: what is under way is lost."""
        self.gone = True
        self._to_host.clear()
        self._to_device.clear()

    def restore(self) -> None:
        """Bring the bus back."""
        self.gone = False
