"""Random states around loss of convexity: one status whatever the tolerance, the order and the company.

``python -m model.verification.search --states 20000`` runs it with progress. A state is asked for at three tolerances,
in a batch, in the batch turned round, alone, and near the answer at a lower voltage; statuses must agree, and forces
within the sum of their stated errors. Some are followed by `model.verification.continuation`, which shares nothing
with the solver.
"""

from __future__ import annotations

import argparse
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
BLOCK = 50
# A continuation that ends, or a law that falls, within this share of the voltage may be judged either way.
EDGE = 4e-3


@dataclass
class States:
    """Films with a displacement (m) and a voltage (V) each."""

    films: list[Specimen]
    h: Array
    voltage: Array


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


@dataclass
class Report:
    """What disagreed, in sentences; and counts."""

    states: int = 0
    answered: int = 0
    unstable: int = 0
    not_converged: int = 0
    followed: int = 0
    statuses: list[str] = field(default_factory=list)
    forces: list[str] = field(default_factory=list)
    truth: list[str] = field(default_factory=list)


def compare(states: States, report: Report, *, wrinkling: Wrinkling = "tension_field", truth: int = 0) -> None:
    """Add the comparison of ``states`` to the ``report``; the first ``truth`` of them are followed from rest."""
    films, h, v = states.films, states.h, states.voltage
    found = [solve_many(films, h, v, tolerance=t, wrinkling=wrinkling) for t in TOLERANCES]
    middle = found[1]
    turned = solve_many(films[::-1], h[::-1], v[::-1], tolerance=TOLERANCES[1], wrinkling=wrinkling)
    report.states += len(films)
    report.answered += int(middle.answered.sum())
    report.unstable += int((middle.status == Status.UNSTABLE).sum())
    report.not_converged += sum(int((one.status == Status.NOT_CONVERGED).sum()) for one in found)
    for one, name in ((found[0], "1e-4"), (found[2], "1e-8")):
        _judge(report, states, middle, one.status, one.force, one.error_estimate, name)
    _judge(report, states, middle, turned.status[::-1], turned.force[::-1], 1e-12 + 0.0 * v, "in another order", 1e-12)
    alone = [
        solve(film, height, volts, tolerance=TOLERANCES[1], wrinkling=wrinkling)
        for film, height, volts in zip(films, h.tolist(), v.tolist(), strict=True)
    ]
    _judge(
        report,
        states,
        middle,
        np.array([one.status for one in alone]),
        np.array([one.force for one in alone]),
        np.array([one.error_estimate for one in alone]),
        "alone",
    )
    for i in range(min(truth, len(films))):
        report.followed += 1
        _follow(report, states, middle, i, wrinkling)


def _name(states: States, i: int) -> str:
    return f"{states.films[i]!r}, h = {states.h[i]!r}, V = {states.voltage[i]!r}"


def _judge(
    report: Report,
    states: States,
    middle: Solutions,
    status: NDArray[np.int_] | NDArray[np.int8],
    force: Array,
    error: Array,
    name: str,
    allowed: float | None = None,
) -> None:
    for i in np.flatnonzero(status != middle.status).tolist():
        text = f"{Status(int(middle.status[i])).name} at 1e-6, {Status(int(status[i])).name} {name}"
        report.statuses.append(f"{text}: {_name(states, i)}")
    both = (status <= Status.WRINKLED) & middle.answered
    off = np.abs(force / middle.force - 1.0)
    bound = middle.error_estimate + error if allowed is None else np.full(len(off), allowed)
    for i in np.flatnonzero(both & (off > bound)).tolist():
        report.forces.append(f"{off[i]:.2g} apart, {bound[i]:.2g} stated, {name}: {_name(states, i)}")


def _follow(report: Report, states: States, found: Solutions, i: int, wrinkling: Wrinkling) -> None:
    film, h, v = states.films[i], float(states.h[i]), float(states.voltage[i])
    status = Status(int(found.status[i]))
    end = follow(film, h, v, wrinkling=wrinkling)
    if status <= Status.WRINKLED:
        if end.reached:
            off, bound = abs(end.force / found.force[i] - 1.0), 5.0 * end.error + found.error_estimate[i] + 1e-6
            if off > bound:
                report.truth.append(f"{off:.2g} from elements ({bound:.2g} allowed): {_name(states, i)}")
        elif end.voltage < (1.0 - EDGE) * v:
            report.truth.append(f"{status.name}, elements end at {end.voltage:.6g} V: {_name(states, i)}")
    elif status is not Status.SLACK and end.reached:
        on = follow(film, h, (1.0 + EDGE) * v, wrinkling=wrinkling)
        if on.reached:
            report.truth.append(f"{status.name}, elements reach it: {_name(states, i)}")


def run(count: int, seed: int, truth: int, told: Callable[[Report], None] | None = None) -> Report:
    """Search ``count`` states, of which ``truth`` are followed from rest."""
    report = Report()
    for number, size in enumerate(_sizes(count)):
        share = min(truth - report.followed, -(-truth * size // count))
        compare(draw(size, seed + number), report, truth=max(0, share))
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
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--truth", type=int, default=500, help="states that are followed by finite elements")
    asked = parser.parse_args()

    def told(report: Report) -> None:
        wrong = f"{len(report.statuses)} statuses, {len(report.forces)} forces, {len(report.truth)} against elements"
        sys.stderr.write(f"\r{report.states} of {asked.states} states, {report.followed} followed; differ: {wrong} ")
        sys.stderr.flush()

    report = run(asked.states, asked.seed, asked.truth, told)
    sys.stderr.write("\n")
    sys.stdout.write(
        f"{report.states} states: {report.answered} answered, {report.unstable} unstable, "
        f"{report.not_converged} not converged at some tolerance\n"
    )
    for line in (*report.statuses, *report.forces, *report.truth):
        sys.stdout.write(line + "\n")
    return 1 if report.statuses or report.forces or report.truth else 0


if __name__ == "__main__":
    sys.exit(main())
