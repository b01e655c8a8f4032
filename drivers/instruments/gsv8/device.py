"""A force sensor on a GSV-8 or GSV-6 amplifier: set-up, stream and scaling."""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Generator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

from drivers.dialogue import LOST_AGAIN_S, Ask, Dialogue, label
from drivers.dialogue import Answer as Answered
from drivers.heard import Heard
from drivers.instruments.gsv8.codec import (
    COMMANDS,
    GET_FIRMWARE_VERSION,
    GET_INPUT_TYPE,
    GET_SERIAL_NUMBER,
    GET_TX_MODE,
    GET_VALUE,
    INPUT_TYPES,
    READ_DATA_RATE,
    READ_USER_OFFSET,
    READ_USER_SCALE,
    SET_TX_MODE,
    SET_ZERO,
    START_TRANSMISSION,
    STOP_TRANSMISSION,
    TX_MODE,
    WIDTH,
    WRITE_DATA_RATE,
    Decoder,
    FrameType,
    Measured,
    Message,
    Reply,
    encode,
    identity,
)
from drivers.links.link import ByteLink, DeviceError, DeviceRefused
from drivers.roles import OK, ForceSample, Identity, SampleFlag
from drivers.stream import Stream

_QUIET_S = 0.05  # frames still on their way after the stream was stopped
_UNKNOWN_RANGE_LIMIT = 100.0  # mV/V
TX_INDEX = b"\x01"  # of what the TX mode has: the type of the values
THIRD_TYPE = 3
TX_TYPE, DATA_RATE = "tx_mode", "data_rate_Hz"


@dataclass(frozen=True, slots=True)
class _Request:
    command: int
    parameters: bytes = b""
    answer_lengths: tuple[int, ...] = (0,)  # data bytes that a good answer may have; empty: any

    def __str__(self) -> str:
        return COMMANDS[self.command]


_Step = Ask[_Request]
_Got = Answered[Message]


class GSV8:
    """A force sensor on one channel of a GSV-8 or GSV-6, streaming.

    The set-up dialogue stops the stream, reads serial number, firmware, input range and user scale, sets frame type
    and data rate, reads both back (the frame type from a frame), and starts the stream.

    With ``looks_first`` frame type and data rate are read before they are set (`found`); `give_back` puts both back,
    and the stream as it was: running, or not. An amplifier that does not tell them keeps what was set.

    The reading is the bridge signal in mV/V. For floats it is ``(value - user offset) / user scale``, times the input
    range: the manufacturer's header calls a float the product of user scale and raw value, and his helper sets the
    scale to capacity / sensitivity * input range. Where a device should prove that its user scale multiplies the
    signal in mV/V itself, ``user_scale_of = "mV/V"`` leaves the input range out. For integers it is the value times
    the input range. Check the scale once with a known weight or a bridge simulator.

    A value that is not finite or lies beyond twice the input range, in a frame that does not report an overload, is
    dropped and counted (``bad_values``) and leaves its place in time empty. A frame that reports an overload is flagged
    ``OVER_RANGE``; its reading is NaN with ``NO_VALUE`` if it is not finite.

    Parameters
    ----------
    channel : int
        1 to 16, as counted by the amplifier.
    rate_Hz : float
        Data rate to be set. A rate that reads back more than 1 % off is refused.
    frame_type : {"float32", "int24", "int16"}
        What the amplifier shall send.
    timeout_s : float
        How long to wait for each answer, and for the next measured frame before the sensor is called silent (or
        five sample periods, if that is longer).
    poll_interval_s : float
        Longest time between two polls. They are spaced unevenly on purpose: polls in step with the stream would
        hide when samples really arrive.
    input_range_mV_per_V : float, optional
        Overrides the input range read from the amplifier.
    int_full_scale : float
        Signal at the largest integer, in input ranges.
    boot_s : float
        How long the first answer may take.
    looks_first : bool
        Whether set-up reads what it changes before it does. Recorded dialogues of earlier releases did not.
    """

    reading_unit = "mV/V"

    def __init__(
        self,
        name: str,
        link: ByteLink,
        *,
        channel: int = 1,
        rate_Hz: float = 100.0,
        frame_type: FrameType = "float32",
        timeout_s: float = 0.25,
        poll_interval_s: float = 0.01,
        user_scale_of: Literal["range", "mV/V"] = "range",
        input_range_mV_per_V: float | None = None,
        int_full_scale: float = 1.05,
        boot_s: float = 0.0,
        looks_first: bool = False,
    ) -> None:
        where = label(name, link)
        if not 1 <= channel <= 16:
            raise DeviceRefused(where, f"channel {channel} does not exist", "A GSV-8 counts 1 to 8, a GSV-6 1 to 6.")
        if not 0 < rate_Hz <= 48000:
            raise DeviceRefused(where, f"data rate {rate_Hz} Hz is not possible", "Allowed: above 0, at most 48000 Hz.")
        if input_range_mV_per_V is not None and not 0 < input_range_mV_per_V <= 1000:
            raise DeviceRefused(where, f"input range {input_range_mV_per_V} mV/V is not possible", "Typical: 2 or 3.5.")
        self.name = name
        self._label = where
        self.identity = Identity(model="GSV-8")
        self.settings: dict[str, str] = {}
        self.counters: dict[str, int] = {"unexpected_answers": 0, "ignored_frames": 0, "bad_values": 0, "overloads": 0}
        self._link = link
        self._channel = channel
        self._rate = rate_Hz
        self._frame_type: FrameType = frame_type
        self._timeout = timeout_s
        self._interval = poll_interval_s
        self._boot_s = boot_s
        self._looks_first = looks_first
        self.found: dict[str, float] = {}
        self._present: dict[str, float] = {}
        self._streamed = self._ended = False  # whether it streamed when it was found; whether our own stream is over
        self._heard = Heard()
        self._user_scale_of = user_scale_of
        self._range = input_range_mV_per_V
        self._int_full_scale = int_full_scale
        self._decoder = Decoder(self.counters)
        self._dialogue: Dialogue[_Request, Message] = Dialogue(
            where,
            self._transmit,
            self.counters,
            timeout_s=timeout_s,
            advice="Check that the amplifier is switched on, its cable, and the baud rate.",
            heard=self._heard,
        )
        self._settle_s = 0.0
        self._gain = math.nan
        self._offset = 0.0
        self._limit = _UNKNOWN_RANGE_LIMIT
        self._stream: Stream[ForceSample] | None = None
        self._fresh = True
        self._inbox: deque[Message] = deque()
        self._asked: _Request | None = None
        self._next_poll = -math.inf

    @property
    def ready(self) -> bool:
        return self._stream is not None or self._ended

    @property
    def rate(self) -> float:
        """Data rate in hertz: as asked for until it has been read back."""
        return self._rate

    @property
    def next_poll(self) -> float:
        return self._next_poll

    @property
    def busy(self) -> bool:
        """True while a command waits to be sent or answered."""
        return not self._dialogue.idle

    def set_zero(self) -> None:
        """Make the present signal of this channel the amplifier's zero. All later readings refer to it."""
        self._dialogue.begin(self._zero())
        self._next_poll = -math.inf

    @property
    def given_back(self) -> bool:
        """Whether the amplifier has frame type and data rate as they were found, by its own word."""
        return self._present == self.found

    def resume_found(self, found: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        """Take over what an earlier run found; what is not as this run sets it, somebody has set since."""
        wanted = self._set_now(self._rate)
        left = {
            key: (now, found[key])
            for key, now in self.found.items()
            if key in found and now == wanted[key] and found[key] != now
        }
        self.found |= {key: before for key, (_, before) in left.items()}
        return left

    def give_back(self) -> None:
        """End the stream and put both back; a stream that ran when it was found runs again."""
        if self._stream is not None and not self.given_back:
            self._stream, self._ended = None, True
            self._dialogue.begin(self._giving_back())
            self._next_poll = -math.inf

    def close(self) -> None:
        """Give back what is not yet, without waiting, and release the line."""
        if not self.given_back:
            with suppress(DeviceError):
                self._link.write(encode(STOP_TRANSMISSION))
                for command, parameters in self._as_found():
                    self._link.write(encode(command, parameters))
                if self._streamed:
                    self._link.write(encode(START_TRANSMISSION))
        self._link.close()

    def poll(self, now: float) -> Sequence[ForceSample]:
        self._next_poll = now + LOST_AGAIN_S
        data = self._heard.bytes(self._link.read())
        if self._fresh:
            self._streamed = bool(data)
            data = b""  # whatever was in the line belongs to an earlier conversation
        self._fresh = False
        if not self.ready and self._dialogue.idle:
            self._decoder.expect_any()
            self._dialogue.begin(self._set_up())
        arrived: list[ForceSample | None] = []
        self._inbox.extend(self._decoder.feed(data))
        while self._inbox:  # an error that an answer brings on leaves the others for the next poll
            message = self._inbox.popleft()
            if isinstance(message, Measured) and self._stream is not None:
                arrived.append(self._sample(message))
            elif not self._dialogue.offer(message, now):
                self._streamed |= isinstance(message, Measured) and not self.ready
                self.counters["ignored_frames" if isinstance(message, Measured) else "unexpected_answers"] += 1
        self._dialogue.run(now)
        stream = self._stream
        look = now + self._interval if stream is None else stream.next_poll(now)
        self._next_poll = min(look, self._dialogue.next_poll(now))
        return [] if stream is None else stream.take(now, arrived)

    # -- stream -----------------------------------------------------------------------------------------------------

    def _sample(self, frame: Measured) -> ForceSample | None:
        reading = (frame.values[self._channel - 1] - self._offset) * self._gain
        flags = OK
        if frame.six_axis_error:
            flags |= SampleFlag.SENSOR_ERROR
        if frame.overload:
            self.counters["overloads"] += 1
            flags |= SampleFlag.OVER_RANGE
            if not math.isfinite(reading):
                reading, flags = math.nan, flags | SampleFlag.NO_VALUE
        elif not abs(reading) <= self._limit:
            self.counters["bad_values"] += 1
            return None
        return ForceSample(math.nan, reading, flags)

    # -- dialogue ---------------------------------------------------------------------------------------------------

    def _transmit(self, request: _Request) -> _Recogniser:
        if request is self._asked and self._stream is None:  # once more: nothing came in the time that an answer takes
            self._decoder.drop()
        self._asked = request
        self._link.write(encode(request.command, request.parameters))
        return _Recogniser(request)

    def _ask(
        self, command: int, parameters: bytes = b"", lengths: tuple[int, ...] = (0,), delay_s: float = 0
    ) -> Generator[_Step, _Got, Reply]:
        """One request; refused answers are returned like others."""
        message = yield from self._exchange(_Request(command, parameters, lengths), delay_s)
        assert isinstance(message, Reply)
        return message

    def _exchange(self, request: _Request, delay_s: float = 0) -> Generator[_Step, _Got, Message]:
        delay_s, self._settle_s = max(delay_s, self._settle_s), self._timeout  # in case this one goes wrong
        retries = self.counters["retries"]
        boot_s = 0.0 if self.counters["round_trips"] else self._boot_s
        answer = yield Ask(request, delay_s=delay_s, boot_s=boot_s)
        if self.counters["retries"] == retries:
            self._settle_s = 0.0
        return answer.message

    def _demand(
        self, command: int, parameters: bytes = b"", lengths: tuple[int, ...] = (0,), delay_s: float = 0
    ) -> Generator[_Step, _Got, bytes]:
        """One request whose refusal ends the dialogue."""
        reply = yield from self._ask(command, parameters, lengths, delay_s)
        if reply.error > 0x01:
            raise DeviceRefused(
                self._label,
                f"{COMMANDS[command]} refused: {reply.meaning}",
                "Check channel, rate and frame type against the amplifier, and that its settings are not locked.",
            )
        return reply.data

    def _set_up(self) -> Generator[_Step, _Got, None]:
        channel = bytes((self._channel,))
        yield from self._demand(STOP_TRANSMISSION)
        serial = yield from self._ask(GET_SERIAL_NUMBER, lengths=(4,), delay_s=_QUIET_S)
        firmware = yield from self._ask(GET_FIRMWARE_VERSION, lengths=())
        self.identity = identity(
            serial.data if serial.error <= 1 else b"", firmware.data if firmware.error <= 1 else b""
        )
        yield from self._read_scaling(channel)
        if self._looks_first:
            yield from self._look()
        yield from self._demand(SET_TX_MODE, TX_INDEX + struct.pack(">H", TX_MODE[self._frame_type]))
        yield from self._demand(WRITE_DATA_RATE, struct.pack(">f", self._rate))
        data = yield from self._demand(READ_DATA_RATE, lengths=(4,))
        (rate,) = struct.unpack(">f", data)
        if not abs(rate - self._rate) <= 0.01 * self._rate:
            raise DeviceRefused(
                self._label,
                f"data rate reads back as {rate:.6g} Hz after {self._rate:.6g} Hz was written",
                "Choose a rate that the amplifier supports.",
            )
        self._rate = rate
        self._present = {key: now for key, now in self._set_now(rate).items() if key in self.found}
        self.settings["data_rate_Hz"] = f"{rate:.9g}"
        yield from self._check_frame()
        yield from self._demand(START_TRANSMISSION)
        self._stream = Stream(self._label, self._rate, self._timeout, self._interval, self.counters, self._heard)

    def _set_now(self, rate: float) -> dict[str, float]:
        return {TX_TYPE: float(TX_MODE[self._frame_type]), DATA_RATE: rate}

    def _look(self) -> Generator[_Step, _Got, None]:
        """What is about to be changed. An amplifier that does not tell one of them is given back neither."""
        kind = yield from self._ask(GET_TX_MODE, TX_INDEX, (2,))
        if kind.error > 0x01:
            return
        rate = yield from self._ask(READ_DATA_RATE, lengths=(4,))
        if rate.error > 0x01:
            return
        found = _told(kind.data, rate.data)
        if found[TX_TYPE] in TX_MODE.values() and math.isfinite(found[DATA_RATE]):
            self.found = found
            self.settings["found"] = ", ".join(f"{key} {value:.9g}" for key, value in found.items())

    def _as_found(self) -> list[tuple[int, bytes]]:
        """The commands that put back what is not as it was found: the frame type first, which bounds the rate."""
        commands = []
        if self._present.get(TX_TYPE) != self.found[TX_TYPE]:
            commands.append((SET_TX_MODE, TX_INDEX + struct.pack(">H", int(self.found[TX_TYPE]))))
        if commands or self._present.get(DATA_RATE) != self.found[DATA_RATE]:
            commands.append((WRITE_DATA_RATE, struct.pack(">f", self.found[DATA_RATE])))
        return commands

    def _giving_back(self) -> Generator[_Step, _Got, None]:
        yield from self._demand(STOP_TRANSMISSION)
        delay_s = _QUIET_S
        for command, parameters in self._as_found():
            yield from self._demand(command, parameters, delay_s=delay_s)
            delay_s = 0.0
        kind = yield from self._demand(GET_TX_MODE, TX_INDEX, (2,))
        rate = yield from self._demand(READ_DATA_RATE, lengths=(4,))
        if self._streamed:
            yield from self._demand(START_TRANSMISSION)
        self._present = _told(kind, rate)

    def _read_scaling(self, channel: bytes) -> Generator[_Step, _Got, None]:
        reply = yield from self._ask(GET_INPUT_TYPE, channel + b"\xff", lengths=(5,))
        if reply.error <= 1:
            kind, hundredths = struct.unpack(">BI", reply.data)
            self.settings["input_type"] = INPUT_TYPES.get(kind, f"type {kind}")
            self.settings["input_range_mV_per_V"] = f"{hundredths / 100:g}"
            if self._range is None and hundredths > 0:
                self._range = hundredths / 100
        needed = self._frame_type != "float32" or self._user_scale_of == "range"
        if self._range is None and needed:
            raise DeviceRefused(
                self._label,
                f"input range unknown: GetInputType answered {reply.meaning}",
                "State input_range_mV_per_V in the scene.",
            )
        scale = yield from self._read_float(READ_USER_SCALE, channel, "user_scale")
        offset = yield from self._read_float(READ_USER_OFFSET, channel, "user_offset")
        if self._frame_type == "float32":
            if not (math.isfinite(scale) and scale != 0 and math.isfinite(offset)):
                raise DeviceRefused(
                    self._label,
                    f"user scale of channel {self._channel} is {scale:g}, its user offset {offset:g}",
                    "Set them in the amplifier, to 1 and 0 say.",
                )
            self._gain = (self._range if self._user_scale_of == "range" and self._range else 1.0) / scale
            self._offset = offset
        else:
            assert self._range is not None
            self._offset = float(1 << (8 * WIDTH[self._frame_type] - 1))
            self._gain = self._range * self._int_full_scale / self._offset
        self._limit = 2.0 * self._range if self._range is not None else _UNKNOWN_RANGE_LIMIT
        self.settings["mV_per_V_per_unit"] = f"{self._gain:.9g}"

    def _read_float(self, command: int, channel: bytes, key: str) -> Generator[_Step, _Got, float]:
        data = yield from self._demand(command, channel, lengths=(4,))
        value = float(struct.unpack(">f", data)[0])
        self.settings[key] = f"{value:.9g}"
        return value

    def _check_frame(self) -> Generator[_Step, _Got, None]:
        """One measured frame on request: it shows type and number of channels, and the stream is held to them."""
        frame = yield from self._exchange(_Request(GET_VALUE))
        if isinstance(frame, Reply):
            raise DeviceRefused(self._label, f"GetValue refused: {frame.meaning}", "Check the sensor and its cable.")
        if frame.type != self._frame_type:
            raise DeviceRefused(
                self._label,
                f"sends {frame.type} although {self._frame_type} was set",
                f'Set frame_type = "{frame.type}" in the scene, or change it in the amplifier.',
            )
        if self._channel > len(frame.values):
            raise DeviceRefused(
                self._label,
                f"has {len(frame.values)} channels, but channel {self._channel} was asked for",
                "Correct the channel in the scene.",
            )
        self._decoder.expect(frame.type, len(frame.values))
        self.settings["frame_type"] = frame.type
        self.settings["channels"] = str(len(frame.values))
        self.settings["channel"] = str(self._channel)

    def _zero(self) -> Generator[_Step, _Got, None]:
        yield from self._demand(SET_ZERO, bytes((self._channel,)))


def _told(kind: bytes, rate: bytes) -> dict[str, float]:
    """What the amplifier answers. Floats are set by the word 10h, and may be told as 10h or as the third type."""
    (word,), (hertz,) = struct.unpack(">H", kind), struct.unpack(">f", rate)
    return {TX_TYPE: float(TX_MODE["float32"] if word == THIRD_TYPE else word), DATA_RATE: float(hertz)}


class _Recogniser:
    """Whether a message answers a request: by kind and length, since answers do not name their request."""

    def __init__(self, request: _Request) -> None:
        self._request = request

    def __call__(self, message: Message) -> bool:
        if isinstance(message, Measured):
            return self._request.command == GET_VALUE
        if message.error > 0x01:
            return True
        if self._request.command == GET_VALUE:
            return False
        return not self._request.answer_lengths or len(message.data) in self._request.answer_lengths
