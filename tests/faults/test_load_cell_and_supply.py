"""Load-cell and HV drivers on simulated instruments when things go wrong: more than the matrix of switches says.

The instruments move in virtual time. The film is slack and the load cell's noise is off, so that its true reading is
one number; the supply is on at 1000 V.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from drivers.instruments.gsv8.device import GSV8
from drivers.instruments.iseg_edcp.device import IsegEDCP
from drivers.links.link import DeviceError, DeviceSilent
from drivers.roles import ForceSample, HVFlag, HVSample, SampleFlag
from model.material.materials import NAMED
from model.specimen import Specimen
from rig.base.clock import VirtualClock
from rig.bench.memory_link import MemoryByteLink, MemoryFrameLink
from rig.operator.control import Control
from rig.sim.bench import SimulatedBench
from rig.sim.instruments.gsv8 import GSV8Truth
from rig.sim.instruments.iseg import IsegTruth
from rig.sim.instruments.iseg.words import DISABLED, OFF_AT_ONCE
from rig.sim.settings import SimulationSettings
from rig.sim.truth import Fault
from rig.sim.wire import ByteWire, FrameWire

SPECIMEN = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"])
TRUE_READING = 0.013  # mV/V: the simulated cell's zero offset
VOLTS = 1000.0


class Rig:
    """Load cell and supply, set up; errors are kept with their time."""

    def __init__(self, *, on: bool, channels: int = 1) -> None:
        settings = SimulationSettings(
            seed=1,
            force=GSV8Truth(noise_fraction=0.0, zero_offset_mV_per_V=TRUE_READING, stored_rate_Hz=100.0),
            hv=IsegTruth(channels=channels),
        )
        self.bench = SimulatedBench(settings, SPECIMEN, {"force", "hv"})
        self.clock = VirtualClock(self.bench.advance)
        line, bus = self.bench.wire("force"), self.bench.wire("hv")
        assert isinstance(line, ByteWire) and isinstance(bus, FrameWire)
        self.force = GSV8("force", MemoryByteLink("force", line, self.clock))
        self.hv = IsegEDCP("hv", MemoryFrameLink("hv", bus, self.clock))
        self.errors: list[tuple[float, DeviceError]] = []
        self.forces: list[ForceSample] = []
        self.outputs: list[HVSample] = []
        self.run(0.5)
        assert self.force.ready and self.hv.ready
        if on:
            self.hv.set_ramp(1200.0)
            self.hv.set_current_limit(1e-4)
            self.hv.set_voltage(VOLTS)
            self.hv.switch_on()
            self.run(2.0)
            assert self.outputs[-1].voltage == pytest.approx(VOLTS, abs=3)
        assert not self.errors
        self.forces.clear()
        self.outputs.clear()

    @property
    def t(self) -> float:
        return self.clock.now()

    def inject(self, role: str, kind: str, **keys: object) -> None:
        self.bench.inject(Fault.model_validate({"role": role, "kind": kind, "at_s": self.t} | keys))

    def run(self, seconds: float) -> None:
        end = self.t + seconds
        while self.t < end:
            due = min(self.force.next_poll, self.hv.next_poll)
            self.clock.sleep_until(min(end, max(due, self.t + 1e-5)))
            for device, samples in ((self.force, self.forces), (self.hv, self.outputs)):
                if self.t < device.next_poll:  # type: ignore[attr-defined]
                    continue
                try:
                    samples += device.poll(self.t)  # type: ignore[operator]
                except DeviceError as error:
                    self.errors.append((self.t, error))

    def settle(self, seconds: float = 3.0) -> None:
        end = self.t + seconds
        while self.hv.busy and self.t < end:
            self.run(0.01)
        assert not self.hv.busy


@pytest.fixture
def rig() -> Rig:
    return Rig(on=False)


@pytest.fixture
def live() -> Rig:
    return Rig(on=True)


def kinds(errors: Sequence[tuple[float, DeviceError]]) -> set[type[DeviceError]]:
    return {type(error) for _, error in errors}


# The load cell's wire -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "value"), [("delay", 0.05), ("split", None), ("merge", None), ("drop", None), ("duplicate", None)]
)
def test_bad_wire_from_the_load_cell(rig: Rig, kind: str, value: float | None) -> None:
    """Readings are right, times increase and stay below the present; what is missing is counted."""
    rig.inject("force", kind, probability=0.05, value=value, duration_s=3.0)
    rig.run(4.0)
    assert not rig.errors
    assert {round(s.reading, 6) for s in rig.forces} == {TRUE_READING}
    assert not any(s.flags for s in rig.forces)
    assert all(b.t > a.t for a, b in itertools.pairwise(rig.forces))
    assert rig.forces[-1].t <= rig.t
    lost = rig.force.counters["lost_samples"]
    if kind == "drop":
        assert 400 - len(rig.forces) == pytest.approx(lost, abs=1)
        assert lost > 5
    elif kind == "duplicate":  # no counter in the frame: a double cannot be told from a sample
        assert len(rig.forces) > 400
    else:
        assert lost == 0
        assert len(rig.forces) == pytest.approx(400, abs=1)


def test_corrupt_bytes_from_the_load_cell(rig: Rig) -> None:
    """There is no checksum: a bit in the value may change unseen. All else is dropped or shows as a flag."""
    rig.inject("force", "corrupt", probability=0.5)
    rig.run(20.0)
    right = [round(s.reading, 6) == TRUE_READING for s in rig.forces]
    assert sum(right) > 0.92 * len(right)  # 1 of 2 frames, 4 of 36 bytes
    assert all(abs(s.reading) <= 2 * 3.5 for s in rig.forces if not s.flags)
    assert rig.force.counters["bad_frames"] > 10
    assert rig.force.counters["dropped_bytes"] > 100
    assert not rig.errors


@pytest.mark.parametrize(("kind", "value"), [("delay", 0.1), ("delay", 0.4), ("drop", None), ("duplicate", None)])
def test_bad_wire_to_the_load_cell(rig: Rig, kind: str, value: float | None) -> None:
    """The tare gets there; its answer is given to it alone, and the stream is not disturbed."""
    rig.inject("force", kind, probability=0.2, value=value, direction="to_device")
    for _ in range(10):
        rig.force.set_zero()
        rig.run(1.5)
        if rig.errors:  # three times lost is told
            assert kinds(rig.errors) == {DeviceSilent}
            rig.errors.clear()
    assert {round(s.reading, 6) for s in rig.forces} <= {TRUE_READING, 0.0, -0.0}
    assert rig.forces[-1].reading == pytest.approx(0.0, abs=1e-6)
    assert rig.force.counters["lost_samples"] == 0


# The load cell itself -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_saturated_load_cell_says_so_on_every_sample(rig: Rig, sign: float) -> None:
    rig.inject("force", "saturate", value=sign, duration_s=1.0)
    rig.run(1.0)
    flagged = rig.forces[2:-2]
    assert len(flagged) > 90
    assert all(s.flags == SampleFlag.OVER_RANGE and s.reading * sign > 3.0 for s in flagged)
    rig.forces.clear()
    rig.run(0.3)
    assert not any(s.flags for s in rig.forces[2:])


# The supply's bus -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", ["from_device", "to_device"])
@pytest.mark.parametrize(("kind", "value"), [("delay", 0.05), ("delay", 0.4), ("drop", None), ("duplicate", None)])
def test_bad_bus_costs_time_but_never_truth(live: Rig, kind: str, value: float | None, direction: str) -> None:
    live.inject("hv", kind, probability=0.05, value=value, direction=direction)
    live.run(3.0)
    live.hv.set_voltage(500.0)
    live.settle()
    at = live.t
    live.run(3.0)
    assert not live.errors or kinds(live.errors) == {DeviceSilent}
    assert {s.flags & ~HVFlag.RAMPING for s in live.outputs} == {HVFlag.ON}
    assert all(s.voltage == pytest.approx(VOLTS, abs=3) for s in live.outputs if s.t < at - 0.6)
    assert live.outputs[-1].setpoint == 500.0
    assert live.outputs[-1].voltage == pytest.approx(500.0, abs=3)
    if not (kind == "delay" and value == 0.05):
        assert live.hv.counters["retries"] + live.hv.counters["unexpected_frames"] > 0


@pytest.mark.parametrize("chance", [0.1, 0.5, 0.9])
def test_emergency_off_gets_through_a_bus_that_loses_frames_or_is_said_not_to(live: Rig, chance: float) -> None:
    live.inject("hv", "drop", probability=chance, direction="both")
    live.hv.emergency_off()
    live.run(5.0)
    assert not live.hv.busy
    unconfirmed = any("EMERGENCY OFF IS NOT CONFIRMED" in str(error) for _, error in live.errors)
    assert unconfirmed or float(live.bench.world.voltage(np.array([live.t]))[0]) < 1.0


# The module itself ----------------------------------------------------------------------------------------------------


def test_module_that_restarts_is_registered_again_and_left_off(live: Rig) -> None:
    live.inject("hv", "reset")
    live.run(15.0)
    assert live.hv.counters["log_ons"] >= 1
    assert live.outputs[-1].flags == HVFlag(0)
    assert live.outputs[-1].setpoint == 0.0
    assert float(live.hv.settings["current_limit_A"]) == pytest.approx(1e-3)  # what was set is gone, and it shows


@pytest.mark.parametrize(
    ("kind", "value", "flag"),
    [
        ("interlock", None, HVFlag.INTERLOCK_OPEN),
        ("inhibit", None, HVFlag.INHIBITED),
        ("over_current", 2e-4, HVFlag.CURRENT_LIMIT),
        ("breakdown", None, HVFlag.CURRENT_LIMIT),
        ("wrong_status", float(1 << 13), HVFlag.TRIPPED),
    ],
)
def test_what_the_module_reports_shows_in_the_next_samples(
    live: Rig, kind: str, value: float | None, flag: HVFlag
) -> None:
    live.inject("hv", kind, value=value)
    live.run(0.5)
    assert flag in live.outputs[-1].flags
    assert not live.errors


def test_an_event_stays_latched_until_cleared(live: Rig) -> None:
    live.inject("hv", "inhibit", duration_s=0.5)
    live.run(1.5)
    assert HVFlag.INHIBITED in live.outputs[-1].flags
    live.hv.switch_on()
    live.run(0.2)
    assert "EXTERNAL_INHIBIT is latched" in str(live.errors[-1][1])
    live.hv.clear()
    live.settle()
    live.run(0.3)
    assert live.outputs[-1].flags == HVFlag(0)


def test_output_that_cannot_be_switched_off_goes_on_being_measured(live: Rig) -> None:
    """Control and status say off; the voltage that is there says otherwise, and is what the guard looks at."""
    live.inject("hv", "stuck_on")
    live.hv.emergency_off()
    live.settle()
    live.run(0.5)
    assert HVFlag.EMERGENCY_OFF in live.outputs[-1].flags
    assert live.outputs[-1].voltage == pytest.approx(VOLTS, abs=5)


@pytest.mark.parametrize("channels", [1, 2])
def test_armed_the_supply_trips_by_itself_with_nobody_there_to_see_it(channels: int) -> None:
    """Both processes stopped: from the breakdown on nobody polls, and the output goes all the same."""
    live = Rig(on=True, channels=channels)
    live.hv.arm_trip(50.0, 1e-4)
    live.settle()
    live.inject("hv", "breakdown")
    at = live.t
    live.clock.sleep_until(at + 0.2)
    assert float(live.bench.world.output.at(live.t)[0]) == 0.0
    live.run(0.3)
    assert HVFlag.TRIPPED in live.outputs[-1].flags and HVFlag.ON not in live.outputs[-1].flags


def test_unarmed_it_does_not() -> None:
    live = Rig(on=True)
    live.inject("hv", "breakdown")
    live.clock.sleep_until(live.t + 0.2)
    assert live.bench.world.output.at(live.t)[0] != 0.0


@pytest.mark.parametrize("asked", ["stop", "fault"])
def test_a_run_arms_the_supplys_own_trip_and_gives_everything_back(tell: Callable[..., Any], asked: str) -> None:
    armed: list[tuple[Any, ...]] = []

    def settings(bench: SimulatedBench) -> tuple[Any, ...]:
        twin: Any = bench.instruments["hv"]
        one = twin._channels[0]
        own = (one.current_limit, one.v_bounds, one.i_bounds, one.trip_delay_ms, one.trip_action)
        return (twin._ramp_percent, twin._kill, *own)

    def mischief(bench: SimulatedBench, control: Control) -> None:
        armed.append(settings(bench))
        if asked == "stop":
            control.ask("a test")
        else:
            bench.inject(Fault(role="hv", kind="interlock", at_s=bench.now))

    story = tell(mischief)
    percent, kill, current, *bounds_and_trip = armed[0]
    assert percent == pytest.approx(100 / 12) and kill  # 500 V/s of 6 kV
    assert current == pytest.approx(5e-5)  # the scene's
    assert bounds_and_trip == pytest.approx([90.0, 5e-5, 20, OFF_AT_ONCE])
    assert story.outcome.safe and abs(story.final_output) < 60
    assert settings(story.bench) == pytest.approx((10.0, False, 1e-3, 0.0, 0.0, 0, DISABLED))
