"""What force amplifier and shvps supply had before a run they have again after it, whatever ended it.

Asserted on the simulated instruments' own settings, in virtual time.
"""

from __future__ import annotations

from typing import Any

import pytest

from drivers.instruments.gsv8.device import GSV8
from drivers.instruments.shvps import Shvps
from drivers.roles import Device
from model.material.materials import NAMED
from model.specimen import Specimen
from rig.base.clock import VirtualClock
from rig.bench.memory_link import MemoryByteLink
from rig.sim.bench import SimulatedBench
from rig.sim.settings import SimulationSettings
from rig.sim.wire import ByteWire

FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"])


class Bench:
    """One simulated instrument, and as many drivers of it, one after the other, as are wanted."""

    def __init__(self, role: str, **truth: Any) -> None:
        settings = SimulationSettings.model_validate({"seed": 5, role: truth})
        self.role = role
        self.bench = SimulatedBench(settings, FILM, {role})
        self.clock = VirtualClock(self.bench.advance)
        self.twin: Any = self.bench.instruments[role]

    def connect(self, driver: Any, **options: Any) -> Any:
        wire = self.bench.wire(self.role)
        assert isinstance(wire, ByteWire)
        device = driver(self.role, MemoryByteLink(self.role, wire, self.clock), **options)
        self.run(device, 1.5)
        assert device.ready
        return device

    def run(self, device: Device, seconds: float) -> None:
        end = self.clock.now() + seconds
        while self.clock.now() < end:
            self.clock.sleep_until(min(end, max(device.next_poll, self.clock.now() + 1e-4)))
            device.poll(self.clock.now())

    @property
    def amplifier(self) -> tuple[int, float, bool]:
        """Type of the values, data rate, and whether it streams."""
        return self.twin._type, self.twin._rate, self.twin._transmitting


@pytest.mark.parametrize("streams", [True, False])
@pytest.mark.parametrize("confirmed", [True, False])
def test_the_amplifier_gets_back_rate_frame_type_and_stream(streams: bool, confirmed: bool) -> None:
    bench = Bench("force", driver="gsv8", stored_rate_Hz=25.0)
    bench.twin._type, bench.twin._transmitting = 2, streams
    before = bench.amplifier
    bench.clock.sleep_until(0.5)
    force = bench.connect(GSV8, rate_Hz=500.0, looks_first=True)
    assert bench.amplifier == (3, 500.0, True) and not force.given_back
    if confirmed:
        force.give_back()
        bench.run(force, 0.5)
        assert force.given_back and bench.amplifier == before
    force.close()
    bench.clock.sleep_until(bench.clock.now() + 0.1)
    assert bench.amplifier == before


def test_the_next_run_gives_back_what_a_killed_one_had_found_unless_it_was_set_since() -> None:
    bench = Bench("force", driver="gsv8", stored_rate_Hz=25.0)
    killed = bench.connect(GSV8, rate_Hz=500.0, looks_first=True)
    kept = dict(killed.found)  # and it is never heard of again
    force = bench.connect(GSV8, rate_Hz=500.0, looks_first=True)
    assert force.found["data_rate_Hz"] == 500.0
    assert force.resume_found(kept) == {"data_rate_Hz": (500.0, 25.0)}
    force.give_back()
    bench.run(force, 0.5)
    assert force.given_back and bench.twin._rate == 25.0
    bench.twin._rate = 50.0  # in the maker's software
    force = bench.connect(GSV8, rate_Hz=500.0, looks_first=True)
    assert force.resume_found(kept) == {}
    force.give_back()
    bench.run(force, 0.5)
    assert bench.twin._rate == 50.0


def test_an_amplifier_that_is_as_it_should_be_is_left_alone() -> None:
    bench = Bench("force", driver="gsv8", stored_rate_Hz=500.0)
    force = bench.connect(GSV8, rate_Hz=500.0, looks_first=True)
    assert force.given_back
    force.give_back()
    assert force.busy is False and bench.amplifier == (3, 500.0, True)


@pytest.mark.parametrize("ended", ["switch_off", "emergency_off"])
@pytest.mark.parametrize("by", ["itself", "another"])
def test_the_supply_gets_its_modes_back_and_stays_at_zero_volts(ended: str, by: str) -> None:
    bench = Bench("hv", driver="shvps", voltage_noise_V=0.0)
    modes: dict[str, int] = bench.twin._numbers
    modes |= {"VMode": 1, "SwSrc": 2}
    supply = bench.connect(Shvps, looks_first=True)
    assert (modes["VMode"], modes["SwSrc"]) == (1, 2)  # connecting changes nothing
    supply.set_ramp(1000.0)
    supply.set_voltage(800.0)
    supply.switch_on()
    bench.run(supply, 3.0)
    volts = float(bench.bench.world.output.at(bench.clock.now())[0])
    assert volts == pytest.approx(800.0, abs=10.0) and (modes["VMode"], modes["SwSrc"]) == (0, 0)
    found = dict(supply.found)
    if by == "another":  # a program that takes over where the first was killed
        supply = bench.connect(Shvps, ramp_V_per_s=1000.0)
        supply.resume_found(found)
    getattr(supply, ended)()
    bench.run(supply, 3.0)
    supply.give_back()
    bench.run(supply, 1.0)
    assert supply.given_back and (modes["VMode"], modes["SwSrc"]) == (1, 2)
    assert bench.twin._vset == 0 and float(bench.bench.world.output.at(bench.clock.now())[0]) < 60.0
