"""A command is added by one file outside the tree, named by an entry point of another distribution."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

COMMAND = '''
"""``dea-rig weather``: told by another package."""

import click


@click.command("weather")
@click.argument("place")
def command(place):
    """What the weather at PLACE is."""
    from rig.base.errors import LimitError

    if place == "outside":
        raise LimitError("It rains outside. Stay in.")
    click.echo(f"dry in {place}")
'''


def dea_rig(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    command = [sys.executable, "-m", "rig", *arguments]
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=60)


@pytest.fixture
def other_package(tmp_path: Path) -> Path:
    (tmp_path / "weather_for_rigs.py").write_text(COMMAND)
    about = tmp_path / "weather_for_rigs-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: weather-for-rigs\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[dea_rig.commands]\nweather = weather_for_rigs:command\n")
    return tmp_path


def test_the_command_is_listed_helped_and_carried_out(other_package: Path) -> None:
    listing = dea_rig(other_package, "--help").stdout
    assert "weather" in listing and "What the weather at PLACE is." in listing and "calibrate" in listing
    assert "Usage: dea-rig weather [OPTIONS] PLACE" in dea_rig(other_package, "weather", "--help").stdout
    assert dea_rig(other_package, "weather", "the lab").stdout == "dry in the lab\n"


def test_its_errors_are_those_of_the_family(other_package: Path) -> None:
    done = dea_rig(other_package, "weather", "outside")
    assert (done.returncode, done.stdout, done.stderr) == (3, "", "It rains outside. Stay in.\n")


@pytest.mark.parametrize("spoilt", ["import no_such_module_at_all\n", "command = 7\n"])
def test_one_that_cannot_be_loaded_says_so_and_leaves_the_others_alone(other_package: Path, spoilt: str) -> None:
    (other_package / "weather_for_rigs.py").write_text(spoilt)
    listing = dea_rig(other_package, "--help")
    assert listing.returncode == 0 and "calibrate" in listing.stdout and "Cannot be loaded." in listing.stdout
    done = dea_rig(other_package, "weather")
    assert done.returncode == 1 and "weather_for_rigs:command" in done.stderr and "Traceback" not in done.stderr


def test_a_name_of_the_programs_own_is_not_taken_over(other_package: Path) -> None:
    about = other_package / "weather_for_rigs-1.0.dist-info" / "entry_points.txt"
    about.write_text("[dea_rig.commands]\nstop = weather_for_rigs:command\n")
    assert "End the run that is going on" in dea_rig(other_package, "stop", "--help").stdout
