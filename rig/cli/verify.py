"""``dea-rig verify``: does a sensor still agree with its certificate? One standard."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rig.cli.files import CLEAR, FILE, PORTS, POSITIVE, nothing_without_a_log, read_ports

if TYPE_CHECKING:
    from rig.analysis.sensors import Quantity


@click.command("verify")
@click.argument("quantity", type=click.Choice(["force", "displacement", "hv"]))
@click.argument("scene", type=FILE)
@click.option("--standard", type=POSITIVE, required=True, help="In g, mm or V.")
@click.option("-o", "--out", type=FILE, required=True, help="Log to write; never overwrites.")
@click.option("--arm", is_flag=True, help="Allow high voltage on real ports (hv only).")
@PORTS
@click.option("--yes", is_flag=True, help="Answer every question as expected: for unattended simulated benches.")
@CLEAR
def command(
    quantity: Quantity, scene: Path, standard: float, out: Path, arm: bool, ports: Path | None, yes: bool, clear: bool
) -> None:
    """Daily one-point check: does the sensor still agree with its certificate? Exit code 1 if not."""
    from rig.analysis.certificate_file import certificate_place
    from rig.analysis.one_point import judge
    from rig.analysis.sensor_protocols import verify_text
    from rig.base.outputs import check_new, write_text
    from rig.cli.running import run_and_tell
    from rig.protocol.experiment import prepare
    from rig.scene.scene import load_scene

    loaded, _ = load_scene(scene)
    given = read_ports(ports)
    steps = out.with_suffix(".protocol.toml")
    check_new(out, steps)
    write_text(steps, verify_text(quantity, loaded, standard))
    with nothing_without_a_log(out, steps):
        run_and_tell(prepare(scene, steps, given), out, arm=arm, yes=yes, take_down=False, clear=clear)
    found = judge(out, quantity)
    factor, unit = (1e3, "mm") if found.unit == "m" else (1.0, found.unit)
    click.echo(
        f"{quantity}: applied {found.applied * factor:.6g} {unit}, measured {found.measured * factor:.6g} {unit}, "
        f"U = {found.uncertainty * factor:.2g} {unit} (k = 2), E_n = {found.normalised_error:+.2f}: "
        + ("the certificate holds." if found.passed else "DOES NOT AGREE. Calibrate anew before you measure.")
    )
    if not found.passed:
        click.echo(f"Then: dea-rig calibrate {quantity} {scene} -o FOLDER\n{certificate_place(scene, quantity)}")
        click.get_current_context().exit(1)
