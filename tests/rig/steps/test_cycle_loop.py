"""What one cycle sums up, against closed forms: areas, slopes, energies of loops that can be written down."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.roles import DisplacementSample, ForceSample, HVFlag, HVSample, SampleFlag, StageSample
from rig.steps.cycle import Ends, Loop, Slope, _Line

POINTS = 64
MIDDLE, WAY, FORCE, STIFFNESS, WIDTH = 5e-3, 2e-3, 0.4, 60.0, 0.01  # m, m, N, N/m, N


def loop(*, moves: bool, laser: bool = True) -> tuple[Loop, Any]:
    """With its recorder, whose ``displacement`` is what was measured last."""
    recorder = SimpleNamespace(keeping=True, has_laser=laser, displacement=math.nan)
    recorder.quantity_of = lambda sample: sample.reading
    rig: Any = SimpleNamespace(recorder=recorder, clock=SimpleNamespace(now=lambda: 7.5))
    return Loop(rig, SimpleNamespace(moves=moves, step=3)), recorder  # type: ignore[arg-type]


@pytest.mark.parametrize("laser", [True, False])
def test_an_ellipse_has_its_area_its_ends_and_its_slope(laser: bool) -> None:
    one, recorder = loop(moves=True, laser=laser)
    one.begin(4)
    for k in range(POINTS + 1):  # the first point is the last
        angle, t = 2.0 * math.pi * k / POINTS, k / POINTS
        recorder.displacement = MIDDLE + WAY * math.sin(angle)
        one(DisplacementSample(t, 0.0) if laser else StageSample(t, 0.0, True, True, 0))
        one(ForceSample(t, FORCE + STIFFNESS * WAY * math.sin(angle) + WIDTH * math.cos(angle)))
        one(ForceSample(t, 1e3, next(iter(SampleFlag))))  # not good: not counted
    row = one.end(whole=True)
    polygon = 0.5 * POINTS * math.sin(2.0 * math.pi / POINTS) * WAY * WIDTH  # pi * WAY * WIDTH, nearly
    assert row["work_J"] == pytest.approx(polygon, rel=1e-9)
    assert row["stiffness_N_per_m"] == pytest.approx(STIFFNESS, rel=1e-9)
    assert (row["displacement_valley_m"], row["displacement_peak_m"]) == pytest.approx((MIDDLE - WAY, MIDDLE + WAY))
    most = math.hypot(STIFFNESS * WAY, WIDTH)
    assert row["force_peak_N"] == pytest.approx(FORCE + most, abs=1e-3 * most) and row["force_peak_N"] <= FORCE + most
    assert row["samples"] == POINTS + 1
    assert (row["step"], row["cycle"], row["whole"], row["kept"], row["begin_s"]) == (3, 4, True, True, 7.5)
    assert all(math.isnan(row[name]) for name in ("actuation_N_per_V2", "electric_J", "leakage_A", "voltage_peak_V"))


def test_a_ramp_of_the_voltage_takes_its_energy_and_gives_its_slope() -> None:
    """1000 V in 1 s at 2 uA are 1 mJ; then half a second at rest with 3 and 5 uA, of which the mean leaks."""
    one, _ = loop(moves=False)
    one.begin(1)
    for k in range(11):
        t, volts = 0.1 * k, 100.0 * k
        one(HVSample(t, volts, 2e-6, 1000.0, HVFlag.ON | HVFlag.RAMPING))
        one(ForceSample(t, FORCE - 1e-7 * volts * volts))
    row = one.end(whole=False)
    assert row["electric_J"] == pytest.approx(1e-3, rel=1e-12)
    assert row["actuation_N_per_V2"] == pytest.approx(-1e-7, rel=1e-9)
    assert (row["voltage_valley_V"], row["voltage_peak_V"]) == (0.0, 1000.0)
    assert (row["current_valley_A"], row["current_peak_A"]) == (2e-6, 2e-6)
    assert math.isnan(row["stiffness_N_per_m"]) and math.isnan(row["leakage_A"]) and row["whole"] is False
    one.begin(2)  # nothing of the last one is left
    one.resting_since = 2.0
    one(HVSample(1.9, 1000.0, 9e-6, 1000.0, HVFlag.ON))
    one(HVSample(2.0, 1000.0, 3e-6, 1000.0, HVFlag.ON))
    one(HVSample(2.1, 1000.0, 7e-6, 1000.0, HVFlag.ON | HVFlag.RAMPING))
    one(HVSample(2.2, 1000.0, 5e-6, 1000.0, HVFlag.ON))
    row = one.end(whole=True)
    assert row["leakage_A"] == pytest.approx(4e-6)
    assert row["electric_J"] == pytest.approx(1e3 * 0.1 * 0.5 * (9 + 3 + 3 + 7 + 7 + 5) * 1e-6)
    assert math.isnan(row["work_J"])


def test_between_cycles_nothing_is_counted_and_a_cycle_without_samples_has_no_numbers() -> None:
    one, recorder = loop(moves=True)
    recorder.displacement = 1e-3
    one(ForceSample(0.0, 1.0))
    one.begin(1)
    row = one.end(whole=True)
    one(ForceSample(0.1, 1.0))
    assert row["samples"] == 0
    assert all(math.isnan(float(value)) for name, value in row.items() if name.endswith(("_N", "_J", "_V", "_A", "_m")))


def test_a_force_is_put_where_the_disk_is_at_its_instant_and_no_further_than_a_period_on() -> None:
    line = _Line()
    assert math.isnan(line.at(0.0))
    line.add(1.0, 5.0)
    assert line.at(3.0) == 5.0
    line.add(1.5, 6.0)
    assert [line.at(t) for t in (1.25, 1.5, 1.75, 2.0, 9.0, 1.0, 0.0)] == [5.5, 6.0, 6.5, 7.0, 7.0, 5.0, 5.0]
    line.add(1.5, 8.0)  # a second one at the same instant has no rate
    assert line.at(2.0) == 8.0


def test_slope_and_ends_are_those_of_the_finite_values() -> None:
    rng = np.random.default_rng(1)
    x, y = rng.normal(1e3, 1.0, 50), rng.normal(-2.0, 1.0, 50)
    slope, ends = Slope(), Ends()
    for a, b in zip(x, y, strict=True):
        slope.add(float(a), float(b))
        slope.add(math.nan, 1.0)
        slope.add(1.0, math.inf)
        ends.add(float(b))
        ends.add(math.nan)
    assert slope.slope == pytest.approx(np.polyfit(x - 1e3, y, 1)[0], rel=1e-9)
    assert (ends.low, ends.high, ends.count) == (y.min(), y.max(), 50)
    few = Slope()
    for value in (1.0, 2.0):
        few.add(value, value)
        assert math.isnan(few.slope)  # two points are no slope
    few.add(3.0, 3.0)
    assert few.slope == 1.0
    level = Slope()
    for value in (1.0, 2.0, 3.0):
        level.add(4.0, value)
    assert math.isnan(level.slope)
