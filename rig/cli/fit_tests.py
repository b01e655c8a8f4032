"""``dea-rig fit-tests``: a sheet's parameters from homogeneous tests."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rig.cli.files import FILE, tell_written
from rig.cli.import_options import import_options, taken, understood_or_refused, with_import

if TYPE_CHECKING:
    from rich.console import Group

    from calibration.sheet.sheet_tests import TestsFit


@click.command("fit-tests")
@click.argument("tests", nargs=-1, required=True, type=FILE)
@click.option("-o", "--out", type=FILE, help="Result as JSON.")
@click.option("--law", default="ogden", show_default=True, help="Law of the sheet, e.g. yeoh.")
@click.option("--terms", type=click.IntRange(1, 4), default=3, show_default=True, help="Ogden terms.")
@click.option("--predict", multiple=True, type=FILE, help="A test that takes no part and is predicted.")
@import_options(sheet=True)
def command(
    tests: tuple[Path, ...],
    out: Path | None,
    law: str,
    terms: int,
    predict: tuple[Path, ...],
    dry_run: bool,
    tidy: Path | None,
    **words: Any,
) -> None:
    """Identify a law from homogeneous TESTS of a sheet, all at once.

    TESTS are tables as testing machines and spreadsheets write them: text in any encoding, separator and decimal sign,
    with columns of stretch, strain or extension, and of nominal stress or force. What is understood of each is printed
    first; what cannot be understood is asked for, with the option that tells it. A shared set of options can stand in
    DATA.import.toml beside DATA.csv. The kind of test is in the file, in its name, or in --kind.
    """
    from rig.analysis.imported import identify_sheets, read_sheets
    from rig.base.outputs import check_new, write_text
    from rig.cli.show import show

    check_new(out, tidy)
    read = understood_or_refused(lambda: read_sheets(tests, predict, taken(words)))
    if tidy is not None:
        from rig.importing.tidy import write_sheet_tests

        write_sheet_tests(tidy, read.tests)
    if not dry_run:
        found = identify_sheets(read, terms=terms, law=law)
        if out is not None:
            write_text(out, with_import(found.to_json(), read.understood))
        show(tests_table(found))
    tell_written(None if dry_run else out, tidy)


def tests_table(found: TestsFit) -> Group:
    """The law from homogeneous tests, and how much of each test they explain."""
    from rich.console import Group
    from rich.table import Table

    from rig.cli.show import quantities_table

    terms = f" with {len(found.mu)} terms" if found.law.series else ""
    title = f"Identified from homogeneous tests: {found.law.title} law{terms}"
    table = quantities_table(title, found.quantities)
    explained = Table(title="Share of variance explained, R^2")
    explained.add_column("test")
    explained.add_column("fitted", justify="right")
    explained.add_column("predicted", justify="right")
    for name, share in found.r_squared.items():
        explained.add_row(name, _share(share), "")
    for name, share in found.prediction.items():
        explained.add_row(name, "", _share(share))
    return Group(table, explained, *(f"note: {warning}" for warning in found.warnings))


def _share(share: float) -> str:
    """R^2 as text; far below zero, where any constant does better, its digits mean nothing."""
    return f"{share:.5f}" if share >= -10.0 else "< -10"
