"""All quantities with their uncertainties and verdicts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calibration.film.result import IDENTIFIED, WEAKLY_IDENTIFIED
from calibration.report.sections.base import ReportData, Section, Table, symbol


def context(data: ReportData) -> Mapping[str, Any]:
    """The table."""
    from markupsafe import Markup

    known = bool(data.known)
    headings = ["", "meaning", ">value", ">standard uncertainty", ">relative"]
    headings += [">truth", ">off by"] if known else []
    rows = []
    for name, row in data.rows.items():
        badge = Markup('<span class="badge {}">{}</span>').format(row.badge, row.verdict)
        numbers = [f"{row.value} {row.unit}", f"{row.uncertainty} {row.unit}", row.relative]
        rows.append([symbol(name), row.meaning, *numbers, *([row.truth, row.deviation] if known else []), badge])
    return {
        "quantities": Table([*headings, "verdict"], rows),
        "convention": data.identification.material.law.description,
        "thresholds": (f"{IDENTIFIED:.0%}", f"{WEAKLY_IDENTIFIED:.0%}"),
        "known": known,
    }


TEMPLATE = """
<h2>Parameters</h2>
{{ table(quantities) }}
<p class="soft">Convention: {{ convention }} "Identified" means a relative
standard uncertainty of
at most {{ thresholds[0] }}, "weakly identified" of at most {{ thresholds[1] }}.{% if known %} "Off by" counts
standard
uncertainties.{% endif %}</p>
"""

SECTION = Section("parameters", 30, context, TEMPLATE)
