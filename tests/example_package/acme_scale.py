r"""ACME bench scale: a force sensor on a serial line, 115200 8N1. An imagined instrument, to show how one is added.

A command is one letter, ended by CR: ``I`` is answered ``I,ACME,<serial>,<firmware>``, ``R`` is answered
``R,+0.01234`` in newtons, or ``R,OVER`` beyond the end of the range. Answers end with CR.

There is neither checksum nor message number: a changed digit is a valid value. Every other damage makes a line that
fits the grammar no longer, and it is dropped and counted.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

from pydantic import Field

from drivers.dialogue import LOST_AGAIN_S, Ask, Dialogue, Schedule, Script, label
from drivers.instrument import Instrument
from drivers.lines import LineSplitter
from drivers.links.link import ByteLink, DeviceError, DeviceLost
from drivers.probe import FORCE_CERTIFICATE, Answered, Line, SerialProbe
from drivers.recorded import Dialect
from drivers.roles import OK, ForceSample, Identity, SampleFlag
from drivers.settings import ForceSettings, SerialSettings

# -- its keys in a scene -----------------------------------------------------------------------------------------------


class ScaleSettings(ForceSettings, SerialSettings):
    """An ACME bench scale; its certificate corrects the newtons that it states."""

    driver: Literal["acme-scale"] = Field(description="ACME bench scale on a serial port.")
    rate_Hz: float = Field(default=50.0, gt=0, le=100, description="How often the force is asked for (Hz).")


# -- codec: bytes to messages ------------------------------------------------------------------------------------------


class Reading(NamedTuple):
    """Answer to ``R``: newtons; NaN beyond the end of the range."""

    newtons: float


Message = Reading | Identity

_READING = re.compile(r"R,([+-][0-9]\.[0-9]{5}|OVER)")
_IDENTITY = re.compile(r"I,(ACME),([0-9]{1,8}),([0-9.]{1,8})")


class Codec:
    """Bytes from the scale to messages. ``counters``: ``bad_grammar``, ``too_long``."""

    def __init__(self, counters: dict[str, int] | None = None) -> None:
        self.counters = {} if counters is None else counters
        self.counters.setdefault("bad_grammar", 0)
        self._lines = LineSplitter(b"\r", 32, self.counters)

    def feed(self, data: bytes) -> list[Message]:
        """The messages that ``data`` completes, in order."""
        messages = [self._message(line.decode("ascii", "replace")) for line in self._lines.feed(data)]
        return [message for message in messages if message is not None]

    def _message(self, line: str) -> Message | None:
        if match := _READING.fullmatch(line):
            return Reading(math.nan if match[1] == "OVER" else float(match[1]))
        if match := _IDENTITY.fullmatch(line):
            return Identity(*match.groups())
        self.counters["bad_grammar"] += 1
        return None


def encode(command: str) -> bytes:
    return command.encode("ascii") + b"\r"


# -- device: what is asked when ----------------------------------------------------------------------------------------


class Scale:
    """A `drivers.roles.ForceSensor`. Set-up asks who it is; then the force is asked for at ``rate_Hz``."""

    reading_unit = "N"

    def __init__(self, name: str, link: ByteLink, *, rate_Hz: float = 50.0, timeout_s: float = 0.25) -> None:
        self.name = name
        self.identity = Identity()
        self.settings: dict[str, str] = {}
        self.counters: dict[str, int] = {"unexpected_replies": 0}
        self._rate = rate_Hz
        self._link = link
        self._codec = Codec(self.counters)
        self._schedule = Schedule(1.0 / rate_Hz, self.counters)
        self._dialogue: Dialogue[str, Message] = Dialogue(
            label(name, link), self._send, self.counters, timeout_s=timeout_s
        )
        self._samples: list[ForceSample] = []
        self._now = self._next_poll = 0.0
        self._ready = False
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

    def poll(self, now: float) -> Sequence[ForceSample]:
        self._now = now
        try:
            for message in self._codec.feed(self._link.read()):
                if not self._dialogue.offer(message, now):
                    self.counters["unexpected_replies"] += 1
            if self._ready and self._dialogue.idle and self._schedule.take(now):
                self._dialogue.begin(self._measure())
            self._dialogue.run(now)
        except DeviceLost:
            self._next_poll = now + LOST_AGAIN_S
            raise
        except DeviceError:
            self._next_poll = now
            raise
        due = self._schedule.due if self._dialogue.idle else math.inf
        self._next_poll = min(self._dialogue.next_poll(now), due)
        samples, self._samples = self._samples, []
        return samples

    def close(self) -> None:
        self._link.close()

    def _send(self, command: str) -> Callable[[Message], bool]:
        self._link.write(encode(command))
        return lambda message: isinstance(message, Identity if command == "I" else Reading)

    def _set_up(self) -> Script[str, Message]:
        answer = (yield Ask("I")).message
        assert isinstance(answer, Identity)
        self.identity = answer
        self.settings["rate_Hz"] = f"{self._rate:g}"
        self._schedule.start(self._now)
        self._ready = True

    def _measure(self) -> Script[str, Message]:
        answer = yield Ask("R")
        assert isinstance(answer.message, Reading)
        newtons = answer.message.newtons
        flags = OK if math.isfinite(newtons) else SampleFlag.OVER_RANGE | SampleFlag.NO_VALUE
        self._samples.append(ForceSample(answer.t, newtons, flags))


# -- discovery, and its entry in the registry --------------------------------------------------------------------------


def _ask(line: Line) -> list[Answered]:
    for message in line.ask(encode("I"), Codec().feed):
        if isinstance(message, Identity):
            return [Answered(message, {"serial": message.serial, "certificate": FORCE_CERTIFICATE})]
    return []


INSTRUMENTS = (
    Instrument(
        driver="acme-scale",
        role="force",
        settings=ScaleSettings,
        device=Scale,
        dialect=Dialect(b"\r"),
        probe=SerialProbe(_ask, order=60),
    ),
)
