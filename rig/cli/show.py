"""What the tables of several commands share."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import RenderableType

    from calibration.film.result import Quantity

SHOWN = {"Pa": (1e-3, "kPa"), "1": (1.0, "")}  # factor and unit in tables
NAMES = {
    "eps_r": "permittivity",
    "stiffness": "stiffness (best)",
    "stiffness_end": "stiffness (end)",
    "stiffness_fixed": "stiffness (fixed)",
    "G": "shear modulus",
}


def show(*tables: RenderableType) -> None:
    """Print to standard output; as wide as the terminal, at least 100 columns where there is none."""
    console = Console(markup=False, emoji=False)  # texts may come from files
    if not console.is_terminal:
        console.width = max(console.width, 120)
    for table in tables:
        console.print(table)


def quantities_table(title: str, quantities: Mapping[str, Quantity]) -> Table:
    """Values to the digits of their uncertainties; no number is cut on a narrow terminal."""
    from calibration.rounding import percent, stated

    table = Table(title=title)
    table.add_column("quantity", overflow="fold")
    for heading in ("value", "+-"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    table.add_column("relative", justify="right", no_wrap=True)
    table.add_column("verdict", overflow="fold")
    for name, quantity in quantities.items():
        factor, unit = SHOWN.get(quantity.unit, (1.0, quantity.unit))
        table.add_row(
            NAMES.get(name, name),
            *stated(quantity.value * factor, quantity.uncertainty * factor),
            unit,
            percent(quantity.relative),
            quantity.verdict + (" (at its bound)" if quantity.at_bound else ""),
        )
    return table


def minutes(seconds: float) -> str:
    """A duration in minutes and seconds."""
    return f"{round(seconds) // 60} min {round(seconds) % 60} s"
