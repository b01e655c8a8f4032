"""``dea-rig demo``: two simulated specimens, from the run to the report."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rig.cli.files import FOLDER

if TYPE_CHECKING:
    from rich.console import RenderableType

    from rig.analysis.film import Found

SCENES = ("cone-4mm", "cone-6mm")
PROTOCOL = "paper"
VISCOUS_PROTOCOL = "relax"
BRANCHES = ((0.15, 1.0), (0.2, 15.0))  # ratio and time (s) of what relaxes beside the viscous specimen's film


@click.command("demo")
@click.option("--out", type=FOLDER, help="Directory to make.")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=1, show_default=True, help="Seed of the simulation.")
@click.option("--viscous", is_flag=True, help="One specimen whose film relaxes: fast moves and holds, branches fitted.")
def command(out: Path | None, seed: int, viscous: bool) -> None:
    """Characterise two simulated specimens, start to finish, and compare with the truth.

    Everything it used and made is left in a new directory: scenes, protocol, certificates, logs, fit, report.
    """
    import shutil
    from importlib.resources import as_file, files

    from rig.analysis.film import identify_logs, write_results
    from rig.base.progress import progress
    from rig.cli.fit import identification_table
    from rig.cli.show import show
    from rig.protocol.experiment import prepare
    from rig.run.run import run as run_experiment

    folder = _make_folder(out)
    with as_file(files("sim_fixtures")) as fixtures:
        for name in ("scenes", "protocols", "calibrations", "schema"):
            shutil.copytree(fixtures / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    logs = []
    protocol, scenes = (VISCOUS_PROTOCOL, SCENES[:1]) if viscous else (PROTOCOL, SCENES)
    for number, name in enumerate(scenes):
        scene_path = folder / "scenes" / f"{name}.toml"
        _set_seed(scene_path, seed + number)
        if viscous:
            _let_relax(scene_path)
        experiment = prepare(scene_path, folder / "protocols" / f"{protocol}.toml")
        log = folder / f"{name}.mcap"
        with progress(
            f"{name}: {experiment.protocol.title}, {experiment.duration:.0f} s of the bench's time"
        ) as update:
            outcome = run_experiment(experiment, log, update)
        click.echo(f"{log}: {outcome.reason}; {outcome.state}.")
        logs.append(log)
    found = identify_logs(logs, branches=len(BRANCHES) if viscous else 0)
    fit, report = folder / "fit.json", folder / "report.html"
    write_results(found, fit, report)
    show(identification_table(found.identification), truth_table(found))
    for sentence in _branches(found) if viscous else ():
        click.echo(sentence)
    made = "a log" if viscous else "two logs"
    click.echo(f"Left in {folder}/: {made}, {fit.name}, {report.name}, and the files they came from.")
    click.echo("Try next, with `uv run` in front:")
    click.echo(f"  dea-rig view {logs[0]}")
    click.echo(f"  dea-rig check {folder}/scenes/{SCENES[0]}.toml {folder}/protocols/{protocol}.toml")
    click.echo("  change a number there, then: dea-rig run SCENE PROTOCOL -o my.mcap && dea-rig fit my.mcap")


def _make_folder(out: Path | None) -> Path:
    """``out``, or the first free one of dea-rig-demo, dea-rig-demo-2, ..."""
    from rig.base.errors import ConfigError

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
    from rig.base.errors import ConfigError

    text, count = re.subn(r"(?m)^seed = \d+$", f"seed = {seed}", scene.read_text(encoding="utf-8"))
    if count != 1:
        raise ConfigError(f"{scene}: expected one line `seed = ...` in [simulation].")
    scene.write_text(text, encoding="utf-8")


def _let_relax(scene: Path) -> None:
    """Give the simulated film its branches."""
    branches = "".join(
        f"\n[[simulation.film.maxwell]]\nmodulus_ratio = {ratio}\ntime_s = {time}\n" for ratio, time in BRANCHES
    )
    scene.write_text(scene.read_text(encoding="utf-8") + branches, encoding="utf-8")


def _branches(found: Found) -> list[str]:
    """The simulation's branches, and what was found of them."""
    spectrum = found.identification.spectrum
    truth = "; ".join(f"ratio {ratio:g}, time {time:g} s" for ratio, time in BRANCHES)
    return [f"Branches of the simulated film: {truth}.", *(() if spectrum is None else spectrum.sentences)]


def truth_table(found: Found) -> RenderableType:
    """The simulation's hidden truth beside what was identified, the difference in stated standard uncertainties."""
    from rich.table import Table

    from calibration.film.propagation import secant_modulus, sorted_terms
    from calibration.rounding import stated
    from rig.cli.show import NAMES, SHOWN

    truth, identification = found.truth, found.identification
    if truth is None:
        return ""
    known = {
        "eps_r": truth.eps_r,
        "stiffness": secant_modulus(truth, *identification.stretch),
        "stiffness_end": secant_modulus(
            truth, identification.stiffness_curve.meridional_stretch[-1], identification.stretch[1]
        ),
        "G": truth.shear_modulus,
    }
    if (truth.law, truth.terms) == (identification.material.law, identification.terms):
        known |= sorted_terms(truth).values
    table = Table(title="Truth against identified")
    for heading in ("quantity", "truth", "identified", "unit", "+-", "off / +-"):
        table.add_column(heading, justify="left" if heading in ("quantity", "unit") else "right", no_wrap=True)
    for name, quantity in identification.quantities.items():
        if name in known:
            factor, unit = SHOWN.get(quantity.unit, (1.0, quantity.unit))
            value, uncertainty = stated(quantity.value * factor, quantity.uncertainty * factor)
            off = (quantity.value - known[name]) / quantity.uncertainty
            row = (f"{known[name] * factor:.6g}", value, unit, uncertainty, f"{off:+.2f}")
            table.add_row(NAMES.get(name, name), *row)
    return table
