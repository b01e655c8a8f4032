"""The same strokes by the paper's method: shooting with a stiff integrator (BDF) on its equations (1)-(4).

It judges the study's numbers from outside, and its time is what a study costs by that method. It knows no answer
beforehand, but is not made slower than it need be: both unknowns are searched at once, each shot begins from the last
one's unknowns at the disk, and only the stroke to breakdown is sought.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import process_time  # what work costs; when things happen is the clock's business

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from model.actuator.bias import Antagonist
from model.actuator.design import Point, Row, Treatment
from model.specimen import Specimen
from model.verification.baselines import paper_shooting

Array = NDArray[np.float64]
TOLERANCE = 1e-6
NODES = 8  # Gauss-Legendre nodes of the work
SAMPLE = 6  # actuators


class ShootingFailed(Exception):
    """The shooting method has no answer where one is needed."""


@dataclass(frozen=True)
class Shot:
    """One actuator's rest, stroke (m) and work (J) by shooting; NaN and a message where the method fails."""

    row: Row
    stroke: float
    work: float
    solves: int
    seconds: float
    message: str = ""


class _Shooter:
    """Force and peak field by shooting, each shot from the last."""

    def __init__(self) -> None:
        self.solves = 0
        self.start: dict[Specimen, tuple[float, ...]] = {}

    def __call__(self, film: Specimen, h: float, voltage: float) -> tuple[float, float]:
        self.solves += 1
        start = self.start.get(film)
        found = paper_shooting(film, h, voltage, TOLERANCE, start=start)
        if not found.ok and start is not None:
            found = paper_shooting(film, h, voltage, TOLERANCE)
        if not found.ok:
            raise ShootingFailed(found.message)
        if found.start is not None:
            self.start[film] = found.start
        return found.force, found.peak_field


def shoot(point: Point, row: Row) -> Shot:
    """Rest, breakdown-limited stroke and work of a plain point by shooting; ``row`` is ours, for the table."""
    from scipy.optimize import brentq

    bias = point.actuator.bias
    film, field = point.film, point.criteria.field
    if point.treatment is not Treatment.PLAIN or field is None:
        raise ValueError("the paper's method solves the plain equations, to breakdown")
    shooter, second, begun = _Shooter(), _Shooter(), process_time()
    highest = 0.99 * min(point.actuator.bias.reach[1], film.ring_radius)

    def push(h: float) -> float:
        if isinstance(bias, Antagonist):
            return second(bias.film, bias.spacer - h, bias.voltage)[0]
        return float(bias.force(np.array(h)))

    def miss(h: float, voltage: float) -> Array:
        force, peak = shooter(film, h, voltage)
        return np.array([force / push(h) - 1.0, peak / field - 1.0])

    stroke, work, message = np.nan, np.nan, ""
    try:
        rest = brentq(
            lambda h: shooter(film, h, 0.0)[0] - push(h), 0.3 * film.ring_radius, highest, xtol=1e-2 * TOLERANCE
        )
        reached, voltage = _broyden(miss, rest + 0.05 * film.ring_radius, 0.6 * field * film.thickness)
        stroke = reached - rest
        x, weight = np.polynomial.legendre.leggauss(NODES)
        nodes = rest + stroke * 0.5 * (1.0 + x)
        work = (
            0.5 * stroke * sum(w * (push(h) - shooter(film, h, voltage)[0]) for h, w in zip(nodes, weight, strict=True))
        )
    except (ShootingFailed, ValueError) as problem:
        message = str(problem)
    return Shot(row, float(stroke), float(work), shooter.solves + second.solves, process_time() - begun, message)


def _broyden(miss: Callable[[float, float], Array], h: float, voltage: float) -> tuple[float, float]:
    """Both unknowns at once: a Jacobian by differences, then Broyden's updates."""
    x, scale = np.ones(2), np.array([h, voltage])
    value = miss(*(x * scale))
    steps = 1e-3 * np.eye(2)
    jacobian = np.stack([(miss(*((x + step) * scale)) - value) / 1e-3 for step in steps], axis=1)
    for _ in range(20):
        step = -np.linalg.solve(jacobian, value)
        x = x + step
        new = miss(*(x * scale))
        if float(np.max(np.abs(step))) < TOLERANCE:
            return float(x[0] * h), float(x[1] * voltage)
        jacobian += np.outer(new - value - jacobian @ step, step) / float(step @ step)
        value = new
    raise ShootingFailed("no state at breakdown within 20 steps")


def sample(points: Sequence[Point], limits: Sequence[str], count: int = SAMPLE) -> list[int]:
    """Which points to shoot: plain ones whose stroke ends in breakdown, spread over the map.

    ``limits`` tells of each point what ends its stroke.
    """
    plain = [
        i
        for i, (point, limit) in enumerate(zip(points, limits, strict=True))
        if point.treatment is Treatment.PLAIN and limit == "BREAKDOWN"
    ]
    if not plain:
        return []
    return [plain[i] for i in np.unique(np.linspace(0, len(plain) - 1, count).astype(int))]


def compare(
    chosen: Sequence[tuple[Point, Row]], progress: Callable[[int, int], None] = lambda done, total: None
) -> list[Shot]:
    """Shoot the chosen points, one after the other."""
    shots: list[Shot] = []
    for point, row in chosen:
        progress(len(shots), len(chosen))
        shots.append(shoot(point, row))
    return shots


def comparison_table(shots: Sequence[Shot], actuators: int, seconds: float) -> Table:
    """Ours beside the paper's method, and how many times faster so many actuators were here, in ``seconds``."""
    each = float(np.mean([shot.seconds for shot in shots]))
    whole = each * actuators
    table = Table(
        title="A sample by the paper's method: shooting, BDF, eqs. (1)-(4)",
        caption=(
            f"Processor time: {actuators} actuators here {seconds:.1f} s; by the paper's method one "
            f"{each:.1f} s, as many {whole:.0f} s: {whole / seconds:.0f} times as long."
        ),
    )
    for heading in ("case", "a/b", "λp", "film at the end", "d*", "shooting", "work / mJ", "shooting", "shots", "s"):
        table.add_column(heading, justify="left" if heading in ("case", "film at the end") else "right")
    for shot in shots:
        row = shot.row
        table.add_row(
            row.case,
            f"{row.radius_ratio:.2f}",
            f"{row.prestretch:g}",
            row.status.lower(),
            f"{row.normalized_stroke:.6f}",
            "fails" if shot.message else f"{shot.stroke / row.ring_radius:.6f}",
            f"{1e3 * row.work:.6f}",
            "" if shot.message else f"{1e3 * shot.work:.6f}",
            f"{shot.solves}",
            f"{shot.seconds:.1f}",
        )
    return table
