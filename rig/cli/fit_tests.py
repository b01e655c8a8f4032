"""``dea-rig fit-tests``: a sheet's parameters from homogeneous tests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rig.cli.files import FILE, FOLDER, tell_written
from rig.cli.fit_options import branches_wanted, fix_option, fixed_values
from rig.cli.import_options import import_options, taken, understood_or_refused, with_import

if TYPE_CHECKING:
    from rich.console import Group
    from rich.table import Table

    from calibration.sheet.fit import Compared, TestsFit


@click.command("fit-tests")
@click.argument("tests", nargs=-1, required=True, type=FILE)
@click.option("-o", "--out", type=FILE, help="Result as JSON.")
@click.option("--report", type=FILE, help="Result as one self-contained HTML page.")
@click.option("--law", default="ogden", show_default=True, metavar="NAME", help="ogden, neo-hooke, yeoh, gent, ...")
@click.option(
    "--terms", type=click.IntRange(1, 4), default=3, show_default=True, help="Terms of a law that is a series."
)
@click.option(
    "--weighting",
    type=click.Choice(["balanced", "absolute", "relative", "noise"]),
    default="balanced",
    show_default=True,
    help="What counts: each test alike, errors in Pa, relative errors, or errors in units of each test's noise.",
)
@fix_option
@click.option(
    "--negative-exponents/--positive-exponents",
    default=True,
    show_default=True,
    help="Whether an Ogden term may have alpha < 0 (with mu < 0).",
)
@click.option(
    "--branches",
    help="Sheets that take time: fit so many Maxwell branches along (1 to 3), or as many as pay: auto. Every table "
    "needs a column of time.",
)
@click.option(
    "--cone",
    "cones",
    multiple=True,
    type=FILE,
    help="Log of a cone whose force the sheet predicts, with --branches. May be repeated.",
)
@click.option("--film", type=FILE, help="Result of dea-rig fit -o: predict the TESTS from that film; no fit of them.")
@click.option("--compare", "comparing", is_flag=True, help="Judge all laws: AICc, prediction of the other modes.")
@click.option("--predict", multiple=True, type=FILE, help="A test that takes no part and is predicted.")
@click.option("--cards", type=FOLDER, help="Folder for material cards of Abaqus, Ansys, COMSOL and FEBio.")
@import_options(sheet=True)
def command(
    tests: tuple[Path, ...],
    out: Path | None,
    report: Path | None,
    law: str,
    terms: int,
    weighting: Any,
    fixed: tuple[str, ...],
    negative_exponents: bool,
    branches: str | None,
    cones: tuple[Path, ...],
    film: Path | None,
    comparing: bool,
    predict: tuple[Path, ...],
    cards: Path | None,
    dry_run: bool,
    tidy: Path | None,
    **words: Any,
) -> None:
    """Identify the parameters of a law from homogeneous TESTS of a sheet, all at once.

    TESTS are tables as testing machines and spreadsheets write them: text in any encoding, separator and decimal sign,
    with columns of stretch, strain or extension, and of nominal stress or force. What is understood of each is printed
    first; what cannot be understood is asked for, with the option that tells it. A shared set of options can stand in
    DATA.import.toml beside DATA.csv. The kind of test is in the file, in its name, or in --kind.

    With --branches all rows of relaxation and cyclic tests are fitted over time. --cone predicts the force of a cone
    from the sheet, --film the sheet from a cone.
    """
    from rig.analysis.imported import compare_sheets, identify_sheets, read_sheets, sheet_cards, sheets_record
    from rig.base.outputs import check_new, write_text
    from rig.cli.show import show

    check_new(out, report, tidy)
    number = branches_wanted(branches, "--compare" if comparing else "")
    if cones and number == 0:
        raise click.UsageError("--cone goes with --branches: give --branches auto.")
    if film is not None and (number or cones or comparing or predict):
        raise click.UsageError("--film goes without --branches, --cone, --compare and --predict: it fits nothing.")
    if cards is not None and (number or film is not None):
        raise click.UsageError("--cards goes without --branches and --film: the cards are of the elastic law.")
    read = understood_or_refused(lambda: read_sheets(tests, predict, taken(words)))
    if tidy is not None:
        from rig.importing.tidy import write_sheet_tests

        write_sheet_tests(tidy, read.tests)
    if dry_run:
        tell_written(tidy)
        return
    if film is not None:
        from rig.cli.sheet_over_time import predict_from_film

        predict_from_film(read, film, out, report)
        return
    settings: dict[str, Any] = {
        "law": law,
        "terms": terms,
        "weighting": weighting,
        "fixed": fixed_values(fixed),
        "negative_exponents": negative_exponents,
    }
    if number:
        from rig.cli.sheet_over_time import fit_over_time

        del settings["weighting"]
        fit_over_time(
            read, cones, settings | {"branches": number}, sheets_record(tests, predict, settings), out, report
        )
        tell_written(out, report, tidy)
        return
    found = identify_sheets(read, **settings)
    compared = compare_sheets(read, weighting) if comparing else []
    if out is not None:
        result = found.to_dict() | {"provenance": sheets_record(tests, predict, settings)}
        result |= {"compared": [one.to_dict() for one in compared]} if compared else {}
        write_text(out, with_import(result, read.understood))
    if report is not None:
        from calibration.sheet.report import write_report

        told = [line for one in read.understood for line in one.lines()]
        write_report(report, found, [*read.tests, *read.predict], compared, told)
    written, without = ([], []) if cards is None else sheet_cards(found, cards)
    compared_tables = [compared_table(compared)] if compared else []
    show(tests_table(found), *compared_tables, *(f"note: {why}" for why in without))
    tell_written(out, report, tidy, *written)


def compared_table(compared: Sequence[Compared]) -> Table:
    """Laws beside each other."""
    from rich.table import Table

    kinds = sorted({kind for one in compared for kind in one.predicted})
    table = Table(
        title="Laws: smaller AICc is better, differences below 2 mean nothing",
        caption="R^2 of a kind of test as predicted by a fit to the other kinds"
        if kinds
        else "only one kind of test: what the laws predict of other modes cannot be judged",
    )
    table.add_column("law", overflow="fold")
    table.add_column("AICc", justify="right")
    for kind in kinds:
        table.add_column(kind, justify="right", overflow="fold")
    known = [one.fit.aicc for one in compared if math.isfinite(one.fit.aicc)]
    for one in sorted(compared, key=lambda each: each.fit.aicc if math.isfinite(each.fit.aicc) else math.inf):
        aicc = f"{one.fit.aicc - min(known):+.1f}" if math.isfinite(one.fit.aicc) else "too few data"
        table.add_row(one.title, aicc, *(_share(one.predicted.get(kind, math.nan)) for kind in kinds))
    return table


def tests_table(found: TestsFit) -> Group:
    """Ogden terms from homogeneous tests, and how much of each test they explain."""
    from rich.console import Group
    from rich.table import Table

    from rig.cli.show import quantities_table

    terms = f" with {len(found.mu)} term{'s' if len(found.mu) > 1 else ''}" if found.law.series else ""
    table = quantities_table(
        f"Identified from homogeneous tests: {found.law.title}{terms}, {found.weighting} weighting", found.quantities
    )
    explained = Table(title="Share of variance explained, R^2")
    explained.add_column("test")
    explained.add_column("fitted", justify="right")
    explained.add_column("predicted", justify="right")
    for name, share in found.r_squared.items():
        explained.add_row(name, _share(share), "")
    for name, share in found.prediction.items():
        explained.add_row(name, "", _share(share))
    return Group(
        table,
        explained,
        f"convention: {found.law.description}",
        *(f"held, not fitted: {name} = {value:g}" for name, value in found.fixed.items()),
        *(f"note: {warning}" for warning in found.warnings),
    )


def _share(share: float) -> str:
    """R^2 as text; far below zero, where any constant does better, its digits mean nothing."""
    if math.isnan(share):
        return "-"
    return f"{share:.5f}" if share >= -10.0 else "< -10"
