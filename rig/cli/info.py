"""``dea-rig info``: what is in a log."""

from __future__ import annotations

from pathlib import Path

import click

from rig.cli.files import FILE


@click.command("info")
@click.argument("log", type=FILE)
def command(log: Path) -> None:
    """What is in LOG: run, devices, channels and rates, gaps, outcome."""
    from rig.log.info import info

    click.echo(info(log))
