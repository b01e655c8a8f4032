r"""A meter that answers a query over a TCP socket, in the way of SCPI-99: any bench multimeter on the network.

Every message is a line of ASCII that ends with LF (raw socket, usually port 5025)::

    *IDN?             ACME,DMM6500,04387,1.7.3
    MEAS:VOLT:DC?     +1.00273100E+00

One query is outstanding at a time. Answers bear no number, so that one which comes after its time-out looks like that
of the next query: after a time-out ``*IDN?`` is asked, and what comes before the identity is thrown away and counted.
A meter that has no ``*IDN?`` (``asks_identity = false``) is given its time-out once more, in silence, instead.

A value is the first field of a line, a decimal number (NR1, NR2 or NR3). 9.9E37 of either sign is beyond the range and
9.91E37 no number, by SCPI-99 volume 1, 7.2.1. What corruption cannot be seen: a digit that became another one.

Only what a scene names as ``query`` is sent, and ``*IDN?``; the meter's function and range are as they were set at its
front, unless the query itself sets them, as ``MEAS`` does. Checked against pyvisa-py as a client of the twin.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Generator, Sequence
from typing import ClassVar, Literal, NamedTuple

from pydantic import Field

from drivers.dialogue import LOST_AGAIN_S, Answer, Ask, Dialogue, Schedule, label
from drivers.heard import Heard
from drivers.instrument import Instrument
from drivers.lines import LineSplitter
from drivers.links.link import ByteLink, DeviceError, DeviceLost, DeviceRefused, DeviceSilent
from drivers.recorded import Dialect
from drivers.roles import OK, Identity, MonitorSample, SampleFlag
from drivers.settings import MonitorSettings, Quantity, TcpSettings

IDENTIFY = "*IDN?"
LONGEST = 512
"""Bytes of the longest line that is read."""
INFINITE, NO_NUMBER = 9.9e37, 9.91e37
SILENCES = 2
"""So many queries in a row that are not answered are an error."""


class ScpiSettings(MonitorSettings, TcpSettings):
    """A meter on the network that answers SCPI queries on a raw TCP socket."""

    asks_per_sample: ClassVar[int] = 1

    driver: Literal["scpi"] = Field(description="Meter on the network that answers SCPI queries on a raw socket.")
    tcp_port: int = Field(default=5025, ge=1, le=65_535, description="TCP port of its raw socket. Usual: 5025.")
    query: str = Field(
        default="MEAS:VOLT:DC?",
        pattern=r"^[!-~][ -~]{0,98}\?[ -~]{0,98}$",
        description='The query whose answer is the value, e.g. "READ?" or "MEAS:VOLT:DC? 10".',
    )
    asks_identity: bool = Field(default=True, description="Whether it has *IDN?. Default: true.")
    identity: str = Field(
        default="", max_length=200, description='What must stand in its answer to *IDN?, e.g. "DMM6500". Default: any.'
    )
    timeout_s: float = Field(
        default=1.0,
        gt=0,
        le=10,
        description="How long to wait for each answer (s); more than it integrates. Typical: 1.",
    )
    rate_Hz: float = Field(
        default=2.0,
        ge=0.05,
        le=100,
        description="How often it is asked (Hz); of a voltage at least 1. Typical: 2 to 5.",
    )


# -- codec -------------------------------------------------------------------------------------------------------------

_NUMBER = re.compile(r"[+-]?(?:[0-9]{1,20}(?:\.[0-9]{0,20})?|\.[0-9]{1,20})(?:[eE][+-]?[0-9]{1,2})?")
_PRINTABLE = re.compile(rb"[\t -~]*")


class Line(NamedTuple):
    """One line as it came."""

    text: str


class Codec:
    """Bytes to lines. ``counters``: ``bad_grammar`` (no text), ``too_long``."""

    def __init__(self, counters: dict[str, int] | None = None) -> None:
        self.counters = {} if counters is None else counters
        self.counters.setdefault("bad_grammar", 0)
        self._lines = LineSplitter(b"\n", LONGEST, self.counters)

    def feed(self, data: bytes) -> list[Line]:
        """The lines that ``data`` completes, in order; empty ones are nothing."""
        lines = []
        for line in self._lines.feed(data):
            text = line.strip()
            if not _PRINTABLE.fullmatch(text):
                self.counters["bad_grammar"] += 1
            elif text:
                lines.append(Line(text.decode("ascii")))
        return lines


def value_in(line: Line) -> tuple[float, SampleFlag] | None:
    """The number that a line begins with, NaN with flags for those that mean none; None where it has no number."""
    text = line.text.split(",", 1)[0].strip()
    if not _NUMBER.fullmatch(text):
        return None
    number = float(text)
    if abs(number) >= NO_NUMBER:
        return math.nan, SampleFlag.NO_VALUE
    if abs(number) >= INFINITE:
        return math.nan, SampleFlag.NO_VALUE | (SampleFlag.OVER_RANGE if number > 0 else SampleFlag.UNDER_RANGE)
    return number, OK


# -- device ------------------------------------------------------------------------------------------------------------

Script = Generator[Ask[str], Answer[Line], None]


class ScpiMeter:
    """A `drivers.roles.Monitor`: ``to_si`` is (V, K or 1 per number, at 0)."""

    def __init__(
        self,
        name: str,
        link: ByteLink,
        *,
        query: str = "MEAS:VOLT:DC?",
        quantity: Quantity = "voltage",
        to_si: tuple[float, float] = (1.0, 0.0),
        rate_Hz: float = 2.0,
        asks_identity: bool = True,
        identity: str = "",
        timeout_s: float = 1.0,
        boot_s: float = 0.0,
    ) -> None:
        self.name = name
        self.quantity = quantity
        self.identity = Identity()
        self.settings = {"query": query, "si_per_number": f"{to_si[0]:.9g}", "si_at_zero": f"{to_si[1]:.9g}"}
        self.counters: dict[str, int] = {"unexpected_replies": 0, "no_value": 0, "synchronised": 0}
        self._codec = Codec(self.counters)
        self._label = label(name, link)
        self._link = link
        self._heard = Heard()
        self._query, self._rate = query, rate_Hz
        self._scale, self._zero = to_si
        self._asks_identity, self._wanted = asks_identity, identity
        self._timeout_s, self._boot_s = timeout_s, boot_s
        self._said = ""  # its identity, word for word
        self._silences = 0
        self._samples: deque[MonitorSample] = deque()
        self._now, self._next_poll = 0.0, -math.inf
        self._ready = False
        self._schedule = Schedule(1.0 / rate_Hz, self.counters)
        self._dialogue: Dialogue[str, Line] = Dialogue(
            self._label,
            self._send,
            self.counters,
            timeout_s=timeout_s,
            advice="Check its network cable and address, that its raw socket is switched on, and query in the scene.",
            heard=self._heard,
        )
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

    def close(self) -> None:
        self._link.close()

    def poll(self, now: float) -> Sequence[MonitorSample]:
        self._now = now
        dialogue = self._dialogue
        try:
            for line in self._codec.feed(self._heard.bytes(self._link.read())):
                if not dialogue.offer(line, now):
                    self.counters["unexpected_replies"] += 1
            if self._ready and dialogue.idle and self._schedule.take(now):
                dialogue.begin(self._measure())
            dialogue.run(now)
        except DeviceLost:
            self._next_poll = now + LOST_AGAIN_S
            raise
        except DeviceError:
            self._next_poll = now
            raise
        self._next_poll = min(dialogue.next_poll(now), self._schedule.due if dialogue.idle else math.inf)
        samples = list(self._samples)
        self._samples.clear()
        return samples

    def _send(self, query: str) -> Callable[[Line], bool]:
        self._link.write(query.encode("ascii") + b"\n")
        if query != IDENTIFY:
            return lambda line: True
        if self._said:
            return lambda line: line.text == self._said
        return lambda line: value_in(line) is None  # of a query of somebody else before us

    def _set_up(self) -> Script:
        if self._asks_identity:
            answer = yield Ask(IDENTIFY, boot_s=self._boot_s)
            self._said = answer.message.text
            maker, model, serial, firmware = (*(part.strip() for part in self._said.split(",", 3)), "", "", "")[:4]
            self.identity = Identity(f"{maker} {model}".strip(), serial, firmware)
            if self._wanted not in self._said:
                raise DeviceRefused(
                    self._label,
                    f"says that it is {self._said!r}, and identity = {self._wanted!r} is wanted",
                    "Check its address; or correct identity in the scene.",
                )
        self._schedule.start(self._now)
        while not self._ready:
            yield from self._measure(self._boot_s)

    def _measure(self, boot_s: float = 0.0) -> Script:
        try:
            answer = yield Ask(self._query, repeat=False, boot_s=0.0 if self._asks_identity else boot_s)
        except DeviceSilent:
            self._silences += 1
            if self._silences >= SILENCES:
                raise
            yield from self._synchronise()
            return
        self._silences = 0
        found = value_in(answer.message)
        if found is None:
            raise DeviceRefused(
                self._label,
                f"answers {self._query!r} with {answer.message.text!r}, which is no number",
                "Check query in the scene: its answer must begin with the value.",
            )
        number, flags = found
        self.counters["no_value"] += flags != OK
        value = number * self._scale + self._zero
        self._samples.append(MonitorSample(answer.t, self.name, self.quantity, value, flags))
        self._ready = True

    def _synchronise(self) -> Script:
        """An answer may still be on its way: nothing is believed before it is known that no more will come."""
        self.counters["synchronised"] += 1
        if self._asks_identity:
            yield Ask(IDENTIFY)
        else:
            yield Ask(self._query, repeat=False, delay_s=self._timeout_s)  # thrown away: it may be the late one's


INSTRUMENTS = (Instrument("scpi", "monitor", ScpiSettings, ScpiMeter, Dialect(b"\n")),)
