"""Correlations of the raw parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calibration.report.sections.base import ReportData, Section, Table, symbol


def context(data: ReportData) -> Mapping[str, Any]:
    """The table."""
    from markupsafe import Markup

    fit = data.identification
    rows = [
        [symbol(name), *(f"{value:+.3f}" for value in values)]
        for name, values in zip(fit.parameters, fit.correlation, strict=True)
    ]
    headings = ["", *(Markup(">{}").format(symbol(name)) for name in fit.parameters)]
    caption = f"Correlation of the raw parameters; condition number of the problem {fit.condition:.2g}"
    return {"correlation": Table(headings, rows, caption)}


SECTION = Section("correlation", 60, context, "{{ table(correlation) }}")
