"""The table of a campaign: one row for each specimen, from its logs and the fits beside them."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rig.base.text import printable
from rig.campaign.campaign import Campaign
from rig.campaign.progress import COMPLETE, Done, progress_of
from rig.log.reader import read_log

if TYPE_CHECKING:
    from rich.table import Table


@dataclass(frozen=True)
class Row:
    """One specimen.

    Attributes
    ----------
    results : dict of str to (float, float, str)
        What the steps found, by name: value, standard uncertainty, unit; SI.
    found : str
        How the step that found it ended.
    """

    done: Done
    results: dict[str, tuple[float, float, str]]
    found: str


def rows_of(campaign: Campaign) -> list[Row]:
    """The rows, in the campaign's order; results are those of the newest complete run."""
    rows = []
    for one in progress_of(campaign):
        complete = [run for run in one.runs if run.outcome == COMPLETE]
        results: dict[str, tuple[float, float, str]] = {}
        found = ""
        if complete:
            for message in read_log(campaign.logs / complete[-1].log).messages("/result"):
                fields = message.fields
                results[fields["name"]] = (fields["value"], fields["standard_uncertainty"], fields["unit"])
                found = fields["outcome"]
        rows.append(Row(one, results, found))
    return rows


def as_table(campaign: Campaign, rows: list[Row]) -> Table:
    """The rows for the terminal."""
    from rich.table import Table

    table = Table(title=printable(campaign.table.title) or None)
    for heading in ("specimen", "batch", "is", "date (UTC)", "found", "voltage / V", "field / V/um", "fit"):
        table.add_column(heading, overflow="fold")
    for row in rows:
        newest = row.done.newest
        date = newest.date[:16].replace("T", " ") if newest else ""
        volts, field = (_short(row, name, factor) for name, factor in (("voltage", 1.0), ("field", 1e-6)))
        texts = (row.done.specimen.name, row.done.specimen.batch, row.done.standing.value, date, row.found)
        table.add_row(*map(printable, texts), volts, field, printable(newest.fit if newest else ""))
    return table


def _short(row: Row, name: str, factor: float) -> str:
    if name not in row.results:
        return ""
    value, uncertainty, _ = row.results[name]
    return f"{value * factor:.4g} +- {uncertainty * factor:.2g}"


def as_csv(rows: list[Row]) -> str:
    """The rows as CSV; results that only some have are empty for the others."""
    units: dict[str, str] = {}
    for row in rows:
        units |= {name: unit for name, (_, _, unit) in row.results.items()}
    heading = ["specimen", "batch", "standing", "runs", "log", "date", "outcome", "found"]
    for name, unit in units.items():
        heading += [f"{name} [{unit}]", f"standard uncertainty of {name} [{unit}]"]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(heading)
    for row in rows:
        newest, one = row.done.newest, row.done
        cells: list[object] = [one.specimen.name, one.specimen.batch, one.standing.value, len(one.runs)]
        cells += ["", "", ""] if newest is None else [newest.log, newest.date, newest.outcome]
        cells.append(row.found)
        for name in units:
            value = row.results.get(name)
            cells += ["", ""] if value is None else [repr(value[0]), repr(value[1])]
        writer.writerow(cells)
    return out.getvalue()
