"""Where the table stands in the lines: its rows, heading, unit row, what stands above it, and what interrupts it.

The table is the longest run of rows with one count of numbers. Lines between its rows are chatter and left out, unless
they are a heading, a label or dimensions: then another specimen begins.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

from rig.importing.cell_words import without_words
from rig.importing.dialect import Dialect, judge, recogniser
from rig.importing.findings import Findings, shortened
from rig.importing.headings import DIMENSION, Heading, fold, is_unit_row, understand
from rig.importing.text import TableText
from rig.importing.units import unit_of

FEWEST_ROWS = 3
MOST_COLUMNS = 2000
MOST_WIDE = 0.02  # of the rows that may hold more values than the table has columns
PAGE = 8  # rows at the end of a page from which it is told whether the next goes on
SAMPLED = 5000  # lines of which every one is looked at to find the columns
REMARK = re.compile(r"^\s*(#|%|//|!|\*)+\s*")
LABEL = re.compile(
    r"^\W*(specimen|sample|probe|prufling|eprouvette|echantillon|test|messung|versuch|run|essai|curve|kurve|"
    r"zyklus|cycle)\b.{0,60}$"
)
REMARKS = ("comment", "comments", "kommentar", "commentaire", "remark", "remarks", "bemerkung")
STATISTIC = re.compile(  # what stands before the numbers in a row of statistics over the rows above it
    r"(mean|average|avg|median|std|stdev|standard dev\w*|s d|deviation|variance|coefficient|max(imum)?|min(imum)?|"
    r"range|sum|count|mittel\w*|standardabweichung|summe|anzahl|moyenne|ecart type|mediane|somme|total)\b"
)
RULE = re.compile(r"[-=_:+~]{2,}")  # a line that is drawn
UNIT_ROW_LABELS = ("unit", "units", "einheit", "einheiten", "unite", "unites", "y unit label", "uom", "dimension")


@dataclass(frozen=True)
class TextRow:
    """A line that is no row of numbers."""

    line: int
    cells: list[str]
    remark: bool = False

    @property
    def given(self) -> list[str]:
        """The cells that are not empty."""
        return [cell for cell in self.cells if cell]


@dataclass
class Section:
    """Rows of numbers that belong together, and the text above them. ``lines`` count from 1."""

    lead: list[TextRow]
    lines: list[int] = field(default_factory=list)
    rows: list[list[str]] = field(default_factory=list)
    label: str = ""
    bad: int = 0  # rows with a cell that is no number


@dataclass(frozen=True)
class LeftOut:
    """A line inside or behind the table that is not used."""

    line: int
    why: str
    text: str


@dataclass
class RawTable:
    """A table as text, cut into columns; nothing is converted yet."""

    text: TableText
    dialect: Dialect
    headings: list[Heading]
    heading_line: int | None
    unit_line: int | None
    labels: list[str]
    sections: list[Section]
    preamble: list[TextRow]
    left_out: list[LeftOut]
    numeric: list[bool]

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.headings)


def find_table(text: TableText, findings: Findings, separator: str | None, decimal: str | None) -> RawTable | None:
    """The table in the lines of a file; None, with an obstacle, where there is none."""
    lines, words, parted = without_words(text.lines)
    text = replace(text, lines=lines)
    dialect = judge(text.lines, findings, separator or parted or None, decimal)
    form = None if dialect is None else _columns(text.lines, dialect)
    if dialect is None or form is None:
        findings.obstacle(
            "table",
            "no rows of at least two numbers were found",
            '--separator ";" and --decimal "," tell how the numbers are written',
        )
        return None
    width, numeric = form
    if width > MOST_COLUMNS:
        findings.obstacle("table", f"the rows have {width} columns; at most {MOST_COLUMNS} are read")
        return None
    sections, preamble, left_out = _sections(text, dialect, width, numeric)
    sections = [one for one in sections if one.rows]
    if not sections:
        findings.obstacle("table", f"fewer than {FEWEST_ROWS} rows of numbers stand together")
        return None
    _report_wide(left_out, sections, findings)
    main = max(sections, key=lambda one: len(one.rows))
    heads = [_heading(section.lead, width, numeric, dialect) for section in (main, *sections)]
    head = next((one for one in heads if one.names), heads[0])
    kept: list[Section] = []
    for section in sections:
        own = _heading(section.lead, width, numeric, dialect)
        if own.names and head.names and [fold(a) for a in own.names] != [fold(a) for a in head.names]:
            left_out.append(LeftOut(section.lines[0], f"another table of {len(section.rows)} rows", str(own.names)))
            continue
        section.label = _label(section.lead, own)
        if kept and _goes_on(kept[-1], section, numeric, dialect):
            kept[-1].lines += section.lines
            kept[-1].rows += section.rows
            left_out += [
                LeftOut(row.line, "heading repeated", text.lines[row.line - 1]) for row in section.lead if row.cells
            ]
        else:
            kept.append(section)
    _check_heading(head, width, numeric, findings)
    units = head.units or _unit_row_above(preamble, width)
    headings = []
    for j in range(width):
        name = head.names[j] if j < len(head.names) else ""
        unit = units[1][j] if units and j < len(units[1]) else ""
        said = words[j] if j < len(words) else ("", "")
        headings.append(_with_words(understand(name or said[0], unit), said, findings))
    return RawTable(
        text, dialect, headings, head.line, units[0] if units else None, head.labels, kept, preamble, left_out, numeric
    )


def _with_words(heading: Heading, said: tuple[str, str], findings: Findings) -> Heading:
    """The heading with the unit that stands in every cell."""
    unit = unit_of(said[1])
    if unit is None:
        return heading
    if heading.unit is not None and heading.unit.name != unit.name:
        findings.obstacle(
            "unit",
            f"the heading {heading.text!r} says {heading.unit_text}, and its cells say {said[1]}",
            f"--unit {heading.quantity or 'QUANTITY'}=UNIT",
        )
    return understand(heading.name, said[1]) if heading.unit is None else heading


def _columns(lines: Sequence[str], dialect: Dialect) -> tuple[int, list[bool]] | None:
    """How many columns the rows of numbers have, and which of them hold numbers or times."""
    looked_at = lines if len(lines) <= SAMPLED else [*lines[:2000], *lines[len(lines) // 2 :][:2000], *lines[-500:]]
    rows = []
    for line in looked_at:
        cells = dialect.cells(line)
        kinds = [dialect.kind(cell) for cell in cells]
        if kinds.count("N") + kinds.count("T") >= 2 and kinds.count("N") + kinds.count("T") > kinds.count("X"):
            rows.append(kinds)
    if len(rows) < FEWEST_ROWS:
        return None
    widths = Counter(map(len, rows))
    width = max(size for size, count in widths.items() if count >= max(2, 0.1 * len(rows)))
    numeric = []
    for j in range(width):
        kinds = [row[j] for row in rows if len(row) == width]
        numeric.append(kinds.count("N") + kinds.count("T") + kinds.count("M") > kinds.count("X"))
    return (width, numeric) if sum(numeric) >= 2 else None


def _sections(
    text: TableText, dialect: Dialect, width: int, numeric: Sequence[bool]
) -> tuple[list[Section], list[TextRow], list[LeftOut]]:
    """Walk the lines once."""
    fast = recogniser(dialect, numeric)
    separator = dialect.separator
    sections: list[Section] = []
    preamble: list[TextRow] = []
    left_out: list[LeftOut] = []
    current = Section([])
    waiting: list[TextRow] = []  # lines since the last row of numbers
    blanks = 0
    for number, line in enumerate(text.lines, start=1):
        if fast is not None and fast(line):
            cells, clean = line.split(separator), True
        elif not line.strip():
            blanks += 1
            continue
        else:
            cells = dialect.cells(line)
            state = _state(dialect, cells, width, numeric)
            if state == "wide" and len(current.rows) >= FEWEST_ROWS:
                left_out.append(LeftOut(number, "more values than the table has columns", line))
                continue
            if state in ("text", "wide"):  # a row of results above the table can be wider than it
                if blanks and waiting:
                    waiting.append(TextRow(number - 1, []))
                blanks = 0
                waiting.append(_text_row(number, line, dialect))
                continue
            clean = state == "clean"
        if waiting or blanks:
            if current.rows and not _divides(waiting, current, cells, dialect):
                left_out += [
                    LeftOut(row.line, "no row of numbers", text.lines[row.line - 1]) for row in waiting if row.cells
                ]
            elif current.rows or clean or _heads(waiting, width, numeric, dialect):
                sections.append(current)
                current = Section(waiting)
            elif not clean:
                waiting.append(_text_row(number, line, dialect))
                continue
            waiting, blanks = [], 0
        elif not current.rows and not clean:
            waiting.append(_text_row(number, line, dialect))
            continue
        current.lines.append(number)
        current.bad += not clean
        current.rows.append(cells + [""] * (width - len(cells)) if len(cells) < width else cells[:width])
    sections.append(current)
    left_out += [LeftOut(row.line, "no row of numbers", text.lines[row.line - 1]) for row in waiting if row.cells]
    kept: list[Section] = []
    for section in sections:
        preamble += section.lead
        if len(section.rows) - section.bad >= FEWEST_ROWS:
            kept.append(section)
        else:
            rows = zip(section.lines, section.rows, strict=True)
            preamble += [TextRow(line, [cell.strip() for cell in cells]) for line, cells in rows]
    # A few rows of numbers above the heading are results or dimensions, and so part of what stands above the table.
    for k, section in enumerate(kept):
        if not section.lead and k == 0:
            section.lead = list(preamble)
    begin = min((section.lines[0] for section in kept), default=0)
    return kept, sorted(preamble, key=lambda row: row.line), [one for one in left_out if one.line > begin]


def _text_row(number: int, line: str, dialect: Dialect) -> TextRow:
    mark = REMARK.match(line)
    if mark and is_unit_row(dialect.cells(line)):  # "%;MPa" is no remark
        mark = None
    rest = line[mark.end() :] if mark else line
    return TextRow(number, dialect.cells(rest), bool(mark))


def _state(dialect: Dialect, cells: list[str], width: int, numeric: Sequence[bool]) -> str:
    """ "clean", "bad" (a row of the table with a cell that is no number), "wide" or "text"."""
    kinds = [dialect.kind(cell) for cell in cells]
    if "X" in kinds and STATISTIC.match(fold(cells[kinds.index("X")])):
        return "text"
    while len(kinds) > width and kinds[-1] == "E":
        kinds.pop()
    wide = len(kinds) > width
    inside = [kind for kind, one in zip(kinds, numeric, strict=False) if one]
    good, bad = inside.count("N") + inside.count("T"), inside.count("X")
    missing = inside.count("M")
    if wide:
        return "wide" if good >= 2 and not bad and kinds.count("X") <= 1 else "text"
    if not bad and good + missing >= 2 and good >= 1:
        return "clean"
    if bad and len(kinds) >= width - 1 and good >= 2 and good > bad:
        return "bad"
    # In a table of two columns one bad cell leaves one number: a number gone wrong, not a word beside a number.
    wrong = [cell for cell, kind, one in zip(cells, kinds, numeric, strict=False) if one and kind == "X"]
    digits = bad == 1 and re.match(r"[+-.,]*[0-9]", wrong[0]) and good + bad + missing == sum(numeric)
    return "bad" if digits and good >= 1 else "text"


def _divides(waiting: Sequence[TextRow], current: Section, cells: Sequence[str], dialect: Dialect) -> bool:
    """Whether what stands between two rows of numbers begins another specimen."""
    rows = [row for row in waiting if row.cells]
    if not rows:  # blank lines: only where the first column begins again
        first, last, now = (_number(row, dialect) for row in (current.rows[0], current.rows[-1], cells))
        if first is None or last is None or now is None:
            return False
        return abs(now - first) <= 0.05 * abs(last - first) and now != last
    for row in rows:
        words = [understand(cell) for cell in row.given]
        if len(row.given) >= 2 and sum(word.quantity in DIMENSION for word in words) >= 2:
            return True
        if len(row.given) >= 2 and is_unit_row(row.given):
            return True
        if LABEL.match(fold(" ".join(row.given))):
            return True
    return False


def _goes_on(before: Section, after: Section, numeric: Sequence[bool], dialect: Dialect) -> bool:
    """Whether rows under a repeated heading are the same run on another page, and not another specimen.

    A column that has gone one way without a step back goes on that way from where it was, and no column jumps.
    """
    if after.label or before.label or len(before.rows) < PAGE or len(after.rows) < 2:
        return False
    rising = False
    for j, one in enumerate(numeric):
        cells = [row[j].strip() for row in (*before.rows[-PAGE:], *after.rows[:2])] if one else []
        if not one or any(dialect.kind(cell) != "N" for cell in cells):
            continue  # times of day, blanks
        values = [dialect.value(cell) for cell in cells]
        steps = [b - a for a, b in pairwise(values)]
        usual = sorted(map(abs, steps[: PAGE - 1]))[PAGE // 2]
        if abs(steps[PAGE - 1]) > 6.0 * max(usual, max(map(abs, steps[: PAGE - 1]))):
            return False
        rising |= all(step > 0.0 for step in steps) or all(step < 0.0 for step in steps)
    return rising


def _number(cells: Sequence[str], dialect: Dialect) -> float | None:
    cell = next((cell.strip() for cell in cells if cell.strip()), "")
    return dialect.value(cell) if dialect.kind(cell) == "N" else None


def _heads(waiting: Sequence[TextRow], width: int, numeric: Sequence[bool], dialect: Dialect) -> bool:
    """Whether the lines before a row with a bad cell are a heading."""
    return bool(_heading(list(waiting), width, numeric, dialect).names)


@dataclass(frozen=True)
class _Head:
    names: list[str]
    line: int | None
    units: tuple[int, list[str]] | None
    labels: list[str]


def _heading(lead: list[TextRow], width: int, numeric: Sequence[bool], dialect: Dialect) -> _Head:
    """Names, units and labels of the columns from the lines directly above the rows."""
    units: tuple[int, list[str]] | None = None
    remarks: list[TextRow] = []
    usable = sum(numeric)
    for k in range(len(lead) - 1, max(-1, len(lead) - 8), -1):
        row = lead[k]
        if row.remark:
            remarks.append(row)
            continue
        given = row.given
        if not given or all(RULE.fullmatch(cell) for cell in given):
            continue
        cells = _glued(row.cells, width) if dialect.separator == " " else row.cells
        shifted = ["", *cells[1:]] if cells and fold(cells[0]) in UNIT_ROW_LABELS else cells
        shifted = shifted if is_unit_row(shifted) else shifted[:width]  # a remark may stand behind the units
        if units is None and len([c for c in shifted if c]) >= min(2, usable) and is_unit_row(shifted):
            units = (row.line, _fitted(shifted, width))
            continue
        if any(dialect.kind(cell) == "N" for cell in given) and not _named(given):
            continue
        if len(given) == 1 and LABEL.match(fold(given[0])):
            continue  # the name of the first specimen, below the heading of all
        if len(given) >= max(2, usable // 2):
            labels = lead[k - 1].cells if k and not lead[k - 1].remark and len(lead[k - 1].given) < len(given) else []
            return _Head(_fitted(cells, width), row.line, units, _fitted(labels, width) if labels else [])
        break
    for row in remarks:
        cells = _glued(row.cells, width)
        if units is None and len(row.given) in (width, usable) and is_unit_row(row.given):
            units = (row.line, _fitted(row.given, width))
            continue
        if len(cells) == 1:
            cells = re.split(r"\s{2,}|\t|;|,", cells[0])
            cells = cells if len(cells) == width else row.cells[0].split()
        if len(cells) in (width, usable) and sum(understand(cell).quantity in DIMENSION for cell in cells) >= 2:
            return _Head(_fitted([cell.strip() for cell in cells], width), row.line, units, [])
    return _Head([], None, units, [])


def _named(given: Sequence[str]) -> bool:
    """Whether most cells are words, numbers among them or not."""
    return sum(bool(re.search(r"[A-Za-z]{2}", cell)) for cell in given) > len(given) / 2


def _glued(cells: list[str], width: int) -> list[str]:
    """Words that blanks have parted: a unit in brackets belongs to the name before it."""
    if len(cells) <= width:
        return cells
    glued: list[str] = []
    for cell in cells:
        if (glued and (cell[:1] in "([/" or (glued[-1].count("(") > glued[-1].count(")")))) or (
            glued and glued[-1].endswith("/")
        ):
            glued[-1] = f"{glued[-1]} {cell}"
        else:
            glued.append(cell)
    while len(glued) > width:  # words of one name: those that mean nothing alone join their neighbour
        weak = [
            k
            for k in range(1, len(glued))
            if understand(glued[k - 1]).quantity in ("", "other", "index", "true stress")
        ]
        k = weak[0] if weak else len(glued) - 1
        glued[k - 1 : k + 1] = [f"{glued[k - 1]} {glued[k]}"]
    return glued


def _fitted(cells: Sequence[str], width: int) -> list[str]:
    """The cells without empty ones behind the table's last column."""
    cells = list(cells)
    while len(cells) > width and not cells[-1]:
        cells.pop()
    if len(cells) < width:
        cells += [""] * (width - len(cells))
    return cells


def _check_heading(head: _Head, width: int, numeric: Sequence[bool], findings: Findings) -> None:
    """R writes no name over the numbers of its rows; any other lack or surplus of names is asked about."""
    if not head.names:
        return
    while len(head.names) > width and fold(head.names[-1]) in REMARKS:  # LabVIEW names a column that rows leave out
        head.names.pop()
    named = [j for j, name in enumerate(head.names) if name]
    if len(head.names) > width:
        findings.obstacle(
            "heading",
            f"the heading has {len(head.names)} names, and the rows have {width} values",
            "--separator and --decimal tell how the rows are written",
            line=head.line,
        )
    unnamed = [j + 1 for j in range(width) if numeric[j] and j not in named]
    if unnamed and unnamed == [width] and head.names[0]:
        # R: row names without a heading stand in front.
        head.names.insert(0, "")
        head.names.pop()
    elif len(unnamed) > 1 and unnamed[-1] == width and len(named) < sum(numeric) / 2:
        findings.obstacle(
            "heading",
            f"the heading has {len(named)} names, and the rows have {sum(numeric)} columns of numbers",
            "--column QUANTITY=NUMBER names each column by its number",
            line=head.line,
        )


def _unit_row_above(preamble: Sequence[TextRow], width: int) -> tuple[int, list[str]] | None:
    """A row of units that says so in its first cell, as LabVIEW writes one; the first column is then time."""
    for row in reversed(preamble):
        if (
            row.cells
            and fold(row.cells[0]) in UNIT_ROW_LABELS
            and sum(unit_of(cell) is not None for cell in row.cells[1:]) >= min(2, width - 1)
        ):
            first = "s" if fold(row.cells[0]) == "y unit label" else ""
            return row.line, _fitted([first, *row.cells[1:]], width)
    return None


def _label(lead: Sequence[TextRow], head: _Head) -> str:
    """The name of a specimen in the lines above its rows."""
    for row in reversed(lead):
        words = " ".join(row.given)
        if row.line not in (head.line, head.units[0] if head.units else None) and LABEL.match(fold(words)):
            return shortened(words)
    return ""


def _report_wide(left_out: Sequence[LeftOut], sections: Sequence[Section], findings: Findings) -> None:
    wide = [one for one in left_out if one.why.startswith("more values")]
    rows = sum(len(section.rows) for section in sections)
    if len(wide) > MOST_WIDE * rows:
        findings.obstacle(
            "table",
            f"{len(wide)} of {rows + len(wide)} rows have more values than the others; are digits parted by the "
            f"separator",
            "--separator and --decimal tell how the rows are written",
            line=wide[0].line,
            cell=wide[0].text,
        )
