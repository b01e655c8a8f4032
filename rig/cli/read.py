"""``dea-rig read``: what every instrument says now; nothing moves, the output is left alone."""

from __future__ import annotations

from pathlib import Path

import click

from rig.cli.files import FILE, PORTS, read_ports


@click.command("read")
@click.argument("scene", type=FILE)
@PORTS
@click.option("-o", "--out", type=FILE, help="Keep the log of it; default: it is not kept.")
def command(scene: Path, ports: Path | None, out: Path | None) -> None:
    """One line for each instrument of SCENE: what it says now, and who it is. Nothing is moved or switched.

    Guard, limits and checks are those of a run: an output that is found live is told (exit code 4) and left as it is.
    """
    from contextlib import nullcontext
    from tempfile import TemporaryDirectory

    from rig.base.outputs import check_new
    from rig.cli.running import prepare_step
    from rig.log.contents import bench_word
    from rig.run.run import Consent, run

    experiment = prepare_step(scene, "Read the instruments", {"do": "jog", "moves": ["read"]}, read_ports(ports))
    if out is not None:
        check_new(out)
    click.echo(f"{bench_word(experiment.bench)}: {experiment.bench}")
    with nullcontext("") if out is not None else TemporaryDirectory(prefix="dea-rig-read-") as folder:
        consent = Consent(answers="dea-rig read asks nothing")
        run(experiment, out or Path(folder) / "read.mcap", lambda done, total, label: None, consent, click.echo)
