"""Noise that depends on the time of a conversion, never on who asks how often."""

from __future__ import annotations

import math

import numpy as np

BLOCK = 65_536  # drawn at once; a long silence must not ask for much memory


class ConversionNoise:
    """Standard normal noise of a converter that works through conversions of equal length.

    Asking twice within one conversion gives the same number. Times must not decrease.
    """

    def __init__(self, rng: np.random.Generator, period: float, start: float = 0.0) -> None:
        self._rng = rng
        self._period = period
        self._start = start
        self._done = 0
        self._value = 0.0

    def restart(self, period: float, t: float) -> None:
        """Go on with another conversion time from ``t`` on."""
        self._period, self._start, self._done = period, t, 0

    def at(self, t: float) -> float:
        """The noise of the conversion that was complete at time ``t``."""
        due = math.floor((t - self._start) / self._period) + 1
        while self._done < due:
            count = min(due - self._done, BLOCK)
            self._value = float(self._rng.standard_normal(count)[-1])
            self._done += count
        return self._value
