"""The beginning of every import: options, text, table, specimens side by side, one below the other or by a column."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rig.importing.columns import groups_of
from rig.importing.findings import Findings
from rig.importing.headings import fold
from rig.importing.options import ImportOptions, beside
from rig.importing.parameters import Dimensions, dimensions, parameters_in
from rig.importing.table import RawTable, Section, find_table
from rig.importing.text import read_text
from rig.importing.understood import Understood


@dataclass(frozen=True)
class Piece:
    """The columns ``group`` and rows ``section`` of one specimen, its label and its dimensions from the file."""

    label: str
    group: list[int]
    section: Section
    size: Dimensions


@dataclass
class Source:
    """One file: its table, its pieces, what was said about it and what was found."""

    path: Path
    table: RawTable | None
    options: ImportOptions
    findings: Findings
    understood: Understood
    pieces: list[Piece] = field(default_factory=list)


def open_source(path: Path, options: ImportOptions) -> Source:
    """Read a file as far as its table.

    Raises
    ------
    ConfigError
        When the file, or the options beside it, cannot be read at all; what else is wrong is in ``findings``.
    """
    stored, stored_in = beside(path)
    options = options.over(stored)
    text = read_text(path, options.encoding)
    findings = Findings(str(path))
    understood = Understood(
        str(path), options_file=str(stored_in or ""), options=options.to_table(), findings=findings.all
    )
    table = find_table(text, findings, options.separator, options.decimal)
    source = Source(path, table, options, findings, understood)
    if table is not None:
        understood.begin(table)
        source.pieces = _selected(_pieces(table), options, findings)
    return source


def _pieces(table: RawTable) -> list[Piece]:
    groups, labels = groups_of(table)
    shared = parameters_in(table.preamble, table.dialect)
    pieces: list[Piece] = []
    for section in table.sections:
        own = {**shared, **parameters_in(section.lead, table.dialect)}
        for part in _by_specimen(table, section):
            for k, (group, label) in enumerate(zip(groups, labels, strict=True)):
                words = " ".join(filter(None, (label, part.label)))
                pieces.append(Piece(words, group, part, dimensions(own, k if len(groups) > 1 else len(pieces))))
    return pieces


def _by_specimen(table: RawTable, section: Section) -> list[Section]:
    """The section cut where a column of specimens' names changes."""
    column = next((j for j, heading in enumerate(table.headings) if heading.quantity == "specimen"), None)
    if column is None:
        return [section]
    parts: dict[str, Section] = {}
    for line, row in zip(section.lines, section.rows, strict=True):
        name = row[column].strip()
        part = parts.setdefault(name, Section(section.lead, label=name or section.label))
        part.lines.append(line)
        part.rows.append(row)
    # As many names as rows are the numbers of the rows, not specimens.
    return list(parts.values()) if len(parts) <= len(section.rows) // 3 else [section]


def _selected(pieces: Sequence[Piece], options: ImportOptions, findings: Findings) -> list[Piece]:
    if not options.specimen:
        return list(pieces)
    kept = []
    for name in options.specimen:
        found = [piece for piece in pieces if piece.label and fold(piece.label) == fold(name)]
        if not found and name.isdigit() and 1 <= int(name) <= len(pieces):
            found = [pieces[int(name) - 1]]
        if not found:
            known = ", ".join(f"{k + 1} {piece.label!r}" for k, piece in enumerate(pieces))
            findings.obstacle("specimen", f"there is no specimen {name!r}; there are {known}", "--specimen NUMBER")
        kept += found
    return kept
