"""``dea-rig fit-tests``: a sheet's parameters from homogeneous tests."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rig.cli.files import FILE, tell_written

if TYPE_CHECKING:
    from rich.console import Group

    from calibration.sheet.sheet_tests import TestsFit


@click.command("fit-tests")
@click.argument("tests", nargs=-1, required=True, type=FILE)
@click.option("-o", "--out", type=FILE, help="Result as JSON.")
@click.option("--terms", type=click.IntRange(1, 4), default=3, show_default=True, help="Ogden terms.")
@click.option("--predict", multiple=True, type=FILE, help="A test that takes no part and is predicted.")
def command(tests: tuple[Path, ...], out: Path | None, terms: int, predict: tuple[Path, ...]) -> None:
    """Identify Ogden parameters from homogeneous TESTS (CSV) of a sheet, all at once.

    Columns are stretch and nominal_stress_MPa (or _kPa, _Pa); for biaxial tests stretch1, stretch2,
    nominal_stress1_MPa, nominal_stress2_MPa. A remark "# kind: uniaxial" (equibiaxial, pure shear, biaxial), or the
    file's name, says which test it is.
    """
    from rig.analysis.film import identify_tests
    from rig.base.outputs import check_new, write_text
    from rig.cli.show import show

    check_new(out)
    found = identify_tests(tests, predict, terms)
    if out is not None:
        write_text(out, found.to_json())
    show(tests_table(found))
    tell_written(out)


def tests_table(found: TestsFit) -> Group:
    """Ogden terms from homogeneous tests, and how much of each test they explain."""
    from rich.console import Group
    from rich.table import Table

    from rig.cli.show import quantities_table

    table = quantities_table(f"Identified from homogeneous tests with {len(found.mu)} Ogden terms", found.quantities)
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
