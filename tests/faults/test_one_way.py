"""A port that gives nothing any more, but takes: the off goes out all the same. Asserted on the simulated output."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import pytest

from drivers.instruments.iseg_edcp.device import IsegEDCP
from drivers.instruments.shvps import Shvps
from drivers.links.link import DeviceError, DeviceLost
from model.material.materials import NAMED
from model.specimen import Specimen
from rig.base.clock import VirtualClock
from rig.bench.memory_link import MemoryByteLink, MemoryFrameLink
from rig.sim.bench import SimulatedBench
from rig.sim.settings import SimulationSettings

FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"])


@pytest.mark.parametrize(
    ("name", "driver", "kind"),
    [("iseg-edcp", IsegEDCP, MemoryFrameLink), ("shvps", Shvps, MemoryByteLink)],
    ids=["iseg-edcp", "shvps"],
)
def test_the_off_goes_out_on_a_line_that_cannot_be_read(
    name: str, driver: Any, kind: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = SimulatedBench(SimulationSettings.model_validate({"seed": 5, "hv": {"driver": name}}), FILM, {"hv"})
    clock = VirtualClock(bench.advance)
    link = kind("hv", bench.wire("hv"), clock)
    supply = driver("hv", link)

    def run(seconds: float) -> None:
        end = clock.now() + seconds
        while clock.now() < end:
            clock.sleep_until(min(end, max(supply.next_poll, clock.now() + 1e-3)))
            with suppress(DeviceError):
                supply.poll(clock.now())

    def unreadable() -> Any:
        raise DeviceLost("hv", "the port is gone (reading: EIO)", "")

    run(1.5)
    supply.set_ramp(1000.0)
    supply.set_voltage(800.0)
    supply.switch_on()
    run(3.0)
    assert bench.world.output.at(clock.now())[0] == pytest.approx(800.0, abs=10.0)
    monkeypatch.setattr(link, "read", unreadable)
    supply.emergency_off()
    run(0.3)
    assert bench.world.output.at(clock.now())[0] < 60.0
