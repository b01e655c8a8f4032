"""Every fault switch of every simulated instrument, met by its driver as required.

The switches come from the instruments themselves (`InstrumentTruth.faults`); `REQUIRED` says for each what the driver
must do. For all of them: errors are of the drivers' own family; the times of samples rise and lie in the past; a sample
that the driver does not call bad has the value that the simulated hardware had at that time, unless the protocol cannot
show the damage (`BLIND`); and once the fault is over the driver measures rightly again.

Each instrument is alone on its bench, in virtual time and without noise: the stage moves, the sensors are at rest, the
supplies stand at 1000 V.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

from drivers.dialogue import LOST_AGAIN_S
from drivers.instruments.ascii_stream import AsciiForce
from drivers.instruments.cia404.device import CiA404
from drivers.instruments.gsv8.device import GSV8
from drivers.instruments.iseg_edcp.device import IsegEDCP
from drivers.instruments.keyence_lkg import KeyenceLKG
from drivers.instruments.labjack import PRESETS
from drivers.instruments.labjack.amplifier import LabJackAmplifier
from drivers.instruments.labjack.analog_input import AnalogDisplacement, AnalogForce, AnalogMonitor
from drivers.instruments.optoncdt import OptoNCDT
from drivers.instruments.scpi import ScpiMeter
from drivers.instruments.shvps import Shvps
from drivers.instruments.zaber.device import ZaberStage
from drivers.links.link import DeviceError, DeviceLost, DeviceRefused, DeviceSilent
from drivers.roles import (
    DisplacementSample,
    ForceSample,
    HVFlag,
    HVSample,
    HVSupply,
    MonitorSample,
    Sample,
    SampleFlag,
    StageSample,
)
from model.material.materials import NAMED
from model.specimen import Specimen
from rig.base.clock import VirtualClock
from rig.bench.memory_link import MemoryByteLink, MemoryFrameLink
from rig.sim.bench import SimulatedBench
from rig.sim.settings import SimulationSettings
from rig.sim.truth import Fault
from rig.sim.twins import registered
from rig.sim.wire import FrameWire

FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"])
VOLTS = 1000.0
FAULT_S, AFTER_S = 3.0, 4.0
MONITORS_FIRST = sorted(registered().twins.values(), key=lambda one: one.role != "monitor")
ROLE_OF = {one.driver: one.role for one in MONITORS_FIRST}  # of a driver with several roles the last
DRIVERS: dict[str, Callable[..., Any]] = {
    "zaber": ZaberStage,
    "gsv8": GSV8,
    "cia404": CiA404,
    "keyence-lkg": KeyenceLKG,
    "ascii-stream": AsciiForce,
    "optoncdt-1420": OptoNCDT,
    "iseg-edcp": IsegEDCP,
    "shvps": Shvps,
    "labjack-amplifier": LabJackAmplifier,
    "labjack-force": AnalogForce,
    "labjack-displacement": AnalogDisplacement,
    "labjack-monitor": AnalogMonitor,
    "scpi": ScpiMeter,
}
OPTIONS: dict[str, dict[str, Any]] = {
    "cia404": {"node": 5},
    "keyence-lkg": {"poll_rate_Hz": 50.0},
    "labjack-amplifier": {"amplifier": PRESETS["trek-610e"], "enable_line": 0},
    "labjack-force": {"newtons_per_V": 0.2},
    "labjack-displacement": {"mm_per_V": 4.0},
    "labjack-monitor": {"to_si": (1000.0, 0.0), "rate_Hz": 20.0},
    "scpi": {"to_si": (1000.0, 0.0), "rate_Hz": 20.0, "timeout_s": 0.25},
}
QUIET: dict[str, dict[str, Any]] = {
    "zaber": {"start_position_mm": 0.0, "referenced_at_start": True},
    "gsv8": {"noise_fraction": 0.0},
    "cia404": {"noise_fraction": 0.0},
    "keyence-lkg": {"noise_um": 0.0},
    "ascii-stream": {"noise_fraction": 0.0},
    "optoncdt-1420": {"noise_um": 0.0},
    "iseg-edcp": {"voltage_noise_V": 0.0, "current_noise_nA": 0.0},
    "shvps": {"voltage_noise_V": 0.0},
    "labjack-amplifier": {"input_noise_mV": 0.0},
    "labjack-force": {"input_noise_mV": 0.0, "noise_fraction": 0.0},
    "labjack-displacement": {"input_noise_mV": 0.0, "noise_um": 0.0},
    "labjack-monitor": {"input_noise_mV": 0.0, "noise": 0.0, "zero_offset": 40.0},
    "scpi": {"noise": 0.0, "zero_offset": 40.0},
}
TOLERANCE = {"stage": 1e-6, "force": 1e-6, "displacement": 1e-6, "hv": 1.5, "monitor": 1e-3}
ROUND_TRIP_S = 0.14  # half of the longest: by so much a sample's time may be off


@dataclass(frozen=True)
class Required:
    """What a driver must do.

    ``counters``: of each tuple at least one has risen at the end. ``error``: what it raises, and a word of it, within
    ``within_s``, and ``then`` perhaps another one; without one it raises nothing and goes on measuring. ``flag``: some
    sample bears it. ``keys``: more of the fault.
    """

    counters: tuple[tuple[str, ...], ...] = ()
    error: type[DeviceError] | None = None
    then: type[DeviceError] | None = None
    words: str = ""
    within_s: float = 2.0
    flag: SampleFlag | HVFlag | None = None
    keys: tuple[tuple[str, float], ...] = ()
    homed_again: bool = False


def now_and_then(probability: float, *counters: tuple[str, ...], value: float | None = None) -> Required:
    """A fault of single messages, which costs time and is counted."""
    keys = (("probability", probability),) + (() if value is None else (("value", value),))
    return Required(counters, keys=keys)


SILENT = Required(error=DeviceSilent, counters=(("unanswered",),))
STREAM_SILENT = Required(error=DeviceSilent, words="no valid", within_s=0.5, counters=(("lost_samples",),))
LOST = Required(error=DeviceLost, words="gone", within_s=0.1)
AS_IT_IS = Required()  # the driver cannot know: that nothing moves any more is for the engine to notice

REQUIRED: dict[tuple[str, str], Required] = {
    ("zaber", "delay"): now_and_then(0.05, ("unexpected_replies",), ("retries",), value=0.4),
    ("zaber", "drop"): now_and_then(0.1, ("retries",)),
    ("zaber", "split"): now_and_then(0.5),
    ("zaber", "merge"): now_and_then(0.1, ("retries",), ("unexpected_replies",)),
    ("zaber", "duplicate"): now_and_then(0.5, ("unexpected_replies",)),
    ("zaber", "corrupt"): now_and_then(0.1, ("bad_checksum", "bad_grammar", "without_checksum"), ("retries",)),
    ("zaber", "silent"): SILENT,
    ("zaber", "vanish"): LOST,
    ("zaber", "alert"): Required((("alerts",),), keys=(("value", 0.0), ("probability", 0.5))),
    ("zaber", "reset"): Required(error=DeviceRefused, words="lost its reference position", homed_again=True),
    ("zaber", "freeze"): AS_IT_IS,
    ("zaber", "wrong_status"): Required(error=DeviceRefused, words="FS: stalled and stopped", within_s=0.2),
    ("gsv8", "delay"): now_and_then(0.05, value=0.05),
    ("gsv8", "drop"): now_and_then(0.05, ("lost_samples",), ("gaps",)),
    ("gsv8", "split"): now_and_then(0.5),
    ("gsv8", "merge"): now_and_then(0.2),
    ("gsv8", "duplicate"): now_and_then(0.1, ("time_resyncs",)),
    ("gsv8", "corrupt"): now_and_then(0.5, ("bad_frames",), ("dropped_bytes",)),
    ("gsv8", "silent"): STREAM_SILENT,
    ("gsv8", "vanish"): LOST,
    ("gsv8", "reset"): Required(error=DeviceSilent, words="no valid value", within_s=0.5),
    ("gsv8", "saturate"): Required((("overloads",),), flag=SampleFlag.OVER_RANGE),
    ("gsv8", "freeze"): AS_IT_IS,
    ("gsv8", "wrong_status"): Required(flag=SampleFlag.SENSOR_ERROR),
    ("cia404", "delay"): now_and_then(0.05, value=0.05),
    ("cia404", "drop"): now_and_then(0.05, ("lost_samples",), ("gaps",)),
    ("cia404", "duplicate"): now_and_then(0.1, ("time_resyncs",)),
    ("cia404", "corrupt"): now_and_then(0.2, ("bad_values",)),
    ("cia404", "silent"): STREAM_SILENT,
    ("cia404", "vanish"): LOST,
    ("cia404", "alert"): Required((("emergencies",),), keys=(("value", 0.05),)),
    ("cia404", "reset"): Required(error=DeviceSilent, then=DeviceRefused, words="no valid value", within_s=0.5),
    ("cia404", "saturate"): Required((("overloads",),), flag=SampleFlag.OVER_RANGE),
    ("cia404", "freeze"): AS_IT_IS,
    ("cia404", "wrong_status"): Required(flag=SampleFlag.NO_VALUE),
    ("optoncdt-1420", "delay"): now_and_then(0.05, value=0.05),
    ("optoncdt-1420", "drop"): now_and_then(0.05, ("lost_samples",), ("gaps",)),
    ("optoncdt-1420", "split"): now_and_then(0.5),
    ("optoncdt-1420", "merge"): now_and_then(0.2),
    ("optoncdt-1420", "duplicate"): now_and_then(0.1, ("time_resyncs",)),
    ("optoncdt-1420", "corrupt"): now_and_then(0.2, ("dropped_bytes",)),
    ("optoncdt-1420", "silent"): STREAM_SILENT,
    ("optoncdt-1420", "vanish"): LOST,
    ("optoncdt-1420", "reset"): Required(error=DeviceSilent, words="no valid", within_s=0.5),
    ("optoncdt-1420", "saturate"): Required(flag=SampleFlag.OVER_RANGE),
    ("optoncdt-1420", "freeze"): AS_IT_IS,
    ("optoncdt-1420", "wrong_status"): Required((("error_words",),), flag=SampleFlag.NO_VALUE),
    ("optoncdt-1420", "no_value"): Required((("error_words",),), flag=SampleFlag.NO_VALUE),
    ("ascii-stream", "delay"): now_and_then(0.05, value=0.05),
    ("ascii-stream", "drop"): now_and_then(0.05),  # no line has a number
    ("ascii-stream", "split"): now_and_then(0.5),
    ("ascii-stream", "merge"): now_and_then(0.2),
    ("ascii-stream", "duplicate"): now_and_then(0.1),
    ("ascii-stream", "corrupt"): now_and_then(0.2, ("bad_grammar", "bad_values")),
    ("ascii-stream", "silent"): Required(error=DeviceSilent, words="no valid", within_s=0.5),
    ("ascii-stream", "vanish"): LOST,
    ("ascii-stream", "reset"): Required(error=DeviceSilent, words="no valid", within_s=0.5),
    ("ascii-stream", "saturate"): Required((("no_value",),), flag=SampleFlag.OVER_RANGE),
    ("ascii-stream", "freeze"): AS_IT_IS,
    ("ascii-stream", "wrong_status"): Required((("no_value",),), flag=SampleFlag.NO_VALUE),
    ("keyence-lkg", "delay"): now_and_then(0.05, ("unexpected_replies",), ("retries",), value=0.25),
    ("keyence-lkg", "drop"): now_and_then(0.1, ("retries",)),
    ("keyence-lkg", "split"): now_and_then(0.5),
    ("keyence-lkg", "merge"): now_and_then(0.1, ("retries",)),
    ("keyence-lkg", "duplicate"): now_and_then(0.5, ("unexpected_replies",)),
    ("keyence-lkg", "corrupt"): now_and_then(0.2, ("bad_grammar",), ("retries",)),
    ("keyence-lkg", "silent"): SILENT,
    ("keyence-lkg", "vanish"): LOST,
    ("keyence-lkg", "alert"): Required((("pushed",),), keys=(("value", 0.0), ("probability", 0.5))),
    ("keyence-lkg", "reset"): SILENT,
    ("keyence-lkg", "saturate"): Required(flag=SampleFlag.OVER_RANGE),
    ("keyence-lkg", "freeze"): AS_IT_IS,
    ("keyence-lkg", "wrong_status"): Required(error=DeviceRefused, words="refused to measure", within_s=0.2),
    ("keyence-lkg", "no_value"): Required(flag=SampleFlag.NO_VALUE),
    ("iseg-edcp", "delay"): now_and_then(0.05, ("unexpected_frames",), ("retries",), value=0.4),
    ("iseg-edcp", "drop"): now_and_then(0.1, ("retries",)),
    ("iseg-edcp", "duplicate"): now_and_then(0.5, ("unexpected_frames",)),
    ("iseg-edcp", "corrupt"): now_and_then(0.2, ("bad_frames", "bad_values"), ("retries",)),
    ("iseg-edcp", "silent"): SILENT,
    ("iseg-edcp", "vanish"): LOST,
    ("iseg-edcp", "alert"): Required((("log_ons",),), keys=(("value", 0.0), ("probability", 0.5))),
    ("iseg-edcp", "reset"): Required(error=DeviceSilent),
    ("iseg-edcp", "freeze"): AS_IT_IS,
    ("iseg-edcp", "wrong_status"): Required(flag=HVFlag.TRIPPED),
    ("iseg-edcp", "stuck_on"): AS_IT_IS,
    ("iseg-edcp", "breakdown"): Required(flag=HVFlag.CURRENT_LIMIT),
    ("iseg-edcp", "over_current"): Required(flag=HVFlag.CURRENT_LIMIT),
    ("iseg-edcp", "sag"): AS_IT_IS,
    ("iseg-edcp", "lies"): AS_IT_IS,  # only a second reading can tell
    ("iseg-edcp", "interlock"): Required(flag=HVFlag.INTERLOCK_OPEN),
    ("iseg-edcp", "inhibit"): Required(flag=HVFlag.INHIBITED),
    ("shvps", "delay"): now_and_then(0.05, ("unexpected_replies",), ("retries",), value=0.15),
    ("shvps", "drop"): now_and_then(0.05, ("retries",)),
    ("shvps", "split"): now_and_then(0.5),
    ("shvps", "merge"): now_and_then(0.05, ("retries",), ("unexpected_replies",)),
    ("shvps", "duplicate"): now_and_then(0.5, ("unexpected_replies",)),
    ("shvps", "corrupt"): now_and_then(0.05, ("bad_grammar",), ("retries",)),
    ("shvps", "silent"): SILENT,
    ("shvps", "vanish"): LOST,
    ("shvps", "reset"): Required(error=DeviceSilent),
    ("shvps", "freeze"): AS_IT_IS,
    ("shvps", "wrong_status"): AS_IT_IS,
    ("shvps", "stuck_on"): AS_IT_IS,
    ("shvps", "breakdown"): AS_IT_IS,
    ("shvps", "over_current"): AS_IT_IS,
    ("shvps", "sag"): AS_IT_IS,
    ("shvps", "lies"): AS_IT_IS,
    **{
        (driver, kind): required
        for driver in ("labjack-amplifier", "labjack-force", "labjack-displacement", "labjack-monitor")
        for kind, required in {
            "delay": now_and_then(0.05, ("unexpected_replies",), ("retries",), value=0.4),
            "split": now_and_then(0.5),
            "merge": now_and_then(0.05, ("retries",), ("unexpected_replies",)),
            "silent": SILENT,
            "vanish": LOST,
            "alert": Required((("unexpected_replies",),), keys=(("value", 0.0), ("probability", 0.5))),
            "reset": SILENT,
            "freeze": AS_IT_IS,
            "wrong_status": Required(error=DeviceRefused, words="refused: it failed", within_s=0.2),
        }.items()
    },
    ("labjack-force", "saturate"): Required((("over_range",),), flag=SampleFlag.OVER_RANGE),
    ("labjack-displacement", "saturate"): Required((("over_range",),), flag=SampleFlag.OVER_RANGE),
    ("labjack-amplifier", "saturate"): Required((("over_range",),), flag=HVFlag.TRIPPED),
    ("labjack-amplifier", "stuck_on"): AS_IT_IS,
    ("labjack-amplifier", "breakdown"): AS_IT_IS,
    ("labjack-amplifier", "over_current"): AS_IT_IS,
    ("labjack-amplifier", "sag"): AS_IT_IS,
    ("labjack-amplifier", "lies"): AS_IT_IS,
    ("labjack-monitor", "saturate"): Required((("over_range",),), flag=SampleFlag.OVER_RANGE),
    ("scpi", "delay"): now_and_then(0.05, ("synchronised",), value=0.4),
    ("scpi", "split"): now_and_then(0.5),
    ("scpi", "merge"): now_and_then(0.05, ("synchronised",)),
    ("scpi", "silent"): SILENT,
    ("scpi", "vanish"): LOST,
    ("scpi", "reset"): SILENT,
    ("scpi", "saturate"): Required((("no_value",),), flag=SampleFlag.OVER_RANGE),
    ("scpi", "freeze"): AS_IT_IS,
    ("scpi", "wrong_status"): Required((("no_value",),), flag=SampleFlag.NO_VALUE),
}
# Where the protocol cannot show it: a frozen value looks like any other, and without a checksum so does a changed
# digit or bit of a value. How large the part of wrong values may be while one message in five or twenty is damaged.
BLIND = {
    **dict.fromkeys((("iseg-edcp", "lies"), ("shvps", "lies"), ("labjack-amplifier", "lies")), 1.0),
    ("zaber", "freeze"): 1.0,
    ("iseg-edcp", "freeze"): 1.0,
    ("shvps", "freeze"): 1.0,
    ("labjack-amplifier", "freeze"): 1.0,
    ("labjack-amplifier", "saturate"): 1.0,  # told by the flag
    ("gsv8", "corrupt"): 0.1,
    ("cia404", "corrupt"): 0.15,
    ("keyence-lkg", "corrupt"): 0.15,
    ("ascii-stream", "corrupt"): 0.15,
    ("optoncdt-1420", "corrupt"): 0.2,
    ("iseg-edcp", "corrupt"): 0.35,
    ("shvps", "corrupt"): 0.1,
}
PLAUSIBLE = {
    "zaber": 0.2,
    "gsv8": 7.0,
    "cia404": 1e4,
    "keyence-lkg": 80e-3,
    "ascii-stream": 1e4,
    "optoncdt-1420": 51e-3,
    "iseg-edcp": 12e3,
    "shvps": 6e3,
    "labjack-amplifier": 22e3,
    "labjack-force": 2.2,
    "labjack-displacement": 44e-3,
    "labjack-monitor": 11e3,
    "scpi": 11e3,
}


def value_of(sample: Sample) -> float:
    match sample:
        case StageSample():
            return sample.position
        case ForceSample():
            return sample.reading
        case DisplacementSample():
            return sample.displacement
        case HVSample():
            return sample.voltage
        case MonitorSample():
            return sample.value


class Watched:
    """One instrument and its driver, polled; with the truth written down along the way."""

    def __init__(self, driver: str) -> None:
        self.role = ROLE_OF[driver]
        truth = {"driver": driver, **QUIET[driver]}
        settings = SimulationSettings.model_validate({"seed": 5, "rig_compliance_um_per_N": 0.0, self.role: truth})
        self.bench = SimulatedBench(settings, FILM, {self.role})
        self.clock = VirtualClock(self.bench.advance)
        wire = self.bench.wire(self.role)
        link = (
            MemoryFrameLink(driver, wire, self.clock)
            if isinstance(wire, FrameWire)
            else MemoryByteLink(driver, wire, self.clock)
        )
        self.device = DRIVERS[driver](driver, link, **OPTIONS.get(driver, {}))
        self.samples: list[Sample] = []
        self.errors: list[tuple[float, DeviceError]] = []
        self.truth: list[tuple[float, float]] = []
        self._steady = math.nan
        self.run(2.0)
        self.rate = len([sample for sample in self.samples if sample.t > self.t - 1.0])
        assert self.device.ready and not self.errors
        if self.role == "hv":
            supply: HVSupply = self.device
            supply.set_ramp(1200.0)
            supply.set_voltage(VOLTS)
            supply.switch_on()
            self.run(2.0)
        elif self.role != "stage":
            self._steady = value_of(self.samples[-1])
        assert not self.errors and len(self.samples) > 5

    @property
    def t(self) -> float:
        return self.clock.now()

    def true(self) -> float:
        """What the instrument would measure now if nothing were wrong with it."""
        world = self.bench.world
        if self.role == "stage":
            return float(world.stage.at(self.t)[0])
        return float(world.output.at(self.t)[0]) if self.role == "hv" else self._steady

    def run(self, seconds: float) -> None:
        end = self.t + seconds
        while self.t < end:
            self.clock.sleep_until(min(end, max(self.device.next_poll, self.t + 1e-4), self.t + 5e-3))
            self.truth.append((self.t, self.true()))
            if self.t >= self.device.next_poll:
                try:
                    self.samples += self.device.poll(self.t)
                except DeviceError as error:
                    self.errors.append((self.t, error))

    def is_right(self, sample: Sample) -> bool:
        near = [x for t, x in self.truth if abs(t - sample.t) <= ROUND_TRIP_S]
        slack = TOLERANCE[self.role]
        return min(near) - slack <= value_of(sample) <= max(near) + slack


CASES = list(dict.fromkeys((one.driver, kind) for one in registered().twins.values() for kind in one.truth.faults()))


@pytest.mark.parametrize(("driver", "kind"), CASES)
def test_every_switch_is_met_as_required(driver: str, kind: str) -> None:
    assert (driver, kind) in REQUIRED, "say what the driver must do"
    required = REQUIRED[driver, kind]
    watched = Watched(driver)
    device, begin = watched.device, watched.t
    counted = dict(device.counters)
    watched.samples.clear()
    watched.truth.clear()
    if watched.role == "stage":
        device.move_to(60e-3, 5e-3)
    keys = {"role": watched.role, "kind": kind, "at_s": begin, "duration_s": FAULT_S, **dict(required.keys)}
    watched.bench.inject(Fault.model_validate(keys))
    watched.run(FAULT_S)

    # What it says.
    if required.error is None:
        assert not watched.errors, watched.errors[:3]
        assert len(watched.samples) > 0.2 * FAULT_S * watched.rate
    else:
        first, error = watched.errors[0]
        assert {type(one) for _, one in watched.errors} == {required.error, required.then} - {None}
        assert type(error) is required.error
        assert required.words in str(error) and (error.advice or kind == "vanish")
        assert first - begin <= required.within_s
        assert len(watched.errors) <= 1 + 50 * FAULT_S  # told, not repeated at every turn of the loop
    bad = [sample for sample in watched.samples if getattr(sample, "flags", None) and watched.role != "hv"]
    if required.flag is not None:
        assert any(required.flag in sample.flags for sample in watched.samples)  # type: ignore[union-attr]
        assert bad or watched.role == "hv"
    else:
        limit = 0.2 if kind == "corrupt" else 0.0
        assert len(bad) <= limit * len(watched.samples)

    # What it measures.
    good = [sample for sample in watched.samples if sample not in bad]
    assert all(abs(value_of(sample)) <= PLAUSIBLE[driver] for sample in good)
    wrong = [sample for sample in good if not watched.is_right(sample)]
    assert len(wrong) <= BLIND.get((driver, kind), 0.0) * len(good), wrong[:3]
    assert all(a.t < b.t for a, b in itertools.pairwise(watched.samples))
    assert all(sample.t <= watched.t for sample in watched.samples)

    # Afterwards it measures rightly again.
    watched.run(AFTER_S)
    if required.homed_again:
        assert not watched.samples[-1].referenced  # type: ignore[union-attr]
        device.home()
        watched.run(AFTER_S)
        assert watched.samples[-1].referenced  # type: ignore[union-attr]
    watched.errors.clear()
    watched.samples.clear()
    watched.run(1.0)
    assert not watched.errors and len(watched.samples) >= 9
    assert all(watched.is_right(sample) for sample in watched.samples)
    if watched.role != "hv":
        assert not any(getattr(sample, "flags", None) for sample in watched.samples)

    # And all of it is counted.
    for several in required.counters:
        assert any(device.counters[counter] > counted[counter] for counter in several), (several, device.counters)


def test_what_is_required_is_required_of_switches_that_there_are() -> None:
    assert set(REQUIRED) == set(CASES) and set(BLIND) <= set(CASES)


ROUND_TRIPS = {"round_trips", "round_trip_sum_us", "round_trip_max_us"}  # what a counter counts that is no trouble


@pytest.mark.parametrize("driver", DRIVERS)
def test_on_a_clean_line_no_trouble_is_counted(driver: str) -> None:
    watched = Watched(driver)
    before = dict(watched.device.counters)
    watched.run(3.0)
    rose = {key for key, count in watched.device.counters.items() if count != before.get(key, 0)}
    assert rose <= ROUND_TRIPS


@pytest.mark.parametrize("driver", DRIVERS)
def test_a_lost_port_is_looked_for_again_at_intervals(driver: str) -> None:
    watched = Watched(driver)
    watched.bench.inject(Fault.model_validate({"role": watched.role, "kind": "vanish", "duration_s": 60.0}))
    with pytest.raises(DeviceLost):
        while True:
            watched.clock.sleep_until(watched.t + 0.005)
            watched.device.poll(watched.t)
    assert watched.device.next_poll == pytest.approx(watched.t + LOST_AGAIN_S)
