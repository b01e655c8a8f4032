"""What a driver sees of its wire, and the one family of errors that every driver raises.

A link never blocks: ``read`` returns what has arrived, possibly nothing. Links over real ports are in
``serial_link`` and ``can_link``; the in-memory links of the simulated bench have the same shape.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol


class CanFrame(NamedTuple):
    """A classic CAN data frame with an 11-bit identifier and 0 to 8 data bytes."""

    id: int
    data: bytes


class ByteLink(Protocol):
    """A serial line. ``read`` and ``write`` raise `DeviceLost` once the port is gone."""

    name: str

    def read(self) -> bytes:
        """All bytes that have arrived since the last call; ``b""`` when there are none."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of ``data``; what the port does not take at once goes out later."""
        ...

    def reopen(self) -> bool:
        """Look whether a port that was lost is back, now and then; True when it has been opened again."""
        ...

    def close(self) -> None:
        """Release the port. Calling it twice does no harm."""
        ...


class FrameLink(Protocol):
    """A CAN bus. ``read`` and ``write`` raise `DeviceLost` once the bus is gone."""

    name: str

    def read(self) -> list[CanFrame]:
        """All frames that have arrived since the last call, in order."""
        ...

    def write(self, frame: CanFrame, *, urgent: bool = False) -> None:
        """Send one frame; one for which there is no room goes out later, an urgent one before all others."""
        ...

    def reopen(self) -> bool:
        """As `ByteLink.reopen`."""
        ...

    def close(self) -> None:
        """Release the bus. Calling it twice does no harm."""
        ...


class DeviceError(Exception):
    """Something about a device on which the operator must act.

    Parameters
    ----------
    device : str
        The device's name in the scene, with its port where known.
    what : str
        What happened, as a sentence without its full stop.
    advice : str
        What to do about it.
    """

    def __init__(self, device: str, what: str, advice: str = "") -> None:
        super().__init__(f"{device}: {what}." + (f" {advice}" if advice else ""))
        self.device = device
        self.what = what
        self.advice = advice
        self.role = ""  # of the instrument in the scene; whoever polls it knows


class DeviceLost(DeviceError):
    """The port or bus is gone: unplugged, closed by the other end, or bus-off."""


class DeviceSilent(DeviceError):
    """No valid answer arrived in time, retries included."""


class DeviceRefused(DeviceError):
    """The device answered, and the answer was no; or the driver refuses a command that would be unsafe."""
