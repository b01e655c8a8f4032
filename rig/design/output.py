"""CSV files of design studies, with units in the headers."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from model.actuator.design import Row
from rig.design.claims import Claims


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """One line a row; a number with all its digits, NaN and None as nothing."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(rows[0])
        writer.writerows([_cell(value) for value in row.values()] for row in rows)


def read_csv(path: Path) -> list[dict[str, str]]:
    """The rows of a file that `write_csv` wrote, as texts; none of what is no such file."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return [row for row in csv.DictReader(file) if None not in row and None not in row.values()]
    except (OSError, UnicodeDecodeError, csv.Error):
        return []


def _cell(value: Any) -> Any:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return repr(float(value)) if isinstance(value, float) else value


def map_rows(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Strokes and work, one actuator a line."""
    return [
        {
            "case": row.case,
            "treatment": row.treatment,
            "radius_ratio": row.radius_ratio,
            "disk_radius_mm": 1e3 * row.disk_radius,
            "ring_radius_mm": 1e3 * row.ring_radius,
            "thickness_um": 1e6 * row.thickness,
            "prestretch": row.prestretch,
            "rest_mm": 1e3 * row.rest,
            "stroke_mm": 1e3 * row.stroke,
            "stroke_error_mm": 1e3 * row.stroke_error,
            "normalized_stroke": row.normalized_stroke,
            "work_mJ": 1e3 * row.work,
            "work_relative_error": row.work_error,
            "work_by_energy_mJ": 1e3 * row.work_by_energy,
            "blocked_force_N": row.blocked_force,
            "voltage_V": row.voltage,
            "peak_field_V_per_um": 1e-6 * row.peak_field,
            "min_hoop_stress_kPa": 1e-3 * row.min_hoop_stress,
            "max_stretch": row.max_stretch,
            "snaps": row.snaps,
            "limit": row.limit,
            "status": row.status,
            "status_at_work": row.status_at_work,
        }
        for row in rows
    ]


def claim_rows(claims: Claims) -> list[dict[str, Any]]:
    """Printed numbers beside ours, then the verdicts."""
    rows = []
    for one in claims.compared:
        scale, unit = (1e3, "mJ") if one.printed.quantity == "work" else (1.0, "1")
        printed = one.printed
        rows.append(
            {
                "what": f"largest {printed.quantity}" + (" with both cones driven" if printed.times == 2 else ""),
                "case": printed.case,
                "treatment": one.treatment,
                "unit": unit,
                "paper": None if printed.value is None else scale * printed.value,
                "ours": scale * one.value,
                "deviation_percent": None if one.deviation is None else 100.0 * one.deviation,
                "paper_radius_ratio": printed.radius_ratio,
                "our_radius_ratio": one.radius_ratio,
                "our_peak_at_edge_of_map": one.edge,
                "ours_at_paper_radius_ratio": None if one.at_printed is None else scale * one.at_printed,
                "our_best_prestretch": one.prestretch,
                "holds": "",
                "evidence": "",
            }
        )
    blank = dict.fromkeys(rows[0])
    for verdict in claims.verdicts:
        rows.append(
            blank
            | {
                "what": f"claim {verdict.claim}, {verdict.films}",
                "treatment": verdict.treatment,
                "holds": "yes" if verdict.holds else "no",
                "evidence": verdict.evidence,
            }
        )
    return rows
