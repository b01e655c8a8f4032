"""What was understood of a table: told before anything is done with it, and kept in results and reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from rig.importing.columns import Chosen
from rig.importing.dialect import SEPARATOR_NAMES
from rig.importing.findings import Finding, shortened, spans
from rig.importing.table import LeftOut, RawTable


@dataclass
class Understood:
    """Facts of one file. ``parts`` are one line for each specimen or curve; ``use`` maps columns to quantities."""

    file: str
    encoding: str = ""
    separator: str = ""
    decimal: str = ""
    heading_line: int | None = None
    unit_line: int | None = None
    options_file: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    kind: str = ""
    kind_source: str = ""
    use: dict[int, str] = field(default_factory=dict)
    columns: list[str] = field(default_factory=list)
    rows_in_file: int = 0
    rows_kept: list[int] = field(default_factory=list)
    left_out: dict[str, list[int]] = field(default_factory=dict)
    parts: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def begin(self, table: RawTable) -> None:
        """Take over what the table itself says."""
        self.encoding = table.text.encoding
        self.separator = SEPARATOR_NAMES[table.dialect.separator]
        self.decimal = table.dialect.decimal
        self.heading_line = table.heading_line
        self.unit_line = table.unit_line
        self.columns = [heading.text for heading in table.headings]
        self.rows_in_file = sum(len(section.rows) for section in table.sections)
        self.leave_out(table.left_out)

    def leave_out(self, rows: Sequence[LeftOut]) -> None:
        """Note lines that are not used, by reason."""
        for row in rows:
            self.left_out.setdefault(row.why, []).append(row.line)

    def take(self, chosen: Sequence[Chosen], how: str = "") -> None:
        """Note what columns are used for."""
        for one in chosen:
            unit = f" [{one.unit.name}]" if one.unit.name else ""
            words = f"{one.quantity}{unit}" + (", sign reversed" if one.sign < 0 else "")
            if one.extra != 1.0:
                words += f", times {one.extra:g}"
            if one.zero is None:
                words += ", its first value taken off"
            elif one.zero:
                words += f", {one.zero:g} taken off"
            self.use[one.index] = words + how

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for results."""
        return {
            "file": self.file,
            "encoding": self.encoding,
            "separator": self.separator,
            "decimal": self.decimal,
            "heading_line": self.heading_line,
            "unit_line": self.unit_line,
            "options_file": self.options_file or None,
            "options": self.options,
            "kind": self.kind or None,
            "kind_from": self.kind_source or None,
            "columns": {
                f"{j + 1} {name}".strip(): self.use.get(j, "not used")
                for j, name in enumerate(self.columns)
                if name or j in self.use
            },
            "rows_in_file": self.rows_in_file,
            "rows_kept": self.rows_kept[0] if len(self.rows_kept) == 1 else self.rows_kept,
            "rows_left_out": {why: len(lines) for why, lines in self.left_out.items()},
            "parts": self.parts,
            "warnings": [str(one) for one in self.findings if one.severity == "warning"],
            "notes": [str(one) for one in self.findings if one.severity == "note"],
        }

    def lines(self) -> list[str]:
        """The same for the screen, a fact a line."""
        where = "no heading" if self.heading_line is None else f"heading in line {self.heading_line}"
        if self.unit_line is not None:
            where += f", units in line {self.unit_line}"
        told = [
            f"{self.file}: {self.encoding}, columns parted by {self.separator}, decimal sign {self.decimal!r}, {where}"
        ]
        if self.options_file:
            told.append(f"  options from {self.options_file}")
        if self.kind:
            told.append(f"  kind of test: {self.kind} ({self.kind_source})")
        for j, words in sorted(self.use.items()):
            name = self.columns[j] if j < len(self.columns) else ""
            told.append(f"  column {j + 1} {shortened(name)!r} -> {words}")
        spare = [shortened(name) for j, name in enumerate(self.columns) if name and j not in self.use]
        if spare:
            told.append(
                f"  not used: {', '.join(map(repr, spare[:12]))}"
                + (f" and {len(spare) - 12} more" if len(spare) > 12 else "")
            )
        if self.rows_kept:
            told.append(f"  rows used: {', '.join(map(str, self.rows_kept))} of {self.rows_in_file}" + self._reasons())
        told += [f"  {part}" for part in self.parts]
        told += [
            f"  {one.severity}: {one.what}." + (f" Option: {one.option}" if one.option else "")
            for one in self.findings
            if one.severity != "obstacle"
        ]
        return told

    def _reasons(self) -> str:
        words = [
            f"{len(lines)} left out: {why} (line{'s' if len(lines) > 1 else ''} {spans(lines)})"
            for why, lines in self.left_out.items()
        ]
        return "; " + "; ".join(words) if words else ""
