"""The host's ends of the simulated bench's wires, in memory, in the shape that drivers expect of a link."""

from __future__ import annotations

from drivers.links.link import CanFrame, DeviceLost
from rig.base.clock import Clock
from rig.sim.wire import ByteWire, FrameWire, WireGone


class MemoryByteLink:
    """A serial line to a simulated instrument; bytes arrive when the bench's clock says so."""

    def __init__(self, name: str, wire: ByteWire, clock: Clock) -> None:
        self.name = name
        self._wire = wire
        self._clock = clock

    def read(self) -> bytes:
        try:
            return self._wire.host_read(self._clock.now())
        except WireGone:
            raise DeviceLost(self.name, "the simulated port is gone") from None

    def write(self, data: bytes) -> None:
        try:
            self._wire.host_write(data, self._clock.now())
        except WireGone:
            raise DeviceLost(self.name, "the simulated port is gone") from None

    def reopen(self) -> bool:
        """Never: a wire in memory that comes back needs no opening."""
        return False

    def close(self) -> None:
        """Nothing to release."""


class MemoryFrameLink:
    """A CAN bus with a simulated node."""

    def __init__(self, name: str, wire: FrameWire, clock: Clock) -> None:
        self.name = name
        self._wire = wire
        self._clock = clock

    def read(self) -> list[CanFrame]:
        try:
            return [CanFrame(*frame) for frame in self._wire.host_read(self._clock.now())]
        except WireGone:
            raise DeviceLost(self.name, "the simulated bus is gone") from None

    def write(self, frame: CanFrame, *, urgent: bool = False) -> None:
        try:
            self._wire.host_write((frame.id, frame.data), self._clock.now())
        except WireGone:
            raise DeviceLost(self.name, "the simulated bus is gone") from None

    def reopen(self) -> bool:
        """Never: a wire in memory that comes back needs no opening."""
        return False

    def close(self) -> None:
        """Nothing to release."""
