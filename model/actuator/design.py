"""Design maps: strokes and work of many actuators, in three treatments of lost tension, on any executor.

The three treatments answer the question what a stroke is where the paper's equations lose hoop tension: *plain* goes on
with them, *tension* ends the stroke there, *tension_field* goes on with folds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from enum import Enum
from itertools import groupby
from time import process_time  # what work costs; when things happen is the clock's business

import numpy as np

from model.actuator.bias import Antagonist, Bias
from model.actuator.energy import work_by_energy
from model.actuator.equilibrium import Actuator
from model.actuator.stroke import Criteria, Limit, strokes
from model.membrane.solve import Status, Wrinkling
from model.specimen import Specimen

BLOCK = 36  # actuators solved together: one task of an executor
Progress = Callable[[int, int], None]


class Treatment(Enum):
    """What is done where the hoop stress would fall below zero."""

    PLAIN = "plain"
    TENSION = "tension"
    TENSION_FIELD = "tension_field"

    @property
    def wrinkling(self) -> Wrinkling:
        """The equations of the way to the end."""
        return "tension_field" if self is Treatment.TENSION_FIELD else "plain"

    @property
    def at_work(self) -> Wrinkling:
        """The equations of the work. A film held back at rest may fold where the free one does not."""
        return "plain" if self is Treatment.PLAIN else "tension_field"


@dataclass(frozen=True)
class SameFilm:
    """An antagonist of the same film as the driven one: a double cone.

    Parameters
    ----------
    spacer : L (m)
    voltage : of the antagonist (V)
    """

    spacer: float
    voltage: float = 0.0


Recipe = Bias | SameFilm


@dataclass(frozen=True)
class Point:
    """One actuator of a map.

    Parameters
    ----------
    case : its name
    film, recipe : the driven film, and its bias
    treatment : of lost tension
    criteria : limits; tension is a limit in the treatment of that name, whatever they say
    """

    case: str
    film: Specimen
    recipe: Recipe
    treatment: Treatment
    criteria: Criteria

    @property
    def actuator(self) -> Actuator:
        kind = self.treatment.wrinkling
        bias = self.recipe
        if isinstance(bias, SameFilm):
            bias = Antagonist(self.film, bias.spacer, bias.voltage, kind)
        return Actuator(self.film, bias, kind)


@dataclass(frozen=True)
class Row:
    """What became of one point; SI units, NaN without a rest.

    ``stroke``, ``work`` and the rest are those of `model.actuator.stroke.Strokes`; ``work_by_energy`` is the same work
    from the film's energies instead of its forces.
    """

    case: str
    treatment: str
    radius_ratio: float
    disk_radius: float
    ring_radius: float
    thickness: float
    prestretch: float
    rest: float
    stroke: float
    stroke_error: float
    work: float
    work_error: float
    work_by_energy: float
    blocked_force: float
    voltage: float
    peak_field: float
    min_hoop_stress: float
    max_stretch: float
    snaps: int
    limit: str
    status: str
    status_at_work: str

    @property
    def normalized_stroke(self) -> float:
        """Stroke over ring radius, the paper's d*."""
        return self.stroke / self.ring_radius


@dataclass(frozen=True)
class Swept:
    """Rows of a sweep in the order of its points, and the processor time of all who solved them (s)."""

    rows: list[Row]
    seconds: float


def points(
    films: Sequence[Specimen], recipes: dict[str, Recipe], treatments: Sequence[Treatment], criteria: Criteria
) -> list[Point]:
    """Every film with every bias in every treatment."""
    return [
        Point(case, film, recipe, t, criteria) for case, recipe in recipes.items() for t in treatments for film in films
    ]


def sweep(
    wanted: Sequence[Point],
    *,
    executor: Executor | None = None,
    tolerance: float = 1e-8,
    progress: Progress = lambda done, total: None,
) -> Swept:
    """Solve the points, in blocks, here or on any `concurrent.futures.Executor`; rows in the order of the points.

    The blocks are the same wherever they are solved, and so are the numbers.
    """
    blocks = list(_blocks(wanted))
    tolerances = [tolerance] * len(blocks)
    found = map(solve_block, blocks, tolerances) if executor is None else executor.map(solve_block, blocks, tolerances)
    rows: list[Row] = []
    seconds = 0.0
    for block, spent in found:
        rows += block
        seconds += spent
        progress(len(rows), len(wanted))
    return Swept(rows, seconds)


def _blocks(wanted: Sequence[Point]) -> Iterator[list[Point]]:
    for _, group in groupby(wanted, lambda point: (point.treatment, point.criteria)):
        some = list(group)
        for first in range(0, len(some), BLOCK):
            yield some[first : first + BLOCK]


def solve_block(block: Sequence[Point], tolerance: float = 1e-8) -> tuple[list[Row], float]:
    """Rows of points that share treatment and criteria, and the processor time they took (s)."""
    begun = process_time()
    treatment, criteria = block[0].treatment, block[0].criteria
    if treatment is Treatment.TENSION:
        criteria = replace(criteria, tension=True)
    actuators = [point.actuator for point in block]
    found = strokes(actuators, criteria, tolerance=tolerance, folds_at_work=treatment.at_work)
    rows = []
    for i, (point, actuator) in enumerate(zip(block, actuators, strict=True)):
        film = point.film
        rest, reached, voltage = float(found.rest[i]), float(found.reached[i]), float(found.voltage[i])
        energy = work_by_energy(actuator, rest, reached, voltage, treatment.at_work) if reached > rest else np.nan
        rows.append(
            Row(
                case=point.case,
                treatment=treatment.value,
                radius_ratio=film.disk_radius / film.ring_radius,
                disk_radius=film.disk_radius,
                ring_radius=film.ring_radius,
                thickness=film.thickness,
                prestretch=film.prestretch,
                rest=rest,
                stroke=float(found.stroke[i]),
                stroke_error=float(found.error_estimate[i]),
                work=float(found.work[i]),
                work_error=float(found.work_error[i]),
                work_by_energy=energy,
                blocked_force=float(found.blocked_force[i]),
                voltage=voltage,
                peak_field=float(found.peak_field[i]),
                min_hoop_stress=float(found.min_hoop_stress[i]),
                max_stretch=float(found.max_stretch[i]),
                snaps=int(found.snaps[i]),
                limit=Limit(int(found.limit[i])).name,
                status=Status(int(found.status[i])).name,
                status_at_work=Status(int(found.way[i])).name,
            )
        )
    return rows, process_time() - begun
