"""Voltages that are said, not measured: by the option, a label, a line above the rows, a heading, the file's name."""

from __future__ import annotations

import re
from collections.abc import Sequence

from rig.importing.findings import Findings
from rig.importing.headings import voltage_in
from rig.importing.parameters import named_value
from rig.importing.source import Piece, Source

TITLE = re.compile(
    r"(applied |nominal |test |set |dc |drive |actuation |bias |angelegte )?"
    r"(voltage|hv|high voltage|u|v|spannung|hochspannung|prufspannung|tension)( applied| set| soll| dc)?( u| v)?"
)


def said_of(source: Source, piece: Piece) -> tuple[float, str] | None:
    """The voltage (V) of a piece of a table that has no column of it, and where it is said; None where nowhere."""
    found = voltage_in(piece.label)
    if found is not None:
        return found, f"the label {piece.label!r}"
    if source.table is not None:
        for row in reversed(piece.section.lead):
            one = named_value(row, source.table.dialect, TITLE)
            if one is not None and len(one[1]) == 1 and one[2] is not None and one[2].dimension == "voltage":
                return one[1][0] * one[2].factor, f"line {row.line}: {' '.join(row.given)}"
    found = voltage_in(source.path.stem.replace("_", " "))
    return None if found is None else (found, "the file's name")


def shared_out(stated: Sequence[float], counts: Sequence[int]) -> list[list[float]] | None:
    """The voltage of each sweep of each run, which have ``counts`` sweeps; None where the numbers do not agree.

    One voltage is for all; as many as runs are for one run each; as many as sweeps are for the sweeps in turn.

    >>> shared_out([1.0], [2, 1]), shared_out([0.0, 1.0], [2, 2]), shared_out([0.0, 1.0, 2.0], [2, 1])
    ([[1.0, 1.0], [1.0]], [[0.0, 0.0], [1.0, 1.0]], [[0.0, 1.0], [2.0]])
    """
    if len(stated) == 1:
        return [[stated[0]] * count for count in counts]
    if len(stated) == len(counts):
        return [[value] * count for value, count in zip(stated, counts, strict=True)]
    if len(stated) != sum(counts):
        return None
    left = list(stated)
    return [[left.pop(0) for _ in range(count)] for count in counts]


def ask_for_other(stated: Sequence[float], counts: Sequence[int], findings: Findings) -> None:
    """Say that the number of stated voltages suits neither the runs nor the sweeps."""
    runs = f" in {len(counts)} runs ({', '.join(map(str, counts))})" if len(counts) > 1 else ""
    findings.obstacle(
        "voltage",
        f"{len(stated)} voltages are stated, and there are {sum(counts)} sweeps{runs}",
        "--voltage with one value a sweep" + (", one a run" if runs else "") + ", or one for all",
    )
