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

    def calendar_ns(self) -> int:
        """What the host's calendar says now, nanoseconds since 1970: jumps when somebody sets it."""
        ...

    def asleep(self) -> float:
        """Seconds that the host has spent suspended since it was started, where it says so; this clock stood then."""
        ...


class RealClock:
    """The host's monotonic clock, mapped to the calendar once at the start.

    ``zero`` and ``started_ns`` of another one make it show the same time in another process of this host.
    """

    def __init__(self, zero: float | None = None, started_ns: int | None = None) -> None:
        self.zero = time.monotonic() if zero is None else zero
        self.started_ns = time.time_ns() if started_ns is None else started_ns

    def now(self) -> float:
        return time.monotonic() - self.zero

    def sleep_until(self, t: float) -> None:
        delay = t - self.now()
        if delay > 0:
            time.sleep(delay)

    def epoch_ns(self, t: float) -> int:
        return self.started_ns + round(t * 1e9)

    def calendar_ns(self) -> int:
        return time.time_ns()

    def asleep(self) -> float:
        boot_time = getattr(time, "CLOCK_BOOTTIME", None)  # Linux
        if boot_time is None:
            return 0.0
        return time.clock_gettime(boot_time) - time.clock_gettime(time.CLOCK_MONOTONIC)


class VirtualClock:
    """Time that passes only by sleeping; whoever lives in that time (the simulated bench) is moved along.

    Parameters
    ----------
    advance : callable
        Called with the new time before ``now`` shows it.

    Attributes
    ----------
    calendar_step_ns, slept : int, float
        For tests: how far somebody has set the host's calendar; how long the host was suspended.
    """

    def __init__(self, advance: Callable[[float], None] | None = None) -> None:
        self._now = 0.0
        self.advance = advance
        self.calendar_step_ns = 0
        self.slept = 0.0

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

    def calendar_ns(self) -> int:
        return self.epoch_ns(self._now) + self.calendar_step_ns

    def asleep(self) -> float:
        return self.slept


def calendar_now() -> datetime:
    """The host's date and time (UTC): a host fact, never part of what a run does."""
    return datetime.now(UTC)
