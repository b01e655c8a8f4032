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
        rows.append([_label(data, part), *(_share(quantity, part) for quantity in quantities.values())])
    rows.append([Markup("<b>combined</b>"), *(Markup("<b>{}</b>").format(row.relative) for row in data.rows.values())])
    headings = ["part", *(Markup(">{}").format(symbol(name)) for name in quantities)]
    caption = "Uncertainty budget: relative standard uncertainties, which add in squares (share of the variance)"
    return {"budget": Table(headings, rows, caption)}


def _label(data: ReportData, part: str) -> str:
    """The part, and what was assumed of it where nobody stated it."""
    assumed = data.identification.assumed
    return f"{part} (assumed, not stated: {percent(assumed[part])})" if part in assumed else part


def _share(quantity: Quantity, part: str) -> str:
    """A part of the budget relative to the value, and its share of the variance."""
    if part not in quantity.budget or not quantity.value:
        return "–"
    return f"{percent(quantity.budget[part] / abs(quantity.value))} ({quantity.share(part):.0%})"


SECTION = Section("budget", 50, context, "{{ table(budget) }}")
