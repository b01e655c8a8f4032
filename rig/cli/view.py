"""``dea-rig view``: a log in the Rerun viewer."""

from __future__ import annotations

from pathlib import Path

import click

from rig.cli.files import FILE, tell_written


@click.command("view")
@click.argument("log", type=FILE)
@click.option("--save", type=FILE, help="Write a Rerun recording instead of opening the viewer.")
@click.option("--screenshot", type=FILE, help="Write a picture instead of opening the viewer; needs no display.")
@click.option("--follow", "live", is_flag=True, help="Of a run that goes on: show what is added, as it comes.")
def command(log: Path, save: Path | None, screenshot: Path | None, live: bool) -> None:
    """Open LOG in the Rerun viewer, on this machine only."""
    from rig.base.outputs import check_new
    from rig.view.viewer import follow, view

    if live:
        if save is not None or screenshot is not None:
            raise click.UsageError("--follow opens the viewer; --save and --screenshot are for the whole log.")
        follow(log)
        return
    check_new(save, screenshot)
    view(log, save=save, screenshot=screenshot)
    tell_written(save, screenshot)
