"""``dea-rig sim``: serve the simulated bench on pseudo-terminals."""

from __future__ import annotations

import json
import os
from pathlib import Path

import click

from rig.cli.files import FILE


@click.command("sim")
@click.argument("scene", type=FILE)
def command(scene: Path) -> None:
    """Serve the simulated bench of SCENE, or the log in its place, on pseudo-terminals; prints the ports as JSON."""
    from rig.base.clock import RealClock
    from rig.base.errors import ConfigError
    from rig.operator.signals import stop_on_signals
    from rig.protocol.experiment import SERVED_BY, SERVER
    from rig.run.backend import wired_bench
    from rig.scene.scene import load_scene

    if os.name != "posix":
        raise ConfigError("The bench is served on pseudo-terminals, which this system lacks. Run it in memory.")
    from rig.sim.server import Server

    loaded, _ = load_scene(scene)
    server = Server(wired_bench(loaded, real_time=True), RealClock())
    with stop_on_signals() as stop:
        try:
            click.echo(json.dumps({**server.ports, SERVED_BY: SERVER}))
            server.run(lambda: stop.count > 0)
        finally:
            server.close()
