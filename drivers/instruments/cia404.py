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

import math
import struct
from collections import deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Literal

from drivers.dialogue import LOST_AGAIN_S, Answer, Ask, Dialogue, label
from drivers.links.link import CanFrame, DeviceRefused, FrameLink
from drivers.roles import ForceSample, Identity, SampleFlag
from drivers.stream import Stream

PROFILE = 404
FLOAT_VALUE, INT16_VALUE, INT24_VALUE, INT32_VALUE, STATUS = 0x6130, 0x7130, 0x8130, 0x9130, 0x6150
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


@dataclass(frozen=True, slots=True)
class _Request:
    frame: CanFrame
    index: int
    sub: int

    def __str__(self) -> str:
        return f"object {self.index:04X}h:{self.sub}"


_Step = Ask[_Request]
_Got = Answer[Message]

# Nearest event timer, in milliseconds, and how far the rate may be from the one asked for.
_RATE_TOLERANCE = 0.01

_LIMIT_MV_PER_V = 100.0


class CiA404:
    """A force sensor on one analogue input of a CiA 404 node, streaming by event timer.

    Set-up takes the node to PRE-OPERATIONAL, reads profile, identity and unit, makes TPDO1 carry process value and
    status (or takes it as it is, if it already carries the float value, or carries any and cannot be changed), sets its
    timer, and starts the node. Nothing is stored in the device. Without the status in the PDO only a value that is not
    a number can be told to be invalid.

    The reading is in newtons, or in mV/V if the device is set so; for any other unit ``unit`` and ``factor`` must say
    what its values are. A value that is not finite or beyond ``limit_N`` (100 mV/V), in a PDO that calls it valid, is
    counted (``bad_values``); its sample is NaN with ``NO_VALUE``. While an emergency is reported the samples carry
    ``SENSOR_ERROR``.

    Parameters
    ----------
    node : int
        1 to 127.
    channel : int
        Analogue input, from 1.
    rate_Hz : float
        1000 / n, n a whole number of milliseconds.
    timeout_s : float
        How long to wait for each answer, and for the next PDO before the sensor is called silent (or five sample
        periods, if that is longer).
    poll_interval_s : float
        Longest time between two polls.
    unit, factor
        Reading unit and what to multiply the device's value with, instead of the unit it states.
    limit_N : float
        Largest magnitude of a reading in newtons that is believed.
    """

    def __init__(
        self,
        name: str,
        link: FrameLink,
        *,
        node: int = 1,
        channel: int = 1,
        rate_Hz: float = 100.0,
        timeout_s: float = 0.25,
        poll_interval_s: float = 0.01,
        unit: Literal["N", "mV/V"] | None = None,
        factor: float = 1.0,
        limit_N: float = 1e4,
    ) -> None:
        where = label(name, link)
        if not 1 <= node <= 127:
            raise DeviceRefused(where, f"node {node} does not exist", "Allowed: 1 to 127.")
        if not 1 <= channel <= 199:
            raise DeviceRefused(where, f"channel {channel} does not exist", "CiA 404 counts them from 1 to 199.")
        if not 0.02 <= rate_Hz <= 1000:
            raise DeviceRefused(where, f"rate {rate_Hz} Hz is not possible", "Allowed: 0.02 to 1000 Hz.")
        self._period_ms = round(1000 / rate_Hz)
        self._rate = 1000 / self._period_ms
        if not abs(self._rate / rate_Hz - 1) <= _RATE_TOLERANCE:
            raise DeviceRefused(
                where,
                f"rate {rate_Hz:g} Hz is not a whole number of milliseconds",
                f"Next to it: {self._rate:.6g} Hz.",
            )
        self.name = name
        self._label = where
        self.identity = Identity(model="CiA 404")
        self.reading_unit: str = unit or "N"
        self.settings: dict[str, str] = {}
        self.counters: dict[str, int] = dict.fromkeys(
            ("unexpected_answers", "ignored_frames", "bad_values", "overloads", "emergencies"), 0
        )
        self._link = link
        self._node = node
        self._channel = channel
        self._timeout = timeout_s
        self._interval = poll_interval_s
        self._stated = (unit, factor) if unit is not None else None
        self._factor = factor
        self._limit_N = limit_N
        self._decoder = Decoder(node, self.counters)
        self._dialogue: Dialogue[_Request, Message] = Dialogue(
            where,
            self._transmit,
            self.counters,
            timeout_s=timeout_s,
            advice=f"Check power, CAN cable and termination, bit rate, and that the device is node {node}.",
        )
        self._layout = Layout((), channel)
        self._stream: Stream | None = None
        self._emergency = 0
        self._inbox: deque[CanFrame] = deque()
        self._next_poll = -math.inf

    @property
    def ready(self) -> bool:
        return self._stream is not None

    @property
    def rate(self) -> float:
        return self._rate

    @property
    def next_poll(self) -> float:
        return self._next_poll

    @property
    def busy(self) -> bool:
        """True while a command waits to be sent or answered."""
        return not self._dialogue.idle

    def set_zero(self) -> None:
        """Make the present value the device's zero. All later readings refer to it."""
        self._dialogue.begin(self._zero())
        self._next_poll = -math.inf

    def close(self) -> None:
        self._link.close()

    def poll(self, now: float) -> Sequence[ForceSample]:
        self._next_poll = now + LOST_AGAIN_S
        self._inbox.extend(self._link.read())
        if self._stream is None and self._dialogue.idle:
            self.counters["ignored_frames"] += len(self._inbox)  # they belong to an earlier conversation
            self._inbox.clear()
            self._link.write(nmt(self._node, "pre-operational"))
            self._dialogue.begin(self._set_up())
        arrived: list[ForceSample] = []
        while self._inbox:  # an error that an answer brings on leaves the others for the next poll
            match self._decoder.feed(self._inbox.popleft()):
                case None:
                    pass
                case ProcessData(data):
                    if self._stream is None or len(data) != self._layout.length:
                        self.counters["ignored_frames"] += 1
                    else:
                        arrived.append(self._sample(data))
                case Emergency(code, _):
                    self.counters["emergencies"] += code != 0
                    self._emergency = code
                    self.settings["last_emergency"] = f"{code:04X}"
                case NodeState(state):
                    self._check_state(state)
                case answer:
                    if not self._dialogue.offer(answer, now):
                        self.counters["unexpected_answers"] += 1
        self._dialogue.run(now)
        stream = self._stream
        look = now + self._interval if stream is None else stream.next_poll(now)
        self._next_poll = min(look, self._dialogue.next_poll(now))
        return [] if stream is None else stream.take(now, arrived)

    # -- stream -----------------------------------------------------------------------------------------------------

    def _sample(self, data: bytes) -> ForceSample:
        value, status = self._layout.take(data)
        reading = value * self._factor
        flags = SampleFlag.SENSOR_ERROR if self._emergency else SampleFlag(0)
        if status & 2:
            flags |= SampleFlag.OVER_RANGE
        if status & 4:
            flags |= SampleFlag.UNDER_RANGE
        self.counters["overloads"] += bool(status & 6)
        if status & 1:
            return ForceSample(math.nan, math.nan, flags | SampleFlag.NO_VALUE)
        if not abs(reading) <= (self._limit_N if self.reading_unit == "N" else _LIMIT_MV_PER_V):
            self.counters["bad_values"] += 1
            return ForceSample(math.nan, math.nan, flags | SampleFlag.NO_VALUE)
        return ForceSample(math.nan, reading, flags)

    def _check_state(self, state: int) -> None:
        if state != 0 or self._stream is None:
            return
        self._stream = None  # set up again if somebody goes on polling
        raise DeviceRefused(
            self._label,
            "has restarted by itself (boot-up message) and stopped measuring",
            "Check its supply. Its tare and settings may be gone.",
        )

    # -- dialogue ---------------------------------------------------------------------------------------------------

    def _transmit(self, request: _Request) -> Callable[[Message], bool]:
        self._link.write(request.frame)
        # A late answer to a repeated request has the same object and is taken for it, which does no harm.
        kind = Uploaded if request.frame.data[0] == 0x40 else Downloaded
        return lambda m: isinstance(m, (kind, Aborted)) and (m.index, m.sub) == (request.index, request.sub)

    def _read(self, index: int, sub: int, length: int) -> Generator[_Step, _Got, int | Aborted]:
        """An unsigned number of at most ``length`` bytes, or the reason why it cannot be read."""
        frame = upload_request(self._node, index, sub)
        answer = (yield Ask(_Request(frame, index, sub))).message
        if isinstance(answer, Aborted):
            return answer
        assert isinstance(answer, Uploaded)
        return int.from_bytes(answer.value[:length], "little")

    def _write(self, index: int, sub: int, value: bytes) -> Generator[_Step, _Got, Aborted | None]:
        frame = download_request(self._node, index, sub, value)
        answer = (yield Ask(_Request(frame, index, sub))).message
        return answer if isinstance(answer, Aborted) else None

    def _refused(self, what: str, why: Aborted, advice: str) -> DeviceRefused:
        return DeviceRefused(self._label, f"{what}: {why.meaning}", advice)

    def _set_up(self) -> Generator[_Step, _Got, None]:
        kind = yield from self._read(0x1000, 0, 4)
        if isinstance(kind, Aborted) or kind & 0xFFFF != PROFILE:
            stated = kind.meaning if isinstance(kind, Aborted) else f"profile {kind & 0xFFFF}"
            raise DeviceRefused(
                self._label,
                f"node {self._node} is no CiA 404 device ({stated})",
                "Correct the node number in the scene.",
            )
        identifying: list[int | None] = []
        for sub in range(1, 5):
            answer = yield from self._read(0x1018, sub, 4)
            identifying.append(None if isinstance(answer, Aborted) else answer)
        self.identity = identity(*identifying)
        self._layout = yield from self._map()
        yield from self._read_unit()
        yield from self._set_timer()
        self._emergency = 0
        self._link.write(nmt(self._node, "start"))
        self._stream = Stream(self._label, self._rate, self._timeout, self._interval, self.counters)

    def _read_unit(self) -> Generator[_Step, _Got, None]:
        code = yield from self._read(UNIT, self._channel, 4)
        if not isinstance(code, Aborted):
            self.settings["unit_code"] = f"{code:08X}"
        known = self._stated or (None if isinstance(code, Aborted) else unit_of(code))
        if known is None:
            stated = code.meaning if isinstance(code, Aborted) else f"code {code:08X}"
            raise DeviceRefused(
                self._label,
                f"the unit of its values is neither newtons nor mV/V ({stated})",
                "Set it to newtons in the device, or state unit and factor in the scene.",
            )
        self.reading_unit, self._factor = known
        if self._layout.index != FLOAT_VALUE:
            decimals = yield from self._read(DECIMALS, self._channel, 1)
            if isinstance(decimals, Aborted) or decimals > 9:
                raise DeviceRefused(
                    self._label,
                    "does not state the decimal digits of its integer value",
                    "Map the float value (6130h).",
                )
            self.settings["decimals"] = str(decimals)
            self._factor /= 10.0**decimals
        self.settings["reading_unit"] = self.reading_unit

    def _map(self) -> Generator[_Step, _Got, Layout]:
        """TPDO1 as it is, if it carries the float value; else as we want it; else as it is, if that can be used."""
        present = yield from self._mapping()
        if present.usable and present.index == FLOAT_VALUE:
            return self._mapped(present, "as found")
        wanted = (Entry(FLOAT_VALUE, self._channel, 32), Entry(STATUS, self._channel, 8))
        off = struct.pack("<I", 0x8000_0180 + self._node)
        writes = [(TPDO1_PARAMETERS, 1, off), (TPDO1_MAPPING, 0, b"\0")]
        writes += [(TPDO1_MAPPING, i, entry.pack()) for i, entry in enumerate(wanted, 1)]
        writes += [(TPDO1_MAPPING, 0, bytes((len(wanted),)))]
        for index, sub, value in writes:
            abort = yield from self._write(index, sub, value)
            if abort is not None:
                if present.usable and (yield from self._mapping()).usable:
                    return self._mapped(present, "as found")
                raise self._refused(
                    f"TPDO1 cannot be made to carry the process value (object {index:04X}h:{sub})",
                    abort,
                    "Map object 6130h to TPDO1 with the manufacturer's tool.",
                )
        return self._mapped(Layout(wanted, self._channel), "set")

    def _mapping(self) -> Generator[_Step, _Got, Layout]:
        count = yield from self._read(TPDO1_MAPPING, 0, 1)
        entries = []
        for sub in range(1, 1 + min(8, count if isinstance(count, int) else 0)):
            word = yield from self._read(TPDO1_MAPPING, sub, 4)
            entries.append(Entry.unpack(0 if isinstance(word, Aborted) else word))
        return Layout(entries, self._channel)

    def _mapped(self, layout: Layout, how: str) -> Layout:
        self.settings["tpdo1"] = f"{layout.index:04X}h {how}"
        return layout

    def _set_timer(self) -> Generator[_Step, _Got, None]:
        on = struct.pack("<I", 0x180 + self._node)
        for sub, value in ((2, b"\xfe"), (5, struct.pack("<H", self._period_ms)), (1, on)):
            abort = yield from self._write(TPDO1_PARAMETERS, sub, value)
            if abort is not None:
                raise self._refused(
                    f"TPDO1 cannot be sent every {self._period_ms} ms (object 1800h:{sub})",
                    abort,
                    "Choose another rate, or set it with the manufacturer's tool.",
                )
        timer = yield from self._read(TPDO1_PARAMETERS, 5, 2)
        if timer != self._period_ms:
            stated = timer.meaning if isinstance(timer, Aborted) else f"{timer} ms"
            raise DeviceRefused(
                self._label, f"event timer reads back as {stated} after {self._period_ms} ms", "Choose another rate."
            )
        self.settings["event_timer_ms"] = str(timer)

    def _zero(self) -> Generator[_Step, _Got, None]:
        request = _Request(autozero_request(self._node, self._channel), AUTOZERO, self._channel)
        answer = (yield Ask(request, timeout_s=max(2.0, self._timeout))).message
        if isinstance(answer, Aborted):
            raise self._refused("tare refused", answer, "Take the load off; the tare range may be too small.")
