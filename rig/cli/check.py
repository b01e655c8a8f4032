"""``dea-rig check``: the plan of a protocol, and what the model predicts of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rig.cli.files import FILE

MOST_ROWS = 200  # of the table; of a longer plan the beginning and the end are shown

if TYPE_CHECKING:
    from rich.table import Table

    from rig.protocol.experiment import Experiment


@click.command("check")
@click.argument("scene", type=FILE)
@click.argument("protocol", type=FILE)
def command(scene: Path, protocol: Path) -> None:
    """Validate SCENE and PROTOCOL and print the plan with what the model predicts. Touches no hardware."""
    from rig.cli.show import show
    from rig.protocol.experiment import prepare
    from rig.run.rehearse import check_instruments

    experiment = prepare(scene, protocol)
    check_instruments(experiment)
    show(plan_table(experiment))


def plan_table(experiment: Experiment) -> Table:
    """The plan: every action with its time and the extremes that the model predicts of it."""
    from rich.table import Table

    from rig.cli.show import minutes

    scene = experiment.scene
    table = Table(
        title=f"{experiment.protocol.title or 'Protocol'} on {scene.specimen.name}",
        caption=(
            f"{len(experiment.actions)} actions, {minutes(experiment.duration)}. Predicted with the scene's material; "
            f"limits: force {scene.limits.force_N:g} N, displacement {scene.limits.displacement_mm:g} mm"
            + (f", voltage {scene.limits.voltage_V:g} V" if scene.hv is not None else "")
            + ". All hold."
        ),
    )
    table.add_column("step", justify="right")
    table.add_column("action")
    table.add_column("time / s", justify="right")
    table.add_column("peak force / N", justify="right")
    if scene.hv is not None:
        table.add_column("peak field / V/um", justify="right")
        table.add_column("tension margin / kPa", justify="right")
    left_out = len(experiment.actions) - MOST_ROWS
    for number, (action, prediction) in enumerate(zip(experiment.actions, experiment.predictions, strict=True)):
        if left_out > 0 and MOST_ROWS // 2 <= number < MOST_ROWS // 2 + left_out:
            if number == MOST_ROWS // 2:
                table.add_row("...", f"{left_out} more, which hold too", "...")
            continue
        row = [str(action.step), f"{action.kind}: {action.label}", f"{action.duration:.1f}"]
        if action.record or action.moves or action.voltage[0] != action.voltage[1]:
            row.append(f"{prediction.peak_force:.3f}")
            if scene.hv is not None:
                row.append(f"{prediction.peak_field * 1e-6:.1f}")
                row.append(f"{prediction.minimum_hoop_stress * 1e-3:.0f}")
        table.add_row(*row)
    return table
