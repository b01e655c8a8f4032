"""A law in one file outside the tree is known everywhere: scene, check, solve, run, fit."""

from __future__ import annotations

import json
import os
from importlib.resources import files
from pathlib import Path

import pytest

from tests import elsewhere

FIXTURES = Path(str(files("sim_fixtures")))
ROOT = Path(__file__).resolve().parents[1]

# Demiray's law, as somebody else would write it: three methods.
LAW = """
import numpy as np
from model.material.first_invariant import derivatives, invariant
from model.material.law import Law, Parameter

class Demiray(Law):
    name = "demiray"
    title = "Demiray"
    description = "W = mu/(2 b) (exp(b J) - 1), J = I1 - 3, G = mu."
    moduli = (Parameter("mu", "Pa", "Shear modulus."),)
    shapes = (Parameter("b", "1", "How fast it stiffens.", lower=1e-9, search=(1e-3, 5.0), start=(0.02, 0.5)),)

    def energy(self, log):
        return 0.5 * self.mu[0] / self.alpha[0] * np.expm1(self.alpha[0] * invariant(log)[0])

    def derivatives(self, log):
        total, squares = invariant(log)
        first = 0.5 * self.mu[0] * np.exp(self.alpha[0] * total)
        return derivatives(squares, first, self.alpha[0] * first)

    @classmethod
    def shear_modulus(cls, mu, alpha):
        return mu[0]
"""
SCENE = """
[specimen]
name = "demiray-film"
disk_radius_mm = 4.0
ring_radius_mm = 20.0
thickness_um = 40.0
prestretch = 1.2
[specimen.material]
law = "demiray"
mu_Pa = 9e4
b = 0.2
eps_r = 2.0
[limits]
force_N = 0.9
displacement_mm = 14.0
speed_mm_per_s = 5.0
[stage]
driver = "zaber"
approach_from_mm = 5.0
[force]
driver = "gsv8"
certificate = "CERTIFICATE"
[simulation]
seed = 3
contact_position_mm = 7.0
[simulation.stage]
start_position_mm = 2.0
[simulation.force]
full_scale_N = 1.0
[simulation.film]
law = "demiray"
mu_Pa = 8e4
b = 0.1
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """The law as an installed package would be: one module, and its entry point."""
    (tmp_path / "acme_demiray.py").write_text(LAW)
    information = tmp_path / "acme_demiray-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-demiray\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[dea_rig.laws]\ndemiray = acme_demiray:Demiray\n")
    return tmp_path


def dea_rig(package: Path, *commands: list[str | Path], fails: bool = False) -> list[str]:
    """Outputs of the commands in a fresh process that has the package."""
    done = elsewhere.dea_rig(f"{package}{os.pathsep}{ROOT}", *commands, cwd=package)
    for one in done:
        assert (one.returncode != 0) == fails, one.all
    return [one.all for one in done]


def test_solve_knows_it(package: Path) -> None:
    """With a tiny b it is the neo-Hookean law."""
    film = {"a": 4e-3, "b": 20e-3, "thickness": 40e-6, "prestretch": 1.2, "h": 10e-3, "voltage": 800.0}
    cases = [
        film | {"id": 1, "material": {"law": "demiray", "mu": 1e5, "b": 1e-9, "eps_r": 2.0}},
        film | {"id": 2, "material": {"law": "neo_hooke", "mu": 1e5, "eps_r": 2.0}},
        film | {"id": 3, "material": {"law": "demiray", "mu": 1e5, "b": 0.2, "eps_r": 2.0}},
    ]
    path = package / "cases.json"
    path.write_text(json.dumps(cases))
    first, second, third = json.loads(dea_rig(package, ["solve", path])[0])
    assert first["status"] == "taut" and first["F"] == pytest.approx(second["F"], rel=1e-7)
    assert third["F"] > 1.1 * second["F"]


@pytest.mark.slow
def test_a_scene_with_it_is_checked_run_and_fitted(package: Path) -> None:
    scene, log, out = package / "scene.toml", package / "run.mcap", package / "fit.json"
    scene.write_text(SCENE.replace("CERTIFICATE", str(FIXTURES / "calibrations" / "force.toml")))
    protocol = FIXTURES / "protocols" / "passive.toml"
    run = ["run", scene, protocol, "-o", log, "--yes"]
    *_, told = dea_rig(package, ["check", scene, protocol], run, ["fit", log, "-o", out])
    assert "Demiray law" in told, told
    found = json.loads(out.read_text())
    assert found["law"] == "demiray"
    assert list(found["quantities"])[:2] == ["mu", "b"]
    modulus = found["quantities"]["mu"]
    assert abs(modulus["value"] - 8e4) < 4 * modulus["standard_uncertainty"] < 6e4, told


def test_errors_name_its_keys_only(package: Path) -> None:
    scene = package / "scene.toml"
    scene.write_text(SCENE.replace("eps_r = 2.0", "eps_r = 2.0\nalpha = [2.0]"))
    (told,) = dea_rig(package, ["check", scene, FIXTURES / "protocols" / "passive.toml"], fails=True)
    assert "alpha" in told and "mu_Pa" in told and "Jm" not in told


def test_a_law_that_cannot_be_used_stops_nobody_who_does_not_need_it(package: Path) -> None:
    (package / "acme_demiray.py").write_text("raise OSError('no such thing')")
    film = {"a": 4e-3, "b": 20e-3, "thickness": 40e-6, "prestretch": 1.2, "h": 10e-3}
    cases = [
        film | {"id": 1, "material": {"law": "demiray", "mu": 1e5, "b": 0.1, "eps_r": 2.0}},
        film | {"id": 2, "material": {"mu": [2e5], "alpha": [1.0], "eps_r": 2.0}},
    ]
    path = package / "cases.json"
    path.write_text(json.dumps(cases))
    first, second = json.loads(dea_rig(package, ["solve", path])[0])
    assert first["status"] == "invalid" and "acme-demiray" in first["message"] and "no such thing" in first["message"]
    assert second["status"] == "taut"
