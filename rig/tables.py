"""Tables for the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from rich.console import RenderableType

    from rig.experiment import Experiment


def show(*tables: RenderableType) -> None:
    """Print to standard output; as wide as the terminal, at least 100 columns where there is none."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=max(console.width, 110))
    for table in tables:
        console.print(table)


def plan_table(experiment: Experiment) -> Table:
    """The plan: every action with its time and the extremes that the model predicts of it."""
    scene = experiment.scene
    table = Table(
        title=f"{experiment.protocol.title or 'Protocol'} on {scene.specimen.name}",
        caption=(
            f"{len(experiment.actions)} actions, {_minutes(experiment.duration)}. Predicted with the scene's material; "
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
    for action, prediction in zip(experiment.actions, experiment.predictions, strict=True):
        row = [str(action.step), f"{action.kind}: {action.label}", f"{action.duration:.1f}"]
        if action.record or action.moves or action.voltage[0] != action.voltage[1]:
            row.append(f"{prediction.peak_force:.3f}")
            if scene.hv is not None:
                row.append(f"{prediction.peak_field * 1e-6:.1f}")
                row.append(f"{prediction.minimum_hoop_stress * 1e-3:.0f}")
        table.add_row(*row)
    return table


def _minutes(seconds: float) -> str:
    return f"{int(seconds // 60)} min {seconds % 60:.0f} s"
