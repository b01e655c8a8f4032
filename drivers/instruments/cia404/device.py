"""A force sensor on a CiA 404 node: set-up, stream and unit."""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Literal

from drivers.dialogue import LOST_AGAIN_S, Answer, Ask, Dialogue, label
from drivers.heard import Heard
from drivers.instruments.cia404.codec import (
    AUTOZERO,
    DECIMALS,
    FLOAT_VALUE,
    IDENTITY,
    PROFILE,
    STATUS,
    TPDO1_MAPPING,
    TPDO1_PARAMETERS,
    UNIT,
    Aborted,
    Decoder,
    Downloaded,
    Emergency,
    Entry,
    Layout,
    Message,
    NodeState,
    ProcessData,
    Uploaded,
    autozero_request,
    download_request,
    emergency_in_words,
    identity,
    nmt,
    unit_of,
    upload_request,
)
from drivers.links.link import CanFrame, DeviceRefused, FrameLink
from drivers.roles import ForceSample, Identity, SampleFlag
from drivers.stream import Stream


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
    boot_s : float
        How long the first answer may take.
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
        boot_s: float = 0.0,
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
        self._boot_s = boot_s
        self._heard = Heard()
        self._decoder = Decoder(node, self.counters)
        self._dialogue: Dialogue[_Request, Message] = Dialogue(
            where,
            self._transmit,
            self.counters,
            timeout_s=timeout_s,
            advice=f"Check power, CAN cable and termination, bit rate, and that the device is node {node}.",
            heard=self._heard,
        )
        self._layout = Layout((), channel)
        self._identifying: dict[int, bytes] = {}
        self._remarks: list[str] = []
        self._stream: Stream[ForceSample] | None = None
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

    def remarks(self) -> list[str]:
        """Emergencies that it reports, in words."""
        told, self._remarks = self._remarks, []
        return told

    def close(self) -> None:
        self._link.close()

    def poll(self, now: float) -> Sequence[ForceSample]:
        self._next_poll = now + LOST_AGAIN_S
        self._inbox.extend(self._heard.frames(self._link.read()))
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
                    if code != self._emergency:
                        told = f"the device reports {emergency_in_words(code)}" if code else "its emergency is over"
                        self._remarks.append(told)
                    self._emergency = code
                    self.settings["last_emergency"] = f"{code:04X}"
                case NodeState(state):
                    self._check_state(state)
                case answer:
                    if not self._dialogue.offer(answer, now):
                        self.counters["unexpected_answers"] += 1
                        self._judge_second(answer)
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

    def _judge_second(self, answer: Message) -> None:
        """A late answer is the same again; another one to a question who it is comes from somebody else."""
        if not isinstance(answer, Uploaded) or answer.index != IDENTITY:
            return
        first = self._identifying.get(answer.sub, answer.value)
        if first != answer.value:
            one, other = (int.from_bytes(value, "little") for value in (first, answer.value))
            raise DeviceRefused(
                self._label,
                f"two devices answer as node {self._node} (1018h:{answer.sub} is {one} and {other})",
                "Give each its own node number with the maker's tool, one at a time on the bus.",
            )

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
        boot_s = 0.0 if self.counters["round_trips"] else self._boot_s
        answer = (yield Ask(_Request(frame, index, sub), boot_s=boot_s)).message
        if isinstance(answer, Aborted):
            return answer
        assert isinstance(answer, Uploaded)
        if index == IDENTITY:
            self._identifying[sub] = answer.value
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
            answer = yield from self._read(IDENTITY, sub, 4)
            identifying.append(None if isinstance(answer, Aborted) else answer)
        self.identity = identity(*identifying)
        self._layout = yield from self._map()
        yield from self._read_unit()
        yield from self._set_timer()
        self._emergency = 0
        self._link.write(nmt(self._node, "start"))
        self._stream = Stream(self._label, self._rate, self._timeout, self._interval, self.counters, self._heard)

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
