"""Where the stage stands for the displacement: what is not known of the rig is fitted along, nothing else is blamed."""

import re
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from rig.analysis.film import UNKNOWN_LAG, identify_logs
from rig.protocol.experiment import prepare
from rig.run.run import run

FIXTURES = Path(str(files("sim_fixtures")))
PROTOCOL = """title = "Up and down"
[[step]]
do = "home"
[[step]]
do = "zero"
duration_s = 1.0
[[step]]
do = "approach"
speed_mm_per_s = 0.5
threshold_mN = 10.0
max_travel_mm = 10.0
[[step]]
do = "sweep"
displacement_mm = 8.0
speed_mm_per_s = 4.0
voltages_V = [0, 1000]
settle_s = 0.5
[[step]]
do = "return"
speed_mm_per_s = 2.0
"""


@pytest.mark.slow
def test_sensors_without_certificate_are_told_and_a_laser_still_measures_the_disk(tmp_path: Path) -> None:
    text = (FIXTURES / "scenes" / "cone-4mm.toml").read_text(encoding="utf-8")
    text = text.replace("../calibrations", (FIXTURES / "calibrations").as_posix())
    protocol, scene, out = (tmp_path / name for name in ("protocol.toml", "scene.toml", "out.mcap"))
    protocol.write_text(PROTOCOL, encoding="utf-8")
    text, count = re.subn(r"certificate = .*(displacement|hv).toml.*\n", "", text)
    assert count == 2
    scene.write_text(text, encoding="utf-8")
    run(prepare(scene, protocol), out, lambda done, total, label: None)
    found = identify_logs([out], terms=1)
    assert not any("compliance" in name for name in found.identification.nuisance)
    for note, device in zip(found.notes, ("displacement", "hv"), strict=True):
        assert "has no certificate" in note
        assert f"dea-rig calibrate {device}" in note
    (certified,) = (FIXTURES / "logs" / "paper").glob("*.mcap")
    assert identify_logs([certified], terms=1).notes == []


@pytest.mark.slow
@pytest.mark.parametrize("runs", [2, pytest.param(12, marks=[pytest.mark.long, pytest.mark.timeout(900)])])
def test_a_right_film_is_not_called_viscous(tmp_path: Path, runs: int) -> None:
    """Frames of the force, requests and replies of the stage take their time on the wire, which differs by some
    milliseconds; at 4 mm/s that made a loop of a tenth of the noise, which looked like a film of negative viscosity.
    """
    log = FIXTURES / "logs" / "no-laser"
    text = (log / "scene.toml").read_text(encoding="utf-8")
    for old, new in (("../force.toml", log.parent / "force.toml"), ("../../calibrations", FIXTURES / "calibrations")):
        assert old in text
        text = text.replace(old, new.as_posix())
    protocol = tmp_path / "protocol.toml"
    once_more = (log / "protocol.toml").read_text(encoding="utf-8").replace("[0, 1000]", "[0, 1000, 0]")
    assert "[0, 1000, 0]" in once_more
    protocol.write_text(once_more, encoding="utf-8")
    branches: dict[str, list[float]] = {}
    alarms = 0
    for seed in range(runs):
        scene, out = tmp_path / f"{seed}.toml", tmp_path / f"{seed}.mcap"
        scene.write_text(text.replace("seed = 13", f"seed = {100 + seed}"), encoding="utf-8")
        run(prepare(scene, protocol), out, lambda done, total, label: None)
        found = identify_logs([out], terms=1).identification
        alarms += any("does not explain the data" in warning for warning in found.warnings)
        for one in found.suspects:
            branches.setdefault(one.name, []).append(one.amplitude / one.uncertainty)
        (lag,) = (zero for name, zero in found.nuisance.items() if name.startswith("lag of"))
        assert lag.prior == UNKNOWN_LAG
        assert abs(lag.value) < 3e-3
        for name, truth in (("G", 100e3), ("eps_r", 2.5)):
            assert abs(found.quantities[name].value - truth) < 3.0 * found.quantities[name].uncertainty
    assert alarms <= 1
    viscous = {name: z for name, z in branches.items() if name.startswith("viscous")}
    assert len(viscous) >= 3
    for name, z in viscous.items():
        assert abs(np.mean(z)) < 3.5 / np.sqrt(runs), (name, np.mean(z))
