r"""Micro-Epsilon optoNCDT 1420 laser displacement sensor, RS-422 through an adapter, 921600 baud by default.

From the maker's manual; no independent program that speaks it was found, so nothing here is checked by one.

The sensor streams its distance by itself: one 18-bit word a sample in three bytes, lowest first. The top two bits of a
byte say which it is, the lower six are data::

    00 D5..D0     01 D11..D6     10 D17..D12          40000 is 00 71 89

A triple whose highest byte is marked 11 is a further value of the same sample (recalled, not read in the manual); it is
counted and left out. With measuring range MR the word ``x`` is the distance ``d = (x * 102 / 65520 - 1) / 100 * MR``.
Words 643 to 64877 are in range, 0 to 642 and 64878 to 65520 its reserve: flagged. Words from ``first_error_word`` on
are no values (too near, too far, nothing seen); their meanings are recalled only and not told apart. Any other word
is dropped and counted.

Nothing is sent: rate (``MEASRATE``) and output (``OUTPUT RS422``) are what was set in the sensor. Text between the
triples would have bytes of the same shapes and is not looked for. What corruption cannot be seen: a changed data bit.
A lost byte breaks its triple, which is dropped and counted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Literal

from pydantic import Field

from drivers.dialogue import LOST_AGAIN_S, label
from drivers.heard import Heard
from drivers.instrument import Instrument
from drivers.links.link import ByteLink
from drivers.recorded import Dialect
from drivers.roles import OK, DisplacementSample, Identity, SampleFlag
from drivers.settings import Positive, SerialSettings
from drivers.stream import Stream

FULL_WORD = 65_520
FIRST_IN_RANGE, LAST_IN_RANGE = 643, 64_877
LARGEST_WORD = 2**18 - 1


class OptoNCDTSettings(SerialSettings):
    """A Micro-Epsilon optoNCDT 1420 on RS-422."""

    rate_key: ClassVar[str] = "rate_Hz"
    asks_per_sample: ClassVar[int] = 0

    driver: Literal["optoncdt-1420"] = Field(description="Micro-Epsilon optoNCDT 1420 laser on RS-422.")
    baud: int = Field(default=921_600, gt=0, description="Line rate (bit/s), as set in the sensor.")
    measuring_range_mm: Positive = Field(
        default=50.0, description="Measuring range (mm), as on its type plate: ILD1420-50 has 50."
    )
    inverted: bool = Field(
        default=False, description="true if the disk comes nearer to the sensor as it moves on. Default: false."
    )
    rate_Hz: float = Field(
        default=250.0, gt=0, le=4000, description="Measuring rate (Hz), as set in the sensor by MEASRATE. Typical: 250."
    )
    first_error_word: int = Field(
        default=262_073,
        ge=FULL_WORD + 1,
        le=LARGEST_WORD,
        description="From this word on it states errors, no distance.",
    )


class Codec:
    """Bytes to words. ``counters``: ``dropped_bytes`` (of no whole triple), ``further_values``."""

    def __init__(self, counters: dict[str, int] | None = None) -> None:
        self.counters = {} if counters is None else counters
        for key in ("dropped_bytes", "further_values"):
            self.counters.setdefault(key, 0)
        self._begun: list[int] = []  # low and middle byte of a triple that is not whole, or the low one

    @property
    def held(self) -> int:
        """How many bytes of an unfinished triple are kept."""
        return len(self._begun)

    def feed(self, data: bytes) -> list[int]:
        """The words that ``data`` completes, in order."""
        words = []
        for byte in data:
            mark, begun = byte >> 6, self._begun
            if mark == 0:
                self.counters["dropped_bytes"] += len(begun)
                self._begun = [byte]
            elif mark == 1 and len(begun) == 1:
                begun.append(byte & 63)
            elif mark >= 2 and len(begun) == 2:
                if mark == 2:
                    words.append(begun[0] | begun[1] << 6 | (byte & 63) << 12)
                else:
                    self.counters["further_values"] += 1
                self._begun = []
            else:
                self.counters["dropped_bytes"] += len(begun) + 1
                self._begun = []
        return words


class OptoNCDT:
    """A `drivers.roles.DisplacementSensor` that is listened to; ready with its first word."""

    def __init__(
        self,
        name: str,
        link: ByteLink,
        *,
        measuring_range_mm: float = 50.0,
        inverted: bool = False,
        rate_Hz: float = 250.0,
        first_error_word: int = 262_073,
        timeout_s: float = 0.25,
        poll_interval_s: float = 0.01,
        boot_s: float = 0.0,
    ) -> None:
        self.name = name
        self.identity = Identity(model="optoNCDT 1420")
        self.counters: dict[str, int] = {"bad_values": 0, "error_words": 0}
        self.settings = {"measuring_range_mm": f"{measuring_range_mm:g}", "rate_Hz": f"{rate_Hz:g}"}
        self._link = link
        self._codec = Codec(self.counters)
        self._range = measuring_range_mm * 1e-3
        self._sign = -1.0 if inverted else 1.0
        self._rate = rate_Hz
        self._first_error = first_error_word
        self._heard = Heard()
        self._stream: Stream[DisplacementSample] = Stream(
            label(name, link), rate_Hz, timeout_s, poll_interval_s, self.counters, self._heard, boot_s
        )
        self._fresh, self._ready = True, False
        self._next_poll = -math.inf

    @property
    def ready(self) -> bool:
        return self._ready

    @property
    def next_poll(self) -> float:
        return self._next_poll

    @property
    def rate(self) -> float:
        """Samples per second, as the scene says."""
        return self._rate

    def close(self) -> None:
        self._link.close()

    def poll(self, now: float) -> Sequence[DisplacementSample]:
        self._next_poll = now + LOST_AGAIN_S  # unless the port is there
        data = self._heard.bytes(self._link.read())
        if self._fresh and data:  # begins anywhere in a triple; of what had piled up nobody knows the time
            self._fresh, data = False, b""
        self._next_poll = self._stream.next_poll(now)
        arrived = [self._sample(word) for word in self._codec.feed(data)]
        self._ready = self._ready or any(arrived)
        return self._stream.take(now, arrived)

    def _sample(self, word: int) -> DisplacementSample | None:
        if word >= self._first_error:
            self.counters["error_words"] += 1
            return DisplacementSample(math.nan, math.nan, SampleFlag.NO_VALUE)
        if word > FULL_WORD:
            self.counters["bad_values"] += 1
            return None
        flags = OK
        if not FIRST_IN_RANGE <= word <= LAST_IN_RANGE:
            flags = SampleFlag.UNDER_RANGE if word < FIRST_IN_RANGE else SampleFlag.OVER_RANGE
        distance = (word * 102 / FULL_WORD - 1) / 100 * self._range
        return DisplacementSample(math.nan, self._sign * distance, flags)


INSTRUMENTS = (Instrument("optoncdt-1420", "displacement", OptoNCDTSettings, OptoNCDT, Dialect(b"\r")),)
