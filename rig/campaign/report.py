"""The table of a campaign: one row for each specimen, from its logs and the fits beside them."""

from __future__ import annotations

import contextlib
import csv
import io
import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from rig.base.errors import ConfigError, DataError
from rig.base.text import printable
from rig.campaign.campaign import Campaign
from rig.campaign.progress import COMPLETE, Done, progress_of
from rig.campaign.statistics import BOUNDS, RISING, Statistics, Value, plain, statistics_of
from rig.log.contents import scene_in
from rig.log.reader import Log, read_log

if TYPE_CHECKING:
    from rich.table import Table

BOUNDS_WORDS = (
    "A result that is a bound only (a film that bore the ceiling) is in none of these numbers: where there are such, "
    "the mean is that of the films that broke, and too low for all. `dea-rig analyse breakdown` takes all of them."
)

UPPER_WORDS = (
    'Results marked "at most" are upper bounds: the supply measures no current, the film may have broken down lower. '
    "They count as exact values here, so the true mean may be lower."
)

AT_LEAST, AT_MOST = "at least", "at most"


class Result(NamedTuple):
    """What a step found, in SI: value, standard uncertainty (NaN: none is stated), and whether it is a bound."""

    value: float
    uncertainty: float
    unit: str
    bound: str


@dataclass(frozen=True)
class Row:
    """One specimen.

    Attributes
    ----------
    results : dict of str to Result
        What the steps found, by name.
    found : str
        How the step that found it ended.
    """

    done: Done
    results: dict[str, Result]
    found: str


def rows_of(campaign: Campaign) -> list[Row]:
    """The rows, in the campaign's order; results are those of the newest complete run."""
    rows = []
    for one in progress_of(campaign):
        complete = [run for run in one.runs if run.outcome == COMPLETE]
        results: dict[str, Result] = {}
        found = ""
        if complete:
            log = read_log(campaign.logs / complete[-1].log)
            messages = [one.fields for one in log.messages("/result")]
            bound_of = _bounds(log, messages)
            for one_result in messages:
                value, uncertainty, unit = (one_result[key] for key in ("value", "standard_uncertainty", "unit"))
                results[one_result["name"]] = Result(value, uncertainty, unit, bound_of(one_result))
            found = _found(messages)
        rows.append(Row(one, results, found))
    return rows


def _found(messages: list[dict[str, Any]]) -> str:
    """How the last step that found something ended; for each of its results where they ended differently."""
    last = [fields for fields in messages if fields["step"] == messages[-1]["step"]]
    outcomes = {fields["outcome"] for fields in last}
    if len(outcomes) < 2:
        return "".join(outcomes)
    return ", ".join(f"{fields['name']} {fields['outcome']}" for fields in last)


def statistics(rows: list[Row], campaign: Campaign) -> list[Statistics]:
    """Statistics of each result over all complete runs, in the order in which results first come."""
    found: dict[tuple[str, str], list[Value]] = {}
    for row in rows:
        for run in row.done.runs:
            if run.outcome != COMPLETE:
                continue
            log = read_log(campaign.logs / run.log)
            messages = [message.fields for message in log.messages("/result")]
            bound_of = _bounds(log, messages)
            steps = {kind: sorted({f["step"] for f in messages if f["kind"] == kind}) for kind in _kinds(messages)}
            for f in messages:
                place = f" (step {f['step']})" if len(steps[f["kind"]]) > 1 else ""
                name = f"{f['kind']}: {plain(f['name'])}{place}"
                bound = bound_of(f)
                one = row.done.specimen
                at = datetime.fromisoformat(run.date).timestamp() if run.date else math.nan
                found.setdefault((name, f["unit"]), []).append(
                    Value(one.name, one.batch, at, f["value"], bound == AT_LEAST, bound == AT_MOST)
                )
    return [statistics_of(name, unit, values) for (name, unit), values in found.items()]


def _bounds(log: Log, messages: list[dict[str, Any]]) -> Callable[[dict[str, Any]], str]:
    """What tells of which results of a log only a bound is known; a log without a scene that can be read has all."""
    sags = False
    if "breakdown" in _kinds(messages):
        with contextlib.suppress(ConfigError, DataError):
            sags = scene_in(log).breakdowns_are_bounds

    def bound(fields: dict[str, Any]) -> str:
        if fields["kind"] != "breakdown":
            return ""
        if fields["outcome"] in BOUNDS:
            return AT_LEAST
        return AT_MOST if sags and fields["name"] in RISING else ""

    return bound


def bounds_words(found: list[Statistics]) -> str:
    """What is to be said of the bounds among the results; empty without any."""
    said = (any(one.bounds for one in found), BOUNDS_WORDS), (any(one.upper_bounds for one in found), UPPER_WORDS)
    return " ".join(words for there, words in said if there)


def _kinds(messages: list[dict[str, Any]]) -> set[str]:
    return {fields["kind"] for fields in messages}


def certificate_problems(rows: list[Row], campaign: Campaign) -> dict[str, list[str]]:
    """What spoke against the certificates in the runs of each specimen; of the others nothing is said."""
    found: dict[str, list[str]] = {}
    for row in rows:
        for run in row.done.runs:
            if run.outcome == "cannot be read":
                continue
            log = read_log(campaign.logs / run.log)
            said = [message.fields["problem"] for message in log.messages("/certificate_problem")]
            dated = log.metadata.get("run", {}).get("certificate_problems", "")
            for problem in [*(text for text in dated.split("; ") if text), *said]:
                mine = found.setdefault(row.done.specimen.name, [])
                if problem not in mine:
                    mine.append(problem)
    return found


def statistics_table(found: list[Statistics]) -> Table:
    """Statistics for the terminal."""
    from rich.table import Table

    table = Table(title="Over all specimens", caption=bounds_words(found) or None)
    for heading in ("result", "n", "mean (95 % interval)", "between", "within", "groups p", "drift per day", "bounds"):
        table.add_column(heading, overflow="fold")
    for cells in statistics_cells(found):
        table.add_row(*map(printable, cells))
    return table


def statistics_cells(found: list[Statistics]) -> list[list[str]]:
    """The same as text, one row a result."""

    def known(value: float) -> str:
        return f"{value:.3g}" if math.isfinite(value) else "-"

    rows = []
    for one in found:
        interval = f" ({known(one.interval[0])} to {known(one.interval[1])})" if math.isfinite(one.interval[0]) else ""
        drift = known(one.drift_per_day)
        if math.isfinite(one.p_drift):
            drift += f" +- {known(one.drift_uncertainty)}, p {known(one.p_drift)}"
        name = f"{one.name} / {one.unit}"
        numbers = [f"{known(one.mean)}{interval}", known(one.between), known(one.within), known(one.p_groups), drift]
        bounds = [str(one.bounds)] * (one.bounds > 0) + [f"{one.upper_bounds} at most"] * (one.upper_bounds > 0)
        rows.append([name, str(one.specimens), *numbers, ", ".join(bounds)])
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
    one = row.results[name]
    said = f"{one.bound} {one.value * factor:.4g}".strip()
    return f"{said} +- {one.uncertainty * factor:.2g}" if math.isfinite(one.uncertainty) else said


def as_csv(rows: list[Row]) -> str:
    """The rows as CSV; results that only some have are empty for the others, and so is the bound of exact values."""
    units: dict[str, str] = {}
    for row in rows:
        units |= {name: one.unit for name, one in row.results.items()}
    heading = ["specimen", "batch", "standing", "runs", "log", "date", "outcome", "found"]
    for name, unit in units.items():
        heading += [f"{name} [{unit}]", f"standard uncertainty of {name} [{unit}]", f"bound of {name}"]
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
            cells += ["", "", ""] if value is None else [repr(value.value), repr(value.uncertainty), value.bound]
        writer.writerow(cells)
    return out.getvalue()
