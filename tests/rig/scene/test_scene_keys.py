"""What a scene says of an instrument reaches its driver, and its driver's arithmetic."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from importlib.resources import files
from inspect import Parameter, signature
from pathlib import Path
from typing import Any

import pytest

from drivers.instrument import Instrument
from drivers.links.link import DeviceRefused
from drivers.registry import registered
from drivers.roles import Sample
from rig.base.toml_file import parse_table
from rig.bench.bench import Bench
from rig.run.backend import open_bench
from rig.scene.scene import Scene

SCENES = Path(str(files("sim_fixtures"))) / "scenes"
NEEDED: dict[str, dict[str, Any]] = {
    "labjack-amplifier": {"preset": "trek-610e"},
    "labjack-force": {"newtons_per_V": 1.0},
    "labjack-displacement": {"mm_per_V": 1.0},
}
MONITOR = {"quantity": "voltage"}
NOT_IN_A_SCENE = {"poll_interval_s", "settle_s"}  # how the driver works, no fact of the instrument


@pytest.mark.parametrize("one", registered().instruments.values(), ids=lambda one: one.driver)
def test_every_argument_of_a_driver_is_a_key_of_the_scene(one: Instrument) -> None:
    driver, table = one.device, one.settings
    named = {name for name, key in signature(driver).parameters.items() if key.kind is Parameter.KEYWORD_ONLY}
    assert all(hasattr(table, name) or name in table.model_fields for name in named - NOT_IN_A_SCENE)
    needed = MONITOR if one.role == "monitor" else NEEDED.get(one.driver, {})
    given = table.model_validate({"driver": one.driver, "certificate": "c.toml", **needed})
    assert set(one.arguments(given)) == named - NOT_IN_A_SCENE
    # What holds when a scene does not say otherwise is the same as in the driver: one place could not be found.
    # A driver alone waits for no boot; the usual unit of the ASCII stream is the first of its role.
    elsewhere = {"poll_rate_Hz", "timeout_s", "ramp_V_per_s", "boot_s", "unit"}
    for name in (named & set(table.model_fields)) - elsewhere:
        if table.model_fields[name].is_required():
            continue
        assert table.model_fields[name].default == signature(driver).parameters[name].default, name


@contextmanager
def ready(*changes: tuple[str, str], scene: str = "cone-4mm") -> Iterator[tuple[Bench, dict[str, list[Sample]]]]:
    """The bench of a scene with other keys, set up and polled for a while."""
    text = (SCENES / f"{scene}.toml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    with closing(open_bench(parse_table(text, Scene, "scene", "test"))) as bench:
        bench.attach(lambda *told: None)
        samples: dict[str, list[Sample]] = {role: [] for role in bench.devices}
        while bench.clock.now() < 2.0:
            for role, device in bench.devices.items():
                samples[role] += device.poll(bench.clock.now())
            bench.clock.sleep_until(bench.clock.now() + 2e-3)
        assert all(device.ready for device in bench.devices.values())
        yield bench, samples


def test_a_screw_of_another_pitch() -> None:
    with ready() as (plain, _), ready(('driver = "zaber"', 'driver = "zaber"\nfull_step_um = 63.5')) as (other, _):
        assert other.stage.travel[1] == pytest.approx(2 * plain.stage.travel[1])


@pytest.mark.parametrize("frame_type", ["int16", "int24"])
def test_the_load_cell_in_integers(frame_type: str) -> None:
    with ready(("rate_Hz = 100.0", f'rate_Hz = 100.0\nframe_type = "{frame_type}"')) as (bench, samples):
        assert bench.devices["force"].settings["frame_type"] == frame_type
        readings = [sample.reading for sample in samples["force"]]  # type: ignore[union-attr]
        assert sum(readings) / len(readings) == pytest.approx(0.013, abs=0.005)  # the cell's zero offset in mV/V


def test_a_load_cell_whose_range_and_scale_are_stated() -> None:
    stated = (
        "rate_Hz = 100.0",
        'rate_Hz = 100.0\nframe_type = "int24"\nint_full_scale = 1.0\ninput_range_mV_per_V = 7.0',
    )
    with ready(stated) as (_, samples):
        readings = [sample.reading for sample in samples["force"]]  # type: ignore[union-attr]
        assert sum(readings) / len(readings) == pytest.approx(0.013 * 2 / 1.05, abs=0.01)
    with ready(("rate_Hz = 100.0", 'rate_Hz = 100.0\nuser_scale_of = "mV/V"')) as (bench, _):
        gain = float(bench.devices["force"].settings["mV_per_V_per_unit"])
        assert gain == pytest.approx(1 / 3.5)  # the simulated amplifier's user scale


def test_a_laser_whose_display_shows_micrometres() -> None:
    more = ('driver = "keyence-lkg"', 'driver = "keyence-lkg"\nunit_mm = 0.001')
    with ready(more) as (_, samples):
        assert samples["displacement"][-1].displacement == pytest.approx(1.25e-6, rel=0.01)  # type: ignore[union-attr]


def test_a_laser_that_shows_more_than_it_can_is_not_believed() -> None:
    text = ('driver = "keyence-lkg"', 'driver = "keyence-lkg"\nlimit_mm = 1.0')
    with pytest.raises(Exception, match="no answer"), ready(text):
        pass


def test_a_supply_that_ramps_more_slowly() -> None:
    slow = ('driver = "iseg-edcp"', 'driver = "iseg-edcp"\nmax_ramp_percent_per_s = 2.0')
    with ready(slow) as (bench, _):
        assert bench.hv is not None
        with pytest.raises(DeviceRefused, match="120"):
            bench.hv.set_ramp(300.0)


def test_a_can_load_cell_beyond_its_limit_has_no_value() -> None:
    small = ("limit_N = 5.0", "limit_N = 1e-9")
    with ready(small, scene="other-instruments") as (bench, samples):
        assert bench.devices["force"].counters["bad_values"] == len(samples["force"]) > 50
        assert all(sample.flags for sample in samples["force"])  # type: ignore[union-attr]
