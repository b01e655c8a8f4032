"""``dea-rig stroke``: what a follow step measured, beside the model."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import click

from rig.analysis.film import write_text
from rig.analysis.strokes import Stroke, strokes
from rig.base.outputs import check_new
from rig.cli.show import show, stroke_table

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


def tell_strokes(log: Path, out: Path | None, picture: Path | None, fit: Path | None) -> None:
    """Show the table, and write it and its picture where asked for.

    Raises
    ------
    RigError
        When an output exists, the fit cannot be used, or the log holds no strokes.
    """
    check_new(out, picture)
    found = strokes(log, fit)
    show(stroke_table(found))
    if out is not None:
        write_text(out, _csv(found))
    if picture is not None:
        from rig.analysis.stroke_picture import draw

        draw(found, picture)
    for path in (out, picture):
        if path is not None:
            click.echo(f"written: {path}")


def _csv(found: list[Stroke]) -> str:
    names = [field.name for field in fields(Stroke)]
    heading = ",".join(f"{name}_{UNITS[name]}" if name in UNITS else name for name in names)
    rows = [",".join(_cell(getattr(one, name)) for name in names) for one in found]
    return "\n".join([heading, *rows]) + "\n"


def _cell(value: float | str) -> str:
    return f"{value:.9g}" if isinstance(value, float) else str(value)
