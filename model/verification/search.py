"""Random states around loss of convexity: one status and one force, however a state is asked for.

``python -m model.verification.search --states 20000`` runs it with progress and prints every difference as a call that
repeats it. A state is asked for at three tolerances, in a batch and in the batch turned round; a share of them also
alone, with derivatives, and in short sweeps of the voltage and of the displacement through it. Statuses must agree,
forces within the sum of their stated errors; along a sweep of the voltage an answer must not come back once it has
ended, and the force of a state must be the one that its neighbours lead to. Some are followed by
`model.verification.continuation`, which shares nothing with the solver.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from model.material.gent import Gent
from model.material.materials import Material
from model.membrane.solve import Solutions, Status, Wrinkling, solve, solve_many
from model.specimen import Specimen
from model.stability.limits import slack_voltage
from model.verification.continuation import follow

Array = NDArray[np.float64]

TOLERANCES = (1e-4, 1e-6, 1e-8)
MIDDLE = TOLERANCES[1]
BLOCK = 400  # states solved together: fewer cost more each
ALONE = 10  # one state of so many is asked for alone, and with derivatives
SWEPT = 4  # one state of so many stands in a sweep
STEP = 1e-3  # of the voltage and of the displacement
PLACES = (-2, -1, 0, 1, 2)  # steps of a sweep
BEYOND = 0.25  # of the curve of a sweep: a force may be so far off what its neighbours lead to, where a fold begins too
COMPANY = 1e-12  # relative: what the order in which a processor adds may change
# A continuation that ends, or a law that falls, within this share of the voltage may be judged either way.
EDGE = 4e-3


@dataclass
class States:
    """Films with a displacement (m) and a voltage (V) each."""

    films: list[Specimen]
    h: Array
    voltage: Array

    def turned(self) -> States:
        """The same states from the last to the first."""
        return States(self.films[::-1], self.h[::-1], self.voltage[::-1])

    def every(self, step: int) -> States:
        """One of so many."""
        return States(self.films[::step], self.h[::step], self.voltage[::step])

    def solve(self, tolerance: float, wrinkling: Wrinkling, sensitivities: bool = False) -> Solutions:
        return solve_many(
            self.films, self.h, self.voltage, tolerance=tolerance, wrinkling=wrinkling, sensitivities=sensitivities
        )


def draw(count: int, seed: int) -> States:
    """Films of one to four Ogden terms or of Gent's law, some with a negative pair, at 0.6 to 1.02 of slack voltage.

    Stiffening ones are preferred: their relaxed law loses convexity.
    """
    rng = np.random.default_rng(seed)
    films: list[Specimen] = []
    h: list[float] = []
    voltage: list[float] = []
    while len(films) < count:
        material = _material(rng)
        ratio = float(np.exp(rng.uniform(np.log(0.05), np.log(0.6))))
        film = Specimen(0.02 * ratio, 0.02, 10 ** rng.uniform(-5, -4), rng.uniform(1.0, 2.5), material)
        height = 0.02 * (1.0 - ratio) * 10 ** rng.uniform(-1, np.log10(1.5))
        slack = float(slack_voltage(film, np.array(height)))
        if not 0.0 < slack < 1e6:
            continue
        films.append(film)
        h.append(height)
        voltage.append(slack * rng.uniform(0.6, 1.02))
    return States(films, np.array(h), np.array(voltage))


def _material(rng: np.random.Generator) -> Material:
    if rng.random() < 0.15:
        return Material("gent", (10 ** rng.uniform(4, 5),), (rng.uniform(8.0, 120.0),), 3.0, law=Gent)
    terms = int(rng.integers(1, 5))
    alpha = [float(rng.uniform(1.2, 4.0))]
    mu = [10 ** rng.uniform(4, 5)]
    for _ in range(terms - 1):
        if rng.random() < 0.25:
            alpha.append(-float(rng.uniform(1.0, 4.0)))
            mu.append(-mu[0] * 10 ** rng.uniform(-2, -0.5))
        else:  # a little of a high power stiffens it
            alpha.append(float(rng.uniform(5.0, 16.0)))
            mu.append(mu[0] * 10 ** rng.uniform(-5, -1))
    return Material("random", tuple(mu), tuple(alpha), 3.0)


@dataclass(frozen=True)
class Difference:
    """An answer at `MIDDLE` and another one that does not agree with it.

    way : how the other one was asked for
    status, other : of the two
    off, allowed : relative difference of the forces and what was stated; NaN where statuses differ
    """

    film: Specimen
    h: float
    voltage: float
    wrinkling: Wrinkling
    way: str
    status: Status
    other: Status
    off: float = math.nan
    allowed: float = math.nan

    def __str__(self) -> str:
        m = self.film.material
        law = "" if m.law is not Gent else ", law=Gent"
        material = f'Material("{m.name}", {m.mu!r}, {m.alpha!r}, {m.eps_r!r}{law})'
        size = (
            f"{self.film.disk_radius!r}, {self.film.ring_radius!r}, {self.film.thickness!r}, {self.film.prestretch!r}"
        )
        call = f"solve(Specimen({size}, {material}), {self.h!r}, {self.voltage!r}"
        call += f', tolerance={MIDDLE!r}, wrinkling="{self.wrinkling}")'
        if math.isnan(self.off):
            return f"{self.status.name}; {self.way}: {self.other.name}\n  {call}"
        return f"{self.status.name}; {self.way}: {self.off:.2g} off, {self.allowed:.2g} stated\n  {call}"


@dataclass
class Report:
    """What disagreed, and counts."""

    states: int = 0
    answered: int = 0
    unstable: int = 0
    followed: int = 0
    differences: list[Difference] = field(default_factory=list)


def compare(states: States, report: Report, *, wrinkling: Wrinkling = "tension_field", truth: int = 0) -> None:
    """Add the comparison of ``states`` to the ``report``; the first ``truth`` of them are followed from rest."""
    middle = states.solve(MIDDLE, wrinkling)
    report.states += len(states.films)
    report.answered += int(middle.answered.sum())
    report.unstable += int((middle.status == Status.UNSTABLE).sum())
    judge = _Judge(report, states, middle, wrinkling)
    judge.settled()
    for tolerance in (TOLERANCES[0], TOLERANCES[2]):
        judge.same(states.solve(tolerance, wrinkling), f"tolerance {tolerance:g}")
    judge.same(_turned(states.turned().solve(MIDDLE, wrinkling)), "in another order", COMPANY)
    few = _Judge(report, states.every(ALONE), _every(middle, ALONE), wrinkling)
    few.same(few.states.solve(MIDDLE, wrinkling, sensitivities=True), "with derivatives, in less company", COMPANY)
    few.alone()
    swept = _Judge(report, states.every(SWEPT), _every(middle, SWEPT), wrinkling)
    swept.sweep("voltage")
    swept.sweep("displacement")
    for i in range(min(truth, len(states.films))):
        report.followed += 1
        judge.follow(i)


def _pick(found: Solutions, index: slice) -> Solutions:
    """Some of the answers: what is compared of them."""
    names = ("force", "peak_field", "peak_field_radius", "min_hoop_stress", "min_meridional_stress", "max_stretch")
    whole = ("status", "error_estimate", "iterations", "modes", "stable", "field_exceeded", "stretch_exceeded")
    return Solutions(**{name: getattr(found, name)[index] for name in (*names, *whole)})


def _turned(found: Solutions) -> Solutions:
    return _pick(found, slice(None, None, -1))


def _every(found: Solutions, step: int) -> Solutions:
    return _pick(found, slice(None, None, step))


@dataclass
class _Judge:
    """Compares other answers with those ``found`` of ``states`` at `MIDDLE`."""

    report: Report
    states: States
    found: Solutions
    wrinkling: Wrinkling

    def _tell(self, i: int, way: str, other: int, off: float = math.nan, allowed: float = math.nan) -> None:
        s, status = self.states, Status(int(self.found.status[i]))
        state = s.films[i], float(s.h[i]), float(s.voltage[i])
        self.report.differences.append(Difference(*state, self.wrinkling, way, status, Status(other), off, allowed))

    def settled(self) -> None:
        """Every state has an answer or a reason, and every answer an estimate within what was asked for."""
        for i in np.flatnonzero(self.found.status >= Status.NOT_CONVERGED).tolist():
            self._tell(i, "in a batch", int(self.found.status[i]))
        wrong = self.found.answered & ~(self.found.error_estimate <= MIDDLE)
        for i in np.flatnonzero(wrong).tolist():
            error = float(self.found.error_estimate[i])
            self._tell(i, "error estimate", Status.TAUT, error, MIDDLE)

    def same(self, other: Solutions, way: str, allowed: float | None = None) -> None:
        """Statuses are the same, and forces within the sum of the stated errors or what is ``allowed``."""
        for i in np.flatnonzero(other.status != self.found.status).tolist():
            self._tell(i, way, int(other.status[i]))
        both = other.answered & self.found.answered
        off = np.abs(other.force / self.found.force - 1.0)
        bound = self.found.error_estimate + other.error_estimate if allowed is None else np.full(len(off), allowed)
        for i in np.flatnonzero(both & ~(off <= bound)).tolist():
            self._tell(i, way, int(other.status[i]), float(off[i]), float(bound[i]))

    def alone(self) -> None:
        """Each by the way for single states."""
        for i, (film, h, v) in enumerate(
            zip(self.states.films, self.states.h.tolist(), self.states.voltage.tolist(), strict=True)
        ):
            one = solve(film, h, v, tolerance=MIDDLE, wrinkling=self.wrinkling)
            off = abs(one.force / float(self.found.force[i]) - 1.0)
            bound = one.error_estimate + float(self.found.error_estimate[i])
            if one.status != self.found.status[i]:
                self._tell(i, "alone", one.status)
            elif one.answered and not off <= bound:
                self._tell(i, "alone", one.status, off, bound)

    def sweep(self, along: str) -> None:
        """The states in short sweeps of the ``voltage`` or the ``displacement``."""
        films = np.empty((len(self.states.films), 1), dtype=object)
        films[:, 0] = self.states.films
        steps = 1.0 + STEP * np.array(PLACES)
        h = self.states.h[:, None] * (steps if along == "displacement" else 1.0)
        v = self.states.voltage[:, None] * (steps if along == "voltage" else 1.0)
        found = solve_many(films, h, v, tolerance=MIDDLE, wrinkling=self.wrinkling)
        way = f"in a sweep of the {along}"
        self.same(_pick(found, np.s_[:, 2]), way, COMPANY)  # type: ignore[arg-type]
        if along == "voltage":
            # Once an answer has ended it does not come back; a film that hangs slack has no tension any more.
            rank = np.where(found.answered, 0, np.where(found.status == Status.SLACK, 2, 1))
            for i, k in np.argwhere(np.diff(rank, axis=1) < 0).tolist():
                self._tell(i, f"{way}, then", int(found.status[i, k + 1]))
        f = found.force.T
        lead, curve = (4.0 * (f[1] + f[3]) - f[0] - f[4]) / 6.0, np.abs(np.diff(f, 2, axis=0)).max(axis=0)
        error = found.error_estimate.T
        noise = error[2] + (4.0 * (error[1] + error[3]) + error[0] + error[4]) / 6.0
        off = np.abs(lead / f[2] - 1.0)
        bound = noise + BEYOND * curve / np.abs(f[2])
        for i in np.flatnonzero(found.answered.all(axis=1) & ~(off <= bound)).tolist():
            self._tell(i, f"{way}, led to", Status.TAUT, float(off[i]), float(bound[i]))

    def follow(self, i: int) -> None:
        """One state by finite elements from rest."""
        film, h, v = self.states.films[i], float(self.states.h[i]), float(self.states.voltage[i])
        status = Status(int(self.found.status[i]))
        end = follow(film, h, v, wrinkling=self.wrinkling)
        if status <= Status.WRINKLED:
            if end.reached:
                off = abs(end.force / float(self.found.force[i]) - 1.0)
                bound = 5.0 * end.error + float(self.found.error_estimate[i]) + 1e-6
                if not off <= bound:
                    self._tell(i, "finite elements", status, off, bound)
            elif end.voltage < (1.0 - EDGE) * v:
                self._tell(i, f"finite elements end at {end.voltage:.6g} V", Status.UNSTABLE)
        elif status is not Status.SLACK and end.reached:
            on = follow(film, h, (1.0 + EDGE) * v, wrinkling=self.wrinkling)
            if on.reached:
                self._tell(i, "finite elements", Status.WRINKLED if on.wrinkled else Status.TAUT)


def run(
    count: int,
    seed: int,
    truth: int,
    told: Callable[[Report], None] | None = None,
    wrinkling: Wrinkling = "tension_field",
) -> Report:
    """Search ``count`` states, of which ``truth`` are followed from rest."""
    report = Report()
    for number, size in enumerate(_sizes(count)):
        share = min(truth - report.followed, -(-truth * size // count))
        compare(draw(size, seed + number), report, wrinkling=wrinkling, truth=max(0, share))
        if told is not None:
            told(report)
    return report


def _sizes(count: int) -> Iterator[int]:
    for start in range(0, count, BLOCK):
        yield min(BLOCK, count - start)


def main() -> int:
    """Run the search from the command line; the exit code says whether all agreed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--states", type=int, default=20000)
    parser.add_argument("--seed", type=int, default=1, help=f"of the first {BLOCK} states; the next have the next one")
    parser.add_argument("--truth", type=int, default=500, help="states that are followed by finite elements")
    parser.add_argument("--wrinkling", choices=("tension_field", "plain"), default="tension_field")
    asked = parser.parse_args()
    shown = 0

    def told(report: Report) -> None:
        nonlocal shown
        sys.stdout.writelines(f"{one}\n" for one in report.differences[shown:])
        sys.stdout.flush()
        shown = len(report.differences)
        sys.stderr.write(f"\r{report.states} of {asked.states} states, {report.followed} followed, {shown} differ ")
        sys.stderr.flush()

    report = run(asked.states, asked.seed, asked.truth, told, asked.wrinkling)
    sys.stderr.write("\n")
    sys.stdout.write(
        f"{report.states} states: {report.answered} answered, {report.unstable} unstable; {report.followed} followed "
        f"by finite elements; {len(report.differences)} differ\n"
    )
    return 1 if report.differences else 0


if __name__ == "__main__":
    sys.exit(main())
