"""``dea-rig resume``: go on with a run that ended early."""

from __future__ import annotations

from pathlib import Path

import click

from rig.cli.files import CLEAR, FILE, PORTS, read_ports


@click.command("resume")
@click.argument("log", type=FILE)
@click.option("-o", "--out", type=FILE, required=True, help="Log to write; never overwrites.")
@PORTS
@click.option("--arm", is_flag=True, help="As for `dea-rig run`.")
@click.option("--yes", is_flag=True, help="As for `dea-rig run`.")
@click.option("--take-down", is_flag=True, help="As for `dea-rig run`.")
@CLEAR
def command(log: Path, out: Path, ports: Path | None, arm: bool, yes: bool, take_down: bool, clear: bool) -> None:
    """Go on with the run in LOG that ended early: its next step, the same specimen, the same instruments."""
    from rig.base.outputs import check_new
    from rig.cli.running import run_and_tell
    from rig.run.resume import prepare_resumed

    check_new(out)
    experiment = prepare_resumed(log, read_ports(ports))
    run_and_tell(experiment, out, arm=arm, yes=yes, take_down=take_down, clear=clear)
