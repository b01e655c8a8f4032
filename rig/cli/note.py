"""``dea-rig note``: add a note on a log."""

from __future__ import annotations

from pathlib import Path

import click

from rig.cli.files import FILE


@click.command("note")
@click.argument("log", type=FILE)
@click.argument("text")
@click.option("--by", default="", metavar="NAME", help="Who says it. Without: the user of this computer.")
def command(log: Path, text: str, by: str) -> None:
    """Add a note on LOG, at any time: during the run or years later.

    It goes into LOG.notes.toml beside the log; the log's own bytes stay as they are. `dea-rig info`, `dea-rig runs` and
    reports show it.
    """
    from rig.log.notes import add_note

    click.echo(f"noted in {add_note(log, text, by)}")
