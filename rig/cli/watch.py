"""``dea-rig watch``: a run as it goes on, in the browser or the terminal."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import click


@click.command("watch")
@click.argument("log", type=click.Path(path_type=Path, dir_okay=False), required=False)
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Serve on this port; default: any free one.")
@click.option("--browser/--no-browser", default=True, help="Open the page in the browser.")
@click.option("--terminal", is_flag=True, help="Show the numbers in this terminal instead of a page.")
def command(log: Path | None, port: int, browser: bool, terminal: bool) -> None:
    """Watch the run that writes LOG, or whatever run is going on; finished logs too.

    The page has a Stop button (also: Esc key). It is served on this machine only, by a process of its own that the run
    does not wait for. Close it with Ctrl-C: the run goes on.
    """
    if hasattr(os, "nice"):
        with suppress(OSError):
            os.nice(10)  # the run comes first
    if terminal:
        from rig.panel.terminal import watch

        watch(log)
        return
    from rig.panel.server import Panel

    panel = Panel(log, port)
    click.echo(f"The panel is at {panel.address}\nCtrl-C closes the panel; a run goes on.")
    if browser:
        import webbrowser

        webbrowser.open(panel.address)
    try:
        panel.serve_forever(poll_interval=0.2)
    except KeyboardInterrupt:
        click.echo("The panel is closed.")
    finally:
        panel.server_close()
