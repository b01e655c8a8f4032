"""Load cells and other transducers on CANopen, device profile CiA 404 (analogue input).

Identifiers for node ``n``: SDO request 600h + n, answer 580h + n; TPDO1 180h + n; emergency 80h + n; boot-up and
heartbeat 700h + n; NMT 000h. Little-endian. Objects used (sub-index = analogue input, from 1)::

    1000h     device type, low half 0194h          6125h  autozero: write the u32 "zero"
    1018h     vendor, product, revision, serial    6130h  process value float32, 7130h int16, 8130h int24, 9130h int32
    1800h     TPDO1: identifier, type, timer       6131h  its unit (CiA 303-2: prefix, numerator, denominator)
    1A00h     TPDO1: what it carries               6132h  its decimal digits, for the integer forms
                                                   6150h  status: bit 0 not valid, 1 positive, 2 negative overload

Sources: CiA 404 V1.2, CiA 303-2, Baumer DSRT manual. The SDO and PDO handling is our own, and short: the canopen
package blocks until an answer comes and receives in a thread of its own, which has no place in one polled loop.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from drivers.links.link import CanFrame
from drivers.roles import Identity

PROFILE = 404
FLOAT_VALUE, INT16_VALUE, INT24_VALUE, INT32_VALUE, STATUS = 0x6130, 0x7130, 0x8130, 0x9130, 0x6150
IDENTITY = 0x1018
_EMERGENCIES = {
    0x10: "a fault of its own kind",
    0x20: "current",
    0x30: "voltage",
    0x40: "temperature",
    0x50: "its hardware",
    0x60: "its software",
    0x70: "an additional module",
    0x80: "monitoring",
    0x81: "communication on the bus",
    0x82: "a protocol error",
    0x90: "an external fault",
}
"""By the upper byte of an emergency code (CiA 301), or its upper half where no more is said there."""
AUTOZERO, UNIT, DECIMALS = 0x6125, 0x6131, 0x6132
TPDO1_PARAMETERS, TPDO1_MAPPING = 0x1800, 0x1A00

ABORTS = {
    0x05030000: "toggle bit not alternated",
    0x05040000: "time out",
    0x05040001: "command unknown",
    0x06010000: "access not supported",
    0x06010001: "write-only object",
    0x06010002: "read-only object",
    0x06020000: "object does not exist",
    0x06040041: "object cannot be mapped to a PDO",
    0x06040042: "PDO would become too long",
    0x06040043: "parameters incompatible",
    0x06060000: "hardware error",
    0x06070010: "wrong data length",
    0x06090011: "sub-index does not exist",
    0x06090030: "value out of range",
    0x08000000: "general error",
    0x08000020: "data cannot be stored",
    0x08000022: "not in this device state",
}

_BITS = {FLOAT_VALUE: 32, INT16_VALUE: 16, INT24_VALUE: 24, INT32_VALUE: 32}


@dataclass(frozen=True, slots=True)
class Uploaded:
    """SDO answer to a read: the object's value."""

    index: int
    sub: int
    value: bytes


@dataclass(frozen=True, slots=True)
class Downloaded:
    """SDO answer to a write: done."""

    index: int
    sub: int


@dataclass(frozen=True, slots=True)
class Aborted:
    """SDO answer: no, and why."""

    index: int
    sub: int
    code: int

    @property
    def meaning(self) -> str:
        return f"{ABORTS.get(self.code, 'reason unknown')} (abort {self.code:08X})"


@dataclass(frozen=True, slots=True)
class ProcessData:
    """TPDO1, not yet taken apart."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Emergency:
    """An error has appeared or, with code 0, gone."""

    code: int
    register: int


@dataclass(frozen=True, slots=True)
class NodeState:
    """Heartbeat; state 0 is the boot-up message."""

    state: int


SdoAnswer = Uploaded | Downloaded | Aborted
Message = SdoAnswer | ProcessData | Emergency | NodeState

NmtCommand = Literal["start", "stop", "pre-operational", "reset"]
_NMT = {"start": 0x01, "stop": 0x02, "pre-operational": 0x80, "reset": 0x81}


def nmt(node: int, command: NmtCommand) -> CanFrame:
    """Network management: not acknowledged."""
    return CanFrame(0x000, bytes((_NMT[command], node)))


def upload_request(node: int, index: int, sub: int) -> CanFrame:
    """Read an object."""
    return CanFrame(0x600 + node, struct.pack("<BHB4x", 0x40, index, sub))


def download_request(node: int, index: int, sub: int, value: bytes) -> CanFrame:
    """Write an object of at most four bytes (expedited transfer, size indicated)."""
    if not 1 <= len(value) <= 4:
        raise ValueError(f"{len(value)} bytes; an expedited transfer carries 1 to 4")
    return CanFrame(0x600 + node, struct.pack("<BHB4s", 0x23 | (4 - len(value)) << 2, index, sub, value))


def autozero_request(node: int, channel: int) -> CanFrame:
    """Tare, as Baumer documents it: the size is not indicated."""
    return CanFrame(0x600 + node, struct.pack("<BHB4s", 0x22, AUTOZERO, channel, b"zero"))


def emergency_in_words(code: int) -> str:
    """What an emergency code (CiA 301) is about."""
    what = _EMERGENCIES.get(code >> 8) or _EMERGENCIES.get(code >> 8 & 0xF0) or "a fault that only its manual explains"
    return f"{what} (emergency {code:04X})"


def identity(vendor: int | None, product: int | None, revision: int | None, serial: int | None) -> Identity:
    """From object 1018h:1 to 4; None where the node does not say."""
    return Identity(
        model="CiA 404"
        + (f" vendor {vendor:X} product {product:X}" if vendor is not None and product is not None else ""),
        serial="" if serial is None else str(serial),
        firmware="" if revision is None else f"{revision >> 16}.{revision & 0xFFFF}",
    )


class Decoder:
    """Frames of one node to messages. Never raises.

    Counters: ``foreign_frames`` (other identifiers), ``bad_frames`` (wrong length or an unknown SDO answer; segmented
    transfers are not used and count here too).
    """

    def __init__(self, node: int, counters: dict[str, int] | None = None) -> None:
        self.counters = {} if counters is None else counters
        self.counters.setdefault("foreign_frames", 0)
        self.counters.setdefault("bad_frames", 0)
        self._node = node

    def feed(self, frame: CanFrame) -> Message | None:
        """The frame's message; None (and counted) when it is not for us or makes no sense."""
        function, data = frame.id - self._node, frame.data
        message: Message | None = None
        if function == 0x580:
            message = _sdo_answer(data)
        elif function == 0x180:
            message = ProcessData(data)
        elif function == 0x080:
            message = Emergency(*struct.unpack("<HB", data[:3])) if len(data) == 8 else None
        elif function == 0x700:
            message = NodeState(data[0] & 0x7F) if len(data) == 1 else None
        else:
            self.counters["foreign_frames"] += 1
            return None
        self.counters["bad_frames"] += message is None
        return message


def _sdo_answer(data: bytes) -> SdoAnswer | None:
    if len(data) != 8:
        return None
    command, index, sub = struct.unpack("<BHB", data[:4])
    if command == 0x60:
        return Downloaded(index, sub)
    if command == 0x80:
        return Aborted(index, sub, int.from_bytes(data[4:], "little"))
    if command & 0xF3 == 0x43:  # expedited, size indicated
        return Uploaded(index, sub, data[4 : 8 - (command >> 2 & 3)])
    if command == 0x42:  # expedited, size not indicated
        return Uploaded(index, sub, data[4:])
    return None


@dataclass(frozen=True, slots=True)
class Entry:
    """One object in a PDO."""

    index: int
    sub: int
    bits: int

    @classmethod
    def unpack(cls, word: int) -> Entry:
        return cls(word >> 16, word >> 8 & 0xFF, word & 0xFF)

    def pack(self) -> bytes:
        return struct.pack("<I", self.index << 16 | self.sub << 8 | self.bits)


class Layout:
    """Where process value and status of one channel lie in a PDO.

    ``usable`` is False when the PDO does not carry the channel's process value.
    """

    def __init__(self, entries: Sequence[Entry], channel: int) -> None:
        self.length = (sum(e.bits for e in entries) + 7) // 8
        self.index = 0
        self._value = self._status = -1
        at = 0
        for e in entries:
            if e.sub == channel and _BITS.get(e.index) == e.bits and self._value < 0:
                self.index, self._value = e.index, at
            elif e.sub == channel and e.index == STATUS and e.bits == 8:
                self._status = at
            at += e.bits
        self.usable = self._value >= 0 and self.length <= 8

    def take(self, data: bytes) -> tuple[float, int]:
        """(value as sent, status byte; 0 where the PDO carries none)."""
        word = int.from_bytes(data, "little")
        bits = _BITS[self.index]
        raw = word >> self._value & (1 << bits) - 1
        value: float
        if self.index == FLOAT_VALUE:
            (value,) = struct.unpack("<f", raw.to_bytes(4, "little"))
        else:
            value = raw - (raw >> bits - 1 << bits)
        return value, word >> self._status & 0xFF if self._status >= 0 else 0


def unit_of(code: int) -> tuple[str, float] | None:
    """(reading unit, factor from the device's values to it) for a unit code of CiA 303-2; None for other quantities.

    Newtons with any prefix become "N"; volts per volt become "mV/V".
    """
    prefix, numerator, denominator = code >> 24, code >> 16 & 0xFF, code >> 8 & 0xFF
    exponent = prefix - 256 if prefix > 127 else prefix
    if not -18 <= exponent <= 18:
        return None
    if (numerator, denominator) == (0x21, 0x00):
        return "N", 10.0**exponent
    if (numerator, denominator) == (0x26, 0x26):
        return "mV/V", 10.0 ** (exponent + 3)
    return None
