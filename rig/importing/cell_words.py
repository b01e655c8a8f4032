"""Cells that hold a name or a unit beside their number ("h_mm:1.2", "5.0 %"): said once, for the whole column."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from rig.importing.units import unit_of

NUMBER = r"[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][+-]?\d+)?"
CELL = re.compile(rf"\s*(?:([A-Za-z_][\w()/%]*)\s?[:=]\s?)?({NUMBER})\s?(%|[a-zA-Zµ][\w/²%]*)?\s*")
SEPARATORS = (";", "\t", ",", "|", " ")
MANY = 0.5  # of the lines with a number in them
SAMPLE = 400  # lines from which it is told whether cells hold words

Words = tuple[tuple[str, str], ...]


def without_words(lines: Sequence[str]) -> tuple[list[str], Words, str]:
    """The lines with the numbers alone, name and unit of each column, and the separator; () where cells hold no words.

    A row in which a cell has another name or unit than most rows have there stays as it is: it is no row of numbers.
    A decimal comma and columns parted by commas cannot be told apart here.

    >>> without_words(["t", "strain:0.1 stress:5kPa", "strain:0.2 stress:9kPa"])[1:]
    ((('strain', ''), ('stress', 'kPa')), ' ')
    """
    sample = [line for line in lines[:SAMPLE] if re.search(r"\d", line)]
    for separator in SEPARATORS:
        found = [words for words in (_words(line, separator) for line in sample) if words is not None]
        common, count = Counter(found).most_common(1)[0] if found else ((), 0)
        if count > MANY * len(sample) and len(common) >= 2 and any(name or unit for name, unit in common):
            return [_numbers(line, separator, common) for line in lines], common, separator
    return list(lines), (), ""


def _cut(line: str, separator: str) -> list[str]:
    return line.split() if separator == " " else line.split(separator)


def _words(line: str, separator: str) -> Words | None:
    """Name and unit of every cell; None where a cell is something else than a number with them."""
    found = [CELL.fullmatch(cell) for cell in _cut(line, separator)]
    cells = [(one[1] or "", one[3] or "") for one in found if one is not None]
    known = all(not unit or unit_of(unit) is not None for _, unit in cells)
    return tuple(cells) if known and len(cells) == len(found) else None


def _numbers(line: str, separator: str, words: Words) -> str:
    if _words(line, separator) != words:
        return line
    return separator.join(CELL.fullmatch(cell)[2] for cell in _cut(line, separator))  # type: ignore[index] # as above
