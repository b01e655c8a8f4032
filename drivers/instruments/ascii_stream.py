r"""A sensor that sends lines of text by itself: an Arduino with an HX711, many USB load cells, dial gauges and meters.

There is no protocol beyond this: every line ends with LF, or CR LF, and has ``columns`` columns; one of them is the
value as a decimal number, ``-0.01234\r\n`` say. Nothing is ever sent to it. All that a scene says of it has to be
read in its sketch or its manual: no line tells what its numbers mean.

The line that is under way when the port is opened may have lost its beginning, and with it a sign or a digit: it is
thrown away. Words for a value that is none (``nan``, ``inf``, ``-inf``, ``ovf``, as an Arduino prints them) give a
sample without value. What corruption cannot be seen: a digit or sign that became another one, a digit lost or added.
More columns than one make a line that was cut visible; ``limit`` refuses what is far from anything real.

Times: no line carries one, and the clock of such a board may be off by per cents. A sample has the time at which its
line was found complete; it is late by the line's duration and by at most ``POLL_S``. Lost lines leave a gap.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar, Generic, Literal, NamedTuple, Self, TypeVar

from pydantic import Field, model_validator

from drivers.dialogue import LOST_AGAIN_S, label
from drivers.heard import Heard
from drivers.instrument import Instrument
from drivers.lines import LineSplitter
from drivers.links.link import ByteLink, DeviceRefused, DeviceSilent
from drivers.recorded import Dialect
from drivers.roles import OK, DisplacementSample, ForceSample, Identity, MonitorSample, SampleFlag
from drivers.settings import MONITOR_UNITS, ForceSettings, MonitorSettings, Positive, Quantity, SerialSettings

POLL_S = 4e-3
"""Longest time between two polls."""

LONGEST = 256
"""Bytes of the longest line that is read."""

RATE_WINDOW_S = 5.0
"""Over how long its rate is counted."""

G_N = 9.80665e-3
"""Weight of a gram (N), by the standard acceleration of gravity."""

Separator = Literal[",", ";", "tab", "space"]
ForceUnit = Literal["N", "mN", "gf", "kgf", "mV/V"]
LengthUnit = Literal["m", "mm", "um"]
NEWTONS = {"N": 1.0, "mN": 1e-3, "gf": G_N, "kgf": 1e3 * G_N, "mV/V": 1.0}
METRES = {"m": 1.0, "mm": 1e-3, "um": 1e-6}

# -- its keys in a scene -----------------------------------------------------------------------------------------------


class AsciiSettings(SerialSettings):
    """A sensor that sends lines with numbers by itself."""

    rate_key: ClassVar[str] = "rate_Hz"
    asks_per_sample: ClassVar[int] = 0

    driver: Literal["ascii-stream"] = Field(description="Sensor that sends lines of text on a serial port by itself.")
    rate_Hz: float = Field(
        default=80.0, gt=0, le=1000, description="How many lines it sends per second (Hz). Typical: 10 or 80 (HX711)."
    )
    separator: Separator = Field(
        default=",", description='What stands between columns; "space" is any number of blanks and tabs.'
    )
    columns: int = Field(
        default=1, ge=1, le=32, description="How many columns each line has; a line with more or fewer is not believed."
    )
    column: int = Field(default=1, ge=1, le=32, description="Which column has the value, counted from 1.")
    factor: float = Field(
        default=1.0,
        description="What the number is multiplied by to give the unit; negative if inverted. Not 0.",
    )
    limit: Positive = Field(
        default=1e4, description="Largest value that is believed, in the unit; some times the sensor's range."
    )
    boot_s: float = Field(
        default=3.0,
        ge=0,
        le=30,
        description="How long it may be silent once its port is opened (s); an Arduino restarts then. Typical: 2.",
    )

    @model_validator(mode="after")
    def _makes_sense(self) -> Self:
        if self.column > self.columns:
            raise ValueError(f"column = {self.column}, but a line has columns = {self.columns} only")
        if self.factor == 0.0:
            raise ValueError("factor must not be 0")
        return self


class AsciiForceSettings(AsciiSettings, ForceSettings):
    """A force sensor that sends lines with numbers by itself; its certificate corrects what they say."""

    unit: ForceUnit = Field(
        default="N",
        description="What the number is in, once multiplied by factor; gf, kgf: weight of a gram, a kilogram.",
    )


class AsciiDisplacementSettings(AsciiSettings):
    """A displacement sensor that sends lines with numbers by itself."""

    unit: LengthUnit = Field(default="mm", description="What the number is in, once multiplied by factor.")


class AsciiMonitorSettings(AsciiSettings, MonitorSettings):
    """A meter, thermometer or hygrometer that sends lines with numbers by itself."""

    rate_Hz: float = Field(
        default=5.0,
        ge=0.05,
        le=100,
        description="How many lines it sends per second (Hz); of a voltage at least 1. Typical: 1 to 10.",
    )


# -- codec: bytes to values --------------------------------------------------------------------------------------------

_NUMBER = re.compile(r"[+-]?(?:[0-9]{1,15}(?:\.[0-9]{0,15})?|\.[0-9]{1,15})(?:[eE][+-]?[0-9]{1,2})?")
_WORDS = {
    "nan": SampleFlag.NO_VALUE,
    "inf": SampleFlag.NO_VALUE | SampleFlag.OVER_RANGE,
    "+inf": SampleFlag.NO_VALUE | SampleFlag.OVER_RANGE,
    "ovf": SampleFlag.NO_VALUE | SampleFlag.OVER_RANGE,
    "-inf": SampleFlag.NO_VALUE | SampleFlag.UNDER_RANGE,
}
_PRINTABLE = re.compile(rb"[\t -~]*")


class Value(NamedTuple):
    """The number of one line as it stands there; NaN with a flag for a word that says that there is none."""

    number: float
    flags: SampleFlag = OK


class Codec:
    """Bytes to values, one a line.

    ``counters``: ``bad_grammar`` (not text, or no number in the column), ``wrong_columns``, ``too_long``. Empty lines
    are nothing. What comes before the first line end is thrown away.
    """

    def __init__(
        self, separator: Separator = ",", columns: int = 1, column: int = 1, counters: dict[str, int] | None = None
    ) -> None:
        self.counters = {} if counters is None else counters
        for key in ("bad_grammar", "wrong_columns"):
            self.counters.setdefault(key, 0)
        self._separator = {"tab": "\t", "space": None}.get(separator, separator)
        self._columns, self._column = columns, column
        self._lines = LineSplitter(b"\n", LONGEST, self.counters)
        self._synchronised = False

    def feed(self, data: bytes) -> list[Value]:
        """The values of the lines that ``data`` completes, in order."""
        if not self._synchronised:
            _, end, data = data.partition(b"\n")
            self._synchronised = bool(end)
        values = [self._value(line.removesuffix(b"\r")) for line in self._lines.feed(data)]
        return [value for value in values if value is not None]

    def _value(self, line: bytes) -> Value | None:
        if not line:
            return None
        if not _PRINTABLE.fullmatch(line):
            self.counters["bad_grammar"] += 1
            return None
        fields = line.decode("ascii").split(self._separator)
        if len(fields) != self._columns:
            self.counters["wrong_columns"] += 1
            return None
        text = fields[self._column - 1].strip()
        if flags := _WORDS.get(text.lower()):
            return Value(math.nan, flags)
        if not _NUMBER.fullmatch(text):
            self.counters["bad_grammar"] += 1
            return None
        return Value(float(text))


# -- device ------------------------------------------------------------------------------------------------------------

S = TypeVar("S", ForceSample, DisplacementSample, MonitorSample)


class AsciiStream(ABC, Generic[S]):
    """A sensor whose lines are read; nothing is sent.

    It is ``ready`` with the first line that is understood. ``units`` are the SI values of 1 in each unit, the usual
    one first.

    Raises, in `poll`, `DeviceSilent` when nothing that can be believed has come for ``timeout_s`` (or five periods, or
    ``boot_s`` at the start), telling what was dropped, and `DeviceRefused` when lines come at quite another rate.
    """

    units: ClassVar[Mapping[str, float]]

    def __init__(
        self,
        name: str,
        link: ByteLink,
        *,
        unit: str = "",
        factor: float = 1.0,
        limit: float = 1e4,
        separator: Separator = ",",
        columns: int = 1,
        column: int = 1,
        rate_Hz: float = 80.0,
        boot_s: float = 3.0,
        timeout_s: float = 0.25,
    ) -> None:
        self.name = name
        self.identity = Identity()
        self.counters: dict[str, int] = {}
        self._codec = Codec(separator, columns, column, self.counters)
        self.counters |= {"bad_values": 0, "no_value": 0}
        self._label = label(name, link)
        self._link = link
        self._heard_bytes = Heard()
        self._rate = rate_Hz
        self._unit = unit or next(iter(self.units))
        self._scale, self._limit = factor * self.units[self._unit], limit * self.units[self._unit]
        self._longest_silence = max(timeout_s, 5.0 / rate_Hz)
        self._boot_s = boot_s + self._longest_silence
        self.settings: dict[str, str] = self._scale_in_words()
        self._heard: float | None = None
        self._ready = False
        self._last = -math.inf  # time of the last sample
        self._counted_since, self._counted = math.inf, 0
        self._next_poll = -math.inf

    @property
    def ready(self) -> bool:
        return self._ready

    @property
    def next_poll(self) -> float:
        return self._next_poll

    @property
    def rate(self) -> float:
        """Lines per second, as the scene says."""
        return self._rate

    def close(self) -> None:
        self._link.close()

    def poll(self, now: float) -> Sequence[S]:
        self._next_poll = now + LOST_AGAIN_S  # unless the port is there
        data = self._heard_bytes.bytes(self._link.read())
        self._next_poll = now + POLL_S
        if self._heard is None:
            self._heard = now
        values = self._codec.feed(data)
        samples = self._timed(values, now)
        if samples:
            self._heard, self._ready = now, True
            self._heard_bytes.clear()
        elif now - self._heard > (self._longest_silence if self._ready else self._boot_s):
            self._silent(now, now - self._heard)
        self._check_rate(now, len(values))
        return samples

    def _timed(self, values: Sequence[Value], now: float) -> list[S]:
        """What is believed of the lines found now: the last one is as old as this poll, those before a period older."""
        samples: list[S] = []
        for behind, (number, flags) in zip(reversed(range(len(values))), values, strict=True):
            if flags == OK and not abs(number * self._scale) <= self._limit:
                self.counters["bad_values"] += 1
                continue
            self.counters["no_value"] += flags != OK
            self._last = max(now - behind / self._rate, self._last + 1e-6)
            samples.append(self._sample(self._last, number * self._scale, flags))
        return samples

    def _silent(self, now: float, silent_s: float) -> None:
        self._heard = now
        self._counted_since = math.inf
        dropped = {key: n for key, n in self.counters.items() if n}
        came = str(self._heard_bytes)
        self._heard_bytes.clear()
        told = ", ".join(f"{key} {n}" for key, n in dropped.items()) or "nothing came"
        raise DeviceSilent(
            self._label,
            f"no valid value for {silent_s:.2f} s ({told}){came}",
            "Check its cable and the baud rate, and separator, columns, column and limit in the scene.",
        )

    def _check_rate(self, now: float, lines: int) -> None:
        if not lines:  # a poll that found nothing leaves no trace in a log, and must change nothing
            return
        if self._counted_since == math.inf:
            self._counted_since, self._counted = now, 0
            return
        self._counted += lines
        elapsed = now - self._counted_since
        if elapsed < max(RATE_WINDOW_S, 20.0 / self._rate):
            return
        found = self._counted / elapsed
        self._counted_since, self._counted = now, 0
        if not 0.5 * self._rate <= found <= 1.5 * self._rate:
            raise DeviceRefused(
                self._label,
                f"sends {found:.4g} lines/s although rate_Hz = {self._rate:.4g}",
                "Correct rate_Hz in the scene, or the rate in the instrument; or the line loses data.",
            )

    @abstractmethod
    def _scale_in_words(self) -> dict[str, str]:
        """The scale, for the settings."""

    @abstractmethod
    def _sample(self, t: float, value: float, flags: SampleFlag) -> S:
        """A sample of the quantity in SI units."""


class AsciiForce(AsciiStream[ForceSample]):
    """A `drivers.roles.ForceSensor`, in newtons, or in mV/V where ``unit`` says so."""

    units: ClassVar[Mapping[str, float]] = NEWTONS

    @property
    def reading_unit(self) -> str:
        return "mV/V" if self._unit == "mV/V" else "N"

    def _scale_in_words(self) -> dict[str, str]:
        return {"reading_per_number": f"{self._scale:.9g} {self.reading_unit}"}

    def _sample(self, t: float, value: float, flags: SampleFlag) -> ForceSample:
        return ForceSample(t, value, flags)


class AsciiDisplacement(AsciiStream[DisplacementSample]):
    """A `drivers.roles.DisplacementSensor`."""

    units: ClassVar[Mapping[str, float]] = METRES

    def _scale_in_words(self) -> dict[str, str]:
        return {"m_per_number": f"{self._scale:.9g}"}

    def _sample(self, t: float, value: float, flags: SampleFlag) -> DisplacementSample:
        return DisplacementSample(t, value, flags)


class AsciiMonitor(AsciiStream[MonitorSample]):
    """A `drivers.roles.Monitor`."""

    units: ClassVar[Mapping[str, float]] = {unit: size for unit, (_, size, _) in MONITOR_UNITS.items()}

    def __init__(
        self,
        name: str,
        link: ByteLink,
        *,
        quantity: Quantity = "voltage",
        to_si: tuple[float, float] = (1.0, 0.0),
        unit: str = "",
        factor: float = 1.0,
        limit: float = 1e4,
        separator: Separator = ",",
        columns: int = 1,
        column: int = 1,
        rate_Hz: float = 5.0,
        boot_s: float = 3.0,
        timeout_s: float = 0.25,
    ) -> None:
        self.quantity = quantity
        self._zero = to_si[1]
        super().__init__(
            name,
            link,
            unit=unit or next(unit for unit, (of, _, _) in MONITOR_UNITS.items() if of == quantity),
            factor=factor,
            limit=limit,
            separator=separator,
            columns=columns,
            column=column,
            rate_Hz=rate_Hz,
            boot_s=boot_s,
            timeout_s=timeout_s,
        )

    def _scale_in_words(self) -> dict[str, str]:
        return {"si_per_number": f"{self._scale:.9g}", "si_at_zero": f"{self._zero:.9g}"}

    def _sample(self, t: float, value: float, flags: SampleFlag) -> MonitorSample:
        return MonitorSample(t, self.name, self.quantity, value + self._zero, flags)


INSTRUMENTS = (
    Instrument("ascii-stream", "force", AsciiForceSettings, AsciiForce, Dialect(b"\n")),
    Instrument("ascii-stream", "monitor", AsciiMonitorSettings, AsciiMonitor, Dialect(b"\n")),
    Instrument("ascii-stream", "displacement", AsciiDisplacementSettings, AsciiDisplacement, Dialect(b"\n")),
)
