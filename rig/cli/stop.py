"""``dea-rig stop``: end the run that is going on."""

from __future__ import annotations

from pathlib import Path

import click

from rig.cli.files import FILE

END_S = 600.0  # a ramp down may be slow


@click.command("stop")
@click.argument("log", required=False, type=FILE)
def command(log: Path | None) -> None:
    """End the run that is going on, as Ctrl-C does; a second time hastens it. LOG names the run."""
    from rig.base.clock import RealClock
    from rig.cli.talk import LOOK_S, speaking_to

    with speaking_to(log) as run:
        click.echo(run.send("stop")["said"])
        clock = RealClock()
        try:
            while clock.now() < END_S:
                run.send("status")
                clock.sleep_until(clock.now() + LOOK_S)
        except ConnectionError:
            click.echo(f"The run has ended; its log is {run.log}.")
