"""Errors of the rig that were fitted along."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calibration.report.sections.base import ReportData, Section, Table

UNITS = {"N": ("mN", 1e3), "m": ("µm", 1e6), "s": ("ms", 1e3), "m/N": ("µm/N", 1e6), "1": ("%", 1e2)}
UNITS |= {"F": ("pF", 1e12), "A": ("nA", 1e9)}


def context(data: ReportData) -> Mapping[str, Any] | None:
    """One row an error."""
    rows = []
    for name, found in data.identification.nuisance.items():
        unit, factor = UNITS[found.unit]
        numbers = (found.value * factor, found.uncertainty * factor, found.prior * factor)
        rows.append([name, f"{numbers[0]:+.3f} {unit}", *(f"{number:.3f} {unit}" for number in numbers[1:])])
    headings = ["error", ">found", ">standard uncertainty", ">stated before"]
    return {"found": Table(headings, rows, "Errors of the rig, found together with the parameters")} if rows else None


SECTION = Section("rig_parameters", 100, context, "{{ table(found) }}")
