"""What Cao & Conn 2018 print of their optimisation, beside the same numbers computed here in each treatment."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import correlation

from model.actuator.design import Row, Treatment

HYPOTHESIS = "hypothesis"  # field at the disk's edge, eq. (4) with R for r: `rig.design.hypothesis`
CASES = {"I": "spring", "II": "mass", "III": "double cone"}
NAMES = {
    Treatment.PLAIN.value: "plain equations",
    Treatment.TENSION.value: "tension kept",
    Treatment.TENSION_FIELD.value: "tension field",
    HYPOTHESIS: "as perhaps computed",
}
FLAT, EVERY = "without pre-stretch", "at all pre-stretches"  # the films that a verdict is about


@dataclass(frozen=True)
class Printed:
    """A peak over a/b without pre-stretch that the paper prints: section 5 and figure 8. None: not printed."""

    case: str
    quantity: str  # "stroke" (d*) or "work" (J)
    value: float | None
    radius_ratio: float | None
    times: int = 1  # 2: both cones of the double cone driven in turn


PRINTED = (
    Printed("I", "stroke", 0.061, 0.15),
    Printed("II", "stroke", None, 0.20),
    Printed("III", "stroke", 0.128, 0.10),
    Printed("III", "stroke", 0.256, None, times=2),
    Printed("I", "work", 0.076e-3, 0.35),
    Printed("II", "work", 0.129e-3, 0.30),
    Printed("III", "work", 0.087e-3, 0.20),
    Printed("III", "work", 0.174e-3, None, times=2),
)
BOUND_CLAIMED = 0.3  # claim b: "the optimal a/b ratio is less than 0.3 in all three cases"


@dataclass(frozen=True)
class Compared:
    """One printed peak and ours.

    ``at_printed`` is ours at the a/b of the paper's peak; ``prestretch`` is that of our largest value in the whole map;
    ``edge``: our peak stands at the edge of the map, and may be beyond it.
    """

    printed: Printed
    treatment: str
    value: float
    radius_ratio: float
    at_printed: float | None
    prestretch: float
    edge: bool

    @property
    def deviation(self) -> float | None:
        """Our peak over the paper's, minus one, wherever each stands."""
        return None if self.printed.value is None else self.value / self.printed.value - 1.0

    @property
    def deviation_at_printed(self) -> float | None:
        """Ours at the a/b of the paper's peak over the paper's, minus one."""
        if self.printed.value is None or self.at_printed is None:
            return None
        return self.at_printed / self.printed.value - 1.0


@dataclass(frozen=True)
class Verdict:
    """Whether a claim holds in a treatment, of which films (`FLAT` or `EVERY`), and the numbers that decide."""

    claim: str
    films: str
    treatment: str
    holds: bool
    evidence: str


@dataclass(frozen=True)
class Claims:
    """Everything that the paper says of its optimum, judged.

    ``lost`` counts, by treatment, the states at the end of the stroke in which hoop tension is lost; ``states`` all.
    """

    compared: list[Compared]
    verdicts: list[Verdict]
    contradictions: list[str]
    states: dict[str, int]
    lost: dict[str, int]

    def reading(self) -> list[str]:
        """A few sentences for the reader, made from the numbers."""
        lines = []
        for treatment, name in NAMES.items():
            mine = [v for v in self.verdicts if v.treatment == treatment]
            if not mine:
                continue
            parts = []
            for films in dict.fromkeys(v.films for v in mine):
                these = [v for v in mine if v.films == films]
                good = ", ".join(v.claim.split(":")[0] for v in these if v.holds) or "none"
                bad = "; ".join(f"{v.claim.split(':')[0]} ({v.evidence})" for v in these if not v.holds) or "none"
                parts.append(f"{films}, claims that hold: {good}; that fail: {bad}. ")
            peaks = [c for c in self.compared if c.treatment == treatment and c.printed.times == 1]
            off = [c.deviation for c in peaks if c.deviation is not None]
            there = [c.deviation_at_printed for c in peaks if c.deviation_at_printed is not None]
            works = [c for c in peaks if c.printed.quantity == "work"]
            edge = sum(c.edge for c in works)
            lines.append(
                f"{name[0].upper()}{name[1:]}: {''.join(parts)}Our peaks are "
                f"{min(off):+.0%} to {max(off):+.0%} off the printed ones, peak against peak"
                + (f", and {min(there):+.0%} to {max(there):+.0%} at the printed a/b" if there else "")
                + (f"; {edge} of {len(works)} peaks of the work stand at the map's edge" if edge else "")
                + f"; hoop tension is lost at the end of "
                f"{self.lost[treatment]} of {self.states[treatment]} strokes."
            )
        lines.append(
            "The field is the largest anywhere in the film; in plain states that have lost their hoop tension it "
            "stands inside the film, not at the disk. The paper does not say where it takes the field."
        )
        if any(c.treatment == HYPOTHESIS for c in self.compared):
            lines.append(self._hypothesis())
        return lines + [f"The paper against itself: {text}" for text in self.contradictions]

    def peak(self, case: str, quantity: str, treatment: str) -> Compared:
        """Our peak beside a printed one."""
        return next(
            c
            for c in self.compared
            if (c.printed.case, c.printed.quantity, c.treatment, c.printed.times) == (case, quantity, treatment, 1)
        )

    def _hypothesis(self) -> str:
        """What the fourth treatment is, and what would decide."""
        mass = self.peak("II", "stroke", HYPOTHESIS)
        plain = [c for c in self.compared if c.treatment == Treatment.PLAIN.value and c.printed == mass.printed]
        beside = f" against {plain[0].value:.3f} at {plain[0].radius_ratio:.2f} in the plain equations" if plain else ""
        return (
            "As perhaps computed: the field is read at the disk's edge and eq. (4) is coded with R in place of r. The "
            "paper may have computed it so: that is a hypothesis, not physics. It is the nearest of some 190 readings; "
            "two strokes within 1 % out of so many are no proof. The paper's figure 8(i) would decide: the largest d* "
            f"of case II is {mass.value:.3f} at a/b {mass.radius_ratio:.2f}{beside}."
        )


def value(row: Row, quantity: str) -> float:
    """d* or the work (J) of a row."""
    return row.normalized_stroke if quantity == "stroke" else row.work


def best(rows: Sequence[Row], quantity: str) -> Row:
    """The row with the largest value; rows without one do not count."""
    return max(rows, key=lambda row: -math.inf if math.isnan(value(row, quantity)) else value(row, quantity))


def judge(rows: Sequence[Row]) -> Claims:
    """Compare a map, in whatever treatments and pre-stretches it has, with what the paper prints."""
    treatments = [t for t in NAMES if any(row.treatment == t for row in rows)]
    compared: list[Compared] = []
    verdicts: list[Verdict] = []
    for treatment in treatments:
        mine = [row for row in rows if row.treatment == treatment]
        compared += [_compare(mine, printed, treatment) for printed in PRINTED]
        verdicts += _verdicts(mine, treatment)
    return Claims(
        compared=compared,
        verdicts=verdicts,
        contradictions=_contradictions(),
        states={t: sum(row.treatment == t for row in rows) for t in treatments},
        lost={t: sum(row.treatment == t and row.status == "WRINKLED" for row in rows) for t in treatments},
    )


def _compare(rows: Sequence[Row], printed: Printed, treatment: str) -> Compared:
    case = [row for row in rows if row.case == printed.case]
    flat = [row for row in case if row.prestretch == 1.0]
    top = best(flat, printed.quantity)
    there = None
    for row in flat:
        if printed.radius_ratio is not None and abs(row.radius_ratio - printed.radius_ratio) < 1e-9:
            there = printed.times * value(row, printed.quantity)
    return Compared(
        printed=printed,
        treatment=treatment,
        value=printed.times * value(top, printed.quantity),
        radius_ratio=top.radius_ratio,
        at_printed=there,
        prestretch=best(case, printed.quantity).prestretch,
        edge=top.radius_ratio in (min(r.radius_ratio for r in flat), max(r.radius_ratio for r in flat)),
    )


def _verdicts(rows: Sequence[Row], treatment: str) -> list[Verdict]:
    by_case = {case: [row for row in rows if row.case == case] for case in CASES}
    verdicts = []

    def judged(claim: str, holds: bool, evidence: str, films: str = FLAT) -> None:
        verdicts.append(Verdict(claim, films, treatment, holds, evidence))

    def tops(of: dict[str, list[Row]], quantity: str, show: Callable[[Row], str]) -> str:
        return ", ".join(f"{case} {show(best(mine, quantity))}" for case, mine in of.items())

    several = len({row.prestretch for row in rows}) > 1
    if several:
        at = {q: [best(mine, q).prestretch for mine in by_case.values()] for q in ("stroke", "work")}
        judged(
            "a: stroke and work are largest without pre-stretch",
            all(lp == 1.0 for values in at.values() for lp in values),
            f"largest stroke at pre-stretch {tops(by_case, 'stroke', lambda row: f'{row.prestretch:g}')}; "
            f"largest work at {tops(by_case, 'work', lambda row: f'{row.prestretch:g}')}",
            EVERY,
        )
    flat = {case: [row for row in mine if row.prestretch == 1.0] for case, mine in by_case.items()}
    strokes = [best(mine, "stroke").radius_ratio for mine in flat.values()]
    works = [best(mine, "work").radius_ratio for mine in flat.values()]
    where = (
        f"stroke peaks at a/b {', '.join(f'{c} {x:.2g}' for c, x in zip(CASES, strokes, strict=True))}; "
        f"work at {', '.join(f'{c} {x:.2g}' for c, x in zip(CASES, works, strict=True))}"
    )
    judged(
        "b (order): stroke peaks at a lower a/b than work",
        all(s < w for s, w in zip(strokes, works, strict=True)),
        where,
    )
    judged(
        f"b (bound): every optimal a/b is less than {BOUND_CLAIMED:g}",
        all(x < BOUND_CLAIMED - 1e-9 for x in (*strokes, *works)),
        where,
    )
    lowest = min(CASES, key=lambda case: best(flat[case], "stroke").stroke)
    judged(
        "e: without pre-stretch case I has the lowest stroke",
        lowest == "I",
        "largest d* without pre-stretch "
        + ", ".join(f"{case} {best(mine, 'stroke').normalized_stroke:.3f}" for case, mine in flat.items()),
    )
    falls, straight = _straight([(row.radius_ratio, row.normalized_stroke) for row in flat["III"]])
    judged(
        "f: the stroke of case III falls about linearly with a/b",
        falls and straight > LINEAR,
        f"R^2 of a straight line {straight:.3f}" + ("" if falls else "; it does not fall all the way"),
    )
    for films, of in ((FLAT, flat), (EVERY, by_case)) if several else ((FLAT, flat),):
        longest = max(CASES, key=lambda case: value(best(of[case], "stroke"), "stroke"))
        strongest = max(CASES, key=lambda case: best(of[case], "work").work)
        judged(
            "c (stroke): the double cone has the largest stroke",
            longest == "III",
            f"largest d* {tops(of, 'stroke', lambda row: f'{row.normalized_stroke:.3f}')}",
            films,
        )
        judged(
            "c (work): the mass has the largest work",
            strongest == "II",
            f"largest work {tops(of, 'work', lambda row: f'{1e3 * row.work:.3f}')} mJ",
            films,
        )
        some = [row for mine in of.values() for row in mine]
        judged(
            "d: no film fails by stretch",
            not any(row.limit == "STRETCH" for row in some),
            f"largest stretch {max(row.max_stretch for row in some):.2f}",
            films,
        )
    return verdicts


LINEAR = 0.98  # R^2 of a straight line that is "approximately linear"


def _straight(points: Sequence[tuple[float, float]]) -> tuple[bool, float]:
    """Whether values fall all the way, and R^2 of a straight line through them."""
    found = sorted(point for point in points if not math.isnan(point[1]))
    x, y = [p[0] for p in found], [p[1] for p in found]
    falls = all(later < earlier for earlier, later in pairwise(y))
    return falls, correlation(x, y) ** 2 if len(found) > 2 else math.nan


def _contradictions() -> list[str]:
    """Statements of the paper that its own printed numbers do not bear out."""
    beyond = [p for p in PRINTED if p.radius_ratio is not None and p.radius_ratio >= BOUND_CLAIMED]
    return [
        f"claim b has every optimal a/b below {BOUND_CLAIMED:g}, but section 5 prints the {p.quantity} of "
        f"case {p.case} with its peak at a/b = {p.radius_ratio:g}."
        for p in beyond
    ]
