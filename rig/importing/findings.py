"""What importing found: obstacles, which refuse a file, warnings and notes. All of them are told at once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from rig.base.errors import ConfigError

Severity = Literal["obstacle", "warning", "note"]
LONGEST_CELL = 40


@dataclass(frozen=True)
class Finding:
    """One fact about a table that a person must know.

    ``option`` is what to add to the command line to settle it, ready to be copied. ``line`` and ``column`` count from 1
    as in an editor and in a spreadsheet; ``cell`` is the text that stands there.
    """

    severity: Severity
    topic: str
    file: str
    what: str
    option: str = ""
    line: int | None = None
    column: int | None = None
    cell: str | None = None

    def __str__(self) -> str:
        """One sentence with its place: file, line, column and cell, as far as they are known."""
        place = [self.file]
        if self.line is not None:
            place.append(f"line {self.line}")
        if self.column is not None:
            place.append(f"column {self.column}")
        if self.cell is not None:
            place.append(f"cell {shortened(self.cell)!r}")
        option = f" Option: {self.option}" if self.option else ""
        return f"{', '.join(place)}: {self.what}.{option}"


class ImportRefused(ConfigError):
    """Tables that cannot be used as they are; the message holds every obstacle and the option that removes it."""

    def __init__(self, findings: Sequence[Finding], understood: Sequence[str] = ()) -> None:
        self.findings = tuple(findings)
        self.understood = tuple(understood)
        lines = ["These tables cannot be used as they are:"]
        lines += [f"  - {finding}" for finding in self.findings]
        super().__init__("\n".join(lines))


@dataclass
class Findings:
    """Collects the findings of one file."""

    file: str
    all: list[Finding] = field(default_factory=list)

    def obstacle(
        self,
        topic: str,
        what: str,
        option: str = "",
        *,
        line: int | None = None,
        column: int | None = None,
        cell: str | None = None,
    ) -> None:
        """Something that forbids using the file."""
        self.all.append(Finding("obstacle", topic, self.file, what, option, line, column, cell))

    def warning(self, topic: str, what: str, option: str = "", *, line: int | None = None) -> None:
        """Something that may make the result wrong."""
        self.all.append(Finding("warning", topic, self.file, what, option, line))

    def note(self, topic: str, what: str, option: str = "") -> None:
        """A decision that a reader must be able to question."""
        self.all.append(Finding("note", topic, self.file, what, option))

    def of(self, severity: Severity) -> list[Finding]:
        """The findings of one severity, in the order in which they came up."""
        return [one for one in self.all if one.severity == severity]


def refuse(findings: Iterable[Finding], understood: Sequence[str] = ()) -> None:
    """Raise `ImportRefused` when there is an obstacle among ``findings``."""
    obstacles = [one for one in findings if one.severity == "obstacle"]
    if obstacles:
        raise ImportRefused(obstacles, understood)


def shortened(text: str) -> str:
    """The text, or its beginning where it is long."""
    return text if len(text) <= LONGEST_CELL else text[: LONGEST_CELL - 3] + "..."


def spans(lines: Sequence[int], most: int = 4) -> str:
    """Line numbers in words: "3, 17-20".

    >>> spans([3, 17, 18, 19]), spans([1, 3, 5, 7, 9, 11])
    ('3, 17-19', '1, 3, 5, 7 and more')
    """
    parts: list[list[int]] = []
    for line in sorted(Counter(lines)):
        if parts and line == parts[-1][1] + 1:
            parts[-1][1] = line
        else:
            parts.append([line, line])
    words = [f"{low}" if low == high else f"{low}-{high}" for low, high in parts[:most]]
    return ", ".join(words) + (" and more" if len(parts) > most else "")
