"""Separator and decimal sign, judged together from the rows of numbers; lines -> cells; cells -> numbers."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rig.importing.findings import Findings

SEPARATORS = {"\t": "tab", ";": "semicolon", ",": "comma", "|": "bar", " ": "blanks"}
# Decimal commas, and columns parted by a comma with a blank behind it.
COMMA_AND_BLANK = re.compile(r"\s*[+-]?\d+,\d+(?:[eE][+-]?\d+)?(?:, +[+-]?\d+,\d+(?:[eE][+-]?\d+)?)+\s*")
SEPARATOR_NAMES = SEPARATORS | {", ": "comma and blank"}
BY_NAME = {name: sign for sign, name in SEPARATORS.items()} | {sign: sign for sign in SEPARATORS}
STAMP = r"(?:\d{4}-\d\d-\d\d[ T])?\d{1,2}:\d{2}:\d{2}(?:[.,]\d+)?"
PREFIX = re.compile(rf"^\s*(?:{STAMP}\s*->\s?|\[{STAMP}\]\s*)")  # a serial monitor's time of receipt
MANY = 0.8  # of the lines that begin with such a prefix
TIME = re.compile(
    r"(?:(?:[0-9]{4}[-/.][0-9]{1,2}[-/.][0-9]{1,2}|[0-9]{1,2}[-/.][0-9]{1,2}[-/.][0-9]{2,4})[T ,]\s*)?"
    r"(?:[0-9]{1,3}:[0-9]{2}(?::[0-9]{2})?(?:[.,][0-9]+|:[0-9]{3})?)\s*(?:[AaPp][Mm])?\s*(?:Z|[+-][0-9]{2}:?[0-9]{2})?"
)
MISSING = frozenset(
    (
        "nan",
        "n/a",
        "na",
        "#n/a",
        "#nv",
        "null",
        "none",
        "-",
        "--",
        "---",
        "inf",
        "-inf",
        "+inf",
        "infinity",
        "ovld",
        "ovfl",
        "overflow",
        "overrange",
        "underflow",
        "missing",
        "void",
        "#ref!",
        "#num!",
        "#zahl!",
        "#nombre!",
        "....",
        "...",
        "----",
        "-----",
        "_",
        "ol",
        "overload",
        "over",
        "#div/0!",
        "#wert!",
        "#value!",
        "#valeur!",
        "err",
        "error",
        "?",
        "*",
    )
)
POINT = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eEdD][+-]?[0-9]+)?"
COMMA = r"[+-]?(?:[0-9]+,?[0-9]*|,[0-9]+)(?:[eEdD][+-]?[0-9]+)?"
GROUPED_POINT = r"[+-]?[1-9][0-9]{0,2}(?:[,'’ \u00a0\u202f][0-9]{3})+(?:\.[0-9]*)?"
GROUPED_COMMA = r"[+-]?[1-9][0-9]{0,2}(?:[.'’ \u00a0\u202f][0-9]{3})+(?:,[0-9]*)?"
SAMPLE = (200, 300, 60)  # lines from the beginning, the middle and the end


@dataclass(frozen=True)
class Dialect:
    """How the lines of a table are cut and its numbers written. ``prefix`` is set where each line has one."""

    separator: str
    decimal: str
    quoted: bool
    prefix: bool = False

    @property
    def number(self) -> re.Pattern[str]:
        """A plain number."""
        return PLAIN[self.decimal]

    def cells(self, line: str) -> list[str]:
        """The cells of one line, without blanks around them; the minus sign of typography becomes a plain one."""
        if self.prefix:
            line = PREFIX.sub("", line, count=1)
        if self.separator == " ":
            return [cell.strip('"') for cell in re.findall(r'"[^"]*"|\S+', line)] if self.quoted else line.split()
        if self.quoted and '"' in line:
            try:
                return [
                    cell.strip() for cell in next(csv.reader((line,), delimiter=self.separator, skipinitialspace=True))
                ]
            except (csv.Error, StopIteration):
                pass
        return [cell.strip() for cell in line.split(self.separator)]

    def kind(self, cell: str) -> str:
        """What a cell is: "N" a number, "T" a time of day, "M" a mark for a missing value, "E" empty, "X" text."""
        if not cell:
            return "E"
        if PLAIN[self.decimal].fullmatch(cell):
            return "N"
        if cell[0] in "−–" and PLAIN[self.decimal].fullmatch("-" + cell[1:]):
            return "N"
        if GROUPED[self.decimal].fullmatch(cell):
            return "N"
        if cell.casefold() in MISSING:
            return "M"
        return "T" if TIME.fullmatch(cell) else "X"

    def value(self, cell: str) -> float:
        """The number in a cell of kind "N"."""
        if cell[0] in "−–":
            cell = "-" + cell[1:]
        if not PLAIN[self.decimal].fullmatch(cell):
            cell = re.sub(r"[^0-9+\-" + re.escape(self.decimal) + "]", "", cell)
        cell = cell.replace(",", ".") if self.decimal == "," else cell
        return float(cell.replace("D", "e").replace("d", "e"))  # Fortran writes 1.5D-01


PLAIN = {".": re.compile(POINT), ",": re.compile(COMMA)}
GROUPED = {".": re.compile(GROUPED_POINT), ",": re.compile(GROUPED_COMMA)}


def judge(
    lines: Sequence[str], findings: Findings, separator: str | None = None, decimal: str | None = None
) -> Dialect | None:
    """The dialect in which most cells of a sample of the lines are numbers; None where no row of numbers is found."""
    sample = _sample(lines)
    given = [line for line in sample if line.strip()]
    prefix = sum(bool(PREFIX.match(line)) for line in given) > MANY * len(given)
    quoted = any('"' in line for line in sample)
    if separator is None and decimal in (None, ",") and _comma_and_blank(sample):
        return Dialect(", ", ",", False, prefix)
    best: tuple[float, Dialect] | None = None
    for sign in [BY_NAME[separator]] if separator else SEPARATORS:
        for point in [decimal] if decimal else (".", ","):
            if sign == point and not quoted:
                continue
            dialect = Dialect(sign, point, quoted, prefix)
            score = _score(dialect, sample)
            # Blanks stand in headings, remarks and grouped digits as well: they separate where nothing else does.
            score *= 0.75 if sign == " " else 1.0
            if score > 0.0 and (best is None or score > best[0]):
                best = (score, dialect)
    if best is None:
        return None
    if decimal is None:
        _ask_for_decimal(best[1], sample, findings)
    return best[1]


def _comma_and_blank(sample: Sequence[str]) -> bool:
    numbers = [line for line in sample if re.fullmatch(r"[\d\s,.;eE+-]*\d[\d\s,.;eE+-]*", line)]
    return len(numbers) >= 3 and sum(bool(COMMA_AND_BLANK.fullmatch(line)) for line in numbers) > MANY * len(numbers)


def _sample(lines: Sequence[str]) -> list[str]:
    first, middle, last = SAMPLE
    if len(lines) <= first + middle + last:
        return list(lines)
    half = (len(lines) - middle) // 2
    return [*lines[:first], *lines[half : half + middle], *lines[-last:]]


def _score(dialect: Dialect, sample: Sequence[str]) -> float:
    """Cells that are numbers, less those that are text, over the rows with at least one number more than texts."""
    total = 0.0
    for line in sample:
        cells = dialect.cells(line)
        kinds = [dialect.kind(cell) for cell in cells]
        numbers = kinds.count("N") + kinds.count("T") + 0.5 * kinds.count("M")
        texts = kinds.count("X")
        if numbers > texts and numbers >= 1:
            grouped = sum(
                kind == "N" and not dialect.number.fullmatch(cell) for cell, kind in zip(cells, kinds, strict=True)
            )
            # A single cell can be a number in many dialects: it counts less than one of several.
            total += (numbers - texts - 0.01 * grouped) * (0.5 if len(cells) == 1 else 1.0)
    return total


def _ask_for_decimal(dialect: Dialect, sample: Sequence[str], findings: Findings) -> None:
    """Every comma followed by three digits: decimals, or thousands?"""
    if dialect.decimal != ",":
        return
    commas = [cell for line in sample for cell in dialect.cells(line) if "," in cell and dialect.kind(cell) == "N"]
    if commas and all(GROUPED["."].fullmatch(cell) and "." not in cell for cell in commas):
        findings.obstacle(
            "decimal sign",
            f"each comma has three digits behind it, as in {commas[0]!r}: is it the decimal sign or does it "
            f"part thousands",
            '--decimal "," or --decimal "."',
        )


def recogniser(dialect: Dialect, numeric: Sequence[bool]) -> Callable[[str], bool] | None:
    """A fast test for whole rows of plain numbers; None where the separator is blanks or cells are quoted."""
    if dialect.separator == " " or dialect.quoted or dialect.prefix:
        return None
    number = rf"\s*{COMMA if dialect.decimal == ',' else POINT}\s*"
    other = rf"[^{re.escape(dialect.separator)}]*"
    pattern = re.compile(re.escape(dialect.separator).join(number if one else other for one in numeric))
    return lambda line: pattern.fullmatch(line) is not None
