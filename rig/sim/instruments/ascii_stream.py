"""A microcontroller on the simulated bench that prints lines by itself, as an Arduino with an HX711 does.

It shares no code with the driver. It takes nothing in; its value stands in one column of each line, in newtons or
millimetres, or what a meter reads; the others count lines.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from rig.sim.probe import Probe
from rig.sim.truth import Fault, LineTruth, LoadCellTruth, MonitorTruth, NotNegative, Positive
from rig.sim.twin import Twin
from rig.sim.wire import ByteWire
from rig.sim.world import World


class PrinterTruth(LineTruth):
    """What both kinds have."""

    means_nothing: ClassVar[Mapping[str, str]] = {"alert": "it sends lines all the time, and answers nothing"}

    print_rate_Hz: Positive = Field(default=80.0, description="How many lines it sends per second (Hz).")
    print_columns: int = Field(default=1, ge=1, le=32, description="How many columns its lines have.")
    print_column: int = Field(default=1, ge=1, le=32, description="In which column its value stands.")
    print_separator: str = Field(default=",", max_length=4, description="What it puts between columns.")
    digits: int = Field(default=6, ge=0, le=12, description="How many decimals it prints.")


class PrintedForceTruth(PrinterTruth, LoadCellTruth):
    """A load cell on a board that prints newtons."""

    driver: Literal["ascii-stream"] = Field(default="ascii-stream", description="Load cell that prints lines.")
    zero_offset_N: float = Field(default=0.002, description="What it shows unloaded (N).")


class PrintedDisplacementTruth(PrinterTruth):
    """A displacement sensor on a board that prints millimetres."""

    driver: Literal["ascii-stream"] = Field(default="ascii-stream", description="Dial gauge that prints lines.")
    offset_mm: float = Field(default=1.25, description="What it shows for the flat film (mm).")
    gain_error: float = Field(default=0.0, description="Hidden relative error of the scale. Typical: +-0.001.")
    noise_um: NotNegative = Field(default=1.0, description="Standard deviation of a reading (um).")
    clock_drift_ppm: float = Field(default=0.0, description="By how much its clock is too fast (ppm).")
    reboot_s: Positive = Field(default=1.0, description="How long it is silent after power comes back (s).")


class PrintedMonitorTruth(PrinterTruth, MonitorTruth):
    """A meter, thermometer or hygrometer that prints what it reads."""

    driver: Literal["ascii-stream"] = Field(default="ascii-stream", description="Meter that prints lines.")
    print_rate_Hz: Positive = Field(default=5.0, description="How many lines it sends per second (Hz).")
    units_per_number: float = Field(default=1.0, description="What a number of 1 that it prints stands for (V, C, %).")
    clock_drift_ppm: float = Field(default=0.0, description="By how much its clock is too fast (ppm).")
    reboot_s: Positive = Field(default=1.0, description="How long it is silent after power comes back (s).")


class Printer:
    """One board."""

    def __init__(
        self,
        truth: PrintedForceTruth | PrintedDisplacementTruth | PrintedMonitorTruth,
        world: World,
        wire: ByteWire,
        rng: np.random.Generator,
    ) -> None:
        self._truth, self._world, self._wire, self._rng = truth, world, wire, rng
        self._period = 1.0 / (truth.print_rate_Hz * (1.0 + truth.clock_drift_ppm * 1e-6))
        self._start, self._count = 0.0, 0
        self._frozen: float | None = None
        self._word = ""
        if isinstance(truth, PrintedMonitorTruth):
            self._probe = Probe(truth, world, rng)

    @property
    def next_time(self) -> float:
        return self._start + (self._count + 1) * self._period

    def advance(self, t: float) -> None:
        while (due := self.next_time) <= t:
            self._wire.send(self._line(due), due)
            self._count += 1

    def receive(self, data: bytes, t: float) -> None:
        """It does not listen."""

    def reset(self, t: float) -> None:
        self._start, self._count = t + self._truth.reboot_s, 0

    def freeze(self, t: float, frozen: bool) -> None:
        self._frozen = self._value(t) if frozen else None

    def switch(self, fault: Fault, begins: bool, t: float) -> None:
        """Its other faults: ``saturate``, it prints ``inf`` or ``-inf``; ``wrong_status``, it prints ``nan``."""
        if fault.kind == "saturate":
            self._word = ("inf" if fault.sign > 0 else "-inf") if begins else ""
        else:
            self._word = "nan" if begins else ""

    def _value(self, t: float) -> float:
        s = self._truth
        if isinstance(s, PrintedMonitorTruth):
            return self._probe.number(t)
        noise = float(self._rng.standard_normal())
        if isinstance(s, PrintedForceTruth):
            true = self._world.force_at(max(t - s.lag_ms * 1e-3, 0.0))
            return true * (1.0 + s.gain_error) + s.zero_offset_N + s.noise_fraction * s.full_scale_N * noise
        true = self._world.displacement_at(t) * 1e3
        return true * (1.0 + s.gain_error) + s.offset_mm + s.noise_um * 1e-3 * noise

    def _line(self, t: float) -> bytes:
        s = self._truth
        value = self._frozen if self._frozen is not None else self._value(t)
        word = self._word or ("inf" if math.isinf(value) else f"{value:.{s.digits}f}")
        columns = [str(self._count + i) for i in range(s.print_columns)]
        columns[min(s.print_column, s.print_columns) - 1] = word
        return s.print_separator.join(columns).encode("ascii", "replace") + b"\r\n"


TWINS = (
    Twin("ascii-stream", "displacement", PrintedDisplacementTruth, Printer),
    Twin("ascii-stream", "force", PrintedForceTruth, Printer),
    Twin("ascii-stream", "monitor", PrintedMonitorTruth, Printer),
)
