"""A transducer with a voltage output, a load-cell conditioner, a laser, a probe, on an input of a LabJack."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from typing import Generic, TypeVar

from drivers.dialogue import LOST_AGAIN_S, Schedule
from drivers.instruments.labjack.registers import RAIL, Registers, Script
from drivers.links.link import ByteLink, DeviceError, DeviceLost
from drivers.roles import OK, DisplacementSample, ForceSample, Identity, MonitorSample, SampleFlag
from drivers.settings import Quantity

S = TypeVar("S", ForceSample, DisplacementSample, MonitorSample)


class AnalogInput(ABC, Generic[S]):
    """One input, read at a rate. Set-up proves the LabJack and sets the input's range; it changes no output.

    Parameters
    ----------
    ain : int
        The input, 0 for AIN0.
    rate_Hz : float
        How often it is read.
    boot_s : float
        How long the first answer may take.
    """

    def __init__(
        self,
        name: str,
        link: ByteLink,
        *,
        ain: int = 2,
        rate_Hz: float = 50.0,
        timeout_s: float = 0.25,
        boot_s: float = 0.0,
    ) -> None:
        self.name = name
        self.identity = Identity()
        self.settings: dict[str, str] = {}
        self.counters: dict[str, int] = {"over_range": 0}
        self._link = link
        self._ain, self._rate = ain, rate_Hz
        self._registers = Registers(name, link, self.counters, timeout_s, boot_s)
        self._schedule = Schedule(1.0 / rate_Hz, self.counters)
        self._samples: deque[S] = deque()
        self._range = math.nan
        self._now = self._next_poll = 0.0
        self._ready = False
        self._registers.dialogue.begin(self._set_up())

    @property
    def ready(self) -> bool:
        return self._ready

    @property
    def next_poll(self) -> float:
        return self._next_poll

    @property
    def rate(self) -> float:
        """Values asked for per second."""
        return self._rate

    def poll(self, now: float) -> Sequence[S]:
        self._now = now
        dialogue = self._registers.dialogue
        try:
            self._registers.take_in(now)
            if self._ready and dialogue.idle and self._schedule.take(now):
                dialogue.begin(self._measure())
            dialogue.run(now)
        except DeviceLost:
            self._next_poll = now + LOST_AGAIN_S
            raise
        except DeviceError:
            self._next_poll = now
            raise
        self._next_poll = min(dialogue.next_poll(now), self._schedule.due if dialogue.idle else math.inf)
        samples = list(self._samples)
        self._samples.clear()
        return samples

    def close(self) -> None:
        self._link.close()

    def _set_up(self) -> Script:
        self.identity, product = yield from self._registers.identify(self.settings)
        self._range = yield from self._registers.widest_range(self._ain, product, self.settings)
        self._schedule.start(self._now)
        self._ready = True

    def _measure(self) -> Script:
        volts, _, t = yield from self._registers.inputs(self._ain, None)
        flags = OK
        if not abs(volts) < RAIL * self._range:  # a saturated input tells nothing
            self.counters["over_range"] += 1
            flags = (SampleFlag.UNDER_RANGE if volts < 0 else SampleFlag.OVER_RANGE) | SampleFlag.NO_VALUE
            volts = math.nan
        self._samples.append(self._sample(t, volts, flags))

    @abstractmethod
    def _sample(self, t: float, volts: float, flags: SampleFlag) -> S:
        """A sample of the quantity in SI units."""


class AnalogForce(AnalogInput[ForceSample]):
    """A `drivers.roles.ForceSensor` in newtons: ``newtons_per_V`` times the voltage."""

    reading_unit = "N"

    def __init__(
        self,
        name: str,
        link: ByteLink,
        *,
        newtons_per_V: float,
        ain: int = 2,
        rate_Hz: float = 50.0,
        timeout_s: float = 0.25,
        boot_s: float = 0.0,
    ) -> None:
        super().__init__(name, link, ain=ain, rate_Hz=rate_Hz, timeout_s=timeout_s, boot_s=boot_s)
        self._scale = newtons_per_V

    def _sample(self, t: float, volts: float, flags: SampleFlag) -> ForceSample:
        return ForceSample(t, volts * self._scale, flags)


class AnalogDisplacement(AnalogInput[DisplacementSample]):
    """A `drivers.roles.DisplacementSensor`: ``mm_per_V`` times the voltage."""

    def __init__(
        self,
        name: str,
        link: ByteLink,
        *,
        mm_per_V: float,
        ain: int = 3,
        rate_Hz: float = 50.0,
        timeout_s: float = 0.25,
        boot_s: float = 0.0,
    ) -> None:
        super().__init__(name, link, ain=ain, rate_Hz=rate_Hz, timeout_s=timeout_s, boot_s=boot_s)
        self._scale = mm_per_V * 1e-3

    def _sample(self, t: float, volts: float, flags: SampleFlag) -> DisplacementSample:
        return DisplacementSample(t, volts * self._scale, flags)


class AnalogMonitor(AnalogInput[MonitorSample]):
    """A `drivers.roles.Monitor`: a high-voltage probe, a thermometer. ``to_si`` is (V, K or 1 per volt, at 0 V)."""

    def __init__(
        self,
        name: str,
        link: ByteLink,
        *,
        quantity: Quantity = "voltage",
        to_si: tuple[float, float] = (1000.0, 0.0),
        ain: int = 4,
        rate_Hz: float = 5.0,
        timeout_s: float = 0.25,
        boot_s: float = 0.0,
    ) -> None:
        super().__init__(name, link, ain=ain, rate_Hz=rate_Hz, timeout_s=timeout_s, boot_s=boot_s)
        self.quantity = quantity
        self._scale, self._zero = to_si
        self.settings |= {"si_per_V": f"{self._scale:.9g}", "si_at_zero": f"{self._zero:.9g}"}

    def _sample(self, t: float, volts: float, flags: SampleFlag) -> MonitorSample:
        return MonitorSample(t, self.name, self.quantity, volts * self._scale + self._zero, flags)
