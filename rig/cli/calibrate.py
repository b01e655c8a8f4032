"""``dea-rig calibrate``: calibrate an instrument and write its certificate."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rig.cli.files import CLEAR, FILE, FOLDER, PORTS, nothing_without_a_log, read_ports, tell_written

if TYPE_CHECKING:
    from rich.console import RenderableType

    from rig.analysis.sensors import Calibration, Quantity


@click.command("calibrate")
@click.argument("quantity", type=click.Choice(["force", "displacement", "compliance", "hv", "timing"]))
@click.argument("source", type=FILE)
@click.option("-o", "--out", type=FOLDER, required=True, help="Directory.")
@click.option("--protocol", type=FILE, help="Steps to run in place of the usual ones.")
@click.option("--valid-days", type=click.IntRange(1, 3650), default=365, show_default=True, help="Of the certificate.")
@click.option("--arm", is_flag=True, help="Allow high voltage on real ports (hv only).")
@PORTS
@click.option("--yes", is_flag=True, help="Answer every question as expected: for unattended simulated benches.")
@CLEAR
def command(
    quantity: Quantity,
    source: Path,
    out: Path,
    protocol: Path | None,
    valid_days: int,
    arm: bool,
    ports: Path | None,
    yes: bool,
    clear: bool,
) -> None:
    """Calibrate an instrument on the bench of SOURCE, a scene, and write its certificate; or from SOURCE, a log.

    force: weights. displacement: the laser against the stage. compliance: the rig, against a rigid dummy. hv: the
    monitor against a reference meter. timing: how far laser and force lag behind the stage.
    """
    from rig.analysis.certificate_file import certificate_place, certificate_text
    from rig.analysis.sensor_picture import draw
    from rig.analysis.sensors import calibrate
    from rig.base.errors import ConfigError
    from rig.base.outputs import write_text
    from rig.cli.show import show

    certificate, picture = out / f"{quantity}.toml", out / f"{quantity}.png"
    wanted = [picture] if quantity == "timing" else [certificate, picture]
    if source.suffix == ".mcap":
        if protocol is not None:
            raise ConfigError("--protocol goes with a scene; a log holds its own.")
        if ports is not None:
            raise ConfigError("--ports goes with a scene; a log needs no instruments.")
        with _made(out, *wanted):
            found = calibrate(source, quantity)
    else:
        log = _run(quantity, source, out, protocol, wanted, read_ports(ports), arm=arm, yes=yes, clear=clear)
        found = calibrate(log, quantity)
    if quantity != "timing":
        write_text(certificate, certificate_text(found, valid_days))
    draw(found, picture)
    show(*calibration_table(found))
    tell_written(*wanted)
    if quantity != "timing":
        click.echo(certificate_place(source if source.suffix != ".mcap" else None, quantity, certificate))


def _run(
    quantity: Quantity,
    scene: Path,
    out: Path,
    protocol: Path | None,
    wanted: list[Path],
    ports: dict[str, Any] | None,
    *,
    arm: bool,
    yes: bool,
    clear: bool,
) -> Path:
    """Carry the calibration out on the bench of ``scene``; its log. The usual steps are left beside it."""
    from rig.analysis.sensor_protocols import protocol_text
    from rig.base.outputs import write_text
    from rig.cli.running import run_and_tell
    from rig.protocol.experiment import prepare
    from rig.scene.scene import load_scene

    log, steps = out / f"{quantity}.mcap", protocol or out / f"{quantity}.protocol.toml"
    loaded, _ = load_scene(scene)
    text = protocol_text(quantity, loaded) if protocol is None else ""
    made = [steps] if protocol is None else []
    with _made(out, *wanted, log, *made):
        if protocol is None:
            write_text(steps, text)
        with nothing_without_a_log(log, *made):
            run_and_tell(prepare(scene, steps, ports), log, arm=arm, yes=yes, take_down=False, clear=clear)
    return log


@contextmanager
def _made(out: Path, *files: Path) -> Iterator[None]:
    """Make the directory of new ``files``; it goes again when an error comes before anything is in it."""
    from rig.base.errors import ConfigError
    from rig.base.outputs import check_new

    new = not out.exists()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{out}: this directory cannot be made: {error.strerror}.") from None
    check_new(*files)
    try:
        yield
    except BaseException:
        if new and not any(out.iterdir()):
            out.rmdir()
        raise


def calibration_table(found: Calibration) -> list[RenderableType]:
    """What a calibration found, with its budget."""
    from rich.table import Table
    from rich.text import Text

    tables: list[RenderableType] = []
    characteristic = found.characteristic
    if characteristic is not None:
        from rig.analysis.sensors import UNIT

        unit = UNIT[found.quantity]
        relative = characteristic.gain_uncertainty
        table = Table(title=f"{found.quantity}: {found.instrument or found.quantity} {found.serial}".strip())
        table.add_column("what")
        table.add_column("value", justify="right")
        table.add_column("uncertainty, k = 1", justify="right")
        if found.quantity == "compliance":
            compliance = abs(1e6 / characteristic.gain)
            table.add_row("compliance of the rig / um/N", f"{compliance:.4g}", f"{compliance * relative:.2g}")
        else:
            per = f"{unit} per {found.reading_unit}"
            table.add_row(f"gain / {per}", f"{characteristic.gain:.7g}", f"{characteristic.gain * relative:.2g}")
            factor, unit = (1e6, "um") if unit == "m" else (1.0, unit)
            table.add_row(f"zero / {unit}", f"{characteristic.zero * characteristic.gain * factor:.4g}", "")
            for name, value in (
                ("noise of a sample", characteristic.noise),
                ("zero, with drift", characteristic.zero_uncertainty),
                ("repeatability", characteristic.repeatability),
                ("hysteresis", characteristic.hysteresis),
                ("linearity", characteristic.linearity),
                *([("creep", found.creep)] if found.creep is not None else []),
            ):
                table.add_row(f"{name} / {unit}", f"{value * factor:.2g}", "")
            top = characteristic.high
            expanded = f"{characteristic.expanded_uncertainty(top) * factor:.2g}"
            table.add_row(f"expanded uncertainty at {top * factor:.5g} {unit}, k = 2 / {unit}", expanded, "")
        tables.append(table)
        budget = Table(title="Budget of the gain")
        for heading in ("component", "type", "relative, k = 1", "what it is"):
            budget.add_column(heading)
        for part in sorted(characteristic.budget, key=lambda part: -part.relative):
            budget.add_row(part.name, part.type, f"{part.relative:.1e}", part.note)
        tables.append(budget)
    if found.lags:
        lags = Table(title="Lag behind the stage")
        for heading in ("sensor", "lag / ms", "uncertainty, k = 1 / ms", "hysteresis / um of the stage"):
            lags.add_column(heading, justify="left" if heading == "sensor" else "right")
        for role, lag in sorted(found.lags.items()):
            row = f"{lag.lag * 1e3:.2f}", f"{lag.uncertainty * 1e3:.2f}", f"{lag.standing * 1e6:.2f}"
            lags.add_row(role, *row)
        tables.append(lags)
    if found.quantity == "timing":
        tables.append(Text("For the certificates, above their [findings], in place of what they say of the lag:"))
        tables += [
            Text(f"  {role}: lag_s = {lag.lag:.5f}, lag_uncertainty_s = {lag.uncertainty:.5f}", no_wrap=True)
            for role, lag in sorted(found.lags.items())
        ]
    return tables
