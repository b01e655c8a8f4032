r"""Keyence LK-G laser displacement sensors (LKGD500 controller with LK-G152 head), RS-232 ASCII, 115200 baud 8N1.

One command at a time, each ended by CR; so are the responses (some converters add LF). A response begins with the
command it answers; a refusal is ``ER,<command>,<nn>``. The controller is either in measurement mode or, between
``Q0`` and ``R0``, in communication mode, where settings can be read and there is no measurement.

``M1`` and ``M2`` give OUT1 and OUT2, ``M0`` both: ``M1,+01.2345``. A value is exactly eight characters: a sign and
seven digits with one decimal point among them; ``+FFFFFFF`` is over range, ``-FFFFFFF`` under range, ``XXXXXXXX`` no
value yet. ``TG,a,+01.2345`` may be pushed at any time.

**What corruption cannot be seen.** There is neither checksum nor message number. A digit that has turned into another
digit, or a sign that has flipped, is a valid value as long as it stays within ``limit_mm``; so is a refusal whose code
has changed. Every other change of a single byte, and every lost or added one, makes a line that fits the grammar or
the question no longer, and it is dropped and counted.

Two answers to the same command look alike, too. So the driver asks for ``M1`` and ``M0`` in turn, and a duplicated
answer meets the other question and is dropped. When an answer does not come in time, it asks for the program number,
``PR``, before it asks for a value again: answers keep their order, so that after this one no old value can come.

Source: Keyence LK-G series user's manual, RS-232C communication; settings as used by DESY (cmstkmodlab).
"""

from __future__ import annotations

import contextlib
import math
import re
from collections import deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Literal, NoReturn, TypeVar

from pydantic import Field

from drivers.dialogue import LOST_AGAIN_S, Answer, Ask, Dialogue, Schedule, Script, label
from drivers.heard import Heard
from drivers.instrument import Instrument
from drivers.lines import LineSplitter
from drivers.links.link import ByteLink, DeviceError, DeviceLost, DeviceRefused, DeviceSilent
from drivers.probe import Answered, Line, SerialProbe
from drivers.recorded import Dialect
from drivers.roles import OK, DisplacementSample, Identity, SampleFlag
from drivers.settings import Positive, SerialSettings

T = TypeVar("T")

ERRORS = {
    0: ("the command is unknown to it", "Check that it is an LK-G (not LK-G5000) controller."),
    1: ("it is in the wrong mode", "Close other programs that talk to the controller, and its menu."),
    20: ("the command has the wrong length", "Check that it is an LK-G (not LK-G5000) controller."),
    21: ("the number of parameters is wrong", "Check that it is an LK-G (not LK-G5000) controller."),
    22: ("a parameter is invalid", "Check `output` in the scene."),
    88: ("it timed out", "Try again."),
    99: ("of another error", "Look at the controller's display."),
}
"""Codes of ``ER``: why, and what to do."""

SAMPLING_US = (20, 50, 100, 200, 500, 1000)
"""Sampling period by the code of ``SW,CA``."""

AVERAGING = tuple(4**n for n in range(10))
"""Number of samples averaged by the code of ``SW,OC``."""

LONGEST_SETTLING_S = 10.0
"""How long set-up waits for the first value; a specimen that the head cannot see never gives one."""

SETTLING_LOOK_S = 0.01

UNANSWERED = "not answered"
"""What a setting is called that the controller does not know and says nothing to."""

LATE_S = 0.25
"""How long an answer may be late where no other question can show that it will not come any more."""

MEASURE_TRIES = 3

_MEASURE = "value"
_MAX_LINE = 128
_SPECIAL = {
    "+FFFFFFF": SampleFlag.OVER_RANGE,
    "-FFFFFFF": SampleFlag.UNDER_RANGE,
    "XXXXXXXX": SampleFlag.NO_VALUE,
}
_FIELD = r"([+-](?=[0-9]+\.[0-9]+(?![0-9.]))[0-9.]{7}|[+-]F{7}|X{8})"
_MEASURED = re.compile(rf"M0,{_FIELD},{_FIELD}|M([12]),{_FIELD}")
_PUSHED = re.compile(rf"TG,([0-9]{{1,2}}),{_FIELD}")
_REFUSED = re.compile(r"ER,([A-Z][A-Z0-9])(?:,[A-Z]{2})?,([0-9]{2})")
_RESPONSE = re.compile(
    r"Q0|R0|[VWTU][0-2]|VR|PW|KL|A[QSP]|PR,[0-7]|AN(?:,[0-9]{1,6}){3}"
    r"|SW,[A-Z]{2}|SR,[A-Z]{2}(?:,[+-]?[0-9]+(?:\.[0-9]+)?){1,4}"
)


@dataclass(frozen=True, slots=True)
class Value:
    """A displayed value in the controller's unit, NaN with a flag when there is none."""

    number: float
    flag: SampleFlag = OK


@dataclass(frozen=True, slots=True)
class Measured:
    """Answer to ``M0``, ``M1`` or ``M2``; ``values`` by OUT number."""

    command: str
    values: dict[int, Value]


@dataclass(frozen=True, slots=True)
class Pushed:
    """``TG``: a value that was not asked for."""

    output: int
    value: Value


@dataclass(frozen=True, slots=True)
class Refused:
    """``ER``: the command was not carried out."""

    command: str
    code: int


@dataclass(frozen=True, slots=True)
class Response:
    """Any other answer, as it stands on the wire."""

    text: str


Message = Measured | Pushed | Refused | Response


def encode(command: str) -> bytes:
    return command.encode("ascii") + b"\r"


class Codec:
    """Bytes from the controller to messages.

    A line that fits no grammar is dropped. ``counters``: ``bad_grammar``, ``too_long``.
    """

    def __init__(self, counters: dict[str, int] | None = None) -> None:
        self.counters = {} if counters is None else counters
        self.counters.setdefault("bad_grammar", 0)
        self._lines = LineSplitter(b"\r", _MAX_LINE, self.counters)

    def feed(self, data: bytes) -> list[Message]:
        """The messages that ``data`` completes, in order."""
        messages = (self._line(line.removeprefix(b"\n")) for line in self._lines.feed(data))
        return [message for message in messages if message is not None]

    def _line(self, line: bytes) -> Message | None:
        if not line:
            return None
        message = _parse(line.decode("ascii", "replace"))
        if message is None:
            self.counters["bad_grammar"] += 1
            return None
        return message


def _parse(text: str) -> Message | None:
    if match := _MEASURED.fullmatch(text):
        both_1, both_2, output, single = match.groups()
        if output is None:
            return Measured("M0", {1: _value(both_1), 2: _value(both_2)})
        return Measured(f"M{output}", {int(output): _value(single)})
    if match := _PUSHED.fullmatch(text):
        return Pushed(int(match[1]), _value(match[2]))
    if match := _REFUSED.fullmatch(text):
        return Refused(match[1], int(match[2]))
    if _RESPONSE.fullmatch(text):
        return Response(text)
    return None


def _value(field: str) -> Value:
    flag = _SPECIAL.get(field)
    return Value(float(field)) if flag is None else Value(math.nan, flag)


class KeyenceSettings(SerialSettings):
    """A Keyence LK-G laser displacement sensor on RS-232."""

    driver: Literal["keyence-lkg"] = Field(description="Keyence LK-G laser sensor on RS-232.")
    output: int = Field(default=1, ge=1, le=2, description="OUT number of the controller that looks at the disk.")
    poll_rate_Hz: float = Field(
        default=50.0, ge=5, le=200, description="How often the value is asked for (Hz). Typical: 50."
    )
    unit_mm: Positive = Field(
        default=1.0, description="Unit of the controller's display (mm): 0.001 when it is set to micrometres."
    )
    limit_mm: Positive = Field(
        default=80.0,
        description="Largest displacement that is believed (mm): what the head can show at most, twice its range.",
    )


# One or more questions within a script, ending in a value.
_Part = Generator[Ask[str], Answer[Message], T]


class KeyenceLKG:
    """A `drivers.roles.DisplacementSensor` on one OUT of an LK-G controller.

    Set-up enters communication mode to read sampling period and averaging back into ``settings``, and leaves it again.
    Nothing is written. A value is the mean over the last ``averaging_window_s``; its time is the middle of that.

    Parameters
    ----------
    name : str
        The device's name in the scene.
    link : ByteLink
        Its serial line.
    output : int
        OUT number, 1 or 2.
    poll_rate_Hz : float
        How often the value is asked for.
    timeout_s : float
        How long to wait for each answer.
    unit_mm : float
        Unit of the display; 0.001 when the controller was set to micrometres.
    limit_mm : float
        Largest magnitude that is believed. An LK-G152 sees +-40 mm; with zero or offset set the display may show
        twice that.
    boot_s : float
        How long the first answer may take.
    """

    def __init__(
        self,
        name: str,
        link: ByteLink,
        *,
        output: int = 1,
        poll_rate_Hz: float = 100.0,
        timeout_s: float = 0.1,
        unit_mm: float = 1.0,
        limit_mm: float = 80.0,
        boot_s: float = 0.0,
    ) -> None:
        if output not in (1, 2):
            raise ValueError(f"output must be 1 or 2, not {output!r}")
        self.name = name
        self.identity = Identity(model="Keyence LK-G")
        self.settings: dict[str, str] = {}
        self.counters: dict[str, int] = {
            "implausible": 0,
            "pushed": 0,
            "unexpected_replies": 0,
            "mode_restored": 0,
        }
        self._label = label(name, link)
        self._link = link
        self._output = output
        self._rate = poll_rate_Hz
        self._unit = unit_mm * 1e-3
        self._limit = limit_mm / unit_mm
        self._codec = Codec(self.counters)
        self._boot_s = boot_s
        self._heard = Heard()
        self._states_program = True
        self._dialogue: Dialogue[str, Message] = Dialogue(
            self._label, self._send, self.counters, timeout_s=timeout_s, retries=3, heard=self._heard
        )
        self._inbox: deque[Message] = deque()
        self._samples: list[DisplacementSample] = []
        self._schedule = Schedule(1.0 / poll_rate_Hz, self.counters)
        self._now = self._next_poll = 0.0
        self._ready = self._closed = self._communicating = self._both = False
        self._sampling_s = self._averaging = math.nan
        self._dialogue.begin(self._set_up())

    @property
    def ready(self) -> bool:
        return self._ready

    @property
    def next_poll(self) -> float:
        return self._next_poll

    @property
    def rate(self) -> float:
        """Values asked for per second."""
        return self._rate

    @property
    def averaging_window_s(self) -> float:
        """Time over which the controller averages; NaN when it could not be read."""
        return self._sampling_s * self._averaging

    def poll(self, now: float) -> Sequence[DisplacementSample]:
        self._now = now
        try:
            self._inbox.extend(self._codec.feed(self._heard.bytes(self._link.read())))
            while self._inbox:
                self._take(self._inbox.popleft(), now)
            if self._ready and self._dialogue.idle and self._schedule.take(now):
                self._dialogue.begin(self._measure())
            self._dialogue.run(now)
        except DeviceLost:
            self._next_poll = now + LOST_AGAIN_S
            raise
        except DeviceError:
            self._next_poll = now  # there may be more to read
            raise
        due = self._schedule.due if self._dialogue.idle else math.inf
        self._next_poll = min(self._dialogue.next_poll(now), due)
        samples, self._samples = self._samples, []
        return samples

    def close(self) -> None:
        """Leave the controller in measurement mode and release the line."""
        if self._closed:
            return
        self._closed = True
        if self._communicating:
            with contextlib.suppress(DeviceError):
                self._link.write(encode("R0"))
        self._link.close()

    def _take(self, message: Message, now: float) -> None:
        if isinstance(message, Pushed):
            self.counters["pushed"] += 1
        elif isinstance(message, Measured) and self._implausible(message):
            self.counters["implausible"] += 1
            limit_mm = self._limit * self._unit * 1e3
            self._heard.hint = f"a Keyence value beyond limit_mm = {limit_mm:g}: is its display in micrometres?"
        elif not self._dialogue.offer(message, now):
            self.counters["unexpected_replies"] += 1

    def _implausible(self, message: Measured) -> bool:
        value = message.values.get(self._output)
        return value is not None and abs(value.number) > self._limit

    def _send(self, request: str) -> Callable[[Message], bool]:
        if request == _MEASURE:
            # Two questions in turn, so that the answer to one never fits the next.
            self._both = not self._both
            command = "M0" if self._both else f"M{self._output}"
        else:
            command = request
        self._link.write(encode(command))
        return lambda message: _answers(command, message)

    def _set_up(self) -> Script[str, Message]:
        self._communicating = True
        yield from self._enter("Q0", self._boot_s)
        sampling = yield from self._setting("SR,CA")
        # Whether the kind of filter (0: average) belongs to the question is not known for every firmware.
        averaging = yield from self._setting(f"SR,OC,{self._output}", f"SR,OC,{self._output},0")
        yield from self._enter("R0")
        self._communicating = False
        program = yield from self._setting("PR")
        self._states_program = program != UNANSWERED
        if sampling.isdecimal() and int(sampling) < len(SAMPLING_US):
            self._sampling_s = SAMPLING_US[int(sampling)] * 1e-6
        if averaging.isdecimal() and int(averaging) < len(AVERAGING):
            self._averaging = AVERAGING[int(averaging)]
        self.settings |= {
            "output": str(self._output),
            "sampling_code": sampling,
            "sampling_us": f"{self._sampling_s * 1e6:g}",
            "averaging_code": averaging,
            "averaging_samples": f"{self._averaging:g}",
            "averaging_window_ms": f"{self.averaging_window_s * 1e3:g}",
            "program": program,
        }
        # After communication mode the average begins anew; until it is full there is no value to show.
        give_up = self._now + LONGEST_SETTLING_S
        while self._now < give_up and (yield from self._value(delay_s=SETTLING_LOOK_S))[1].flag & SampleFlag.NO_VALUE:
            pass
        self._schedule.start(self._now)
        self._ready = True

    def _enter(self, mode: str, boot_s: float = 0.0) -> _Part[None]:
        message = (yield Ask(mode, boot_s=boot_s)).message
        # Status error: it is in that mode already, left so by another program or by the answer that was lost.
        if isinstance(message, Refused) and message.code != 1:
            self._refuse(mode, message)

    def _setting(self, *requests: str) -> _Part[str]:
        """Last parameter of the first answer. Refusal and silence are written down: measuring does not need it."""
        refused = ""
        for request in requests:
            try:
                message = (yield Ask(request)).message
            except DeviceSilent:  # a controller of another make or firmware may not know it, and says nothing
                refused = refused or UNANSWERED
                continue
            if isinstance(message, Response):
                return message.text.rpartition(",")[2]
            assert isinstance(message, Refused)
            refused = f"refused: {ERRORS.get(message.code, ('error', ''))[0]} ({message.code:02d})"
        return refused

    def _measure(self) -> Script[str, Message]:
        t, value = yield from self._value()
        window = self.averaging_window_s
        if window < math.inf:  # NaN when it could not be read: then the value stands for the time of asking
            t -= window / 2
        self._samples.append(DisplacementSample(t, value.number * self._unit, value.flag))

    def _value(self, delay_s: float = 0.0) -> _Part[tuple[float, Value]]:
        """One value of our OUT, with its time."""
        answer = yield from self._measured(delay_s)
        if isinstance(answer.message, Refused) and answer.message.code == 1:
            self.counters["mode_restored"] += 1
            yield from self._enter("R0")
            answer = yield from self._measured()
        if isinstance(answer.message, Refused):
            self._refuse("to measure", answer.message)
        assert isinstance(answer.message, Measured)
        return answer.t, answer.message.values[self._output]

    def _measured(self, delay_s: float = 0.0) -> _Part[Answer[Message]]:
        for _ in range(MEASURE_TRIES - 1):
            try:
                return (yield Ask(_MEASURE, repeat=False, delay_s=delay_s))
            except DeviceSilent:
                # The answer may still come. Answers keep their order: after that to PR there is no old value left.
                self.counters["retries"] += 1
                if self._states_program:
                    yield Ask("PR")
                else:
                    delay_s = LATE_S
        return (yield Ask(_MEASURE, repeat=False))

    def _refuse(self, command: str, refused: Refused) -> NoReturn:
        why, advice = ERRORS.get(refused.code, ("of an error that this driver does not know", ""))
        raise DeviceRefused(
            self._label, f"the controller refused {command} because {why} (ER {refused.code:02d})", advice
        )


def _answers(command: str, message: Message) -> bool:
    main = command.partition(",")[0]
    match message:
        case Measured():
            return message.command == command
        case Refused():
            return message.command == main
        case Response():
            return message.text == command or message.text.startswith(f"{command},")
        case Pushed():
            return False


def _ask(line: Line) -> list[Answered]:
    codec = Codec()
    for _ in line.ask(b"\r", codec.feed):  # ends what the question before has left in its buffer
        pass
    for message in line.ask(encode("M1"), codec.feed):
        measuring = isinstance(message, Measured) and message.command == "M1"
        if measuring or message == Refused("M1", 1):
            remark = "" if measuring else "It is in communication mode: another program may be using it."
            return [Answered(Identity("Keyence LK-G"), {"output": 1}, remark)]
    return []


INSTRUMENTS = (
    Instrument(
        driver="keyence-lkg",
        role="displacement",
        settings=KeyenceSettings,
        device=KeyenceLKG,
        dialect=Dialect(b"\r"),
        probe=SerialProbe(_ask, bauds=(115_200, 9_600), order=20),
    ),
)
