"""`dea-rig new-driver` writes a package that works from the start: its own test passes, a scene knows it."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner

from rig.cli.app import main
from rig.cli.new_driver import ROLES
from rig.scene.skeleton import PARTS

FIXTURES = Path(str(files("sim_fixtures")))
ROOT = Path(__file__).parents[3]


def new_driver(*arguments: str | Path) -> tuple[int, str]:
    done = CliRunner().invoke(main, ["new-driver", *map(str, arguments)])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, done.output


@pytest.mark.parametrize("role", ROLES)
def test_the_files_of_every_role_are_complete(tmp_path: Path, role: str) -> None:
    folder = tmp_path / "new"
    code, told = new_driver("my-thing", "--role", role, "-o", folder)
    assert code == 0 and "pip install" in told
    names = {path.name for path in folder.iterdir()}
    assert names == {"pyproject.toml", "my_thing.py", "my_thing_twin.py", "test_my_thing.py"}
    for path in folder.iterdir():
        text = path.read_text()
        assert not re.search(r"@[A-Z_]+@", text) and max(map(len, text.splitlines())) <= 120, path.name
        if path.suffix == ".py":
            ast.parse(text)
    assert PARTS.keys() == set(ROLES)


@pytest.mark.parametrize(
    ("name", "role", "words"),
    [
        ("My Scale", "force", "no name for a driver"),
        ("-x", "force", "no such option"),
        ("scale--x", "force", "no name for a driver"),
        ("gsv8", "force", "already"),
        ("json", "hv", "Python module 'json' already"),
        ("ok", "laser", "is not one of"),
    ],
)
def test_a_name_that_cannot_be_is_refused_and_nothing_written(
    tmp_path: Path, name: str, role: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, told = new_driver(name, "--role", role)
    assert code == 2 and words.lower() in told.lower()
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    code, told = new_driver("my-thing", "--role", "force", "-o", tmp_path / "there")
    assert code == 2 and "exists already" in told and not list((tmp_path / "there").iterdir())
    code, told = new_driver("my-thing", "--role", "force", "-o", tmp_path / "no" / "where")
    assert code == 2 and "cannot be made" in told


def run(folder: Path, *command: str | Path) -> str:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(folder / "new"), str(folder), str(ROOT)))}
    done = subprocess.run(
        [sys.executable, "-m", *map(str, command)],
        capture_output=True,
        text=True,
        cwd=folder,
        env=environment,
        timeout=100,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("role", ROLES)
def test_its_transcript_test_passes(tmp_path: Path, role: str) -> None:
    new_driver("my-thing", "--role", role, "-o", tmp_path / "new")
    assert "9 passed" in run(tmp_path, "pytest", "-q", "-p", "no:cacheprovider", tmp_path / "new")


@pytest.mark.slow
def test_a_scene_names_it_and_its_run_is_replayed(tmp_path: Path) -> None:
    """As if it had been installed: its package's entry points are found on the path."""
    new_driver("my-thing", "--role", "force", "-o", tmp_path / "new")
    about = tmp_path / "my_thing-0.1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: my-thing\nVersion: 0.1\n")
    (about / "entry_points.txt").write_text(
        "[dea_rig.instruments]\nmy-thing = my_thing\n[dea_rig.twins]\nmy-thing = my_thing_twin\n"
    )
    certificate = (FIXTURES / "calibrations" / "force-can.toml").read_text()
    (tmp_path / "force.toml").write_text(certificate.replace('"77120"', '"1"'))
    scene = (FIXTURES / "scenes" / "no-hv.toml").read_text()
    for old, new in {
        'driver = "gsv8"\nrate_Hz = 100.0': 'driver = "my-thing"\nserial = "1"',
        "approach_from_mm = 36.0": "approach_from_mm = 5.0",
        "seed = 7": "seed = 7\ncontact_position_mm = 7.0",
        "../calibrations/force.toml": "force.toml",
    }.items():
        assert old in scene
        scene = scene.replace(old, new)
    (tmp_path / "scene.toml").write_text(scene + "\n[simulation.stage]\nstart_position_mm = 2.0\n")
    (tmp_path / "protocol.toml").write_text(
        '[[step]]\ndo = "home"\n[[step]]\ndo = "zero"\nduration_s = 0.5\n[[step]]\ndo = "approach"\n'
        "speed_mm_per_s = 4.0\nthreshold_mN = 8.0\nmax_travel_mm = 8.0\n"
        '[[step]]\ndo = "return"\nspeed_mm_per_s = 4.0\n'
    )
    run(tmp_path, "rig", "run", "scene.toml", "protocol.toml", "-o", "a.mcap")
    assert "model my-thing, serial 1" in run(tmp_path, "rig", "info", "a.mcap")
    assert "every sample comes out as recorded" in run(tmp_path, "rig", "replay", "--verify", "a.mcap")
