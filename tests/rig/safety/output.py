"""An output of high voltage with a driver that obeys, is deaf or is gone; on a clock that somebody else moves."""

from __future__ import annotations

import math
from collections.abc import Sequence

from drivers.links.link import DeviceLost, DeviceSilent
from drivers.roles import HVFlag, HVSample, Identity
from rig.base.clock import VirtualClock

PERIOD_S = 0.02  # between two samples
DISCHARGE_S = 0.1  # time constant of an output that was taken off


class Clock(VirtualClock):
    """Time that passes where somebody waits; can be handed to another process like the real one."""

    zero, started_ns = 12.5, 10**18


class Output:
    """The simulated output and its driver in one. ``told``: each command with its time and what it names.

    Stuck from ``deaf_from`` to ``deaf_until``: its voltage stays, and what it is told changes nothing. From
    ``gone_from`` on its link is gone, until it is opened again after ``back_at``.
    """

    measures_current = False
    busy = False
    ready = True
    identity = Identity("an output", "7", "1.0")
    nominal = (4000.0, 1e-3)
    fastest_ramp = 1e6

    def __init__(self, clock: Clock) -> None:
        self.settings = {"speed": "250"}
        self.counters = {"errors": 3}
        self.name = "hv"
        self.told: list[tuple[float, str, float]] = []
        self.polls: list[float] = []
        self.voltage = 0.0  # what really stands there
        self.next_poll = math.inf
        self.deaf_from = self.deaf_until = self.gone_from = self.back_at = math.inf
        self.silent = False
        self.reopened: list[float] = []
        self._clock = clock
        self._on, self._target, self._ramp = False, 0.0, 1.0
        self._moved_at = self._next = clock.now()

    @property
    def words(self) -> list[str]:
        return [word for _, word, _ in self.told]

    def when(self, word: str) -> list[float]:
        """The times at which it was told so."""
        return [t for t, one, _ in self.told if one == word]

    def _take(self, word: str, value: float = math.nan) -> bool:
        """Whether it obeys."""
        now = self._clock.now()
        if self._away(now):
            raise DeviceLost("hv", "it is gone")
        self.told.append((now, word, value))
        return not self._stuck(now)

    def _stuck(self, now: float) -> bool:
        return self.deaf_from <= now < self.deaf_until

    def _away(self, now: float) -> bool:
        return now >= self.gone_from

    def reopen(self) -> bool:
        """As its link does."""
        now = self._clock.now()
        if now < self.back_at:
            return False
        self.gone_from = self.back_at = math.inf
        self.reopened.append(now)
        return True

    def poll(self, now: float) -> Sequence[HVSample]:
        self.polls.append(now)
        self._move(now)
        if self._away(now):
            raise DeviceLost("hv", "it is gone")
        if self.silent:
            raise DeviceSilent("hv", "it does not answer")
        if now < self._next:
            return []
        self._next = now + PERIOD_S
        flags = HVFlag.ON if self._on else HVFlag(0)
        if self._on and self.voltage != self._target:
            flags |= HVFlag.RAMPING
        return [HVSample(now, self.voltage, math.nan, self._target, flags)]

    def _move(self, now: float) -> None:
        passed, self._moved_at = now - self._moved_at, now
        if self._stuck(now):
            return
        if self._on:
            way = self._target - self.voltage
            self.voltage += math.copysign(min(abs(way), self._ramp * passed), way)
            self._on = self._on and not (self._target == 0.0 and self.voltage == 0.0 and self._goes_off)
        else:
            self.voltage *= math.exp(-passed / DISCHARGE_S)

    _goes_off = False

    def set_ramp(self, volts_per_second: float) -> None:
        if self._take("set_ramp", volts_per_second):
            self._ramp = volts_per_second

    def set_current_limit(self, amperes: float) -> None:
        self._take("set_current_limit", amperes)

    def set_voltage(self, volts: float) -> None:
        if self._take("set_voltage", volts):
            self._target = volts

    def switch_on(self) -> None:
        if self._take("switch_on"):
            self._on, self._goes_off = True, False

    def switch_off(self) -> None:
        if self._take("switch_off"):
            self._target, self._goes_off = 0.0, True

    def emergency_off(self) -> None:
        if self._take("emergency_off"):
            self._on, self._target = False, 0.0

    def clear(self) -> None:
        self._take("clear")

    def close(self) -> None:
        pass


class Lends(Output):
    """One that arming changes, and that gives it back in ``takes_s``."""

    found = {"knob": 1.0}  # noqa: RUF012
    given_back = False
    takes_s = 0.1
    resumed: object = None
    _asked_at: float | None = None

    def poll(self, now: float) -> Sequence[HVSample]:
        self.given_back = self._asked_at is not None and now >= self._asked_at + self.takes_s
        return super().poll(now)

    def give_back(self) -> None:
        self._take("give_back")
        self._asked_at = self._clock.now() if self._asked_at is None else self._asked_at

    def resume_found(self, found: object) -> dict[str, tuple[float, float]]:
        self.resumed = found
        return {}
