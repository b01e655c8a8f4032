"""Random films and voltages, and how an answer compares with the reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.material.materials import Material
from model.membrane.solve import Solutions, Status, Wrinkling, solve_many
from model.specimen import Specimen
from model.verification.reference import Reference, reference

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cases:
    films: list[Specimen]
    h: Array
    voltage: Array


def random_cases(count: int, seed: int) -> Cases:
    """a/b 0.02-0.7, h/b 0.01-1.5, lp 1-2, one to three Ogden terms with negative pairs, V to 1.2 x loss of tension."""
    rng = np.random.default_rng(seed)
    films, h = [], []
    for _ in range(count):
        mu, alpha = [], []
        for _ in range(rng.integers(1, 4)):
            if rng.random() < 0.25:
                alpha.append(-rng.uniform(1.0, 4.0))
                mu.append(-(10 ** rng.uniform(2, 4)))
            else:
                alpha.append(rng.uniform(1.2, 8.0))
                mu.append(10 ** rng.uniform(3, 5))
        material = Material("random", tuple(mu), tuple(alpha), rng.uniform(1.5, 8.0))
        ratio = np.exp(rng.uniform(np.log(0.02), np.log(0.7)))
        films.append(Specimen(0.02 * ratio, 0.02, 10 ** rng.uniform(-5, -4), rng.uniform(1.0, 2.0), material))
        h.append(0.02 * 10 ** rng.uniform(-2, np.log10(1.5)))
    height = np.array(h)
    low, high = np.zeros(count), np.array([200e6 * film.thickness for film in films])
    for _ in range(14):
        middle = 0.5 * (low + high)
        taut = solve_many(films, height, middle, tolerance=1e-4).status == Status.TAUT
        low, high = np.where(taut, middle, low), np.where(taut, high, middle)
    return Cases(films, height, low * rng.uniform(0.0, 1.2, count))


@dataclass(frozen=True)
class Comparison:
    """Errors where both have an answer."""

    found: Solutions
    truth: Reference
    both: NDArray[np.bool_]
    error: Array
    estimate: Array


def compare(cases: Cases, truth: Reference, tolerance: float, wrinkling: Wrinkling) -> Comparison:
    found = solve_many(cases.films, cases.h, cases.voltage, tolerance=tolerance, wrinkling=wrinkling)
    both = found.answered & truth.converged
    error = np.abs(found.force / truth.force - 1.0)[both]
    return Comparison(found, truth, both, error, found.error_estimate[both])


def assert_honest(cases: Cases, tolerances: tuple[float, ...], wrinkling: Wrinkling) -> None:
    """True error below three estimates and below the tolerance in 99 % of the answers, and hardly an answer missed."""
    truth = reference(cases.films, cases.h, cases.voltage, wrinkling=wrinkling)
    count = len(cases.films)
    for tolerance in tolerances:
        c = compare(cases, truth, tolerance, wrinkling)
        few = max(1.0, 0.01 * c.error.size)
        assert np.sum(~(c.error <= 3.0 * c.estimate)) <= few
        assert np.sum(~(c.error <= tolerance)) <= few
        assert np.all(c.error <= 10.0 * c.estimate)
        assert np.all(c.estimate <= tolerance)
        # Slack states have a solution of the plain equations, with no tension to hold it: it is not an answer.
        missed = truth.converged & ~c.found.answered & (c.found.status != Status.SLACK)
        assert missed.mean() <= 0.01
        assert np.array_equal(np.isnan(c.found.force), ~c.found.answered)
        assert c.both.sum() > 0.75 * count
