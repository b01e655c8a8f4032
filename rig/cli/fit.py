"""``dea-rig fit``: the film's law and permittivity from logs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rig.cli.files import FILE, FOLDER, tell_written
from rig.cli.fit_options import branches_wanted, fix_option, fixed_values
from rig.cli.import_options import given, import_options, taken, understood_or_refused

if TYPE_CHECKING:
    from rich.console import Group, RenderableType
    from rich.table import Table

    from calibration.film.between import Spread
    from calibration.film.result import Identification


ELASTIC = "--compare, --posterior, --along and --permittivity charge"  # options that know no branches
LEAST_SHARE = 0.01  # of a variance, for a line in the budget on screen


@click.command("fit")
@click.argument("logs", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--scene", type=FILE, help="Scene whose [specimen] the tables are of; logs have their own inside.")
@click.option("-o", "--out", type=FILE, help="Result as JSON.")
@click.option("--report", type=FILE, help="Result as one self-contained HTML page.")
@click.option("--law", help="Law of the film, e.g. gent; that of the scene when not given.")
@click.option("--terms", type=click.IntRange(1, 3), default=2, show_default=True, help="Ogden terms.")
@click.option("--compare", "comparing", is_flag=True, help="Judge 1, 2 and 3 terms: AICc, BIC, held-out curves.")
@click.option("--profiles", is_flag=True, help="95 % intervals from profile likelihood too; takes longer.")
@click.option("--posterior", is_flag=True, help="Markov chains too (extra `posterior`); takes a minute or more.")
@click.option(
    "--wrinkled",
    type=click.Choice(["left-out", "tension-field"]),
    default="left-out",
    show_default=True,
    help="Samples at which the film is wrinkled: leave out, or describe by the tension field. Counted either way.",
)
@fix_option
@click.option("--negative-exponents", is_flag=True, help="Let a term have alpha < 0 and mu < 0 as well.")
@click.option(
    "--along",
    multiple=True,
    type=click.Choice(["eps-stretch", "softening", "voltage-loss", "zero-drift"]),
    help="An error to be fitted along within its usual size. May be repeated.",
)
@click.option(
    "--permittivity",
    type=click.Choice(["force", "charge"]),
    default="force",
    show_default=True,
    help="By what: with charge the currents of the logs are data beside the forces; softening is fitted along.",
)
@click.option(
    "--branches",
    help="Films that take time: fit so many Maxwell branches along (1 to 3), or as many as pay: auto.",
)
@click.option("--stiffness-at", help="Stretches of the stiffness that can be compared between runs, e.g. 1.5,1.2.")
@click.option("--cards", type=FOLDER, help="Folder for material cards of Abaqus, Ansys, COMSOL and FEBio.")
@import_options(cone=True)
def command(
    logs: tuple[Path, ...],
    scene: Path | None,
    out: Path | None,
    report: Path | None,
    law: str | None,
    terms: int,
    comparing: bool,
    profiles: bool,
    posterior: bool,
    wrinkled: str,
    fixed: tuple[str, ...],
    negative_exponents: bool,
    along: tuple[str, ...],
    permittivity: str,
    branches: str | None,
    stiffness_at: str | None,
    cards: Path | None,
    dry_run: bool,
    tidy: Path | None,
    **words: Any,
) -> None:
    """Identify the film's law and permittivity from all curves of LOGS at once, with uncertainties.

    LOGS are logs of this program, or a folder of them, whose specimens are also fitted each alone and compared. With
    --scene they are tables of another rig with columns of displacement, force and voltage, in any encoding, separator
    and decimal sign. What is understood of a table is printed first; what cannot be understood is asked for, with the
    option that tells it.
    """
    from calibration.film.cards import without_card
    from rig.analysis.film import identify_logs, write_cards, write_results
    from rig.base.outputs import check_new
    from rig.base.progress import progress
    from rig.cli.show import show

    check_new(out, report, tidy)
    each = any(path.is_dir() for path in logs)
    logs = _of_folders(logs)
    options = taken(words)
    _check_source(logs, scene, given(options) or dry_run or tidy is not None)
    if scene is not None and permittivity == "charge":
        raise click.UsageError("--permittivity charge needs logs: tables have no current.")
    tables = None
    if scene is not None:
        from rig.analysis.imported import identify_cones, read_cones

        tables = understood_or_refused(lambda: read_cones(logs, scene, options))
        if tidy is not None:
            from rig.importing.tidy import write_cone_table

            write_cone_table(tidy, tables.tidy)
    if dry_run:
        tell_written(tidy)
        return
    elastic = comparing or posterior or bool(along) or permittivity == "charge"
    with progress("Markov chains around the fit") if posterior else nullcontext(lambda *_: None) as update:
        settings: dict[str, Any] = {
            "law": law,
            "terms": terms,
            "comparing": comparing,
            "profiles": profiles,
            "wrinkled": wrinkled,
            "posterior": posterior,
            "progress": update,
            "fixed": fixed_values(fixed),
            "negative_exponents": negative_exponents,
            "along": along,
            "each": each,
            "fixed_stretch": _stretches(stiffness_at),
            "branches": branches_wanted(branches, ELASTIC if elastic else ""),
        }
        if tables is not None and scene is not None:
            found = identify_cones(tables, logs, scene, **settings)
        elif permittivity == "charge":
            from rig.analysis.charged_film import identify_with_charge

            found = identify_with_charge(list(logs), **settings)
        else:
            found = identify_logs(list(logs), **settings)
    write_results(found, out, report)
    written = [] if cards is None else write_cards(found.identification.material, cards)
    without = [] if cards is None else without_card(found.identification.material)
    parts = [comparison_table(found.comparison)] if comparing else []
    parts += [posterior_table(found.identification)] if posterior else []
    if found.spreads:
        parts.append(spread_table(found.spreads))
    show(identification_table(found.identification), *parts, *(f"note: {note}" for note in (*found.notes, *without)))
    tell_written(out, report, tidy, *written)


def _of_folders(paths: Sequence[Path]) -> tuple[Path, ...]:
    """The paths, with the logs of a folder in place of the folder. Raises `ConfigError` where it has none."""
    from rig.base.errors import ConfigError

    found: list[Path] = []
    for path in paths:
        if not path.is_dir():
            found.append(path)
            continue
        logs = sorted(path.rglob("*.mcap"))
        if not logs:
            raise ConfigError(f"{path}: there is no log (*.mcap) in this folder. Tables are named one by one.")
        found += logs
    return tuple(found)


def spread_table(spreads: Mapping[str, Spread]) -> Table:
    """Each specimen alone, and what they have in common."""
    from rich.table import Table

    from calibration.rounding import rounded
    from rig.cli.show import NAMES

    table = Table(
        title="Between specimens, each fitted alone (random effects)",
        caption="After +-: each specimen's own standard uncertainty; of the mean, with what all share.",
    )
    table.add_column("specimen", overflow="fold")
    factors = {name: (1e-3, " / kPa") if one.unit == "Pa" else (1.0, "") for name, one in spreads.items()}
    for name, (_, unit) in factors.items():
        table.add_column(NAMES.get(name, name) + unit, justify="right")
    rows: dict[str, list[str]] = {}
    for name, one in spreads.items():
        factor = factors[name][0]
        for who, value in one.values.items():
            rows.setdefault(who, []).append(" +- ".join(rounded(value * factor, one.uncertainties[who] * factor)))
        rows.setdefault("mean", []).append(" +- ".join(rounded(one.mean * factor, one.uncertainty * factor)))
        for label, size in (("scatter between", one.between), ("scatter within", one.within), ("shared", one.shared)):
            rows.setdefault(label, []).append(f"{size * factor:.2g}")
        rows.setdefault("probability of no scatter between", []).append(f"{one.probability:.2g}")
    last = ("mean", "scatter between", "scatter within", "shared", "probability of no scatter between")
    for who in (*(one for one in rows if one not in last), *last):
        if len(rows[who]) == len(spreads):
            table.add_row(who, *rows[who])
    return table


def _stretches(words: str | None) -> tuple[float, float] | None:
    """Meridional and hoop stretch, from two numbers with a comma."""
    if words is None:
        return None
    try:
        meridional, hoop = (float(word) for word in words.split(","))
    except ValueError:
        meridional = hoop = math.nan
    if not 1.0 <= hoop <= meridional < 20.0 or meridional == 1.0:
        raise click.BadParameter(
            f"{words!r}: write the meridional and the hoop stretch, as in 1.5,1.2; the first is the larger one",
            param_hint="--stiffness-at",
        )
    return meridional, hoop


def _check_source(paths: Sequence[Path], scene: Path | None, about_tables: bool) -> None:
    """Logs carry their scene; a table needs one. Raises `ConfigError` where they do not go together."""
    from rig.base.errors import ConfigError
    from rig.importing.text import is_log

    missing = [str(path) for path in paths if not path.is_file()]
    if missing:
        raise ConfigError(f"{', '.join(missing)}: there is no such file.")
    logs = [path for path in paths if is_log(path)]
    if scene is not None and logs:
        raise ConfigError(f"{logs[0]}: a log of this program has its scene inside; give it without --scene.")
    others = [path for path in paths if path not in logs and path.suffix != ".mcap"]
    if scene is None and others:
        raise ConfigError(
            f"{others[0]}: not a log of this program (MCAP). For a table of another rig add --scene scene.toml, whose "
            "[specimen] says what film was measured."
        )
    if scene is None and about_tables:
        raise ConfigError("Options about tables (--column, --dry-run, --tidy, ...) need tables, and these are logs.")


def identification_table(found: Identification) -> Group:
    """The identified quantities with their standard uncertainties and verdicts, and what speaks against them."""
    from rich.console import Group

    from rig.cli.show import NAMES, quantities_table

    table = quantities_table(
        f"Identified: {found.model}, {found.used} samples, {found.excluded} left out", found.quantities
    )
    lines: list[RenderableType] = [
        table,
        f"reduced chi-square {found.reduced_chi_square:.3f} ({found.freedom} degrees of freedom); stiffness is the "
        f"secant shear modulus at stretches {found.stretch[0]:.2f} (meridional; largest "
        f"{found.stiffness_curve.meridional_stretch[-1]:.2f}) and {found.stretch[1]:.2f} (hoop).",
    ]
    lines.append(
        f"stiffness (fixed) belongs to stretches {found.fixed_stretch[0]:.2f} and {found.fixed_stretch[1]:.2f}, "
        "whatever the data determine best: compare it between runs."
    )
    lines += [budget_table(found), *_given_dimensions(found), *_measurement(found), *_along(found)]
    lines += [f"note: {warning}" for warning in found.warnings]
    lines += [f"advice: {advice}" for advice in found.advice]
    if found.blind_spots:
        from calibration.rounding import percent

        worst = found.blind_spots[0]
        shifts = (
            f"{NAMES.get(name, name)} by {percent(abs(shift / found.quantities[name].value))}"
            for name, shift in found.unseen[worst.name].items()
        )
        lines.append(
            f"unseen: {worst.blind} could be there without showing in these data and shift {', '.join(shifts)}. To "
            f"rule it out: {worst.remedy}. The report lists all {len(found.blind_spots)} that could shift a result by "
            "more than its uncertainty."
        )
    return Group(*lines)


def budget_table(found: Identification) -> Table:
    """Where the uncertainties come from: parts that make up a hundredth of a variance or more."""
    from rich.table import Table

    from calibration.rounding import percent
    from rig.cli.show import NAMES

    names = [name for name in ("stiffness", "eps_r") if name in found.quantities]
    shown = [found.quantities[name] for name in names]
    table = Table(title="Budget: standard uncertainty, and share of the variance")
    table.add_column("part", overflow="fold")
    for name in names:
        table.add_column(NAMES.get(name, name), justify="right")
    parts = list(dict.fromkeys(part for quantity in shown for part in quantity.budget))
    parts.sort(key=lambda part: -max(quantity.share(part) for quantity in shown))
    for part in parts:
        if max(quantity.share(part) for quantity in shown) < LEAST_SHARE:
            continue
        assumed = f" (assumed, not stated: {percent(found.assumed[part])})" if part in found.assumed else ""
        cells = (
            f"{percent(quantity.budget.get(part, 0.0) / abs(quantity.value))} ({quantity.share(part):.0%})"
            for quantity in shown
        )
        table.add_row(part + assumed, *cells)
    return table


def _given_dimensions(found: Identification) -> list[str]:
    """The conditional figures, and what took a verdict away."""
    from calibration.rounding import percent
    from rig.cli.show import NAMES

    names = [name for name in ("stiffness", "eps_r") if name in found.quantities]
    shown = {NAMES.get(name, name): found.quantities[name] for name in names}
    words = ", ".join(
        f"{label} +- {percent(one.conditional / abs(one.value))} ({one.conditional_verdict})"
        for label, one in shown.items()
    )
    lines = [f"given the dimensions, as if those of the specimens were exact: {words}."]
    lines += [f"{label} does not count as identified: {one.doubt}." for label, one in shown.items() if one.doubt]
    return lines


def _along(found: Identification) -> list[str]:
    """What was fitted along on request, how well it is determined, and what it did to the results."""
    from calibration.film.result import SHOWN
    from calibration.rounding import rounded
    from rig.cli.show import NAMES

    lines = []
    for name, shifts in found.along.items():
        one = found.nuisance[name]
        factor, unit = SHOWN[one.unit]
        size, error = rounded(one.value * factor, one.uncertainty * factor)
        moved = ", ".join(
            f"{NAMES.get(key, key)} by {100.0 * shift / found.quantities[key].value:+.2g} %"
            for key, shift in shifts.items()
        )
        known = "" if one.uncertainty < 0.5 * one.prior else "; these data hardly determine it"
        lines.append(
            f"fitted along: {name}: {size} +- {error} {unit} (allowed +- {one.prior * factor:.2g} {unit}{known}); "
            f"it moved {moved}."
        )
    return lines


def _measurement(found: Identification) -> list[str]:
    """What to measure next."""
    from calibration.rounding import percent
    from rig.cli.show import NAMES

    best = found.measurement
    if best is None:
        return []
    gains = ", ".join(
        f"{NAMES.get(name, name)} from {percent(now)} to {percent(then)}" for name, (now, then) in best.relative.items()
    )
    known = "assumed" if best.assumed else "stated"
    return [
        f"the one measurement that would help most: the {best.part}, to {percent(best.then)} ({known} now: "
        f"{percent(best.now)}). It would bring {gains}."
    ]


def comparison_table(found: Sequence[Identification]) -> Table:
    """The same data with several numbers of Ogden terms."""
    from rich.table import Table

    table = Table(title="Ogden terms: smaller criteria are better, differences below 2 mean nothing")
    for heading in ("terms", "AICc", "BIC", "held out / noise", "not identifiable"):
        table.add_column(heading, justify="left" if heading == "not identifiable" else "right", overflow="fold")
    least = [min(getattr(one, name) for one in found) for name in ("aicc", "bic")]
    for one in found:
        lost = [name for name, quantity in one.quantities.items() if quantity.verdict.startswith("not")]
        predicted = ", ".join(f"{part.ratio:.2f}" for part in one.held_out)
        criteria = (f"{value - low:+.1f}" for value, low in zip((one.aicc, one.bic), least, strict=True))
        table.add_row(str(one.terms), *criteria, predicted or "-", ", ".join(lost) or "-")
    return table


def posterior_table(found: Identification) -> Table:
    """What the Markov chains say, beside the fit."""
    from rich.table import Table

    chains = found.posterior
    assert chains is not None
    ended = "" if chains.converged else " TOO SHORT for its autocorrelation: do not rely on it."
    table = Table(
        title="Posterior by Markov chains; gains and dimensions held",
        caption=f"{chains.walkers} walkers, {chains.steps} steps, {chains.acceptance:.0%} accepted, "
        f"autocorrelation {chains.autocorrelation:.0f} steps.{ended}",
    )
    table.add_column("quantity")
    for heading in ("fit", "mean", "standard deviation", "95 % from", "to"):
        table.add_column(heading, justify="right")
    for name, one in chains.quantities.items():
        numbers = (found.quantities[name].value, one.mean, one.deviation, one.low, one.high)
        table.add_row(f"{name} / {one.unit}" if one.unit else name, *(f"{value:.5g}" for value in numbers))
    return table
