"""What can happen to the host's time while a run goes on: its calendar is set, or it is suspended."""

from __future__ import annotations

from rig.base.clock import Clock
from rig.base.errors import FaultError

LOOK_S = 0.5
CALENDAR_STEP_S = 0.05  # a calendar that moves further than this against the monotonic clock was set
SLEEP_S = 0.2


class HostTime:
    """Looks at the host's calendar and suspension about twice a second.

    Durations are unaffected by the calendar, since everything goes by the monotonic clock; the log's stamps go on from
    the calendar as it was at the start.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._next = clock.now()
        self._asleep = clock.asleep()
        self._offset = self._calendar_offset()

    def check(self) -> float:
        """Seconds by which the calendar was set since the last look; 0.0 if it was not.

        Raises
        ------
        FaultError
            The computer was suspended: for that long nobody has watched the rig.
        """
        now = self._clock.now()
        if now < self._next:
            return 0.0
        self._next = now + LOOK_S
        slept, self._asleep = self._clock.asleep() - self._asleep, self._clock.asleep()
        if not slept <= SLEEP_S:
            raise FaultError(f"The computer was suspended for {slept:.1f} s; nobody watched the rig meanwhile.")
        offset = self._calendar_offset()
        step, self._offset = offset - self._offset, offset
        return step if abs(step) > CALENDAR_STEP_S else 0.0

    def _calendar_offset(self) -> float:
        return (self._clock.calendar_ns() - self._clock.epoch_ns(self._clock.now())) * 1e-9
