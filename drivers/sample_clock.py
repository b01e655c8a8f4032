"""Times for the samples of a stream that carries none: from the known rate, held to the clock of the host.

An instrument that streams at a fixed rate without counter or time stamp gives the host only blocks: ``n`` samples that
had arrived by ``now``. The arrival is the sampling instant plus a delay that is never negative, mostly small and
sometimes large (buffers, schedulers, the poll itself). So the *lower envelope* of the delays, not their mean, carries
the sampling instants. With period ``p`` the last of ``n`` new samples is expected at ``t + n p``, and is late by
``e = now - (t + n p)``:

- ``e < 0`` proves that the expectation is too late; it is corrected at once, so that no sample is stamped after its
  arrival;
- the least ``e`` of a window of about a second corrects phase and period slowly: a causal second-order loop;
- ``e`` near or above one period for longer than ``confirm_s`` means that samples are missing: they are counted and
  left as a gap. Until that is certain the samples are held back, so that neither is a late block mistaken for a gap
  nor a gap for a late block.

Times increase strictly. Between neighbours they differ from the period by less than a period, except at an event
counted in ``lost_samples`` or ``time_resyncs``.
"""

from __future__ import annotations

import math
from typing import Generic, TypeVar

T = TypeVar("T")

_PHASE_GAIN = 0.5
_PERIOD_GAIN = 0.1
_WINDOW_S = 1.0
_WINDOW_BLOCKS = 8


class SampleClock(Generic[T]):
    """Stamps the samples of one uninterrupted stream.

    Parameters
    ----------
    rate_Hz : float
        The instrument's nominal rate.
    counters : dict
        Gets ``lost_samples``, ``gaps`` and ``time_resyncs``.
    jitter_s : float
        Delays up to this are never taken for missing samples; with it, a single lost sample is noticed below
        about ``1 / jitter_s`` hertz only, above that losses of several at once.
    confirm_s : float
        How long a suspected gap is watched before it is believed.
    max_drift : float
        Largest relative deviation of the instrument's rate from its nominal one.
    """

    def __init__(
        self,
        rate_Hz: float,
        counters: dict[str, int],
        *,
        jitter_s: float = 2e-3,
        confirm_s: float = 0.05,
        max_drift: float = 1e-3,
    ) -> None:
        self._nominal = 1.0 / rate_Hz
        self._period = self._nominal
        self._late_limit = 0.75 * self._nominal + jitter_s
        self._jitter = jitter_s
        self._confirm = confirm_s
        self._max_drift = max_drift
        self._counters = counters
        for key in ("lost_samples", "gaps", "time_resyncs"):
            counters.setdefault(key, 0)
        self._last: float | None = None
        self._held: list[T] = []
        self._held_since: float | None = None
        self._held_late = 0.0
        self._acquired = False
        self._open_window(0.0)
        self.rate_ratio = 1.0
        """Samples of the last complete window over those that the nominal rate would have given."""
        self.windows = 0
        """Number of complete windows."""
        self._windows_off_rate = 0

    @property
    def drift(self) -> float:
        """Relative deviation of the instrument's period from its nominal one, against the host's clock."""
        return self._period / self._nominal - 1.0

    @property
    def off_rate(self) -> bool:
        """True after two windows in a row at quite another rate; one alone may hold what a stall had dammed up."""
        return self._windows_off_rate >= 2

    def feed(self, now: float, samples: list[T]) -> list[tuple[float, T]]:
        """Take the samples that have arrived by ``now``, oldest first; return those whose times are settled."""
        if not samples:
            return []
        if self._last is None:
            self._last = now - len(samples) * self._period
            self._open_window(now)
        self._held += samples
        return self._settle(now, self._last)

    def _settle(self, now: float, last: float) -> list[tuple[float, T]]:
        n = len(self._held)
        late = now - (last + n * self._period)
        if late > self._late_limit:
            if self._held_since is None:
                self._held_since, self._held_late = now, late
            self._held_late = min(self._held_late, late)
            # One late block may simply be late; it takes a later one as well to tell.
            if now == self._held_since or now - self._held_since < self._confirm:
                return []
            lost = max(1, math.floor(self._held_late / self._period + 0.25))
            self._counters["lost_samples"] += lost
            self._counters["gaps"] += 1
            last += lost * self._period
            late -= lost * self._period
            self._acquired = False
            self._open_window(now)
        if late < -(self._period + self._jitter):
            self._counters["time_resyncs"] += 1
        # A sample is stamped at its arrival at the latest; nanoseconds keep the order if nothing else can.
        end = max(last + n * self._period + min(late, 0.0), last + n * 1e-9)
        step = (end - last) / n
        stamped = [(last + (i + 1) * step, sample) for i, sample in enumerate(self._held)]
        self._last = end
        self._held, self._held_since = [], None
        self._track(now, n, late)
        return stamped

    def _open_window(self, now: float) -> None:
        self._window_start = now
        self._window_samples = 0
        self._window_blocks = 0
        self._window_least = math.inf
        self._window_early = 0.0

    def _track(self, now: float, n: int, late: float) -> None:
        self._window_samples += n
        self._window_blocks += 1
        self._window_early += min(late, 0.0)
        self._window_least = min(self._window_least, max(late, 0.0))
        elapsed = now - self._window_start
        if elapsed < _WINDOW_S or self._window_blocks < _WINDOW_BLOCKS:
            return
        assert self._last is not None
        if self._acquired:  # the first window only finds the phase
            error = self._window_early + self._window_least
            period = self._period + _PERIOD_GAIN * error / self._window_samples
            low, high = self._nominal * (1 - self._max_drift), self._nominal * (1 + self._max_drift)
            self._period = min(max(period, low), high)
        self._last += min(_PHASE_GAIN * self._window_least, 0.5 * self._nominal)
        self._acquired = True
        self.rate_ratio = self._window_samples * self._nominal / elapsed
        self.windows += 1
        self._windows_off_rate = 0 if 0.5 <= self.rate_ratio <= 1.05 else self._windows_off_rate + 1
        self._open_window(now)
