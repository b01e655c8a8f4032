"""Dimensions of the specimen in the lines above a table: thickness, width, length, cross-section."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile

from rig.importing.dialect import Dialect
from rig.importing.headings import fold, is_unit_row, split_unit
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
        r"longueur|^lange|\bl ?0\b|grip (to grip )?separation",
    ),
)
NOT_A_DIMENSION = re.compile(r"final|after|at break|deformed|bruch|maximum|tolerance|unit|increment|change|rate|speed")
ANY = re.compile(r".+")
OVER_SPECIMENS = (
    r"mean|average|median|std|standard|deviation|coefficient|minimum|maximum|range|mittel|abweichung|moyenne"
)


@dataclass(frozen=True)
class Parameter:
    """A dimension in SI and the line that states it."""

    name: str
    values: tuple[float, ...]
    line: int
    text: str


def parameters_in(rows: Sequence[TextRow], dialect: Dialect) -> dict[str, Parameter]:
    """Dimensions in rows of the form name, value, unit; the last of one name counts."""
    found: dict[str, Parameter] = {one.name: one for one in _results(rows, dialect)}
    for row in rows:
        one = _parameter(row, dialect)
        if one is not None:
            found[one.name] = one
    return found


def _results(rows: Sequence[TextRow], dialect: Dialect) -> list[Parameter]:
    """Dimensions in a table of results: names in one row, units in it or in the next, a row for every specimen."""
    found = []
    for k, row in enumerate(rows):
        names = [(j, _named(split_unit(cell)[0])) for j, cell in enumerate(row.cells)]
        named = [(j, name) for j, name in names if name]
        if len(named) < 2 or any(dialect.kind(cell) == "N" for cell in row.cells):
            continue
        below = [one for one in rows[k + 1 :] if one.given][:30]
        units = below[0].cells if below and is_unit_row(below[0].given) else []
        lines = list(takewhile(lambda one: _is_result(one, dialect), below[1:] if units else below))
        for j, name in named:
            unit = unit_of(units[j]) if j < len(units) else split_unit(row.cells[j])[2]
            cells = [one.cells[j] for one in lines if j < len(one.cells)]
            values = [dialect.value(cell) for cell in cells if dialect.kind(cell) == "N"]
            if values and len(values) == len(lines) and unit is not None and min(values) > 0.0:
                told = f"{row.cells[j]}, {', '.join(cells[:4])}, {unit.name}"
                wanted = "area" if name == "area" else "length"
                if unit.dimension == wanted:
                    found.append(Parameter(name, tuple(value * unit.factor for value in values), lines[0].line, told))
    return found


def _is_result(row: TextRow, dialect: Dialect) -> bool:
    """Whether a row holds numbers of one specimen, and not a mean or a deviation over them."""
    numbers = sum(dialect.kind(cell) == "N" for cell in row.given)
    return numbers >= 2 and numbers >= len(row.given) - 1 and not re.search(OVER_SPECIMENS, fold(row.given[0]))


def _named(title: str) -> str:
    """The dimension that a title names; "" where it names none, or not that of the undeformed specimen."""
    folded = fold(title.rpartition(" : ")[2])  # Bluehill writes the group of a parameter before it
    name = next((name for name, pattern in NAMES if re.search(pattern, folded)), "")
    return "" if NOT_A_DIMENSION.search(folded) else name


def _parameter(row: TextRow, dialect: Dialect) -> Parameter | None:
    """A dimension of the specimen in one row."""
    found = named_value(row, dialect, ANY)
    if found is None:
        return None
    title, values, unit = found
    name = _named(title)
    values = tuple(value for value in values if value > 0.0)
    if not name or not values or unit is None or unit.dimension != ("area" if name == "area" else "length"):
        return None
    return Parameter(name, tuple(value * unit.factor for value in values), row.line, ", ".join(row.given))


def named_value(
    row: TextRow, dialect: Dialect, wanted: re.Pattern[str]
) -> tuple[str, tuple[float, ...], Unit | None] | None:
    """Title, values and unit of a row of the form name, value, unit whose folded name is ``wanted``; else None."""
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
    if not wanted.fullmatch(fold(title)):
        return None
    values, unit = _values(given[1:], dialect, unit)
    return title, tuple(values), unit


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
    return [value for value in values if math.isfinite(value)], unit


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
