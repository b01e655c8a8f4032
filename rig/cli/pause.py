"""``dea-rig pause``: stop the stage and take the voltage off; the run can go on."""

from __future__ import annotations

from pathlib import Path

import click

from rig.cli.files import FILE


@click.command("pause")
@click.argument("log", required=False, type=FILE)
def command(log: Path | None) -> None:
    """Pause the run that is going on: the stage stops, the voltage ramps to zero. LOG names the run."""
    from rig.cli.talk import speaking_to

    with speaking_to(log) as run:
        click.echo(run.send("pause")["said"])
