"""The main job on the simulated bench: two specimens through the real drivers, identified, held against truth."""

from __future__ import annotations

import re
import shutil
from importlib.resources import as_file, files
from pathlib import Path

import click

from rig.analysis.film import identify_logs, write_results
from rig.base.errors import ConfigError
from rig.base.progress import progress
from rig.cli.show import identification_table, show, truth_table
from rig.experiment import prepare
from rig.experiment import run as run_experiment

SCENES = ("cone-4mm", "cone-6mm")
PROTOCOL = "paper"


def run_demo(out: Path | None, seed: int) -> None:
    """Run the paper's experiment on two simulated specimens and print truth against identified.

    Everything it used and made is left in ``out``: scenes, protocol, certificates, logs, fit, report.

    Raises
    ------
    ConfigError
        When ``out`` exists already.
    """
    folder = _make_folder(out)
    with as_file(files("sim_fixtures")) as fixtures:
        for name in ("scenes", "protocols", "calibrations"):
            shutil.copytree(fixtures / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    logs = []
    for number, name in enumerate(SCENES):
        scene_path = folder / "scenes" / f"{name}.toml"
        _set_seed(scene_path, seed + number)
        experiment = prepare(scene_path, folder / "protocols" / f"{PROTOCOL}.toml")
        log = folder / f"{name}.mcap"
        with progress(
            f"{name}: {experiment.protocol.title}, {experiment.duration:.0f} s of the bench's time"
        ) as update:
            outcome = run_experiment(experiment, log, update)
        click.echo(f"{log}: {outcome.reason}; {outcome.state}.")
        logs.append(log)
    found = identify_logs(logs)
    fit, report = folder / "fit.json", folder / "report.html"
    write_results(found, fit, report)
    show(identification_table(found.identification), truth_table(found))
    click.echo(f"Left in {folder}/: two logs, {fit.name}, {report.name}, and the files they came from.")
    click.echo("Try next, with `uv run` in front:")
    click.echo(f"  dea-rig view {logs[0]}")
    click.echo(f"  dea-rig check {folder}/scenes/{SCENES[0]}.toml {folder}/protocols/{PROTOCOL}.toml")
    click.echo("  change a number there, then: dea-rig run SCENE PROTOCOL -o my.mcap && dea-rig fit my.mcap")


def _make_folder(out: Path | None) -> Path:
    """``out``, or the first free one of dea-rig-demo, dea-rig-demo-2, ..."""
    if out is not None:
        try:
            out.mkdir(parents=True)
        except FileExistsError:
            raise ConfigError(f"{out} exists already; nothing is overwritten. Name another directory.") from None
        except OSError as error:
            raise ConfigError(f"{out} cannot be made: {error.strerror}.") from None
        return out
    number = 1
    while True:
        folder = Path("dea-rig-demo" if number == 1 else f"dea-rig-demo-{number}")
        try:
            folder.mkdir()
        except FileExistsError:
            number += 1
        except OSError as error:
            raise ConfigError(f"{folder} cannot be made here: {error.strerror}. Use --out.") from None
        else:
            return folder


def _set_seed(scene: Path, seed: int) -> None:
    text, count = re.subn(r"(?m)^seed = \d+$", f"seed = {seed}", scene.read_text(encoding="utf-8"))
    if count != 1:
        raise ConfigError(f"{scene}: expected one line `seed = ...` in [simulation].")
    scene.write_text(text, encoding="utf-8")
