"""What `dea-rig fit-tests` prints and writes of sheets that take time."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Group
from rich.table import Table

from rig.base.outputs import write_text
from rig.cli.files import tell_written
from rig.cli.import_options import with_import
from rig.cli.show import quantities_table, show

if TYPE_CHECKING:
    from calibration.sheet.timed.predict import ConePrediction
    from calibration.sheet.timed.result import SheetTrace, TimedFit
    from rig.analysis.imported import SheetsRead


def fit_over_time(
    read: SheetsRead,
    cones: Sequence[Path],
    settings: Mapping[str, Any],
    provenance: Mapping[str, Any],
    out: Path | None,
    report: Path | None,
) -> None:
    """Fit the tests that were read with branches, predict the cones, write the result and print it."""
    from rig.analysis.sheet_over_time import identify_over_time, record_of

    found = identify_over_time(read, cones, **settings)
    if out is not None:
        result = found.to_dict() | {"provenance": record_of(settings, provenance, cones)}
        write_text(out, with_import(result, read.understood))
    if report is not None:
        from calibration.sheet.timed.report import write_report

        write_report(report, found.fit, found.cones, [line for one in read.understood for line in one.lines()])
    show(_fitted(found.fit), *([_cones(found.cones)] if found.cones else []))


def predict_from_film(read: SheetsRead, film: Path, out: Path | None, report: Path | None) -> None:
    """Predict the tests that were read from a film's result, write and print how well."""
    from rig.analysis.sheet_over_time import sheets_from_film
    from rig.base.errors import ConfigError

    if report is not None:
        raise ConfigError("--report goes with a fit; with --film nothing is fitted. Give -o for the numbers.")
    material, traces = sheets_from_film(read, film)
    if out is not None:
        found = {"format": "dea-rig sheets from a film 1", "film": str(film), "law": material.law.name}
        found |= {"predicted": {one.name: one.to_dict() for one in traces}}  # type: ignore[dict-item]
        write_text(out, json.dumps(found, indent=2, allow_nan=False) + "\n")
    show(_explained(f"The sheets from the film of {film.name}", {"predicted": traces}))
    tell_written(out)


def _fitted(fit: TimedFit) -> Group:
    terms = f" with {len(fit.mu)} term{'s' if len(fit.mu) > 1 else ''}" if fit.law.series else ""
    shown = {**fit.quantities, "G at once": fit.spectrum.instant}
    return Group(
        quantities_table(f"Identified from tests over time: {fit.law.title}{terms}, relaxed", shown),
        _explained("What is explained of each test", {"fitted": fit.tests, "predicted": fit.predicted}),
        f"convention: {fit.law.description}",
        *(f"held, not fitted: {name} = {value:g}" for name, value in fit.fixed.items()),
        *(f"note: {warning}" for warning in fit.warnings),
    )


def _explained(title: str, tests: Mapping[str, Sequence[SheetTrace]]) -> Table:
    table = Table(title=title)
    for heading in ("test", "role", "kind"):
        table.add_column(heading)
    for heading in ("R^2", "residual", "over the largest"):
        table.add_column(heading, justify="right")
    for role, traces in tests.items():
        for one in traces:
            share = f"{one.r_squared:.5f}" if one.r_squared > -10.0 else "< -10"
            table.add_row(
                one.name, role, one.kind, share, f"{one.rms / 1e3:.3g} kPa", f"{100.0 * one.rms / one.largest:.2g} %"
            )
    return table


def _cones(cones: Sequence[ConePrediction]) -> Table:
    table = Table(
        title="The cone from the sheet",
        caption="+-: standard uncertainty of the sheet's stiffness and of what is stated of the cone. The permittivity "
        "is that of the cone's scene.",
    )
    table.add_column("run", overflow="fold")
    for heading in ("difference over the peak", "measured / predicted", "+-", "after factor"):
        table.add_column(heading, justify="right")
    table.add_column("agrees")
    for one in cones:
        numbers = f"{100.0 * one.rms:.2g} %", f"{one.factor:.4f}", f"{one.uncertainty:.2g}"
        table.add_row(one.run, *numbers, f"{100.0 * one.rms_scaled:.2g} %", "yes" if one.agrees else "no")
    return table
