"""A Micro-Epsilon optoNCDT 1420 on the simulated bench: streams 18-bit words, three bytes each, and takes nothing in.

It shares no code with the driver. What the real one does with commands is not simulated.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from rig.sim.truth import Fault, LineTruth, LinkTruth, NotNegative, Positive
from rig.sim.twin import Twin
from rig.sim.wire import ByteWire
from rig.sim.world import World

NO_PEAK = 262_075  # one of the error words


class OptoNCDTTruth(LineTruth):
    """Micro-Epsilon optoNCDT 1420."""

    means_nothing: ClassVar[Mapping[str, str]] = {"alert": "it streams all the time, and answers nothing"}
    more_faults: ClassVar[tuple[str, ...]] = ("no_value",)

    driver: Literal["optoncdt-1420"] = Field(default="optoncdt-1420", description="Micro-Epsilon optoNCDT 1420.")
    link: LinkTruth = Field(default=LinkTruth(baud=921_600), description="Its serial line.")
    plate_range_mm: Positive = Field(default=50.0, description="Measuring range (mm).")
    measuring_rate_Hz: Positive = Field(default=250.0, description="Samples per second (Hz).")
    offset_mm: float = Field(default=5.0, description="Distance that it shows for the flat film (mm).")
    gain_error: float = Field(default=0.0, description="Hidden relative error of the scale. Typical: +-0.001.")
    noise_um: NotNegative = Field(default=2.0, description="Standard deviation of a reading (um).")
    clock_drift_ppm: float = Field(default=0.0, description="By how much its clock is too fast (ppm).")
    reboot_s: Positive = Field(default=1.0, description="How long it is silent after power comes back (s).")


class OptoNCDT:
    """One sensor."""

    def __init__(self, truth: OptoNCDTTruth, world: World, wire: ByteWire, rng: np.random.Generator) -> None:
        self._truth, self._world, self._wire, self._rng = truth, world, wire, rng
        self._period = 1.0 / (truth.measuring_rate_Hz * (1.0 + truth.clock_drift_ppm * 1e-6))
        self._start, self._count = 0.0, 0
        self._frozen: float | None = None
        self._rail, self._dark = 0, False

    @property
    def next_time(self) -> float:
        return self._start + (self._count + 1) * self._period

    def advance(self, t: float) -> None:
        while (due := self.next_time) <= t:
            word = self._word(due)
            self._wire.send(bytes((word % 64, 64 + word // 64 % 64, 128 + word // 4096)), due)
            self._count += 1

    def receive(self, data: bytes, t: float) -> None:
        """It does not listen."""

    def reset(self, t: float) -> None:
        self._start, self._count = t + self._truth.reboot_s, 0

    def freeze(self, t: float, frozen: bool) -> None:
        self._frozen = self._millimetres(t) if frozen else None

    def switch(self, fault: Fault, begins: bool, t: float) -> None:
        """``saturate``: the end of its reserve; ``no_value`` and ``wrong_status``: an error word."""
        if fault.kind == "saturate":
            self._rail = fault.sign if begins else 0
        else:
            self._dark = begins

    def _millimetres(self, t: float) -> float:
        s = self._truth
        true = self._world.displacement_at(t) * 1e3 * (1.0 + s.gain_error) + s.offset_mm
        return true + s.noise_um * 1e-3 * float(self._rng.standard_normal())

    def _word(self, t: float) -> int:
        if self._dark:
            return NO_PEAK
        if self._rail:
            return 65_520 if self._rail > 0 else 0
        distance = self._frozen if self._frozen is not None else self._millimetres(t)
        word = round((100.0 * distance / self._truth.plate_range_mm + 1.0) * 65_520 / 102)
        return min(max(word, 0), 65_520)


TWINS = (Twin("optoncdt-1420", "displacement", OptoNCDTTruth, OptoNCDT),)
