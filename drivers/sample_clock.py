"""Times for the samples of a stream that carries none: from the known rate, held to the clock of the host.

An instrument that streams at a fixed rate without counter or time stamp gives the host only blocks: ``n`` samples that
had arrived by ``now``. The arrival is the sampling instant plus a delay that is never negative, mostly small and
sometimes large (buffers, schedulers, the poll itself). So the *lower envelope* of the delays, not their mean, carries
the sampling instants. With period ``p`` the last of ``n`` new samples is expected at ``t + n p``, and is late by
``e = now - (t + n p)``:

- ``e < 0`` proves that the expectation is too late; it is corrected at once, so that no sample is stamped after its
  arrival;
- the least ``e`` of a window of about a second corrects phase and period slowly: a causal second-order loop;
- ``e`` of about a period or more for longer than ``confirm_s`` means that samples are missing: they are counted and
  left as a gap. Until that is certain the samples are held back, so that neither is a late block mistaken for a gap
  nor a gap for a late block. At high rates, where a few samples are no longer than usual delays, a whole window must
  be late; the gap then stands at the window's end;
- samples that come early within two seconds of a gap refute it: they had been late, and the counters are corrected.

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
_LEAST_HOLD_S = 8e-3  # delays up to this are common on a busy host and not worth holding samples back
_REFUTE_S = 2.0
_COUNT_S = 10.0  # over how long the rate is counted
_STALL_S = 0.5


class SampleClock(Generic[T]):
    """Stamps the samples of one uninterrupted stream.

    Parameters
    ----------
    rate_Hz : float
        The instrument's nominal rate.
    counters : dict
        Gets ``lost_samples``, ``gaps`` and ``time_resyncs``.
    jitter_s : float
        How far the least delay of some tens of polls varies. Losses shorter than this are not noticed as such: at
        1 kHz that is two samples.
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
        confirm_s: float = 0.1,
        max_drift: float = 1e-3,
    ) -> None:
        self._nominal = 1.0 / rate_Hz
        self._period = self._nominal
        self._window_limit = 0.75 * self._nominal + jitter_s
        self._hold_limit = max(self._window_limit, _LEAST_HOLD_S)
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
        self._doubt_since = -math.inf  # of the latest gaps, which samples that still come may refute
        self._doubted_samples = 0
        self._doubted_gaps = 0
        self._acquired = False
        self._open_window(0.0)
        self._counted_since = 0.0
        self._counted = 0
        self._now = 0.0

    @property
    def drift(self) -> float:
        """Relative deviation of the instrument's period from its nominal one, against the host's clock."""
        return self._period / self._nominal - 1.0

    @property
    def acquired(self) -> bool:
        """Whether the phase of the stream has been found, some seconds after its start or a gap."""
        return self._acquired

    def other_rate(self) -> float | None:
        """The rate at which samples really come, if it is quite another than the nominal one; then counts anew.

        It is another when stalls of half a second and what they dam up cannot explain the samples of the last
        seconds. Gaps that have been counted do not enter, nor does the time before the first sample.
        """
        if self._last is None:
            return None
        elapsed, given = self._now - self._counted_since, self._counted * self._nominal
        slack = max(_STALL_S, 3 * self._nominal)
        if 0.5 * elapsed - slack <= given <= 1.05 * elapsed + slack:
            return None
        rate = self._counted / elapsed if elapsed > 0 else math.inf
        self.count_anew()
        return rate

    def count_anew(self) -> None:
        """Forget how many samples have come: `other_rate` judges what comes from now on."""
        self._counted_since, self._counted = self._now, 0

    def feed(self, now: float, samples: list[T]) -> list[tuple[float, T]]:
        """Take the samples that have arrived by ``now``, oldest first; return those whose times are settled."""
        self._now = now
        if not samples:
            return []
        self._counted += len(samples)
        if self._last is None:
            self._last = now
            self.count_anew()
            self._open_window(now)
            return [(now - (len(samples) - 1 - i) * self._period, sample) for i, sample in enumerate(samples)]
        self._held += samples
        return self._settle(now, self._last)

    def _settle(self, now: float, last: float) -> list[tuple[float, T]]:
        n = len(self._held)
        late = now - (last + n * self._period)
        gap = False
        if late > self._hold_limit:
            if self._held_since is None:
                self._held_since, self._held_late = now, late
            self._held_late = min(self._held_late, late)
            # One late block may simply be late; it takes a later one as well to tell.
            if now == self._held_since or now - self._held_since < self._confirm:
                return []
            gap = True
            missing = self._count_gap(self._held_late, now)
            last += missing
            late -= missing
        elif late < -0.75 * self._period:
            self._early(late, now)
        # A sample is stamped at its arrival at the latest; nanoseconds keep the order if nothing else can.
        end = max(last + n * self._period + min(late, 0.0), last + n * 1e-9)
        step = (end - last) / n
        stamped = [(last + (i + 1) * step, sample) for i, sample in enumerate(self._held)]
        self._last = end
        self._held, self._held_since = [], None
        if gap:
            self._acquired = False
            self._open_window(now)
            self.count_anew()
        else:
            self._track(now, n, late)
        return stamped

    def _count_gap(self, late: float, now: float) -> float:
        """Count the samples that ``late`` stands for; returns their duration."""
        lost = max(1, math.floor(late / self._period + 0.25))
        self._counters["lost_samples"] += lost
        self._counters["gaps"] += 1
        if now - self._doubt_since > _REFUTE_S:
            self._doubted_samples = self._doubted_gaps = 0
        self._doubt_since = now
        self._doubted_samples += lost
        self._doubted_gaps += 1
        return lost * self._period

    def _early(self, late: float, now: float) -> None:
        """Samples have come that a gap had been counted for, or more than the rate allows."""
        if self._doubted_samples and now - self._doubt_since < _REFUTE_S:
            found = min(self._doubted_samples, round(-late / self._period))
            self._doubted_samples -= found
            self._counters["lost_samples"] -= found
            if self._doubted_samples == 0:
                self._counters["gaps"] -= self._doubted_gaps
                self._doubted_gaps = 0
        elif late < -(self._period + self._jitter):
            self._counters["time_resyncs"] += 1

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
        if self._acquired and self._window_least > self._window_limit:
            self._last += self._count_gap(self._window_least, now)
            self._window_least = 0.0
        elif self._acquired:  # the first window only finds the phase
            error = self._window_early + self._window_least
            period = self._period + _PERIOD_GAIN * error / self._window_samples
            low, high = self._nominal * (1 - self._max_drift), self._nominal * (1 + self._max_drift)
            self._period = min(max(period, low), high)
        self._last += min(_PHASE_GAIN * self._window_least, 0.5 * self._nominal)
        self._acquired = True
        if now - self._counted_since > _COUNT_S:
            self.count_anew()
        self._open_window(now)
