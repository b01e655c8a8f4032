"""The same data with other numbers of Ogden terms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calibration.report.sections.base import ReportData, Section, Table


def context(data: ReportData) -> Mapping[str, Any] | None:
    """The table, where several numbers of terms were tried."""
    if not data.comparison:
        return None
    least = min(other.bic for other in data.comparison)
    rows = [
        [
            str(other.terms),
            f"{other.reduced_chi_square:.4f}",
            f"{other.aicc:.1f}",
            f"{other.bic:.1f}",
            f"{other.bic - least:.1f}",
            ", ".join(f"{one.ratio:.2f} ({one.what})" for one in other.held_out),
        ]
        for other in data.comparison
    ]
    headings = ["terms", ">reduced chi-square", ">AICc", ">BIC", ">BIC above the least", ">held-out error over noise"]
    caption = "Number of Ogden terms: smaller criteria are better, differences below 2 mean nothing"
    return {"comparison": Table(headings, rows, caption)}


SECTION = Section("comparison", 80, context, "{{ table(comparison) }}")
