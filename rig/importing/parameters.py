"""Dimensions of the specimen in the lines above a table: thickness, width, length, cross-section."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from rig.importing.dialect import Dialect
from rig.importing.headings import fold, split_unit
from rig.importing.table import TextRow
from rig.importing.units import Unit, unit_of

NAMES = (
    ("thickness", r"thickness|dicke|epaisseur|^a ?0$"),
    ("width", r"width|breite|largeur|^b ?0$"),
    ("diameter", r"diameter|durchmesser|diametre|^d ?0$"),
    ("area", r"cross ?section|querschnitt|\barea\b|section|^s ?0$|flache"),
    (
        "length",
        r"\b(gauge|gage|initial|specimen|sample|original) length|^length|messlange|einspannlange|"
        r"anfangslange|probenlange|"
        r"longueur|\bl ?0$|grip (to grip )?separation|dimension length",
    ),
)
NOT_A_DIMENSION = re.compile(r"final|after|at break|deformed|bruch|maximum|tolerance|unit|increment|change|rate|speed")


@dataclass(frozen=True)
class Parameter:
    """A dimension in SI and the line that states it."""

    name: str
    values: tuple[float, ...]
    line: int
    text: str


def parameters_in(rows: Sequence[TextRow], dialect: Dialect) -> dict[str, Parameter]:
    """Dimensions in rows of the form name, value, unit; the last of one name counts."""
    found: dict[str, Parameter] = {}
    for row in rows:
        one = _parameter(row, dialect)
        if one is not None:
            found[one.name] = one
    return found


def _parameter(row: TextRow, dialect: Dialect) -> Parameter | None:
    given = row.given
    if len(given) == 1 or dialect.separator == " ":
        text = " ".join(given)
        parts = re.match(r"^(.*?[A-Za-z)\]0])\s*(?:[:=]|\s)\s*([+-]?\d+(?:[.,]\d+)?)\s*([^\s\d]\S*)?$", text)
        if not parts:
            return None
        given = [parts[1].strip(" :="), parts[2], *([parts[3]] if parts[3] else [])]
    if len(given) < 2 or not re.search(r"[A-Za-z]", given[0]):
        return None
    title, _, unit = split_unit(given[0].rstrip(" :="))
    folded = fold(title)
    name = next((name for name, pattern in NAMES if re.search(pattern, folded)), None)
    if name is None or NOT_A_DIMENSION.search(folded):
        return None
    values, unit = _values(given[1:], dialect, unit)
    wanted = "area" if name == "area" else "length"
    if not values or unit is None or unit.dimension != wanted:
        return None
    return Parameter(name, tuple(value * unit.factor for value in values), row.line, ", ".join(given))


def _values(cells: Sequence[str], dialect: Dialect, unit: Unit | None) -> tuple[list[float], Unit | None]:
    values: list[float] = []
    for cell in cells:
        parts = re.match(r"^([+-]?[0-9.,]+)\s*(.*)$", cell)
        number = parts[1] if parts else ""
        if dialect.kind(cell) == "N":
            values.append(dialect.value(cell))
        elif parts and dialect.kind(number) == "N" and unit_of(parts[2]):
            values.append(dialect.value(number))
            unit = unit_of(parts[2])
        elif re.fullmatch(r"[+-]?\d+\.\d+", number) and not parts[2]:  # type: ignore[index] # found, or number is ""
            values.append(float(number))  # a point although the table has commas
        elif unit_of(cell) is not None:
            unit = unit_of(cell)
            break
        else:
            break
    return [value for value in values if math.isfinite(value) and value > 0.0], unit


@dataclass(frozen=True)
class Dimensions:
    """Length and cross-section of one undeformed specimen (m, m2), and where they come from; None where not stated."""

    length: float | None
    area: float | None
    length_source: str
    area_source: str


def dimensions(found: dict[str, Parameter], number: int) -> Dimensions:
    """What the parameters say of specimen ``number`` (from 0)."""

    def of(name: str) -> float | None:
        one = found.get(name)
        if one is None or (len(one.values) > 1 and number >= len(one.values)):
            return None
        return one.values[number] if len(one.values) > 1 else one.values[0]

    def place(*names: str) -> str:
        return " and ".join(f"line {found[name].line} ({found[name].text})" for name in names)

    length, area, source = of("length"), of("area"), ""
    thickness, width, diameter = of("thickness"), of("width"), of("diameter")
    if area is not None:
        source = place("area")
    elif thickness is not None and width is not None:
        area, source = thickness * width, place("thickness", "width")
    elif diameter is not None and thickness is None:
        area, source = 0.25 * math.pi * diameter**2, place("diameter")
    return Dimensions(length, area, place("length") if length is not None else "", source)
