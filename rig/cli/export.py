"""``dea-rig export``: a log as a table, with units in the header."""

from __future__ import annotations

from pathlib import Path

import click

from rig.cli.files import FILE


@click.command("export")
@click.argument("log", type=FILE)
@click.option("-o", "--out", type=FILE, required=True, help="File to write: .csv or .parquet.")
@click.option("--topic", help="One channel as recorded; default: the aligned run.")
def command(log: Path, out: Path, topic: str | None) -> None:
    """Write LOG as a table, with units in the header."""
    from rig.log.export import export

    click.echo(f"{out}: {export(log, out, topic)} rows")
