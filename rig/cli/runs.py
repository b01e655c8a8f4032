"""``dea-rig runs``: list and search the logs of a folder."""

from __future__ import annotations

import re
from pathlib import Path

import click

from rig.cli.files import FOLDER


@click.command("runs")
@click.argument("folder", type=FOLDER)
@click.argument("words", nargs=-1)
@click.option("--specimen", default="", metavar="TEXT", help="Only runs of specimens with this in their name.")
@click.option("--operator", default="", metavar="TEXT", help="Only runs of operators with this in their name.")
@click.option("--outcome", default="", metavar="TEXT", help='Only runs that ended so: "complete", "cut short", ...')
@click.option("--since", default="", metavar="DATE", help="Only runs of this day, month or year and later: 2026-03-01.")
@click.option("--until", default="", metavar="DATE", help="Only runs of this day, month or year and before: 2026-03.")
def command(
    folder: Path, words: tuple[str, ...], specimen: str, operator: str, outcome: str, since: str, until: str
) -> None:
    """List the logs in FOLDER and below, the oldest first; with WORDS, only those that have all of them anywhere.

    What was read is kept in FOLDER/.dea-rig-runs.sqlite, which may be deleted at any time.
    """
    from rich import box
    from rich.table import Table

    from rig.base.text import printable
    from rig.cli.show import show
    from rig.log.catalogue import chosen, runs_in

    _check_date("--since", since)
    _check_date("--until", until)
    if since and until and since[: len(until)] > until[: len(since)]:
        raise click.BadParameter(f"{since} comes after --until {until}: no day lies between", param_hint="--since")
    entries = runs_in(folder)
    found = chosen(entries, words, specimen=specimen, operator=operator, outcome=outcome, since=since, until=until)
    columns: dict[str, list[str]] = {}
    for one in found:
        row = {
            "log": one.log,
            "date (UTC)": one.date[:16].replace("T", " "),
            "specimen": one.specimen,
            "operator": one.operator,
            "bench": one.bench,
            "outcome": one.outcome,
            "fit": one.fit,
            "notes": "\n".join(text for text in (one.notes, one.problem) if text),
        }
        for heading, text in row.items():
            columns.setdefault(heading, []).append(printable(text, keep="\n"))
    filled = {heading: texts for heading, texts in columns.items() if any(texts)}
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in filled:
        table.add_column(heading, overflow="fold", no_wrap=heading in ("date (UTC)", "bench"))
    for texts in zip(*filled.values(), strict=True):
        table.add_row(*texts)
    if found:
        show(table)
    click.echo(f"{len(found)} of {len(entries)} runs in {folder}")


def _check_date(option: str, text: str) -> None:
    if text and re.fullmatch(r"\d{4}(-\d{2}(-\d{2})?)?", text) is None:
        raise click.BadParameter(
            f"{text!r}: write year, month, day as in 2026-03-01, 2026-03 or 2026", param_hint=option
        )
