"""The one clock. Nothing else in the project calls `time` (rule 4 of the house)."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Protocol

# Virtual runs are stamped as if they began here, so that their logs are the same whenever they are made.
VIRTUAL_EPOCH_NS = 1_577_836_800_000_000_000  # 2020-01-01T00:00:00Z


class Clock(Protocol):
    """Monotonic seconds, and their place on the calendar."""

    def now(self) -> float:
        """Seconds since this clock was made."""
        ...

    def sleep_until(self, t: float) -> None:
        """Return when ``now() >= t``; at once if that is so already."""
        ...

    def epoch_ns(self, t: float) -> int:
        """Nanoseconds since 1970 that belong to clock time ``t``."""
        ...


class RealClock:
    """The host's monotonic clock, mapped to the calendar once at the start."""

    def __init__(self) -> None:
        self._zero = time.monotonic()
        self._epoch_ns = time.time_ns()

    def now(self) -> float:
        return time.monotonic() - self._zero

    def sleep_until(self, t: float) -> None:
        delay = t - self.now()
        if delay > 0:
            time.sleep(delay)

    def epoch_ns(self, t: float) -> int:
        return self._epoch_ns + round(t * 1e9)


class VirtualClock:
    """Time that passes only by sleeping; whoever lives in that time (the simulated bench) is moved along.

    Parameters
    ----------
    advance : callable
        Called with the new time before ``now`` shows it.
    """

    def __init__(self, advance: Callable[[float], None] | None = None) -> None:
        self._now = 0.0
        self.advance = advance

    def now(self) -> float:
        return self._now

    def sleep_until(self, t: float) -> None:
        if t <= self._now:
            return
        if self.advance is not None:
            self.advance(t)
        self._now = t

    def epoch_ns(self, t: float) -> int:
        return VIRTUAL_EPOCH_NS + round(t * 1e9)


def calendar_now() -> datetime:
    """The host's date and time (UTC): a host fact, never part of what a run does."""
    return datetime.now(UTC)
