"""Tables of breakdown tests, one row a specimen, in CSV or TOML: strict, units in the names, nothing guessed."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from calibration.breakdown.sample import Sample
from rig.analysis.breakdown_logs import log_rows
from rig.base.errors import ConfigError
from rig.base.table import Table
from rig.base.text import printable
from rig.base.text_file import read_text
from rig.base.toml_file import validate
from rig.base.toml_text import parse_toml

KIND = "breakdown table"
MOST = 5000  # specimens
# Column -> SI unit, factor to it, and the range (SI) outside of which a unit was probably mistaken.
QUANTITIES = {
    "voltage_V": ("V", 1.0, 20.0, 1e5),
    "voltage_kV": ("V", 1e3, 20.0, 1e5),
    "field_V_per_um": ("V/m", 1e6, 1e6, 2e9),
    "field_MV_per_m": ("V/m", 1e6, 1e6, 2e9),
    "field_kV_per_mm": ("V/m", 1e6, 1e6, 2e9),
}
AREAS = {"area_mm2": 1e-6, "area_cm2": 1e-4}
ANSWERS = ("censored", "upper_bound")
YES, NO = ("yes", "true", "1"), ("no", "false", "0")
WORDS = ("specimen", "group", "note")


class Row(Table):
    """One specimen."""

    voltage_V: float | None = Field(default=None, gt=0, description="Voltage of breakdown, or survived (V).")
    voltage_kV: float | None = Field(default=None, gt=0, description="The same in kV.")
    field_V_per_um: float | None = Field(default=None, gt=0, description="True field in the deformed film (V/um).")
    field_MV_per_m: float | None = Field(default=None, gt=0, description="The same; 1 MV/m = 1 V/um.")
    field_kV_per_mm: float | None = Field(default=None, gt=0, description="The same; 1 kV/mm = 1 V/um.")
    censored: bool = Field(description="Whether it survived up to this value. yes: no breakdown was seen.")
    upper_bound: bool | None = Field(
        default=None, description="yes: it broke down at this value or below; its supply measures no current."
    )
    area_mm2: float | None = Field(default=None, gt=0, description="Area of the electrode, deformed (mm2).")
    area_cm2: float | None = Field(default=None, gt=0, description="The same in cm2.")
    group: str | None = Field(default=None, min_length=1, description="Batch or kind; groups are compared.")
    specimen: str | None = Field(default=None, min_length=1, description="Its name; each stands once.")
    note: str | None = Field(default=None, description="Remark; not used.")


class Rows(Table):
    """The file: one table [[specimen]] for each."""

    specimen: list[Row] = Field(min_length=1, max_length=MOST, description="One table a specimen.")


@dataclass(frozen=True)
class Breakdowns:
    """Values in SI (``unit``: V or V/m), areas over the reference area (m2; None: no areas), groups where named.

    ``upper_bound`` tells of which failures the value is only an upper bound; the statistics take it as exact.
    """

    sample: Sample
    unit: str
    reference_area: float | None
    groups: list[str] | None
    names: list[str]
    upper_bound: list[bool]


def read_breakdowns(
    paths: Sequence[Path], reference_area_mm2: float | None = None, of_logs: str = "field"
) -> Breakdowns:
    """Read tables and logs and put them one below the other; ``of_logs``: what of the logs, of `breakdown_logs.VALUES`.

    Raises
    ------
    ConfigError
        A file that cannot be read or understood, columns that differ or lack their unit, a value that is probably in
        another unit, a specimen that stands twice, too few failures.
    """
    rows: list[tuple[str, Row]] = []
    for path in paths:
        if path.suffix.lower() == ".mcap":
            found = validate({"specimen": log_rows(path, of_logs)}, Rows, KIND, str(path)).specimen
            rows += [(f"{path}, {row.note}", row) for row in found]
            continue
        text = read_text(path, KIND)
        toml = path.suffix.lower() == ".toml"
        raw = parse_toml(text, KIND, str(path)) if toml else {"specimen": _csv_rows(text, path)}
        found = validate(raw, Rows, KIND, str(path)).specimen
        rows += [(f"{path}, specimen {k}", row) for k, row in enumerate(found, 1)]
    if len({path.resolve() for path in paths}) < len(paths):
        raise ConfigError("The same file is named twice; its specimens would count twice.")
    column = _same(rows, tuple(QUANTITIES), "a value", required=True)
    area = _same(rows, tuple(AREAS), "an area", required=False)
    grouped = _same(rows, ("group",), "a group", required=False)
    assert column is not None
    _check_names(rows)
    unit, factor, least, most = QUANTITIES[column]
    values = np.array([getattr(row, column) for _, row in rows]) * factor
    for value, (where, row) in zip(values, rows, strict=True):
        if not least <= value <= most:
            raise ConfigError(
                f"{where}: {column} = {getattr(row, column):g} is hardly meant: expected is {least / factor:g} to "
                f"{most / factor:g}. Is it in another unit? The unit stands in the column's name: "
                f"{', '.join(QUANTITIES)}."
            )
    areas, reference = np.ones(len(rows)), None
    if area is not None:
        square = np.array([getattr(row, area) for _, row in rows]) * AREAS[area]
        reference = float(np.exp(np.log(square).mean())) if reference_area_mm2 is None else reference_area_mm2 * 1e-6
        areas = square / reference
    elif reference_area_mm2 is not None:
        raise ConfigError("--area-mm2 is given, but the tables have no column area_mm2 or area_cm2.")
    sample = Sample(values, np.array([not row.censored for _, row in rows]), areas)
    if not sample.usable:
        raise ConfigError(
            f"{', '.join(map(str, paths))}: {int(sample.failed.sum())} of {len(rows)} specimens failed; a distribution "
            "needs at least two failures at different values. censored = yes means: no breakdown up to this value."
        )
    return Breakdowns(
        sample,
        unit,
        reference,
        [str(row.group) for _, row in rows] if grouped else None,
        [row.specimen or where for where, row in rows],
        [bool(row.upper_bound) and not row.censored for _, row in rows],
    )


def _same(rows: list[tuple[str, Row]], columns: tuple[str, ...], what: str, required: bool) -> str | None:
    """The one of these columns that every specimen has; None where none has any."""
    used = {column for _, row in rows for column in columns if getattr(row, column) is not None}
    if len(used) > 1:
        raise ConfigError(f"{rows[0][0]} and others: {what} stands in {', '.join(sorted(used))}. Keep one column.")
    if not used:
        if required:
            raise ConfigError(f"{rows[0][0]}: no column with {what}. Name it {', '.join(columns)}.")
        return None
    column = used.pop()
    for where, row in rows:
        if getattr(row, column) is None:
            raise ConfigError(f"{where}: has no {column}, while others have. Fill it in for all, or leave it out.")
    return column


def _check_names(rows: list[tuple[str, Row]]) -> None:
    seen: dict[str, str] = {}
    for where, row in rows:
        if row.specimen is not None and row.specimen in seen:
            raise ConfigError(f'{where}: specimen "{printable(row.specimen)}" stands also in {seen[row.specimen]}.')
        if row.specimen is not None:
            seen[row.specimen] = where


def _csv_rows(text: str, path: Path) -> list[dict[str, Any]]:
    """Rows of a CSV file (comma, semicolon or tab) as the tables of a TOML file; lines with # are remarks."""
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    if not lines:
        raise ConfigError(f"{path}: the file is empty. It needs a line of column names and one line a specimen.")
    heading = lines[0][1]
    separator = max("\t;,", key=heading.count)
    names = [name.strip() for name in _cells(heading, separator, path, lines[0][0])]
    _check_columns(names, path)
    rows = []
    for number, line in lines[1:]:
        cells = [cell.strip() for cell in _cells(line, separator, path, number)]
        if len(cells) != len(names):
            raise ConfigError(
                f"{path}, line {number}: {len(cells)} cells, but {len(names)} columns. A decimal sign is a point, or a "
                "comma where semicolons or tabs part the columns."
            )
        where = f"{path}, line {number}"
        pairs = zip(names, cells, strict=True)
        rows.append({name: _value(name, cell, separator, where) for name, cell in pairs if cell})
        if "censored" not in rows[-1]:
            raise ConfigError(f"{where}: censored is empty. Write yes (survived up to this value) or no (broke down).")
    if not rows:
        raise ConfigError(f"{path}: column names, but no specimen below them.")
    return rows


def _cells(line: str, separator: str, path: Path, number: int) -> list[str]:
    try:
        return next(csv.reader(io.StringIO(line), delimiter=separator, strict=True))
    except (csv.Error, StopIteration):
        raise ConfigError(f"{path}, line {number}: the quotation marks are not closed.") from None


def _check_columns(names: list[str], path: Path) -> None:
    known = tuple(Row.model_fields)
    for name in names:
        if name in known:
            continue
        stem = name.split("_")[0].split("(")[0].split("/")[0].strip().casefold()
        units = [one for one in known if stem and one.split("_")[0] == stem and "_" in one]
        close = units or get_close_matches(name, known, 1)
        ask = f" Which unit is it in? {' or '.join(units)}." if units else f" Is it {close[0]}?" if close else ""
        raise ConfigError(
            f'{path}: the column "{printable(name)[:60]}" is not known.{ask} Columns are: {", ".join(known)}.'
        )
    if len(set(names)) < len(names):
        raise ConfigError(f"{path}: a column name stands twice: {', '.join(names)}.")
    if "censored" not in names:
        raise ConfigError(
            f"{path}: no column censored. Write yes for each specimen that survived up to its value, no for each that "
            "broke down; it is not guessed."
        )


def _value(name: str, cell: str, separator: str, where: str) -> float | bool | str:
    if name in WORDS:
        return cell
    if name in ANSWERS:
        word = cell.casefold()
        if word in YES or word in NO:
            return word in YES
        raise ConfigError(f'{where}: {name} is "{printable(cell)[:40]}"; write yes or no.')
    number = cell.replace(",", ".") if separator != "," else cell
    try:
        if "_" in number:
            raise ValueError
        value = float(number)
    except ValueError:
        raise ConfigError(f'{where}: {name} is "{printable(cell)[:40]}", which is no number.') from None
    if not np.isfinite(value) or value <= 0:
        raise ConfigError(f"{where}: {name} = {printable(cell)[:40]}; it has to be a number above 0.")
    return value
