"""Limits, checked as ``lo <= x <= hi`` so that NaN fails every one of them."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.membrane.compiled import warm
from model.membrane.solve import Solution, Status, hangs_slack, solve, solve_many
from model.specimen import Specimen
from rig.base.errors import LimitError
from rig.scene.scene import Scene

# A monitor has noise and a gain error: a commanded voltage at its limit must not trip on them.
MONITOR_V = 50.0
MONITOR_GAIN = 1.03
# So little raised a film is flat to eight digits, and solved in a tenth of the time that the exactly flat one takes.
FLAT_M = 1e-6
SAME_M, SAME_V = 2e-6, 1.0  # a film that has moved less takes no charge that could be told from the leakage
# An unloaded sensor may be off by this part of the force limit from its stored zero: beyond it something is wrong with
# it. Where a zero is stored the limit holds against it at all times, so that no zero step can carry the limit away;
# where none is, it holds against the bare reading with this allowance.
ZERO_PART = 0.25
STRETCH_POINTS = 33  # displacements at which the model is asked for the stretch beforehand

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Limit:
    """An interval in SI units, with the words and scale in which the operator reads it."""

    name: str
    low: float
    high: float
    unit: str
    per_si: float = 1.0

    def holds(self, value: float) -> bool:
        """Whether ``low <= value <= high``; False for NaN."""
        return self.low <= value <= self.high

    def check(self, value: float, where: str) -> None:
        """Raise `LimitError` unless the value is inside.

        Raises
        ------
        LimitError
            Naming ``where``, the quantity, its value and what is allowed.
        """
        if not self.holds(value):
            raise LimitError(f"{where}: {self.name} {self._text(value)} is outside {self.allowed}.")

    def widened(self, factor: float) -> Limit:
        """The same limit with both ends multiplied by ``factor``."""
        return replace(self, low=self.low * factor, high=self.high * factor)

    @property
    def allowed(self) -> str:
        """The interval as text with its unit."""
        if self.high == math.inf:
            return f"the limit (at least {self._text(self.low)})"
        if self.low == -math.inf:
            return f"the limit (at most {self._text(self.high)})"
        return f"the limits ({self.low * self.per_si:g} to {self._text(self.high)})"

    def _text(self, value: float) -> str:
        return f"{value * self.per_si:.4g} {self.unit}"


@dataclass(frozen=True)
class Limits:
    """All limits of one scene."""

    force: Limit
    displacement: Limit
    speed: Limit
    voltage: Limit
    measured_voltage: Limit
    current: Limit
    field: Limit
    hoop_stress: Limit
    energy: Limit
    stretch: Limit
    leakage: float  # A beside the charging current
    parallel_capacitance: float  # F beside the film

    @classmethod
    def of(cls, scene: Scene) -> Limits:
        """The limits in ``scene``; the field's is the smaller of the scene's and the material's breakdown field.

        A scene without HV allows 0 V only.
        """
        table = scene.limits
        breakdown = scene.specimen.specimen().material.breakdown_field
        candidates = [breakdown] if breakdown is not None else []
        if table.field_V_per_um is not None:
            candidates.append(table.field_V_per_um * 1e6)
        force, travel = table.force_N, table.displacement_mm * 1e-3
        voltage = table.voltage_V if table.voltage_V is not None else 0.0
        current = table.current_uA * 1e-6 if table.current_uA is not None else 0.0
        return cls(
            force=Limit("force", -force, force, "N"),
            displacement=Limit("displacement", -math.inf, travel, "mm", 1e3),
            speed=Limit("speed", 0.0, table.speed_mm_per_s * 1e-3, "mm/s", 1e3),
            voltage=Limit("voltage", 0.0, voltage, "V"),
            measured_voltage=Limit("voltage", -MONITOR_V, voltage * MONITOR_GAIN + MONITOR_V, "V"),
            current=Limit("current", -current, current, "uA", 1e6),
            field=Limit("field", 0.0, min(candidates, default=math.inf), "V/um", 1e-6),
            hoop_stress=Limit("hoop stress", table.minimum_hoop_stress_kPa * 1e3, math.inf, "kPa", 1e-3),
            energy=Limit("stored energy", 0.0, table.stored_energy_mJ * 1e-3, "mJ", 1e3),
            stretch=Limit("stretch", 0.0, scene.specimen.specimen().material.max_stretch or math.inf, "(max_stretch)"),
            leakage=table.leakage_uA * 1e-6,
            parallel_capacitance=scene.hv.parallel_capacitance_nF * 1e-9 if scene.hv is not None else 0.0,
        )


def check_zero(limits: Limits, force_at_zero: float) -> None:
    """Refuse a zero of the force sensor so far from its stored zero (N) that something must be wrong with it.

    Raises
    ------
    LimitError
        Naming what was found and what is allowed.
    """
    limits.force.widened(ZERO_PART).check(force_at_zero, "Zero of the force sensor, unloaded, against the stored zero")


class FilmLimits:
    """Field and tension of the *deformed* film for a pair (displacement, voltage), by the model.

    A voltage that is allowed on the flat film may be too much on the stretched one, and a displacement that is
    allowed without voltage may not be with it; so the pair is checked before either changes.
    """

    def __init__(self, specimen: Specimen, limits: Limits) -> None:
        self._specimen = specimen
        self._limits = limits
        self._capacitance = (math.nan, math.nan, math.nan)  # displacement, voltage and what the model said there
        # What is loaded or tabulated on first use takes a tenth of a second: now, and not between two turns of a loop.
        hangs_slack(specimen, FLAT_M, 1.0)
        solve(specimen, FLAT_M, 1.0)
        warm()

    def check(self, h: float, voltage: float, where: str) -> None:
        """Raise unless the film at ``h`` metres and ``voltage`` volts is taut and within its limits.

        Raises
        ------
        LimitError
            Naming ``where`` and the quantity that does not hold.
        """
        if hangs_slack(self._specimen, max(h, FLAT_M), voltage):  # the solver would look for long
            raise LimitError(f"{where}: the model has no taut state there. {Status.SLACK.message}")
        state = solve(self._specimen, max(h, FLAT_M), voltage)
        self._limits.field.check(state.peak_field, where)
        self._limits.hoop_stress.check(state.min_hoop_stress, where)
        if state.status is not Status.TAUT:
            raise LimitError(f"{where}: the model has no taut state there. {state.status.message}")
        self._limits.energy.check(self._energy(state), where)
        self._limits.stretch.check(state.max_stretch, where)

    def _energy(self, state: Solution) -> float:
        """0.5 C V^2 of film and cable (J).

        Where an upper bound suffices, that bound: nowhere does the film have more than its peak field, and its volume
        does not change.
        """
        s, v2 = self._specimen, state.voltage**2
        beside = 0.5 * self._limits.parallel_capacitance * v2
        volume = s.thickness * math.pi * (s.ring_radius**2 - s.disk_radius**2) / s.prestretch**2
        bound = 0.5 * s.material.permittivity * state.peak_field**2 * volume + beside
        return bound if self._limits.energy.holds(bound) or v2 == 0.0 else 0.5 * state.capacitance() * v2 + beside

    def capacitance(self, h: float, voltage: float) -> float:
        """Capacitance of film and cable (F) at displacement ``h`` metres; NaN where the model has no state.

        Within `SAME_M` and `SAME_V` of where the model was last asked it is the same: by less than a thousandth.
        """
        last_h, last_voltage, known = self._capacitance
        if abs(h - last_h) <= SAME_M and abs(voltage - last_voltage) <= SAME_V:
            return known
        state = solve(self._specimen, max(h, FLAT_M), voltage)
        found = state.capacitance() + self._limits.parallel_capacitance if state.answered else math.nan
        self._capacitance = h, voltage, found
        return found

    def check_path(self, h0: float, h1: float, voltage: float, points: int = 5) -> None:
        """Check the film along a move from ``h0`` to ``h1`` metres at ``voltage`` volts, ends included.

        Raises
        ------
        LimitError
            At the first displacement where field or tension does not hold.
        """
        if not (math.isfinite(h0) and math.isfinite(h1)):
            raise LimitError("A move was asked for from or to a displacement that is not a number.")
        for k in range(points):
            h = h0 + (h1 - h0) * k / (points - 1)
            self.check(h, voltage, f"Move to {h1 * 1e3:.2f} mm with {voltage:g} V on, at {h * 1e3:.2f} mm")


class Line:
    """Straight lines between points, as `numpy.interp` draws them, for one place at a time: ten times as fast.

    Parameters
    ----------
    x, y
        Finite, one at least; ``x`` rises. Beyond the ends the value at the end goes on.
    """

    def __init__(self, x: Floats, y: Floats) -> None:
        self._x: list[float] = x.tolist()
        self._y: list[float] = y.tolist()
        self._slopes: list[float] = (np.diff(y) / np.diff(x)).tolist()

    def __call__(self, x: float) -> float:
        k = bisect_right(self._x, x) - 1
        if k < 0:
            return self._y[0]
        if k >= len(self._slopes):
            return self._y[-1]
        return self._slopes[k] * (x - self._x[k]) + self._y[k]


class StretchLimit:
    """The film's largest stretch (``max_stretch`` of its material) without voltage, by the model, at any displacement.

    For a disk that is measured many times a second: the model is asked beforehand.
    """

    def __init__(self, specimen: Specimen, limits: Limits) -> None:
        self._limit = limits.stretch
        self._stretch: Line | None = None
        if math.isfinite(self._limit.high):
            h = np.linspace(FLAT_M, max(limits.displacement.high, 2 * FLAT_M), STRETCH_POINTS)
            stretch = solve_many(specimen, h, 0.0).max_stretch
            known = np.isfinite(stretch)
            if known.sum() > 1:
                self._stretch = Line(h[known], stretch[known])

    def check(self, h: float, where: str) -> None:
        """Raise unless the film is stretched less with the disk at ``h`` metres; what is not known is not held.

        Raises
        ------
        LimitError
        """
        if self._stretch is not None and math.isfinite(h):
            self._limit.check(self._stretch(h), where)
