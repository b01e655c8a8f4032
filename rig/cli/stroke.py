"""``dea-rig stroke``: what a follow step measured, beside the model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from rig.cli.files import FILE, tell_written

if TYPE_CHECKING:
    from rich.table import Table

    from rig.analysis.strokes import Stroke

UNITS = {
    "nominal_voltage": "V",
    "voltage": "V",
    "start": "m",
    "stroke": "m",
    "stroke_uncertainty": "m",
    "work": "J",
    "work_uncertainty": "J",
    "expected_stroke": "m",
    "expected_stroke_uncertainty": "m",
    "expected_work": "J",
    "expected_work_uncertainty": "J",
}


@click.command("stroke")
@click.argument("log", type=FILE)
@click.option("-o", "--out", type=FILE, help="The table as CSV.")
@click.option("--picture", type=FILE, help="PNG or SVG.")
@click.option("--fit", type=FILE, help="Result of `dea-rig fit`: expect what that film does, not the scene's.")
def command(log: Path, out: Path | None, picture: Path | None, fit: Path | None) -> None:
    """Stroke and work against a virtual spring, mass or second cone in LOG: measured beside expected."""
    from rig.analysis.strokes import strokes
    from rig.base.outputs import check_new, write_text
    from rig.cli.show import show

    check_new(out, picture)
    found = strokes(log, fit)
    show(stroke_table(found))
    if out is not None:
        write_text(out, _csv(found))
    if picture is not None:
        from rig.analysis.stroke_picture import draw

        draw(found, picture)
    tell_written(out, picture)


def _csv(found: list[Stroke]) -> str:
    from dataclasses import fields

    names = [field.name for field in fields(found[0])]
    heading = ",".join(f"{name}_{UNITS[name]}" if name in UNITS else name for name in names)
    rows = [",".join(_cell(getattr(one, name)) for name in names) for one in found]
    return "\n".join([heading, *rows]) + "\n"


def _cell(value: float | str) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def stroke_table(strokes: Sequence[Stroke]) -> Table:
    """Strokes of virtual biases, measured beside expected."""
    from rich.table import Table

    table = Table(title="Stroke and work against a virtual bias", caption="Uncertainties are standard ones (k = 1).")
    table.add_column("step and bias")
    for heading in ("U / V", "stroke / um", "model / um", "off by", "work / mJ", "model / mJ"):
        table.add_column(heading, justify="right", no_wrap=True)
    for one in strokes:
        table.add_row(
            f"{one.step} {one.kind}",
            f"{one.voltage:.0f}",
            f"{one.stroke * 1e6:.1f} +- {one.stroke_uncertainty * 1e6:.1f}",
            _with_error(one.expected_stroke * 1e6, one.expected_stroke_uncertainty * 1e6, 1),
            f"{one.deviation * 100:+.1f} %",
            f"{one.work * 1e3:.4f} +- {one.work_uncertainty * 1e3:.4f}",
            _with_error(one.expected_work * 1e3, one.expected_work_uncertainty * 1e3, 4),
        )
    return table


def _with_error(value: float, error: float, digits: int) -> str:
    """The value, and its uncertainty where one is known."""
    return f"{value:.{digits}f}" + (f" +- {error:.{digits}f}" if error == error else "")
