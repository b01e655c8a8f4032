"""Which column is which quantity, in which unit; two candidates, a missing unit and an unknown one are asked about."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rig.importing.findings import Findings, spans
from rig.importing.headings import DIMENSION, Heading, fold
from rig.importing.numbers import clock_values, column_values
from rig.importing.options import ImportOptions
from rig.importing.table import LeftOut, RawTable, Section
from rig.importing.units import Unit, known, unit_of

Array = NDArray[np.float64]

ONE = Unit("1", "ratio", 1.0)
SECOND = Unit("s", "time", 1.0)
MOST_SPANS = 12  # of lines in an option that is to be copied
EXAMPLE = {
    "stress": "MPa",
    "force": "N",
    "displacement": "mm",
    "length": "mm",
    "voltage": "V",
    "time": "s",
    "ratio": "%",
}


@dataclass(frozen=True)
class Chosen:
    """A column (``index`` from 0) that holds a quantity. ``factor`` makes SI of it, the unit and the sign included."""

    quantity: str
    index: int
    heading: Heading
    unit: Unit
    sign: float = 1.0
    zero: float | None = 0.0
    extra: float = 1.0

    @property
    def factor(self) -> float:
        """What a value of the column is multiplied by."""
        return self.unit.factor * self.sign * self.extra

    @property
    def name(self) -> str:
        """The column as a person finds it."""
        return f"column {self.index + 1} {self.heading.text!r}" if self.heading.text else f"column {self.index + 1}"

    def reversed(self) -> Chosen:
        """The same column counted the other way."""
        return replace(self, sign=-self.sign)


class Chooser:
    """Finds the columns of one table, or of one specimen's part of it (``group``: column indices)."""

    def __init__(self, table: RawTable, group: Sequence[int], options: ImportOptions, findings: Findings) -> None:
        self.table = table
        self.group = list(group)
        self.options = options
        self.findings = findings

    def candidates(self, quantity: str) -> list[int]:
        """Columns that can be the quantity, the best first; a column that an option names is the only one."""
        named = self.options.column.get(quantity)
        if named is not None:
            found = self._named(named)
            if len(found) != 1:
                what = "there is no such column" if not found else "several columns have that name"
                self.findings.obstacle(
                    "column",
                    f"--column {quantity}={named!r}: {what}; the columns are {self.listing()}",
                    f"--column {quantity}=NUMBER",
                    line=self.table.heading_line,
                )
            return found[:1]
        direction = int(quantity[-1]) if quantity[-1] in "12" else 0
        plain = quantity.rstrip("12")
        taken = {index for other in self.options.column for index in self._named(self.options.column[other])}
        found = [
            j
            for j in self.group
            if self.table.numeric[j]
            and j not in taken
            and self.table.headings[j].quantity == plain
            and (direction == 0 or self.table.headings[j].direction == direction)
        ]
        return sorted(found, key=lambda j: (self.table.headings[j].weak, -self.table.headings[j].rank))

    def choose(self, quantity: str) -> Chosen | None:
        """The column of a quantity; None where there is none. Equal candidates are an obstacle."""
        found = self.candidates(quantity)
        if not found:
            return None
        headings = [self.table.headings[j] for j in found]
        best = headings[0]
        equal = [
            j
            for j, heading in zip(found, headings, strict=True)
            if (heading.weak, heading.rank) == (best.weak, best.rank)
        ]
        if len(equal) > 1:
            self.findings.obstacle(
                "columns",
                f"{len(equal)} columns can be the {quantity}: {', '.join(self._title(j) for j in equal)}",
                " or ".join(f"--column {quantity.replace(' ', '-')}={j + 1}" for j in equal),
                line=self.table.heading_line,
            )
        elif len(found) > 1:
            self.findings.warning(
                "columns",
                f"{self._title(found[0])} is taken as {quantity}, not {', '.join(map(self._title, found[1:]))}: "
                "what is measured at the specimen goes before what is set or measured at the drive",
                f"--column {quantity.replace(' ', '-')}={found[1] + 1}",
            )
        self._against_heading(quantity, found[0])
        return self._with_unit(quantity, found[0])

    def _against_heading(self, quantity: str, index: int) -> None:
        """Tell where an option takes a column for what its heading does not say, in the same kind of unit."""
        said, taken = self.table.headings[index].quantity, quantity.rstrip("12")
        if said != taken and DIMENSION.get(said) == DIMENSION[taken]:
            self.findings.warning(
                "columns",
                f"{self._title(index)} is taken as {taken}, as asked, and its heading reads as {said}",
                f"--column {said.replace(' ', '-')}={index + 1}",
            )

    def _with_unit(self, quantity: str, index: int) -> Chosen | None:
        heading = self.table.headings[index]
        plain = quantity.rstrip("12")
        dimension = DIMENSION[plain]
        stated = next(
            (
                self.options.unit[key]
                for key in (quantity, plain, fold(heading.text), str(index + 1))
                if key in self.options.unit
            ),
            None,
        )
        unit = heading.unit
        text = heading.unit_text
        if stated is not None:
            unit, text = unit_of(stated), stated
        if unit is None and text and plain != "time":
            self.findings.obstacle(
                "unit",
                f"unit {text!r} of {quantity} in {self._title(index)} is not known; known are {known(dimension)}",
                f"--unit {quantity}={EXAMPLE.get(plain, EXAMPLE.get(dimension, '1'))}",
                line=self.table.unit_line or self.table.heading_line,
                column=index + 1,
            )
            return None
        if unit is None and dimension == "ratio":
            unit = ONE
        if unit is None:
            if plain == "time":
                return Chosen(quantity, index, heading, replace(SECOND, name=""))
            self.findings.obstacle(
                "unit",
                f"the unit of {quantity} in {self._title(index)} is missing; known are {known(dimension)}",
                f"--unit {quantity}={EXAMPLE.get(plain, EXAMPLE.get(dimension, '1'))}",
                line=self.table.heading_line,
                column=index + 1,
            )
            return None
        if unit.dimension != dimension:
            self.findings.obstacle(
                "unit",
                f"{self._title(index)} is to be the {quantity}, and {unit.name!r} is a unit of {unit.dimension}",
                f"--unit {quantity}={EXAMPLE.get(plain, EXAMPLE.get(dimension, '1'))}",
                line=self.table.unit_line or self.table.heading_line,
                column=index + 1,
            )
            return None
        if unit.remark:
            self.findings.note("unit", f"{quantity}: {unit.remark}", f"--unit {quantity}=UNIT")
        return Chosen(
            quantity,
            index,
            heading,
            unit,
            self.options.sign.get(plain, 1.0),
            self.options.zero.get(plain, 0.0),
            self.options.factor.get(plain, 1.0),
        )

    def _named(self, name: str) -> list[int]:
        """Columns of a heading, or of a number that counts from 1."""
        headings = self.table.headings
        exact = [j for j in self.group if headings[j].text == name]
        if exact:
            return exact
        if name.isdigit() and 1 <= int(name) <= len(headings):
            # A number means the same column of each specimen that stands beside the first.
            index = int(name) - 1
            return (
                [index]
                if index in self.group
                else [j for j in self.group if headings[j].text == headings[index].text][:1]
            )
        alike = [j for j in self.group if fold(headings[j].text) == fold(name)]
        return alike or [j for j in self.group if fold(headings[j].name) == fold(name)]

    def _title(self, index: int) -> str:
        text = self.table.headings[index].text
        return f"column {index + 1} {text!r}" if text else f"column {index + 1} (no heading)"

    def listing(self) -> str:
        """All columns, for messages."""
        return ", ".join(self._title(j) for j in self.group if self.table.numeric[j])


def groups_of(table: RawTable) -> tuple[list[list[int]], list[str]]:
    """Columns of each specimen where several stand side by side, with their labels; else one group of all columns.

    Side by side means that the headings, without the specimen's number, are one sequence of two or more names that is
    repeated; a first column of time may be shared. Where headings name voltages, the columns of one voltage stand with
    all that name none.
    """
    used = [j for j in range(table.width) if table.headings[j].text or table.numeric[j]]
    voltages = {table.headings[j].at_voltage: None for j in used}  # in the order of the columns
    if len(voltages) > 1 + (None in voltages):
        shared = [j for j in used if table.headings[j].at_voltage is None]
        voltages.pop(None, None)
        groups = [shared + [j for j in used if table.headings[j].at_voltage == one] for one in voltages]
        return groups, [f"{one:g} V" for one in voltages]
    for first in (0, 1):
        if first and (not used or table.headings[used[0]].quantity not in ("time", "index")):
            continue
        rest = used[first:]
        for period in range(2, len(rest) // 2 + 1):
            names = [_base(table.headings[j].text) for j in rest]
            if len(rest) % period or names != names[:period] * (len(rest) // period) or "" in names:
                continue
            if len(set(names[:period])) < period:
                continue
            groups = [rest[k : k + period] for k in range(0, len(rest), period)]
            labels = [
                next((table.labels[j] for j in group if table.labels and table.labels[j]), "") for group in groups
            ]
            return [used[:first] + group for group in groups], labels
    return [used], [""]


def _base(text: str) -> str:
    """A heading without the number or the name of a specimen."""
    folded = fold(text)
    words = [
        word
        for word in folded.split()
        if not word.isdigit() and word not in ("specimen", "probe", "sample", "eprouvette")
    ]
    return " ".join(words).rstrip("0123456789") if words else folded


@dataclass(frozen=True, eq=False)
class Part:
    """Numbers of one specimen or run: columns in SI by quantity, the lines they stand on, and its label."""

    label: str
    lines: NDArray[np.intp]
    values: dict[str, Array]
    section: Section


def read_columns(
    table: RawTable, section: Section, chosen: Sequence[Chosen], label: str, options: ImportOptions, findings: Findings
) -> tuple[Part, list[LeftOut]]:
    """Convert the chosen columns of one section; rows without a value in one of them are left out and returned."""
    keep = [k for k, line in enumerate(section.lines) if options.has(line)]
    left_out = []
    if keep and not table.text.ends_whole and section.lines[keep[-1]] == len(table.text.lines):
        rows = [section.rows[k] for k in keep]
        if _is_cut(rows, table.numeric):
            left_out.append(LeftOut(section.lines[keep[-1]], "cut off", table.text.lines[-1]))
            keep.pop()
    lines = np.array([section.lines[k] for k in keep], dtype=np.intp)
    whole = np.ones(lines.size, dtype=np.bool_)
    values: dict[str, Array] = {}
    wrong: dict[int, list[Chosen]] = {}  # by row
    for one in chosen:
        cells = [section.rows[k][one.index] for k in keep]
        column, bad = _converted(one, cells, table)
        for row in bad:
            wrong.setdefault(row, []).append(one)
        if column is None or bad:
            continue
        whole &= np.isfinite(column) | (one.quantity == "time")
        first = column[np.isfinite(column)][:1]
        zero = (float(first[0]) if first.size else 0.0) if one.zero is None else one.zero
        values[one.quantity] = (column - zero) * one.factor if zero else column * one.factor
    _report_wrong(wrong, [section.rows[k] for k in keep], lines, findings)
    inside = np.flatnonzero(whole)
    last = int(inside[-1]) if inside.size else -1
    marked = [any(section.rows[keep[k]][one.index].strip() for one in chosen) for k in range(last + 1, lines.size)]
    missing = [int(lines[k]) for k in range(lines.size) if not whole[k] and (k < last or marked[k - last - 1])]
    left_out += [LeftOut(line, "no value in a column that is used", table.text.lines[line - 1]) for line in missing]
    return Part(label, lines[whole], {name: column[whole] for name, column in values.items()}, section), left_out


def _converted(one: Chosen, cells: list[str], table: RawTable) -> tuple[Array | None, list[int]]:
    """A column in its own unit, nan where there is no value; and the rows whose cell is something else."""
    if one.quantity == "time":
        clock = clock_values([cell.strip() for cell in cells]) if cells and ":" in cells[0] else None
        if clock is not None:
            return clock / one.unit.factor, []
        if not one.unit.name:
            return None, []
    return column_values([cell.strip() for cell in cells], table.dialect)


def _report_wrong(
    wrong: dict[int, list[Chosen]], rows: Sequence[Sequence[str]], lines: NDArray[np.intp], findings: Findings
) -> None:
    """Cells that are no number, by column; the option is the same for all of them, for it leaves all these rows out."""
    option = _rows_without(lines, sorted(wrong)) if wrong else ""
    for one in {one.index: one for row in sorted(wrong) for one in wrong[row]}.values():
        bad = [row for row in sorted(wrong) if one in wrong[row]]
        more = f", here and in {len(bad) - 1} more rows (lines {spans([int(lines[k]) for k in bad])})"
        findings.obstacle(
            "cell",
            f"{one.quantity} is no number" + (more if len(bad) > 1 else ""),
            option,
            line=int(lines[bad[0]]),
            column=one.index + 1,
            cell=rows[bad[0]][one.index],
        )


def _rows_without(lines: NDArray[np.intp], bad: Sequence[int]) -> str:
    """The option that leaves rows out."""
    if len(bad) > MOST_SPANS:
        return "--rows FIRST-LAST leaves lines out"
    kept, start = [], int(lines[0])
    for k in bad:
        if int(lines[k]) > start:
            kept.append(f"{start}-{int(lines[k]) - 1}")
        start = int(lines[k]) + 1
    kept.append(f"{start}-")
    return f"--rows {','.join(kept)}"


def _is_cut(rows: Sequence[Sequence[str]], numeric: Sequence[bool]) -> bool:
    """Whether the last row was cut off: cells are missing, or its last number has fewer digits than those before."""
    if len(rows) < 4:
        return False
    last, before = rows[-1], rows[-21:-1]
    given = [j for j, cell in enumerate(last) if cell.strip()]
    if not given:
        return True
    full = [j for j in range(len(last)) if numeric[j] and all(row[j].strip() for row in before)]
    if any(j not in given for j in full):
        return True
    j = given[-1]
    lengths = [len(row[j].strip()) for row in before]
    decimals = [len(row[j].strip()) - max(row[j].find("."), row[j].find(",")) for row in before]
    mine = last[j].strip()
    point = max(mine.find("."), mine.find(","))
    if len(set(decimals)) == 1 and point >= 0:
        return len(mine) - point < decimals[0]
    return len(mine) < min(lengths) or (point < 0 and all("." in row[j] or "," in row[j] for row in before))
