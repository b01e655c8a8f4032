"""Short calibrations on the simulated bench, with a hidden truth of the test's choice."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import pytest

from rig.analysis.sensors import Calibration, calibrate
from rig.protocol.experiment import prepare
from rig.run.run import run

FIXTURES = Path(str(files("sim_fixtures")))
SCENE = """
[specimen]
name = "cone-4mm"
disk_radius_mm = 4.0
ring_radius_mm = 20.0
thickness_um = 40.0
prestretch = 1.2
[specimen.material]
mu_Pa = [33e3, 32e3]
alpha = [2.0, 5.0]
eps_r = 1.9
breakdown_V_per_um = 80.0
[limits]
force_N = 0.9
displacement_mm = 14.0
speed_mm_per_s = 10.0
{voltage}
[stage]
driver = "zaber"
approach_from_mm = 10.0
[force]
driver = "gsv8"
rate_Hz = 100.0
certificate = "{calibrations}/force.toml"
"""
LASER = """
[displacement]
driver = "keyence-lkg"
certificate = "{calibrations}/displacement.toml"
"""
HV = """
[hv]
driver = "iseg-edcp"
ramp_V_per_s = 1200.0
certificate = "{calibrations}/hv.toml"
"""
STEPS = {
    "force": """
[[step]]
do = "zero"
duration_s = 0.2
[[step]]
do = "mount"
fixture = "none"
[[step]]
do = "weigh"
weights_g = [0, 30, 80]
weight_uncertainty_mg = 5.0
preloads = 0
settle_s = 0.1
average_s = 0.5
""",
    "displacement": """
[[step]]
do = "home"
[[step]]
do = "zero"
duration_s = 0.3
[[step]]
do = "mount"
fixture = "target"
[[step]]
do = "visit"
positions_mm = [10, 14.7, 18.6, 24]
speed_mm_per_s = 10
accuracy_um = 3.0
cycles = 1
settle_s = 0.1
average_s = 0.2
[[step]]
do = "glide"
from_mm = 14
to_mm = 18
speeds_mm_per_s = [4, 10]
""",
    "compliance": """
[[step]]
do = "home"
[[step]]
do = "zero"
duration_s = 0.2
[[step]]
do = "mount"
fixture = "dummy"
[[step]]
do = "press"
force_N = 0.5
speed_mm_per_s = 0.1
settle_s = 0.05
average_s = 0.15
""",
    "hv": """
[[step]]
do = "zero"
duration_s = 0.3
[[step]]
do = "mount"
fixture = "none"
[[step]]
do = "meter"
voltages_V = [0, 400, 800]
cycles = 1
settle_s = 0.2
average_s = 0.5
""",
}


@pytest.fixture(scope="session")
def steps():
    """Short protocols by quantity."""
    return STEPS


@pytest.fixture(scope="session")
def write_scene():
    """``write(folder, truth, laser=False, hv=False)``: a scene file; ``truth`` is its ``[simulation]`` table."""

    def write(folder: Path, truth: str, *, laser: bool = False, hv: bool = False) -> Path:
        voltage = "voltage_V = 1800.0\ncurrent_uA = 50.0" if hv else ""
        parts = SCENE + (LASER if laser else "") + (HV if hv else "")
        path = folder / "scene.toml"
        path.write_text(
            parts.format(calibrations=(FIXTURES / "calibrations").as_posix(), voltage=voltage)
            + f"[simulation]\ncontact_position_mm = 14.0\n{truth}"
        )
        return path

    return write


@pytest.fixture(scope="session")
def bench_calibration(tmp_path_factory, write_scene):
    """``make(quantity, truth)``: run the short calibration of ``quantity`` on a bench with that hidden truth."""

    def make(quantity: str, truth: str) -> Calibration:
        folder = tmp_path_factory.mktemp(quantity)
        scene = write_scene(folder, truth, laser=quantity == "displacement", hv=quantity == "hv")
        (folder / "steps.toml").write_text(STEPS[quantity])
        run(prepare(scene, folder / "steps.toml"), folder / "log.mcap", lambda *_: None)
        return calibrate(folder / "log.mcap", quantity)

    return make
