"""An instrument and its twin, two files in a package outside the tree, are known everywhere by their entry points."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import pytest

from tests.elsewhere import dea_rig
from tests.protocols import TO_THE_FILM

HERE = Path(__file__).parent
FIXTURES = Path(str(files("sim_fixtures")))
ENTRY_POINTS = """[dea_rig.instruments]
acme-scale = acme_scale
[dea_rig.twins]
acme-scale = acme_scale_twin
"""
SHORT = (
    TO_THE_FILM
    + """[[step]]
do = "sweep"
displacement_mm = 3.0
speed_mm_per_s = 4.0
[[step]]
do = "return"
speed_mm_per_s = 4.0
"""
)


class Place:
    """A folder with a scene, and an interpreter that finds the package."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.packages = folder / "packages"
        for name in ("acme_scale.py", "acme_scale_twin.py"):
            self.packages.mkdir(exist_ok=True)
            shutil.copy(HERE / "example_package" / name, self.packages)
        info = self.packages / "acme_scale-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-scale\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(ENTRY_POINTS)
        certificate = (FIXTURES / "calibrations" / "force-can.toml").read_text()
        (folder / "force.toml").write_text(certificate.replace('"77120"', '"4711"'))
        scene = (FIXTURES / "scenes" / "no-hv.toml").read_text()
        scene = scene.replace('driver = "gsv8"\nrate_Hz = 100.0', 'driver = "acme-scale"\nserial = "4711"')
        scene = scene.replace("approach_from_mm = 36.0", "approach_from_mm = 5.0")  # less way to go
        scene = scene.replace("seed = 7", "seed = 7\ncontact_position_mm = 7.0")
        scene += "\n[simulation.stage]\nstart_position_mm = 2.0\n"
        scene = scene.replace("../calibrations/force.toml", "force.toml")
        (folder / "scene.toml").write_text(scene)
        (folder / "protocol.toml").write_text(SHORT)

    @property
    def environment(self) -> dict[str, str]:
        return {**os.environ, "PYTHONPATH": f"{self.packages}{os.pathsep}{HERE.parent}"}

    def told(self, *commands: str, codes: tuple[int, ...] = ()) -> list[str]:
        """What each command says, one after the other in one process; each ends with its code, or with 0."""
        done = dea_rig(self.environment["PYTHONPATH"], *(command.split() for command in commands), cwd=self.folder)
        for one, code in zip(done, codes or [0] * len(done), strict=True):
            assert one.returncode == code, one.all
            assert "Traceback" not in one.stderr
        return [one.all for one in done]


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(tmp_path)


@pytest.fixture
def ports(place: Place) -> Iterator[dict[str, dict[str, str]]]:
    """The simulated bench of the scene, served by another process."""
    served = subprocess.Popen(
        [sys.executable, "-m", "rig", "sim", "scene.toml"],
        stdout=subprocess.PIPE,
        cwd=place.folder,
        env=place.environment,
        text=True,
    )
    try:
        assert served.stdout is not None
        told = ""
        while not told.rstrip().endswith("}"):
            line = served.stdout.readline()
            assert line, f"the simulated bench ended: {told}"
            told += line
            try:
                json.loads(told)
                break
            except ValueError:
                continue
        (place.folder / "ports.json").write_text(told)
        yield json.loads(told)
    finally:
        served.kill()
        served.wait()
        assert served.stdout is not None
        served.stdout.close()


def test_a_scene_a_run_and_a_replay_know_it(place: Place) -> None:
    made = ("check scene.toml protocol.toml", "run scene.toml protocol.toml -o a.mcap")
    _, _, info, verified, again = place.told(*made, "info a.mcap", "replay --verify a.mcap", "replay --rerun a.mcap")
    assert "model ACME, serial 4711, firmware 1.0" in info
    assert "every sample comes out as recorded" in verified
    assert "the run ends as it did" in again


def test_its_keys_and_faults_are_checked(place: Place) -> None:
    scene = (place.folder / "scene.toml").read_text()
    fault = '\n[[simulation.fault]]\nrole = "force"\nkind = "{}"\n'
    (place.folder / "rate.toml").write_text(scene.replace('serial = "4711"', "rate_Hz = 200.0"))
    (place.folder / "other.toml").write_text(scene + fault.format("no_value"))
    (place.folder / "own.toml").write_text(scene + fault.format("drift"))
    rate, other, _ = place.told(
        *(f"check {name}.toml protocol.toml" for name in ("rate", "other", "own")), codes=(2, 2, 0)
    )
    assert "rate_Hz = 200.0: it must be at most 100" in rate
    assert "drift" in other


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")
def test_it_is_served_found_and_run_on_its_port(place: Place, ports: dict[str, dict[str, str]]) -> None:
    (found,) = place.told(f"devices --port {ports['force']['port']}")
    assert "ACME" in found and "acme-scale" in found and "4711" in found
    place.told("run scene.toml protocol.toml --ports ports.json --yes -o a.mcap")
    assert "every sample comes out as recorded" in place.told("replay --verify a.mcap")[0]


def test_a_package_that_cannot_be_imported_stops_nobody_who_does_not_name_it(place: Place) -> None:
    (place.packages / "acme_scale.py").write_text("import no_such_module\n")
    own = f"check {FIXTURES / 'scenes' / 'no-hv.toml'} {FIXTURES / 'protocols' / 'passive.toml'}"
    told, _ = place.told("check scene.toml protocol.toml", own, codes=(2, 0))
    assert "acme-scale" in told and "no_such_module" in told


@pytest.mark.slow
def test_it_is_installed_by_pip(place: Place, tmp_path: Path) -> None:
    """As another laboratory would: a package of its own, nothing in the tree changed."""
    if shutil.which("uv") is None:
        pytest.skip("needs uv")
    shutil.rmtree(place.packages)
    subprocess.run(
        ["uv", "pip", "install", "--quiet", "--target", str(place.packages), str(HERE / "example_package")],
        check=True,
        timeout=100,
    )
    _, verified = place.told("run scene.toml protocol.toml -o a.mcap", "replay --verify a.mcap")
    assert "every sample comes out as recorded" in verified
