"""Tables of design studies for the terminal."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from rich.table import Table

from model.actuator.design import Row
from rig.design.claims import CASES, NAMES, Claims, Compared, best

if TYPE_CHECKING:
    from rich.console import RenderableType


def map_table(rows: Sequence[Row]) -> Table:
    """The largest stroke and work of every case in every treatment, and what became of all states."""
    table = Table(title="Largest stroke and work, and what ends the strokes")
    for heading in ("case", "treatment"):
        table.add_column(heading)
    for heading in ("d*", "at a/b", "λp", "work / mJ", "at a/b", "λp", "energy check"):
        table.add_column(heading, justify="right")
    table.add_column("ended by")
    table.add_column("film there")
    for case in CASES:
        for treatment in NAMES:
            mine = [row for row in rows if (row.case, row.treatment) == (case, treatment)]
            if not mine:
                continue
            far, strong = best(mine, "stroke"), best(mine, "work")
            check = max((abs(row.work_by_energy / row.work - 1.0) for row in mine if row.work > 0.0), default=0.0)
            table.add_row(
                f"{case} {CASES[case]}",
                NAMES[treatment],
                f"{far.normalized_stroke:.4f}",
                f"{far.radius_ratio:.3g}",
                f"{far.prestretch:g}",
                f"{1e3 * strong.work:.4f}",
                f"{strong.radius_ratio:.3g}",
                f"{strong.prestretch:g}",
                f"{check:.0e}",
                _counted(row.limit for row in mine),
                _counted(row.status for row in mine),
            )
    return table


def _counted(words: Iterable[str]) -> str:
    return ", ".join(f"{count} {word.lower()}" for word, count in sorted(Counter(words).items()))


def claim_tables(claims: Claims) -> list[RenderableType]:
    """The paper's numbers beside ours, its claims, and the reading."""
    numbers = Table(
        title="What the paper prints without pre-stretch, beside the same computed here",
        caption=(
            "At: the a/b of the largest value; in brackets peak against peak; after the bar ours at the paper's a/b. "
            "*: at the edge of the map, the peak may be beyond."
        ),
    )
    numbers.add_column("largest")
    numbers.add_column("paper", justify="right")
    treatments = [t for t in NAMES if t in claims.states]
    for treatment in treatments:
        numbers.add_column(NAMES[treatment], justify="right")
    for first in (c for c in claims.compared if c.treatment == treatments[0]):
        printed = first.printed
        what = f"{'d*' if printed.quantity == 'stroke' else 'work / mJ'}, {printed.case} {CASES[printed.case]}"
        cells = [_cell(c) for t in treatments for c in claims.compared if c.printed is printed and c.treatment == t]
        scale = 1.0 if printed.quantity == "stroke" else 1e3
        paper = "-" if printed.value is None else f"{scale * printed.value:.3f}"
        paper += "" if printed.radius_ratio is None else f" at {printed.radius_ratio:.2f}"
        numbers.add_row(what + (", both driven" if printed.times == 2 else ""), paper, *cells)
    blocks = []
    for films in dict.fromkeys(v.films for v in claims.verdicts):
        judged = Table(title=f"The paper's claims in each treatment, {films}")
        judged.add_column("claim")
        block = [v for v in claims.verdicts if v.films == films]
        some = [t for t in treatments if any(v.treatment == t for v in block)]
        for treatment in some:
            judged.add_column(NAMES[treatment])
        for claim in dict.fromkeys(v.claim for v in block):
            mine = {v.treatment: v for v in block if v.claim == claim}
            judged.add_row(claim, *("holds" if mine[t].holds else "fails" for t in some))
        blocks.append(judged)
    return [numbers, *blocks, *claims.reading()]


def _cell(one: Compared) -> str:
    scale = 1.0 if one.printed.quantity == "stroke" else 1e3
    text = f"{scale * one.value:.3f} at {one.radius_ratio:.2f}{'*' if one.edge else ''}"
    if one.deviation is not None:
        text += f" ({100 * one.deviation:+.0f} %)"
    if one.at_printed is not None and one.deviation_at_printed is not None:
        text += f" | {scale * one.at_printed:.3f} ({100 * one.deviation_at_printed:+.0f} %)"
    return text
