"""``dea-rig recover``: save what can be read of a damaged log."""

from __future__ import annotations

from pathlib import Path

import click

from rig.cli.files import FILE


@click.command("recover")
@click.argument("log", type=FILE)
@click.option("-o", "--out", type=FILE, required=True, help="Log to write.")
def command(log: Path, out: Path) -> None:
    """Save what can be read of a damaged LOG. Exit code 0: all of it; 3: part of it; 1: nothing."""
    from rig.log.recover import recover

    recovery = recover(log, out)
    click.echo(recovery.report)
    click.get_current_context().exit(recovery.exit_code)
