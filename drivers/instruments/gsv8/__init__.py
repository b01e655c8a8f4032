"""Strain-gauge amplifiers GSV-8 and GSV-6: keys in a scene, how one is found and replayed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

from pydantic import Field

from drivers.instrument import Instrument
from drivers.instruments.gsv8.codec import (
    GET_FIRMWARE_VERSION,
    GET_SERIAL_NUMBER,
    GET_TX_MODE,
    Decoder,
    FrameType,
    Reply,
    encode,
    identity,
)
from drivers.instruments.gsv8.device import GSV8
from drivers.probe import FORCE_CERTIFICATE, Answered, Line, SerialProbe
from drivers.recorded import Dialect
from drivers.settings import ForceSettings, SerialSettings

LOOKS_FIRST = encode(GET_TX_MODE, b"\x01")
COMMAND_UNKNOWN = bytes.fromhex("AA 50 40 85")
_OVERHEAD = 4
"""Bytes of a request beside its data: prefix, kind with the number of data bytes, command, suffix."""


class GSV8Settings(ForceSettings, SerialSettings):
    """An ME-Messsysteme GSV-8 with a strain-gauge force sensor; its certificate turns mV/V into newtons."""

    asks_per_sample: ClassVar[int] = 0

    driver: Literal["gsv8"] = Field(description="GSV-8 or GSV-6 strain-gauge amplifier on a serial port.")
    baud: int = Field(default=230_400, gt=0, description="Line rate (bit/s), as set in the amplifier.")
    channel: int = Field(default=1, ge=1, le=8, description="Input with the force sensor, as the amplifier counts.")
    rate_Hz: float = Field(
        default=100.0,
        gt=0,
        le=2000,
        description="Data rate that is set in the amplifier (Hz); refused if it reads back more than 1 % off.",
    )
    frame_type: FrameType = Field(
        default="float32", description="Number format that the amplifier shall send; floats unless the line is slow."
    )
    user_scale_of: Literal["range", "mV/V"] = Field(
        default="range",
        description="What the user scale of the amplifier multiplies in its float values: the signal in input ranges, "
        "or the signal in mV/V. Prove it with a known weight.",
    )
    int_full_scale: float = Field(
        default=1.05, ge=0.5, le=2, description="Signal at the largest integer value, in input ranges."
    )
    input_range_mV_per_V: float | None = Field(
        default=None,
        gt=0,
        le=1000,
        description="Input range (mV/V). Typical: 2 or 3.5. Absent: asked of the amplifier.",
    )

    def as_recorded(self, sent: Sequence[bytes]) -> None:
        self._looked_first = LOOKS_FIRST in sent


def _ask(line: Line) -> list[Answered]:
    decoder = Decoder()

    def four_bytes(command: int) -> bytes:
        for message in line.ask(encode(command), decoder.feed):
            if isinstance(message, Reply) and message.error <= 1 and len(message.data) == 4:
                return message.data
        return b""

    serial = four_bytes(GET_SERIAL_NUMBER)
    if not serial:
        return []
    found = identity(serial, four_bytes(GET_FIRMWARE_VERSION))
    return [Answered(found, {"serial": found.serial, "certificate": FORCE_CERTIFICATE})]


class CountedBytes(Dialect):
    """Requests say how long they are."""

    def __init__(self) -> None:
        super().__init__(b"")

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        whole = []
        while len(data) > 1 and len(data) >= (length := _OVERHEAD + (data[1] & 0x0F)):
            whole.append(data[:length])
            data = data[length:]
        return whole, data

    def unknown(self, request: bytes) -> bytes:
        """Logs of earlier releases have no question for the frame type."""
        return COMMAND_UNKNOWN if request == LOOKS_FIRST else b""


INSTRUMENTS = (
    Instrument(
        driver="gsv8",
        role="force",
        settings=GSV8Settings,
        device=GSV8,
        dialect=CountedBytes(),
        probe=SerialProbe(_ask, bauds=(230_400,)),
    ),
)
