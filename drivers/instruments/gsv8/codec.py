"""Strain-gauge amplifiers GSV-8 and GSV-6 of ME-Messsysteme: binary protocol over USB-CDC or UART.

Frames, big-endian, all beginning with AA and ending with 85 (n = number of data bytes, k = channels - 1)::

    request   AA 9n CC p1..pn 85      CC command
    answer    AA 5n EE d1..dn 85      EE error code: 00 done, 01 done and other settings changed, 40.. refused
    measured  AA 1k SS v1..           SS status: bit 7 set, bits 6..4 type (1 int16, 2 int24, 3 float32),
                                      bit 1 six-axis error, bit 0 input overload

After power-up the amplifier streams by itself. An integer is the bridge signal as a fraction of full scale, in
binary-offset coding; a float is the signal in input ranges, times the user scale, plus the user offset. Sources:
gsv86lib 0.1.1 and MEGSV86x64.h, both by the manufacturer.

What this protocol cannot show
    There is no checksum, no counter, no time stamp, and an answer does not say which request it answers. A changed bit
    *inside* a value is a wrong value that looks like any other. What is enforced: the prefix, the header of measured
    frames (channels and type, once known), the frame's length, the closing 85, known error codes, the data length that
    each answer must have, and that a value is finite and within twice the input range. One to three bytes lost from a
    frame are always noticed by the closing 85; more are missed once in about 256 times. Lost frames are noticed by rate
    (`drivers.sample_clock`). After a request had to be repeated, the line must stay quiet for one timeout before
    the next, so that a late answer is not given to another request.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

from drivers.roles import Identity

FrameType = Literal["int16", "int24", "float32"]

PREFIX = 0xAA
SUFFIX = 0x85
MAX_FRAME = 68  # a measured frame of 16 float channels

_TYPES: dict[int, FrameType] = {1: "int16", 2: "int24", 3: "float32"}
_FLOATS = 0x80 | 3 << 4  # the upper half of the third byte of a measured frame of floats
WIDTH: dict[FrameType, int] = {"int16": 2, "int24": 3, "float32": 4}

STOP_TRANSMISSION = 0x23
START_TRANSMISSION = 0x24
GET_VALUE = 0x3B
SET_ZERO = 0x0C
READ_USER_SCALE = 0x14
READ_USER_OFFSET = 0x9A
GET_SERIAL_NUMBER = 0x1F
GET_FIRMWARE_VERSION = 0x2B
GET_TX_MODE = 0x80
SET_TX_MODE = 0x81
READ_DATA_RATE = 0x8A
WRITE_DATA_RATE = 0x8B
GET_INPUT_TYPE = 0xA2

COMMANDS = {
    STOP_TRANSMISSION: "StopTransmission",
    START_TRANSMISSION: "StartTransmission",
    GET_VALUE: "GetValue",
    SET_ZERO: "SetZero",
    READ_USER_SCALE: "ReadUserScale",
    READ_USER_OFFSET: "ReadUserOffset",
    GET_SERIAL_NUMBER: "GetSerialNo",
    GET_FIRMWARE_VERSION: "GetFirmwareVersion",
    GET_TX_MODE: "GetTXMode",
    SET_TX_MODE: "SetTXMode",
    READ_DATA_RATE: "ReadDataRate",
    WRITE_DATA_RATE: "WriteDataRate",
    GET_INPUT_TYPE: "GetInputType",
}

ERRORS = {
    0x00: "done",
    0x01: "done, and other settings changed with it",
    0x40: "command unknown",
    0x41: "command not implemented in this model",
    0x42: "request frame malformed",
    0x50: "wrong parameter",
    0x51: "wrong index or address",
    0x52: "wrong data in a parameter",
    0x53: "wrong bits in a parameter",
    0x54: "parameter too big",
    0x55: "parameter too small",
    0x56: "combination of parameters not allowed",
    0x57: "parameter too big in relation to the others",
    0x58: "parameter too small in relation to the others",
    0x59: "parameter not supported",
    0x5A: "parameters did not arrive within 200 ms",
    0x5B: "wrong number of parameters",
    0x5C: "parameter does not fit the present settings",
    0x5E: "memory in the wrong condition",
    0x5F: "memory access denied",
    0x70: "access denied",
    0x71: "writing is blocked",
    0x72: "password missing or wrong",
    0x74: "written too many times",
    0x75: "no permission to write on this port",
    0x80: "internal error",
    0x81: "arithmetic error",
    0x82: "analogue-digital converter failed",
    0x83: "measured value in error",
    0x84: "EEPROM failed",
    0x91: "transmit buffer overflow",
    0x92: "busy",
    0x99: "receive buffer full",
}

INPUT_TYPES = {
    0: "bridge at 8.75 V",
    1: "bridge at 5 V",
    2: "bridge at 2.5 V",
    3: "single ended",
    4: "Pt1000",
    5: "thermocouple K",
}

# SetTXMode, index 1. float32 is what the manufacturer's Python library sends; the integer codes follow the
# manufacturer's header and are unproven on hardware. The type of the frames that follow is the proof.
TX_MODE: dict[FrameType, int] = {"int16": 0x0001, "int24": 0x0002, "float32": 0x0010}


@dataclass(frozen=True, slots=True)
class Reply:
    """Answer frame: error code and data."""

    error: int
    data: bytes

    @property
    def meaning(self) -> str:
        return f"{ERRORS[self.error]} (error {self.error:02X})"


class Measured(NamedTuple):
    """Measured frame. Integers are given as sent, in binary-offset coding."""

    type: FrameType
    values: tuple[float, ...]
    overload: bool
    six_axis_error: bool


Message = Reply | Measured


def encode(command: int, parameters: bytes = b"") -> bytes:
    """Request frame; ``parameters`` of at most 15 bytes."""
    if len(parameters) > 15:
        raise ValueError(f"{len(parameters)} parameter bytes; a GSV-8 request holds at most 15")
    return bytes((PREFIX, 0x90 | len(parameters), command)) + parameters + bytes((SUFFIX,))


class Decoder:
    """Bytes to frames. Never raises; holds back less than one frame.

    ``expect`` narrows measured frames to one type and number of channels: what does not match is then dropped byte by
    byte like any other garbage. Counters: ``dropped_bytes`` and ``bad_frames`` (a plausible header whose frame did not
    close with 85).
    """

    def __init__(self, counters: dict[str, int] | None = None) -> None:
        self.counters = {} if counters is None else counters
        self.counters.setdefault("dropped_bytes", 0)
        self.counters.setdefault("bad_frames", 0)
        self._buffer = b""
        self._expected: tuple[FrameType, int] | None = None
        self._floats: tuple[int, int, Callable[[bytes, int], tuple[float, ...]]] | None = None

    def expect(self, frame_type: FrameType, channels: int) -> None:
        """Accept measured frames of this shape only."""
        self._floats = None
        self._expected = (frame_type, channels)
        if frame_type == "float32":
            self._floats = 0x10 | channels - 1, 4 + 4 * channels, struct.Struct(f">{channels}f").unpack_from

    def expect_any(self) -> None:
        """Accept measured frames of every shape."""
        self._expected = self._floats = None

    def drop(self) -> None:
        """Give up what is held back: a frame whose rest is not coming swallows the answers that come in its place."""
        self.counters["dropped_bytes"] += len(self._buffer)
        self._buffer = b""

    def feed(self, data: bytes) -> list[Message]:
        """Frames completed by ``data``, in order."""
        buffer = self._buffer + data
        messages: list[Message] = []
        at = 0
        while True:
            if self._floats is not None:
                at = self._take_floats(buffer, at, messages, *self._floats)
            start = buffer.find(PREFIX, at)
            if start < 0:
                start = len(buffer)
            self.counters["dropped_bytes"] += start - at
            at = start
            length = self._length(buffer, at)
            if length is None:
                break
            if length == 0 or buffer[at + length - 1] != SUFFIX:
                self.counters["bad_frames"] += length != 0
                self.counters["dropped_bytes"] += 1
                at += 1
                continue
            messages.append(self._parse(buffer, at, length))
            at += length
        self._buffer = buffer[at:]
        return messages

    @staticmethod
    def _take_floats(
        buffer: bytes,
        at: int,
        messages: list[Message],
        second: int,
        length: int,
        unpack: Callable[[bytes, int], tuple[float, ...]],
    ) -> int:
        """Take the frames of floats that follow each other from ``at`` on: of a stream nearly all. Gives their end."""
        last = len(buffer) - length
        while at <= last and buffer[at] == PREFIX and buffer[at + 1] == second and buffer[at + length - 1] == SUFFIX:
            third = buffer[at + 2]
            if third & 0xF0 != _FLOATS:
                break
            messages.append(Measured("float32", unpack(buffer, at + 3), third & 1 != 0, third & 2 != 0))
            at += length
        return at

    def _length(self, buffer: bytes, at: int) -> int | None:
        """Length of the frame at ``at``; 0 when there cannot be one, None while bytes are missing to know."""
        left = len(buffer) - at
        if left < 2:
            return None
        kind, low = buffer[at + 1] & 0xF0, buffer[at + 1] & 0x0F
        if kind not in (0x10, 0x50):
            return 0
        if left < 3:
            return None
        third = buffer[at + 2]
        if kind == 0x50:
            length = 4 + low if third in ERRORS else 0
        else:
            frame_type = _TYPES.get((third >> 4) & 7)
            if not third & 0x80 or frame_type is None or self._expected not in (None, (frame_type, low + 1)):
                return 0
            length = 4 + (low + 1) * WIDTH[frame_type]
        return length if left >= length else None

    @staticmethod
    def _parse(buffer: bytes, at: int, length: int) -> Message:
        status = buffer[at + 2]
        payload = buffer[at + 3 : at + length - 1]
        if buffer[at + 1] & 0xF0 == 0x50:
            return Reply(status, payload)
        frame_type = _TYPES[(status >> 4) & 7]
        values: tuple[float, ...]
        if frame_type == "float32":
            values = struct.unpack(f">{len(payload) // 4}f", payload)
        elif frame_type == "int16":
            values = struct.unpack(f">{len(payload) // 2}H", payload)
        else:
            values = tuple(int.from_bytes(payload[i : i + 3], "big") for i in range(0, len(payload), 3))
        return Measured(frame_type, values, bool(status & 1), bool(status & 2))


def identity(serial: bytes, firmware: bytes) -> Identity:
    """From the data of GetSerialNo and GetFirmwareVersion; empty bytes where the amplifier did not say."""
    pair = f"{int.from_bytes(firmware[:2], 'big')}.{int.from_bytes(firmware[2:], 'big')}"
    return Identity(
        model="GSV-8",
        serial=str(int.from_bytes(serial, "big")) if serial else "",
        firmware=pair if len(firmware) == 4 else firmware.hex(),
    )
