"""``dea-rig run``: run a protocol on the bench of a scene, into a log."""

from __future__ import annotations

from pathlib import Path

import click

from rig.cli.files import FILE, PORTS, read_ports


@click.command("run")
@click.argument("scene", type=FILE)
@click.argument("protocol", type=FILE)
@click.option("-o", "--out", type=FILE, required=True, help="Log to write; never overwrites.")
@PORTS
@click.option("--arm", is_flag=True, help="Allow high voltage on real ports; the highest voltage is asked for too.")
@click.option("--yes", is_flag=True, help="Answer every question as expected: for unattended simulated benches.")
@click.option("--take-down", is_flag=True, help="Ramp down an output that is found live; default: ask.")
def command(scene: Path, protocol: Path, out: Path, ports: Path | None, arm: bool, yes: bool, take_down: bool) -> None:
    """Run PROTOCOL on the bench of SCENE and log every byte. Ctrl-C ends it safely, Ctrl-Z or p pauses it."""
    from rig.base.outputs import check_new
    from rig.cli.running import run_and_tell
    from rig.protocol.experiment import prepare

    check_new(out)
    experiment = prepare(scene, protocol, read_ports(ports))
    run_and_tell(experiment, out, arm=arm, yes=yes, take_down=take_down)
