"""An ME-Messsysteme GSV-8 strain-gauge amplifier on its binary serial protocol, with one load cell.

Request ``AA 9n CC p1..pn 85``, answer ``AA 5n EE d1..dn 85``, measured values ``AA 1k SS v.. 85`` with k + 1 channels;
big-endian, no escaping. It streams by itself after power-up. Integer values are raw numbers with a binary offset;
float values are ``user scale x raw value in input ranges + user offset``, the zero taken off before scaling.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import ClassVar, Final, Literal

import numpy as np
from pydantic import Field

from rig.sim.truth import Fault, LineTruth, LinkTruth, LoadCellTruth, Positive
from rig.sim.twin import Twin
from rig.sim.wire import ByteWire
from rig.sim.world import World

CHANNELS: Final = 8
INT16, INT24, FLOAT = 1, 2, 3
WIDTH = {INT16: 2, INT24: 3, FLOAT: 4}
# Transmission mode words, index 1 of commands 80/81. 0x0010 selects float as the vendor's library sends it.
TYPE_OF_WORD = {1: INT16, 2: INT24, 3: FLOAT, 0x10: FLOAT}
MAX_RATE = {INT16: 48_000.0, INT24: 24_000.0, FLOAT: 12_000.0}
MIN_RATE = 0.1
ANSWER_S = 1e-3
PARAMETER_TIMEOUT_S = 0.2

# Error codes
OK, CHANGED = 0x00, 0x01
UNKNOWN, NOT_IMPLEMENTED, FRAME_ERROR = 0x40, 0x41, 0x42
BAD_ADDRESS, BAD_DATA, TOO_BIG, TOO_SMALL, NOT_SUPPORTED = 0x51, 0x52, 0x54, 0x55, 0x59
TIMEOUT, WRONG_COUNT = 0x5A, 0x5B

# Commands it knows and their numbers of parameters; None: known, but not built into this amplifier.
COMMANDS: dict[int, int | None] = {
    0x02: 1, 0x03: 5, 0x06: None, 0x07: None, 0x0A: 1, 0x0C: 1, 0x0F: 1, 0x10: 2, 0x11: 1, 0x12: None,
    0x14: 1, 0x15: 5, 0x1F: 0, 0x23: 0, 0x24: 0, 0x26: 0, 0x27: 4, 0x2B: 0, 0x34: None, 0x3B: 0,
    0x59: 1, 0x5A: 2, 0x5B: 1, 0x5C: 5, 0x5D: 1, 0x5E: 3, 0x5F: 2, 0x60: 6,
    0x61: 1, 0x62: 3, 0x78: 0, 0x79: 0, 0x80: 1, 0x81: 3, 0x8A: 0, 0x8B: 4, 0x9A: 1, 0x9B: 5,
    0xA2: 2, 0xA3: 2,
}  # fmt: skip

BRIDGE_8V75, BRIDGE_5V, BRIDGE_2V5 = 0, 1, 2
UNIT_MV_PER_V = 0


PINS, GROUPS = 16, 4
TEMPERATURE_C = 23.5  # of the sensor on its one-wire line


class DigitalLines:
    """Digital inputs and outputs: 16 pins in groups of four, with nothing connected to them."""

    def __init__(self) -> None:
        self.output = [False] * GROUPS
        self.type = [(0, 0)] * PINS
        self.level = [0] * PINS
        self.initial = [0] * PINS
        self.threshold = [[0.0, 0.0] for _ in range(PINS)]

    def execute(self, code: int, p: bytes) -> tuple[int, bytes]:
        """One command about pin or group ``p[0]``, counted from 1."""
        n = p[0] - 1
        if not 0 <= n < (GROUPS if code in (0x59, 0x5A) else PINS):
            return BAD_ADDRESS, b""
        match code:
            case 0x59:
                return OK, bytes((not self.output[n],))
            case 0x5A:
                self.output[n] = p[1] == 0
            case 0x5B:
                kind, channel = self.type[n]
                return OK, kind.to_bytes(3, "big") + bytes((channel,))
            case 0x5C:
                self.type[n] = int.from_bytes(p[1:4], "big"), p[4]
            case 0x5D:
                return OK, struct.pack(">H", self.level[n])
            case 0x5E if self.output[n // GROUPS]:
                self.level[n] = int(p[1:3] != b"\0\0")
            case 0x5E:
                return BAD_DATA, b""  # an input
            case 0x5F | 0x60 if p[1] > 1:
                return BAD_ADDRESS, b""
            case 0x5F:
                return OK, struct.pack(">f", self.threshold[n][p[1]])
            case 0x60:
                (self.threshold[n][p[1]],) = struct.unpack(">f", p[2:])
            case 0x61:
                return OK, struct.pack(">H", self.initial[n])
            case _:
                self.initial[n] = int(p[1:3] != b"\0\0")
        return OK, b""


class GSV8Truth(LoadCellTruth, LineTruth):
    """Strain-gauge cell on an ME-Messsysteme GSV-8."""

    means_nothing: ClassVar[Mapping[str, str]] = {"alert": "it streams: nothing that it sends was asked for"}

    driver: Literal["gsv8"] = Field(default="gsv8", description="GSV-8 amplifier with a load cell.")
    serial_number: int = Field(default=14_209_876, description="Serial number that it states.")
    channel: int = Field(default=1, ge=1, le=8, description="The input with the load cell; the others are open.")
    sensitivity_mV_per_V: Positive = Field(default=2.0, description="Nominal output at full scale (mV/V).")
    zero_offset_mV_per_V: float = Field(default=0.013, description="Output of the unloaded cell (mV/V).")
    input_range_mV_per_V: Positive = Field(default=3.5, description="Input range at 5 V bridge supply (mV/V).")
    raw_range_factor: Positive = Field(default=1.05, description="Signal at the largest raw number, in input ranges.")
    stored_rate_Hz: Positive = Field(default=100.0, description="Rate at which it streams after power-up (Hz).")
    link: LinkTruth = Field(default=LinkTruth(latency_ms=1.0, baud=0), description="Its USB serial line.")


class GSV8:
    """Eight channels, one of them with the load cell, the others open.

    Attributes
    ----------
    saturated : int
        A fault: sign of the rail the input is stuck at, 0 for none.
    """

    def __init__(self, settings: GSV8Truth, world: World, wire: ByteWire, rng: np.random.Generator) -> None:
        self._settings = settings
        self._world = world
        self._wire = wire
        self._rng = rng
        self._cell = settings.channel - 1
        self.lines = DigitalLines()
        self._buffer = bytearray()
        self._buffer_since = 0.0
        self.saturated = 0
        self._status = 0
        self._noise = settings.noise_fraction * settings.sensitivity_mV_per_V
        self._mV_per_V_per_N = settings.sensitivity_mV_per_V * (1.0 + settings.gain_error) / settings.full_scale_N
        self._idle: tuple[bytes, bytes] | None = None
        self._frozen: float | None = None
        # Kept in non-volatile memory
        self._rate = settings.stored_rate_Hz
        self._type = FLOAT
        self._input_type = [BRIDGE_5V] * CHANNELS
        self._user_scale = [settings.input_range_mV_per_V] * CHANNELS  # so that it shows mV/V
        self._user_offset = [0.0] * CHANNELS
        self._zero = [0.0] * CHANNELS  # mV/V
        self._unit = [UNIT_MV_PER_V] * CHANNELS
        self._mode = 0
        self._permanent = True
        self._power_up(0.0)

    def _power_up(self, t: float) -> None:
        self._buffer.clear()
        self._transmitting = self._permanent
        self._restart(t)

    def _restart(self, t: float) -> None:
        self._start, self._count = t, 0

    def reset(self, t: float) -> None:
        """Lose power and come back: deaf and dumb for a while, then streaming with the stored settings."""
        self._power_up(t + self._settings.reboot_s)

    def freeze(self, t: float, frozen: bool) -> None:
        """A fault: from now on every sample has the value of time ``t``."""
        self._frozen = self._bridge(t) if frozen else None

    def switch(self, fault: Fault, begins: bool, t: float) -> None:
        """Its other faults: ``saturate``, and ``wrong_status``, bits of the status byte that are set in every frame."""
        if fault.kind == "saturate":
            self.saturated = fault.sign if begins else 0
        else:
            self._status = (3 if fault.value is None else int(fault.value) & 3) if begins else 0

    # What it measures

    def input_range(self, kind: int) -> float:
        """Input range (mV/V) of an input type: inverse to its bridge supply."""
        return self._settings.input_range_mV_per_V * {BRIDGE_8V75: 5 / 8.75, BRIDGE_5V: 1.0, BRIDGE_2V5: 2.0}[kind]

    def _bridge(self, t: float) -> float:
        """What the bridge puts out (mV/V) at time ``t``, without noise."""
        if self._frozen is not None:
            return self._frozen
        return (
            self._world.force_at(t - self._settings.lag_ms * 1e-3) * self._mV_per_V_per_N
            + self._settings.zero_offset_mV_per_V
        )

    def _sample(self, t: float) -> bytes:
        """The frame with the sample of time ``t``."""
        reading = self._bridge(t)
        if self._noise and self._frozen is None:
            reading += self._noise * float(self._rng.standard_normal())
        top = self.input_range(self._input_type[self._cell]) * self._settings.raw_range_factor
        if self.saturated:
            reading = math.copysign(2 * top, self.saturated)
        raw = round((min(max(reading, -top), top) - self._zero[self._cell]) / top * 2**23)
        status = self._type << 4 | 0x80 | self._status | (abs(reading) > top)
        before, after = self._neighbours()
        return bytes([0xAA, 0x10 | (CHANNELS - 1), status]) + before + self._encode(raw, self._cell) + after

    def _neighbours(self) -> tuple[bytes, bytes]:
        """What stands in a frame before and after the load cell's value: open inputs, and the end."""
        if self._idle is None:
            idle = [self._encode(0, channel) for channel in range(CHANNELS)]
            self._idle = b"".join(idle[: self._cell]), b"".join(idle[self._cell + 1 :]) + b"\x85"
        return self._idle

    def _encode(self, raw: int, channel: int) -> bytes:
        """A raw 24-bit number in the present value type."""
        raw = min(max(raw, -(2**23)), 2**23 - 1)
        if self._type == FLOAT:
            share = raw / 2**23 * self._settings.raw_range_factor
            return struct.pack(">f", self._user_scale[channel] * share + self._user_offset[channel])
        return (raw + 2**23).to_bytes(3, "big")[: WIDTH[self._type]]

    # Time

    @property
    def _period(self) -> float:
        return 1.0 / (self._rate * (1.0 + self._settings.clock_drift_ppm * 1e-6))

    @property
    def next_time(self) -> float:
        """When it sends by itself next."""
        return self._start + (self._count + 1) * self._period if self._transmitting else math.inf

    def advance(self, t: float) -> None:
        """Send the frames that are due up to ``t``."""
        if self._buffer and t > self._buffer_since + PARAMETER_TIMEOUT_S:
            given_up = self._buffer_since + PARAMETER_TIMEOUT_S
            self._buffer.clear()
            self._stream(given_up)
            self._answer(TIMEOUT, b"", given_up)
        self._stream(t)

    def _stream(self, t: float) -> None:
        while (due := self.next_time) <= t:
            self._wire.send(self._sample(due), due)
            self._count += 1

    # Bytes in

    def receive(self, data: bytes, t: float) -> None:
        """Bytes from the host, whose last bit arrived at ``t``."""
        if t < self._start and not self._count:  # still booting
            return
        if not self._buffer:
            self._buffer_since = t
        self._buffer += data
        while self._buffer:
            if self._buffer[0] != 0xAA:
                del self._buffer[0]
                continue
            if len(self._buffer) < 2:
                return
            if self._buffer[1] & 0xF0 != 0x90:
                del self._buffer[0]
                continue
            length = 4 + (self._buffer[1] & 0x0F)
            if len(self._buffer) < length:
                return
            frame = bytes(self._buffer[:length])
            if frame[-1] == 0x85:
                del self._buffer[:length]
                self._command(frame[2], frame[3:-1], t)
            else:
                del self._buffer[0]
                self._answer(FRAME_ERROR, b"", t)
            self._buffer_since = t

    def _answer(self, error: int, data: bytes, t: float) -> None:
        self._wire.send(bytes([0xAA, 0x50 | len(data), error]) + data + b"\x85", t + ANSWER_S)

    def _command(self, code: int, p: bytes, t: float) -> None:
        self._idle = None  # scale, offset or type may change
        if code not in COMMANDS:
            return self._answer(UNKNOWN, b"", t)
        count = COMMANDS[code]
        if count is None:
            return self._answer(NOT_IMPLEMENTED, b"", t)
        if len(p) != count:
            return self._answer(WRONG_COUNT, b"", t)
        if code == 0x3B:  # GetValue: one measured frame is the answer
            self._wire.send(self._sample(t), t + ANSWER_S)
            return None
        if code == 0x78:
            self._answer(OK, b"", t)
            return self.reset(t)
        return self._answer(*self._execute(code, p, t), t)

    def _execute(self, code: int, p: bytes, t: float) -> tuple[int, bytes]:
        match code:
            case 0x23:
                self._transmitting = False
                return OK, b""
            case 0x24:
                if not self._transmitting:
                    self._transmitting = True
                    self._restart(t)
                return OK, b""
            case 0x8A:
                return OK, struct.pack(">f", self._rate)
            case 0x8B:
                (rate,) = struct.unpack(">f", p)
                if not math.isfinite(rate):
                    return BAD_DATA, b""
                if rate > MAX_RATE[self._type]:
                    return TOO_BIG, b""
                if rate < MIN_RATE:
                    return TOO_SMALL, b""
                self._rate = rate
                self._restart(t)
                return OK, b""
            case 0x80:
                words = {0: 0 if self._transmitting else 1, 1: self._type, 2: CHANNELS << 8 | 1}
                return (OK, struct.pack(">H", words[p[0]])) if p[0] in words else (BAD_ADDRESS, b"")
            case 0x81:
                return self._set_tx_mode(p[0], int.from_bytes(p[1:], "big"), t)
            case 0x1F:
                return OK, struct.pack(">I", self._settings.serial_number)
            case 0x2B:
                return OK, struct.pack(">HH", 1, 44)
            case 0x26:
                return OK, struct.pack(">I", self._mode)
            case 0x27:
                (self._mode,) = struct.unpack(">I", p)
                return OK, b""
            case 0x0A:
                return OK, b""
            case 0x79:
                return OK, struct.pack(">f", TEMPERATURE_C)
        if 0x59 <= code <= 0x62:
            return self.lines.execute(code, p)
        return self._channel_command(code, p, t)

    def _set_tx_mode(self, index: int, word: int, t: float) -> tuple[int, bytes]:
        if index == 0:
            self._permanent = not word & 2
            if word & 3:
                self._transmitting = False
            elif not self._transmitting:
                self._transmitting = True
                self._restart(t)
            return OK, b""
        if index != 1:
            return BAD_ADDRESS, b""
        if word not in TYPE_OF_WORD:
            return BAD_DATA, b""
        self._type = TYPE_OF_WORD[word]
        if self._rate > MAX_RATE[self._type]:
            self._rate = MAX_RATE[self._type]
            self._restart(t)
            return CHANGED, b""
        return OK, b""

    def _channel_command(self, code: int, p: bytes, t: float) -> tuple[int, bytes]:
        """Commands whose first parameter is a channel, 1 to 8, or 0 for all where they write."""
        writes = code in (0x03, 0x0C, 0x10, 0x15, 0x9B, 0xA3)
        if not (1 <= p[0] <= CHANNELS or (writes and p[0] == 0)):
            return BAD_ADDRESS, b""
        channels = range(CHANNELS) if p[0] == 0 else [p[0] - 1]
        one = channels[0]
        if code in (0x03, 0x15, 0x9B):
            (value,) = struct.unpack(">f", p[1:])
            if not math.isfinite(value):
                return BAD_DATA, b""
            for channel in channels:
                {0x03: self._zero, 0x15: self._user_scale, 0x9B: self._user_offset}[code][channel] = value
            return OK, b""
        match code:
            case 0x02 | 0x14 | 0x9A:
                table = {0x02: self._zero, 0x14: self._user_scale, 0x9A: self._user_offset}[code]
                return OK, struct.pack(">f", table[one])
            case 0x0C:
                for channel in channels:
                    self._zero[channel] = self._bridge(t) if channel == self._cell else 0.0
            case 0x0F:
                return OK, bytes([self._unit[one]])
            case 0x10:
                for channel in channels:
                    self._unit[channel] = p[1]
            case 0x11:
                return OK, {0: b"mV/V", 1: b"kg", 2: b"g", 3: b"N"}.get(self._unit[one], b"?").ljust(8, b"\0")
            case 0xA2:
                kind = self._input_type[one] if p[1] == 0xFF else p[1]
                if kind > BRIDGE_2V5:
                    return NOT_SUPPORTED, b""
                return OK, bytes([kind]) + struct.pack(">I", round(100 * self.input_range(kind)))
            case 0xA3:
                if p[1] > BRIDGE_2V5:
                    return NOT_SUPPORTED, b""
                for channel in channels:
                    self._input_type[channel] = p[1]
        return OK, b""


TWINS = (Twin(driver="gsv8", role="force", truth=GSV8Truth, make=GSV8),)
