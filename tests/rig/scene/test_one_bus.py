"""Load cell and supply on one CAN bus, which the operating system shares; and when that is refused."""

from __future__ import annotations

from contextlib import closing
from importlib.resources import files
from pathlib import Path

import pytest

from drivers.instruments.cia404.device import CiA404
from drivers.instruments.iseg_edcp.device import IsegEDCP
from drivers.links.can_link import CanLink
from drivers.links.link import CanFrame, DeviceError
from drivers.roles import ForceSample, HVSample
from model.material.materials import NAMED
from model.specimen import Specimen
from rig.base.clock import RealClock
from rig.base.errors import ConfigError
from rig.base.toml_file import parse_table
from rig.scene.scene import Scene
from rig.sim.bench import SimulatedBench
from rig.sim.settings import SimulationSettings
from rig.sim.wire import FrameWire

FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"])
GROUP = "239.74.163.78"
SCENE = (Path(str(files("sim_fixtures"))) / "scenes" / "other-instruments.toml").read_text()


def on_one_bus(interface: str, bitrates: tuple[int, int] = (125_000, 125_000)) -> str:
    """The scene's load cell and an iseg supply, both named to be on one channel."""
    place = f'interface = "{interface}"\ncan_channel = "can0"\nbitrate = '
    changes = {
        'driver = "zaber"': 'driver = "zaber"\nport = "COM1"',
        'driver = "keyence-lkg"': 'driver = "keyence-lkg"\nport = "COM2"',
        'driver = "cia404"': f'driver = "cia404"\n{place}{bitrates[0]}',
        'driver = "shvps"': f'driver = "iseg-edcp"\n{place}{bitrates[1]}',
        "field_V_per_um = 80.0": "field_V_per_um = 80.0\ncurrent_uA = 50.0",
    }
    text = SCENE
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    return text


@pytest.mark.parametrize("interface", ["socketcan", "udp_multicast"])
def test_a_bus_that_the_system_shares_may_carry_both(interface: str) -> None:
    scene = parse_table(on_one_bus(interface), Scene, "scene", "test")
    assert scene.force.can_channel == scene.hv.can_channel == "can0"  # type: ignore[union-attr]


@pytest.mark.parametrize("interface", ["slcan", "pcan", "vector", "virtual"])
def test_an_adapter_that_one_program_owns_serves_one_instrument(interface: str) -> None:
    with pytest.raises(ConfigError, match=r"force and hv both name the CAN channel 'can0'.*guard.*socketcan"):
        parse_table(on_one_bus(interface), Scene, "scene", "test")


def test_one_bus_has_one_bit_rate() -> None:
    with pytest.raises(ConfigError, match="at 125000 and 250000 bit/s"):
        parse_table(on_one_bus("socketcan", (125_000, 250_000)), Scene, "scene", "test")


def test_load_cell_and_supply_work_beside_each_other_on_one_bus() -> None:
    settings = {"seed": 1, "force": {"driver": "cia404"}, "hv": {"voltage_noise_V": 0.0}}
    bench = SimulatedBench(SimulationSettings.model_validate(settings), FILM, {"force", "hv"})
    bench.prepare()
    wires = [bench.wire("force"), bench.wire("hv")]
    try:
        links = [CanLink(name, "udp_multicast", GROUP) for name in ("nodes", "force", "hv")]
    except DeviceError as error:
        pytest.skip(f"no multicast on this machine: {error}")
    with closing(links[0]) as nodes, closing(links[1]), closing(links[2]):
        # Patience with a busy machine: the time-outs are not what is tested here.
        force, hv = CiA404("force", links[1], node=5, timeout_s=5.0), IsegEDCP("hv", links[2], timeout_s=5.0)
        clock = RealClock()
        forces: list[ForceSample] = []
        outputs: list[HVSample] = []
        asked = False
        while clock.now() < 30.0 and not (asked and not hv.busy and len(outputs) > 5 and len(forces) > 50):
            now = clock.now()
            bench.advance(now)
            heard = nodes.read()
            for wire in wires:
                assert isinstance(wire, FrameWire)
                for frame in heard:
                    wire.host_write((frame.id, frame.data), now)
                for identifier, data in wire.host_read(now):
                    nodes.write(CanFrame(identifier, data))
            forces += force.poll(now)
            outputs += hv.poll(now)
            if hv.ready and not asked:
                hv.set_voltage(123.0)
                asked = True
            clock.sleep_until(now + 1e-3)
        assert len(forces) > 50 and len(outputs) > 5
        assert {sample.reading for sample in forces if sample.flags} == set()
        assert all(abs(sample.reading) < 0.1 for sample in forces)
        assert outputs[-1].setpoint == 123.0 and abs(outputs[-1].voltage) < 1.0
        # Each hears the other's frames, and takes none of them for its own.
        assert force.counters["foreign_frames"] > 20 and hv.counters["foreign_frames"] > 50
        for device in (force, hv):
            assert device.counters["bad_frames"] == 0
        assert hv.counters["foreign_requests"] == hv.counters["unexpected_frames"] == 0
