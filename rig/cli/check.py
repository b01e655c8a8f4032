"""``dea-rig check``: the plan of a protocol, and what the model predicts of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rig.cli.files import FILE

MOST_ROWS = 200  # of a longer plan the beginning and the end are shown
PAGE = 40  # rows where there is no terminal, whose height is a page

if TYPE_CHECKING:
    from rich.table import Table

    from rig.protocol.experiment import Experiment


@click.command("check")
@click.argument("scene", type=FILE)
@click.argument("protocol", type=FILE)
def command(scene: Path, protocol: Path) -> None:
    """Validate SCENE and PROTOCOL and print the plan with what the model predicts. Touches no hardware."""
    import shutil
    import sys

    from rich.text import Text

    from rig.cli.show import show
    from rig.protocol.experiment import prepare
    from rig.run.rehearse import check_instruments, log_size

    experiment = prepare(scene, protocol)
    check_instruments(experiment)
    size = log_size(experiment) if experiment.summaries else None
    page = max(shutil.get_terminal_size().lines - 8, 10) if sys.stdout.isatty() else PAGE
    show(*pages(experiment, page), Text(summary(experiment, size)))


def pages(experiment: Experiment, page: int) -> list[Table]:
    """The plan: every action with its time and the extremes that the model predicts of it; each page has the heads."""
    from rich import box
    from rich.table import Table

    title = f"{experiment.protocol.title or 'Protocol'} on {experiment.scene.specimen.name}"
    heads = ["step", "action", "time\n/ s", "peak\nforce / N"]
    if experiment.scene.hv is not None:
        heads += ["peak field\n/ V/um", "tension\nmargin / kPa"]
    rows = list(_rows(experiment))
    tables = []
    for first in range(0, max(len(rows), 1), page):
        number = f" (page {first // page + 1} of {-(-len(rows) // page)})" if len(rows) > page else ""
        table = Table(title=title + number, box=box.SIMPLE_HEAD)
        for head in heads:
            table.add_column(head, justify="left" if head == "action" else "right", no_wrap=head != "action")
        for row in rows[first : first + page]:
            table.add_row(*row)
        tables.append(table)
    return tables


def _rows(experiment: Experiment) -> Iterator[list[str]]:
    left_out = len(experiment.actions) - MOST_ROWS
    for number, (action, prediction) in enumerate(zip(experiment.actions, experiment.predictions, strict=True)):
        if left_out > 0 and MOST_ROWS // 2 <= number < MOST_ROWS // 2 + left_out:
            if number == MOST_ROWS // 2:
                yield ["...", f"{left_out} more, which hold too", "..."]
            continue
        row = [str(action.step), f"{action.kind}: {action.label}", f"{action.duration:.1f}"]
        if action.record or action.moves or action.voltage[0] != action.voltage[1]:
            row.append(f"{prediction.peak_force:.3f}")
            if experiment.scene.hv is not None:
                row.append(f"{prediction.peak_field * 1e-6:.1f}")
                row.append(f"{prediction.minimum_hoop_stress * 1e-3:.0f}")
        yield row


def summary(experiment: Experiment, log_bytes: int | None = None) -> str:
    """How long it takes, how near it comes to the limits, and how long its log will be where that is known."""
    import math

    from rig.cli.show import minutes
    from rig.safety.limits import Limits

    limits, predictions = Limits.of(experiment.scene), experiment.predictions
    reached = [
        (limits.force, max((one.peak_force for one in predictions), default=0.0)),
        (limits.displacement, max((end for action in experiment.actions for end in action.ends), default=0.0)),
    ]
    if experiment.scene.hv is not None:
        reached.append((limits.voltage, experiment.highest_voltage))
        reached.append((limits.field, max((one.peak_field for one in predictions), default=0.0)))
    steps = max((action.step for action in experiment.actions), default=0)
    head = f"{len(experiment.actions)} actions in {steps} steps, {minutes(experiment.duration)} at most."
    lines = [f"{head} Highest, with the scene's material:"]
    for limit, value in reached:
        allowed = f"of {limit.high * limit.per_si:g} allowed" if math.isfinite(limit.high) else "no limit"
        lines.append(f"  {limit.name:<13}{value * limit.per_si:.4g} {limit.unit}, {allowed}")
    if log_bytes is not None:
        lines.append(
            f"  log          {log_bytes / 1e6:.4g} MB: {minutes(experiment.kept_s)} in full and summaries of "
            f"{experiment.summaries} cycles"
        )
    return "\n".join([*lines, "All hold."])
