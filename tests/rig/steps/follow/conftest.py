"""A bench on which the stage plays a bias."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import pytest

FIXTURES = Path(str(files("sim_fixtures")))
# The film of the scene, so near that the way to it is short.
NEARER = {
    "approach_from_mm = 36.0": "approach_from_mm = 13.0",
    "contact_position_mm = 40.0": "contact_position_mm = 17.0",
}
LAWS = {
    "spring": '{ kind = "spring", preload_N = 0.8, stiffness_N_per_mm = 0.05 }',
    "mass": '{ kind = "mass", weight_N = 0.25 }',
    "antagonist": '{ kind = "antagonist", spacer_mm = 20.0 }',
}


@pytest.fixture(scope="session")
def write_bench():
    """``write(folder, laws, voltages, truth="", **keys)``: scene and protocol files.

    What the scene believes of the film is the simulation's truth, so that the model's expectation is exact.
    """

    def write(folder: Path, laws: list[str], voltages: list[float], truth: str = "", **keys: float):
        text = (FIXTURES / "scenes" / "cone-4mm.toml").read_text()
        text = text.replace("../calibrations", (FIXTURES / "calibrations").as_posix())
        for believed, true in (("[33e3, 32e3]", "[5e3, 35e3]"), ("[2.0, 5.0]", "[2.5, 5.6]"), ("1.9", "1.7")):
            assert believed in text
            text = text.replace(believed, true, 1)
        for line in truth.splitlines():
            before, _, after = line.partition(" -> ")
            assert before in text, before
            text = text.replace(before, after)
        for far, near in NEARER.items():
            text = text.replace(far, near)
        scene, protocol = folder / "scene.toml", folder / "protocol.toml"
        scene.write_text(text)
        threshold = keys.pop("threshold_mN", 6.0)
        zero = keys.pop("zero_s", 2.0)
        steps = [
            '[[step]]\ndo = "home"',
            f'[[step]]\ndo = "zero"\nduration_s = {zero}',
            f'[[step]]\ndo = "approach"\nspeed_mm_per_s = 2.0\nthreshold_mN = {threshold}',
        ]
        for law in laws:
            more = "\n".join(f"{key} = {value}" for key, value in keys.items())
            steps.append(f'[[step]]\ndo = "follow"\nbias = {LAWS[law]}\nvoltages_V = {voltages}\n{more}')
        protocol.write_text("\n".join([*steps, '[[step]]\ndo = "return"\nspeed_mm_per_s = 5.0', ""]))
        return scene, protocol

    return write
