"""A load cell on CANopen, device profile CiA 404 (analogue input), frame by frame.

Identifiers of node n: SDO request 600h + n, answer 580h + n; TPDO1 180h + n; emergency 80h + n; boot-up and heartbeat
700h + n; network management 000h ``command node``. Everything is little-endian. After power-up it sends the boot-up
frame and is PRE-OPERATIONAL; process data are sent only in OPERATIONAL, by the event timer (1800h:5, in milliseconds).
The mapping of the process data (1A00h) can be changed while the PDO is switched off (bit 31 of 1800h:1) and its length
is zero.

Sources: CiA 301 (SDO, PDO, network management), CiA 404 (objects 61xxh to 91xxh), CiA 303-2 (units), manual of
Baumer's DSRT strain link (autozero, refused as "time out" when out of the taring range).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from rig.sim.noise import ConversionNoise
from rig.sim.truth import BusTruth, Fault, Fraction, LoadCellTruth, Positive
from rig.sim.twin import Twin
from rig.sim.wire import Frame, FrameWire
from rig.sim.world import World

ANSWER_S = 0.5e-3
UNIT_CODE = {"N": 0x00_21_00_00, "mN": 0xFD_21_00_00}  # prefix, numerator, denominator, 0
PER_NEWTON = {"N": 1.0, "mN": 1e3}
ZERO, SAVE = (int.from_bytes(word, "little") for word in (b"zero", b"save"))
NOT_VALID, POSITIVE, NEGATIVE = 1, 2, 4  # 6150h
PDO_OFF = 1 << 31
EVENT_DRIVEN = (254, 255)


class State(IntEnum):
    """Network management, as the heartbeat states it."""

    BOOT_UP = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class Abort(IntEnum):
    """SDO abort codes of CiA 301."""

    TOGGLE = 0x0503_0000
    TIME_OUT = 0x0504_0000
    COMMAND = 0x0504_0001
    UNSUPPORTED = 0x0601_0000
    WRITE_ONLY = 0x0601_0001
    READ_ONLY = 0x0601_0002
    NO_OBJECT = 0x0602_0000
    NOT_MAPPABLE = 0x0604_0041
    PDO_TOO_LONG = 0x0604_0042
    LENGTH = 0x0607_0010
    NO_SUB_INDEX = 0x0609_0011
    VALUE = 0x0609_0030


class _Refused(Exception):
    def __init__(self, code: Abort) -> None:
        self.code = code


@dataclass(frozen=True)
class _Entry:
    """One object: how it is packed, read and written. ``mappable``: it may be carried by a PDO."""

    kind: str  # of struct, "i24", or "text"
    read: Callable[[float], int | float | str] | None = None
    write: Callable[[int | float, float], None] | None = None
    mappable: bool = False

    @property
    def size(self) -> int:
        return 3 if self.kind == "i24" else struct.calcsize(f"<{self.kind}")

    def pack(self, value: int | float | str) -> bytes:
        if isinstance(value, str):
            return value.encode("ascii")
        if self.kind == "i24":
            return int(value).to_bytes(3, "little", signed=True)
        return struct.pack(f"<{self.kind}", value)


class CiA404Truth(LoadCellTruth, BusTruth):
    """Load cell on CANopen, device profile CiA 404; it states newtons or millinewtons itself."""

    driver: Literal["cia404"] = Field(default="cia404", description="CiA 404 load cell.")
    serial_number: int = Field(default=77_120, description="Serial number that it states.")
    node: int = Field(default=5, ge=1, le=127, description="Its node number.")
    inputs: int = Field(default=1, ge=1, le=4, description="How many analogue inputs it has; all but one are open.")
    channel: int = Field(default=1, ge=1, le=4, description="The input with the load cell.")
    unit: Literal["N", "mN"] = Field(default="N", description="Unit of its process values.")
    decimals: int = Field(default=4, ge=0, le=6, description="Decimal digits of its integer process values.")
    zero_offset_N: float = Field(default=0.004, description="What the unloaded cell shows (N).")
    overload_factor: Positive = Field(default=1.2, description="End of the measuring range, in full scales.")
    tare_fraction: Fraction = Field(default=0.2, description="Largest value that autozero takes, of full scale.")
    conversion_rate_Hz: Positive = Field(default=1000.0, description="How often it measures (Hz).")
    stored_event_time_ms: int = Field(
        default=100, ge=0, le=65_535, description="Period of its process data at power-up (ms), object 1800h:5."
    )
    heartbeat_ms: int = Field(default=0, ge=0, le=65_535, description="Period of its heartbeat (ms); 0: none.")

    @model_validator(mode="after")
    def _channel_exists(self) -> Self:
        if self.channel > self.inputs:
            raise ValueError(f"channel is {self.channel}, but there are only {self.inputs} inputs")
        return self


class CiA404:
    """One node, one of its analogue inputs with the load cell, the others open (0 N).

    Attributes
    ----------
    saturated, status_bits : faults
        Sign of the rail the input is stuck at, 0 for none; these bits are set in the status (6150h).
    before_reply : callable or None
        A fault: called with the time before each SDO answer is sent.
    """

    def __init__(self, settings: CiA404Truth, world: World, wire: FrameWire, rng: np.random.Generator) -> None:
        self._settings = settings
        self._world = world
        self._wire = wire
        self._noise = ConversionNoise(rng, 1.0 / settings.conversion_rate_Hz)
        self.saturated = 0
        self.status_bits = 0
        self.before_reply: Callable[[float], None] | None = None
        self._frozen: float | None = None
        self._tare = [0.0] * settings.inputs  # N
        self._objects = self._dictionary()
        self._power_up(0.0)

    def _power_up(self, t: float) -> None:
        s = self._settings
        self._state = State.BOOT_UP
        self._boot_at = t
        self._heartbeat_ms = s.heartbeat_ms
        self._next_heartbeat = math.inf
        self._pdo_id = 0x180 + s.node
        self._pdo_type = 255
        self._event_ms = s.stored_event_time_ms
        self._mapping = [(0x6130, s.channel, 32), (0x6150, s.channel, 8)]
        self._mapped = len(self._mapping)
        self._since, self._sent = math.inf, 0
        self._segments: tuple[bytes, int] | None = None  # what is left of a long answer, and the next toggle bit

    def reset(self, t: float) -> None:
        """Lose power and come back: silent for a while, then the boot-up frame."""
        self._power_up(t + self._settings.reboot_s)

    def freeze(self, t: float, frozen: bool) -> None:
        """A fault: from now on every sample has the value of time ``t``."""
        self._frozen = None
        if frozen:
            self._frozen = self._newtons(self._settings.channel, t)

    def switch(self, fault: Fault, begins: bool, t: float) -> None:
        """Its other faults: ``saturate``, and ``wrong_status``, bits that are set in the status."""
        if fault.kind == "saturate":
            self.saturated = fault.sign if begins else 0
        else:
            self.status_bits = (1 if fault.value is None else int(fault.value) & 7) if begins else 0

    def alert(self, t: float) -> None:
        """An error appears (CAN overrun) and is gone again: two emergency messages."""
        for code, register in ((0x8110, 0x11), (0x0000, 0x00)):
            self._wire.send((0x080 + self._settings.node, struct.pack("<HB5x", code, register)), t)

    # What it measures

    def _newtons(self, channel: int, t: float) -> float:
        """What the input measures (N), tare not taken off."""
        s = self._settings
        if channel != s.channel:
            return 0.0
        if self._frozen is not None:
            return self._frozen
        true = self._world.force_at(t - s.lag_ms * 1e-3) * (1.0 + s.gain_error) + s.zero_offset_N
        return true + s.noise_fraction * s.full_scale_N * self._noise.at(t)

    def _measure(self, channel: int, t: float) -> tuple[float, int]:
        """Process value in the device's unit, and status."""
        top = self._settings.overload_factor * self._settings.full_scale_N
        status = 0
        newtons = self._newtons(channel, t)
        if channel == self._settings.channel:
            if self.saturated:
                newtons = math.copysign(2 * top, self.saturated)
            status = self.status_bits
        if not abs(newtons) <= top:
            status |= POSITIVE if newtons > 0 else NEGATIVE
            newtons = math.copysign(top, newtons)
        return (newtons - self._tare[channel - 1]) * PER_NEWTON[self._settings.unit], status

    # Object dictionary

    def _dictionary(self) -> dict[tuple[int, int], _Entry]:
        s = self._settings
        objects: dict[tuple[int, int], _Entry] = {
            (0x1000, 0): _Entry("I", lambda t: 0x0002_0194),
            (0x1001, 0): _Entry("B", lambda t: 0),
            (0x1008, 0): _Entry("text", lambda t: "simulated load cell"),
            (0x100A, 0): _Entry("text", lambda t: "1.4"),
            (0x1010, 0): _Entry("B", lambda t: 1),
            (0x1010, 1): _Entry("I", lambda t: 1, self._save),
            (0x1017, 0): _Entry("H", lambda t: self._heartbeat_ms, self._set_heartbeat),
            (0x1018, 0): _Entry("B", lambda t: 4),
            (0x1018, 1): _Entry("I", lambda t: 0x15F),
            (0x1018, 2): _Entry("I", lambda t: 404),
            (0x1018, 3): _Entry("I", lambda t: 0x0001_0004),
            (0x1018, 4): _Entry("I", lambda t: s.serial_number),
            (0x1800, 0): _Entry("B", lambda t: 5),
            (0x1800, 1): _Entry("I", lambda t: self._pdo_id, self._set_pdo_id),
            (0x1800, 2): _Entry("B", lambda t: self._pdo_type, self._set_pdo_type),
            (0x1800, 5): _Entry("H", lambda t: self._event_ms, self._set_event_time),
            (0x1A00, 0): _Entry("B", lambda t: self._mapped, self._set_mapped),
        }
        for number in range(8):
            objects[0x1A00, number + 1] = _Entry("I", self._mapping_reader(number), self._mapping_writer(number))
        for index in (0x6110, 0x6112, 0x6125, 0x6130, 0x6131, 0x6132, 0x6150, 0x7130, 0x8130, 0x9130):
            objects[index, 0] = _Entry("B", lambda t: s.inputs)
        for channel in range(1, s.inputs + 1):
            objects |= self._input(channel)
        return objects

    def _input(self, channel: int) -> dict[tuple[int, int], _Entry]:
        s = self._settings
        factor = 10**s.decimals

        def whole(bits: int) -> Callable[[float], int]:
            top = 2 ** (bits - 1) - 1
            return lambda t: min(max(round(self._measure(channel, t)[0] * factor), -top - 1), top)

        return {
            (0x6110, channel): _Entry("H", lambda t: 90),  # force
            (0x6112, channel): _Entry("B", lambda t: 1, self._set_mode),
            (0x6125, channel): _Entry("I", None, lambda value, t: self._autozero(channel, value, t)),
            (0x6130, channel): _Entry("f", lambda t: self._measure(channel, t)[0], mappable=True),
            (0x6131, channel): _Entry("I", lambda t: UNIT_CODE[s.unit]),
            (0x6132, channel): _Entry("B", lambda t: s.decimals),
            (0x6150, channel): _Entry("B", lambda t: self._measure(channel, t)[1], mappable=True),
            (0x7130, channel): _Entry("h", whole(16), mappable=True),
            (0x8130, channel): _Entry("i24", whole(24), mappable=True),
            (0x9130, channel): _Entry("i", whole(32), mappable=True),
        }

    def _autozero(self, channel: int, value: int | float, t: float) -> None:
        if value != ZERO:
            raise _Refused(Abort.VALUE)
        newtons = self._newtons(channel, t)
        if abs(newtons) > self._settings.tare_fraction * self._settings.full_scale_N:
            raise _Refused(Abort.TIME_OUT)
        self._tare[channel - 1] = newtons

    @staticmethod
    def _set_mode(value: int | float, t: float) -> None:
        if value != 1:  # normal operation is all it has
            raise _Refused(Abort.VALUE)

    @staticmethod
    def _save(value: int | float, t: float) -> None:
        if value != SAVE:
            raise _Refused(Abort.VALUE)

    def _set_heartbeat(self, value: int | float, t: float) -> None:
        self._heartbeat_ms = int(value)
        self._next_heartbeat = t + value * 1e-3 if value else math.inf

    # Process data

    @property
    def _pdo_on(self) -> bool:
        return not self._pdo_id & PDO_OFF

    def _set_pdo_id(self, value: int | float, t: float) -> None:
        word = int(value)
        if not 0x180 <= word & 0x1FFF_FFFF <= 0x57F or word & 1 << 29:
            raise _Refused(Abort.VALUE)
        if self._pdo_on and not word & PDO_OFF and word != self._pdo_id:
            raise _Refused(Abort.VALUE)  # the identifier may only change while it is off
        self._pdo_id = word
        self._restart(t)

    def _set_pdo_type(self, value: int | float, t: float) -> None:
        if value not in EVENT_DRIVEN:
            raise _Refused(Abort.VALUE)
        self._pdo_type = int(value)

    def _set_event_time(self, value: int | float, t: float) -> None:
        self._event_ms = int(value)
        self._restart(t)

    def _set_mapped(self, value: int | float, t: float) -> None:
        count = int(value)
        if self._pdo_on:
            raise _Refused(Abort.UNSUPPORTED)
        if count > len(self._mapping):
            raise _Refused(Abort.NOT_MAPPABLE)
        if sum(bits for _, _, bits in self._mapping[:count]) > 64:
            raise _Refused(Abort.PDO_TOO_LONG)
        self._mapped = count

    def _mapping_reader(self, number: int) -> Callable[[float], int]:
        def read(t: float) -> int:
            if number >= len(self._mapping):
                return 0
            index, sub_index, bits = self._mapping[number]
            return index << 16 | sub_index << 8 | bits

        return read

    def _mapping_writer(self, number: int) -> Callable[[int | float, float], None]:
        def write(value: int | float, t: float) -> None:
            word = int(value)
            index, sub_index, bits = word >> 16, word >> 8 & 0xFF, word & 0xFF
            if self._pdo_on or self._mapped:
                raise _Refused(Abort.UNSUPPORTED)
            entry = self._objects.get((index, sub_index))
            if entry is None or not entry.mappable or bits != 8 * entry.size or number > len(self._mapping):
                raise _Refused(Abort.NOT_MAPPABLE)
            self._mapping[number:] = [(index, sub_index, bits)]

        return write

    def _pdo(self, t: float) -> bytes:
        data = b""
        for index, sub_index, _ in self._mapping[: self._mapped]:
            entry = self._objects[index, sub_index]
            assert entry.read is not None
            data += entry.pack(entry.read(t))
        return data

    # Time

    def _restart(self, t: float) -> None:
        """The event timer begins anew at ``t``, if process data are sent at all."""
        sends = self._state is State.OPERATIONAL and self._pdo_on and self._mapped and self._event_ms
        self._since, self._sent = (t if sends else math.inf), 0

    @property
    def _next_pdo(self) -> float:
        drift = 1.0 + self._settings.clock_drift_ppm * 1e-6
        return self._since + (self._sent + 1) * self._event_ms * 1e-3 / drift

    @property
    def next_time(self) -> float:
        """When it sends by itself next."""
        if self._state is State.BOOT_UP:
            return self._boot_at
        return min(self._next_pdo, self._next_heartbeat)

    def advance(self, t: float) -> None:
        """Send what is due up to ``t``."""
        while (due := self.next_time) <= t:
            if self._state is State.BOOT_UP:
                self._wire.send((0x700 + self._settings.node, bytes([State.BOOT_UP])), due)
                self._state = State.PRE_OPERATIONAL
                self._set_heartbeat(self._heartbeat_ms, due)
            elif due == self._next_heartbeat:
                self._wire.send((0x700 + self._settings.node, bytes([self._state])), due)
                self._next_heartbeat += self._heartbeat_ms * 1e-3
            else:
                self._wire.send((self._pdo_id & 0x7FF, self._pdo(due)), due)
                self._sent += 1

    # Frames in

    def receive(self, frame: Frame, t: float) -> None:
        """A frame from the bus, complete at time ``t``."""
        identifier, data = frame
        if self._state is State.BOOT_UP:
            return
        if identifier == 0 and len(data) == 2 and data[1] in (0, self._settings.node):
            self._manage(data[0], t)
        elif identifier == 0x600 + self._settings.node and len(data) == 8 and self._state is not State.STOPPED:
            answer = self._serve(data, t)
            if answer is not None:
                if self.before_reply is not None:
                    self.before_reply(t)
                self._wire.send((0x580 + self._settings.node, answer.ljust(8, b"\0")), t + ANSWER_S)

    def _manage(self, command: int, t: float) -> None:
        states = {0x01: State.OPERATIONAL, 0x02: State.STOPPED, 0x80: State.PRE_OPERATIONAL}
        if command in states:
            if self._state is not states[command]:
                self._state = states[command]
                self._restart(t)
        elif command in (0x81, 0x82):
            self.reset(t)

    def _serve(self, request: bytes, t: float) -> bytes | None:
        """The answer to one SDO request; None to an abort of the host's."""
        where = request[1:4]
        key = (int.from_bytes(where[:2], "little"), where[2])
        try:
            match request[0] >> 5:
                case 1:
                    self._segments = None
                    self._download(key, request, t)
                    return b"\x60" + where
                case 2:
                    self._segments = None
                    return self._upload(key, where, t)
                case 3:
                    return self._next_segment(request[0] >> 4 & 1)
                case 4:
                    self._segments = None
                    return None
            raise _Refused(Abort.COMMAND)
        except _Refused as refused:
            self._segments = None
            return b"\x80" + where + struct.pack("<I", refused.code)

    def _entry(self, key: tuple[int, int]) -> _Entry:
        if key in self._objects:
            return self._objects[key]
        known = any(index == key[0] for index, _ in self._objects)
        raise _Refused(Abort.NO_SUB_INDEX if known else Abort.NO_OBJECT)

    def _download(self, key: tuple[int, int], request: bytes, t: float) -> None:
        entry = self._entry(key)
        if entry.write is None:
            raise _Refused(Abort.READ_ONLY)
        if not request[0] & 2:  # not expedited: no object here is that long
            raise _Refused(Abort.LENGTH)
        length = 4 - (request[0] >> 2 & 3) if request[0] & 1 else entry.size
        if length != entry.size:
            raise _Refused(Abort.LENGTH)
        (value,) = struct.unpack_from(f"<{entry.kind}", request, 4)
        entry.write(value, t)

    def _upload(self, key: tuple[int, int], where: bytes, t: float) -> bytes:
        entry = self._entry(key)
        if entry.read is None:
            raise _Refused(Abort.WRITE_ONLY)
        data = entry.pack(entry.read(t))
        if len(data) <= 4:
            return bytes([0x43 | (4 - len(data)) << 2]) + where + data
        self._segments = data, 0
        return b"\x41" + where + struct.pack("<I", len(data))

    def _next_segment(self, toggle: int) -> bytes:
        if self._segments is None:
            raise _Refused(Abort.COMMAND)
        rest, expected = self._segments
        if toggle != expected:
            raise _Refused(Abort.TOGGLE)
        piece, rest = rest[:7], rest[7:]
        self._segments = (rest, 1 - toggle) if rest else None
        return bytes([toggle << 4 | (7 - len(piece)) << 1 | (not rest)]) + piece


TWINS = (Twin(driver="cia404", role="force", truth=CiA404Truth, make=CiA404),)
