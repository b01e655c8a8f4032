"""The uncertainty budget of every quantity."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calibration.film.result import Quantity
from calibration.report.sections.base import ReportData, Section, Table, symbol
from calibration.rounding import percent


def context(data: ReportData) -> Mapping[str, Any]:
    """One row a part, one column a quantity."""
    from markupsafe import Markup

    quantities = data.identification.quantities
    parts = list(dict.fromkeys(part for quantity in quantities.values() for part in quantity.budget))
    rows: list[list[Any]] = []
    for part in parts:
        sizes = (
            one.budget[part] / abs(one.value) if part in one.budget and one.value else None
            for one in quantities.values()
        )
        rows.append([part, *("–" if size is None else percent(size) for size in sizes)])
    rows.append([Markup("<b>combined</b>"), *(Markup("<b>{}</b>").format(row.relative) for row in data.rows.values())])
    headings = ["part", *(Markup(">{}").format(symbol(name)) for name in quantities)]
    caption = "Uncertainty budget: standard uncertainties relative to the value; they add in squares"
    return {"budget": Table(headings, rows, caption)}


def _share(quantity: Quantity, part: str) -> str:
    """A part of the budget relative to the value."""
    return percent(quantity.budget[part] / abs(quantity.value)) if part in quantity.budget and quantity.value else "–"


SECTION = Section("budget", 50, context, "{{ table(budget) }}")
