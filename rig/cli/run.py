"""``dea-rig run``: run a protocol on the bench of a scene, into a log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rig.cli.files import CLEAR, FILE, PORTS, read_ports

if TYPE_CHECKING:
    from rig.protocol.experiment import Experiment


@click.command("run")
@click.argument("scene", type=FILE)
@click.argument("protocol", type=FILE, required=False)
@click.option("-o", "--out", type=FILE, required=True, help="Log to write; never overwrites.")
@click.option("--until", help='In place of PROTOCOL: measure until it is known so well, e.g. "eps_r 0.5 %".')
@click.option("--at-most", help="With --until: longest time of measuring, e.g. 20min.  [default: 60min]")
@click.option("--terms", type=click.IntRange(1, 3), default=2, show_default=True, help="With --until: Ogden terms.")
@PORTS
@click.option("--arm", is_flag=True, help="Allow high voltage on real ports; the highest voltage is asked for too.")
@click.option("--yes", is_flag=True, help="Answer every question as expected: for unattended simulated benches.")
@click.option("--take-down", is_flag=True, help="Ramp down an output that is found live; default: ask.")
@CLEAR
def command(
    scene: Path,
    protocol: Path | None,
    out: Path,
    until: str | None,
    at_most: str | None,
    terms: int,
    ports: Path | None,
    arm: bool,
    yes: bool,
    take_down: bool,
    clear: bool,
) -> None:
    """Run PROTOCOL on the bench of SCENE and log every byte. Ctrl-C ends it safely, Ctrl-Z or p pauses it.

    With --until in place of a protocol the run decides by itself where to measure: after each hold it fits what it has
    and goes where that tells most, until the quantity is known as well as asked for or the time is out.
    """
    from rig.base.outputs import check_new
    from rig.cli.running import run_and_tell
    from rig.protocol.experiment import prepare

    if (protocol is None) is (until is None):
        raise click.UsageError("Give either a PROTOCOL or --until.")
    if until is None and at_most is not None:
        raise click.UsageError("--at-most goes with --until.")
    check_new(out)
    if protocol is not None:
        experiment = prepare(scene, protocol, read_ports(ports))
    else:
        assert until is not None
        experiment = _until(scene, until, at_most or "60min", terms, read_ports(ports))
    run_and_tell(experiment, out, arm=arm, yes=yes, take_down=take_down, clear=clear)


def _until(scene: Path, until: str, at_most: str, terms: int, ports: dict[str, dict[str, Any]] | None) -> Experiment:
    """The experiment of a closed loop; what is expected of it is said."""
    from tempfile import TemporaryDirectory

    from rig.analysis.closed_loop import closed_loop, said
    from rig.analysis.proposal import parse_time
    from rig.base.terminal import tell
    from rig.protocol.experiment import prepare

    seconds = parse_time(at_most, "--at-most")
    text, expected = closed_loop(scene, until, seconds, terms)
    for line in said(expected, seconds):
        tell(line)
    with TemporaryDirectory(prefix="dea-rig-") as folder:
        path = Path(folder) / "until.toml"
        path.write_text(text, encoding="utf-8")
        return prepare(scene, path, ports)
