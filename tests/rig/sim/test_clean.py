"""With nothing wrong on the wire no driver counts anything wrong: counters appear only when they should."""

from __future__ import annotations

from typing import Any

import pytest

from drivers.registry import registered
from model.material.materials import NAMED
from model.specimen import Specimen
from rig.base.clock import VirtualClock
from rig.bench.memory_link import MemoryByteLink, MemoryFrameLink
from rig.sim.bench import SimulatedBench
from rig.sim.settings import SimulationSettings
from rig.sim.twins import registered as twins
from rig.sim.wire import FrameWire

FILM = Specimen(
    disk_radius=10e-3, ring_radius=25e-3, thickness=0.5e-3, prestretch=1.2, material=next(iter(NAMED.values()))
)
# What is counted of a dialogue that goes well.
GOES_WELL = {"round_trips", "round_trip_sum_us", "round_trip_max_us", "log_ons", "alerts", "infos"}
# The driver throws away what was in the line before it began; the amplifier has been streaming by then.
AT_START = {"gsv8": {"dropped_bytes", "ignored_frames"}}
MORE_KEYS: dict[str, dict[str, Any]] = {
    "cia404": {"node": 5},
    "labjack-amplifier": {"preset": "trek-610e"},
    "labjack-force": {"newtons_per_V": 1.0},
    "labjack-displacement": {"mm_per_V": 1.0},
    **{key: {"quantity": "voltage", "rate_Hz": 10.0} for key in ("scpi", "labjack-monitor")},
}


@pytest.mark.parametrize("driver", [one.driver for one in twins().twins.values()])
def test_nothing_is_counted_wrong_on_clean_data(driver: str) -> None:
    role = next(one.role for one in twins().twins.values() if one.driver == driver)
    truth = SimulationSettings.model_validate({"seed": 1, role: {"driver": driver}})
    bench = SimulatedBench(truth, FILM, {role})
    clock, wire = VirtualClock(bench.advance), bench.wire(role)
    link: Any = MemoryFrameLink(role, wire, clock) if isinstance(wire, FrameWire) else MemoryByteLink(role, wire, clock)
    instrument = registered().instruments[role, driver]
    keys: dict[str, Any] = {"driver": driver, "certificate": "c.toml"}
    keys |= MORE_KEYS.get(driver, {})
    device = instrument.make(role, link, instrument.settings.model_validate(keys))
    samples: list[Any] = []
    while clock.now() < 20.0:
        samples += device.poll(clock.now())
        clock.sleep_until(max(clock.now() + 1e-3, min(device.next_poll, clock.now() + 5e-3)))
    assert device.ready and len(samples) > 100
    wrong = {key: n for key, n in device.counters.items() if n and key not in GOES_WELL | AT_START.get(driver, set())}
    assert not wrong
