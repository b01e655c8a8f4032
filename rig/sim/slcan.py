"""The adapter's side of the Lawicel serial-line CAN protocol: ASCII lines on one end, a bus on the other.

``S4`` 125 kbit/s, ``O`` open, ``L`` listen only, ``C`` close, ``tiiildd..`` a frame with an 11-bit identifier. A line
ends with CR and is answered by CR, or by BEL when it is refused. Frames from the bus come as unanswered ``t`` lines.
"""

from __future__ import annotations

import re

from rig.sim.wire import Frame, FrameWire

BITRATES = {
    "S0": 10_000,
    "S1": 20_000,
    "S2": 50_000,
    "S3": 100_000,
    "S4": 125_000,
    "S5": 250_000,
    "S6": 500_000,
    "S7": 800_000,
    "S8": 1_000_000,
}
FRAME = re.compile(r"t(?P<id>[0-7][0-9A-Fa-f]{2})(?P<length>[0-8])(?P<data>(?:[0-9A-Fa-f]{2})*)")
OK, REFUSED = b"\r", b"\x07"
LONGEST = 64


class SlcanAdapter:
    """One adapter between a host's serial port and ``bus``. At another bit rate than the bus it hears nothing."""

    def __init__(self, bus: FrameWire) -> None:
        self._bus = bus
        self._line = bytearray()
        self._bitrate: int | None = None
        self._open = False
        self._listen_only = False

    def host_write(self, data: bytes, t: float) -> bytes:
        """Bytes from the host at time ``t``; returns the answers. Frames go out on the bus."""
        answers = bytearray()
        for byte in data:
            if byte == 0x0D:
                answers += self._command(self._line.decode("ascii", "replace"), t)
                self._line.clear()
            elif byte != 0x0A and len(self._line) < LONGEST:
                self._line.append(byte)
        return bytes(answers)

    def host_read(self, t: float) -> bytes:
        """Lines for the frames that have come over the bus by time ``t``."""
        frames = self._bus.host_read(t)
        if not self._hears:
            return b""
        return b"".join(_line(frame) for frame in frames)

    @property
    def _hears(self) -> bool:
        return self._open and self._bitrate == self._bus.bitrate

    def _command(self, line: str, t: float) -> bytes:
        match line[:1]:
            case "":
                return OK
            case "S" if not self._open and line in BITRATES:
                self._bitrate = BITRATES[line]
                return OK
            case "O" | "L" if len(line) == 1 and self._bitrate is not None:
                self._open, self._listen_only = True, line == "L"
                return OK
            case "C" if len(line) == 1:
                self._open = False
                return OK
            case "V":
                return b"V1013\r"
            case "N":
                return b"N0001\r"
            case "F" if self._open:
                return b"F00\r"
            case "t":
                frame = FRAME.fullmatch(line)
                if frame is not None and self._open and not self._listen_only:
                    data = bytes.fromhex(frame["data"])
                    if len(data) == int(frame["length"]):
                        if self._hears:
                            self._bus.host_write((int(frame["id"], 16), data), t)
                        return OK
        return REFUSED


def _line(frame: Frame) -> bytes:
    identifier, data = frame
    return f"t{identifier:03X}{len(data)}{data.hex().upper()}\r".encode("ascii")
