"""A sensor that streams by itself at a fixed rate: its samples get their times, its silence is told."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Generic, TypeVar

from drivers.heard import Heard
from drivers.links.link import DeviceRefused, DeviceSilent
from drivers.roles import DisplacementSample, ForceSample
from drivers.sample_clock import SampleClock

S = TypeVar("S", ForceSample, DisplacementSample)

_GOLDEN = 0.6180339887498949


class Stream(Generic[S]):
    """The stream of one sensor, from its start on.

    Parameters
    ----------
    device : str
        Name for error messages.
    rate_Hz : float
        The rate that was set.
    timeout_s : float
        How long nothing valid may come (or five sample periods, if that is longer).
    poll_interval_s : float
        Longest time between two polls.
    counters : dict
        The device's; `SampleClock` counts in them.
    heard : Heard, optional
        What the device has read; told when nothing valid came.
    boot_s : float
        How long the first valid value may take.
    """

    def __init__(
        self,
        device: str,
        rate_Hz: float,
        timeout_s: float,
        poll_interval_s: float,
        counters: dict[str, int],
        heard: Heard | None = None,
        boot_s: float = 0.0,
    ) -> None:
        self._came = heard or Heard()
        self._boot_s = boot_s
        self._device = device
        self._rate = rate_Hz
        self._silence_limit_s = max(timeout_s, 5.0 / rate_Hz)
        self._interval = poll_interval_s
        self._clock: SampleClock[S | None] = SampleClock(rate_Hz, counters)
        self._heard = math.inf  # the first poll sets it
        self._polls = 0

    def next_poll(self, now: float) -> float:
        """When to look again. Polls in step with the stream would hide when samples really arrive."""
        self._polls += 1
        # The golden ratio spreads the polls evenly over the sample period, whatever the two rates are.
        spread = 0.5 + 0.5 * (self._polls * _GOLDEN % 1.0)
        if not self._clock.acquired:
            spread *= 0.2  # finds the phase of the stream sooner
        return now + self._interval * spread

    def take(self, now: float, arrived: Sequence[S | None]) -> list[S]:
        """What had arrived by ``now``, oldest first, None for one that is not valid: those whose times are settled.

        Raises
        ------
        DeviceSilent
            Nothing valid has come for too long. It is told again after as long a time.
        DeviceRefused
            The samples come at quite another rate.
        """
        self._heard = min(self._heard, now)
        stamped = self._clock.feed(now, list(arrived))
        if any(sample is not None for sample in arrived):
            self._heard, self._boot_s = now, 0.0
            self._came.clear()
        elif now - self._heard > max(self._silence_limit_s, self._boot_s):
            silent_s, self._heard, self._boot_s = now - self._heard, now, 0.0
            came = str(self._came)
            self._came.clear()
            self._clock.count_anew()  # what is missing has been told
            raise DeviceSilent(
                self._device,
                f"no valid value for {silent_s:.2f} s though the stream was started{came}",
                "Check the instrument and its cable; it may have been switched off, stopped or reset.",
            )
        if (rate := self._clock.other_rate()) is not None:
            raise DeviceRefused(
                self._device,
                f"streams at {rate:.4g} Hz although {self._rate:.4g} Hz were set",
                "It may have been reset, its timer may be coarser, or the line loses data.",
            )
        return [_at(t, sample) for t, sample in stamped if sample is not None]


def _at(t: float, sample: S) -> S:
    """The sample with its time. Twice as fast as `dataclasses.replace`, a thousand times a second."""
    if isinstance(sample, ForceSample):
        return ForceSample(t, sample.reading, sample.flags)
    return DisplacementSample(t, sample.displacement, sample.flags)
