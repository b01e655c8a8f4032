"""How well a film that was identified from some of the curves predicts the others."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from calibration.film.curve import Curve
from calibration.film.problem import IdentificationError, Problem
from calibration.film.reduction import select
from calibration.film.result import HeldOut
from calibration.film.search import minimise_many
from model.material.materials import Material
from model.membrane.solve import Wrinkling


def held_out(curves: Sequence[Curve], material: Material, wrinkling: Wrinkling = "plain") -> list[HeldOut]:
    """Leave out each run in turn, or each voltage where there is one run only, and predict it from the rest.

    ``material`` is what all curves together say: starting point and number of terms. Parts that the rest cannot
    predict (the only ones with a voltage) are passed over.
    """
    runs = list(dict.fromkeys(curve.run for curve in curves))
    voltages = list(dict.fromkeys(curve.nominal_voltage for curve in curves))
    if len(runs) > 1:
        parts = [(run, [curve for curve in curves if curve.run == run]) for run in runs]
    elif len(voltages) > 1:
        parts = [(f"{v:g} V", [curve for curve in curves if curve.nominal_voltage == v]) for v in voltages]
    else:
        return []
    found = []
    for what, part in parts:
        rest = [curve for curve in curves if not any(curve is one for one in part)]
        charged = any(curve.nominal_voltage != 0.0 for curve in part)
        if charged and not any(curve.nominal_voltage != 0.0 for curve in rest):
            continue
        try:
            one = _predicted(what, rest, part, material, wrinkling)
        except IdentificationError:
            continue
        found.append(one)
    return found


def _predicted(
    what: str, rest: Sequence[Curve], part: Sequence[Curve], material: Material, wrinkling: Wrinkling
) -> HeldOut:
    film = _fitted(rest, material, wrinkling, only_nuisances=False)[1]
    problem, _, x = _fitted(part, film, wrinkling, only_nuisances=True)
    states = problem.states(x)
    squares = np.zeros(2)
    count = 0
    for row in range(len(problem.active)):
        residual, sigma, _ = problem.samples(row, x, states)
        squares += (float(residual @ residual), float(sigma @ sigma))
        count += residual.size
    return HeldOut(what, math.sqrt(squares[0] / count), math.sqrt(squares[1] / count))


def _fitted(
    curves: Sequence[Curve], near: Material, wrinkling: Wrinkling, *, only_nuisances: bool
) -> tuple[Problem, Material, np.ndarray]:
    problem = Problem(curves, select(curves, near, wrinkling), near.terms, near, wrinkling=wrinkling)
    start = problem.vector(near)
    free = np.ones(start.size, dtype=np.bool_)
    free[: problem.film_parameters] = not only_nuisances
    low, high = problem.bounds(start)
    start = np.where(free, np.clip(start, low, high), start)
    if not free.any():
        return problem, near, start
    (found,) = minimise_many(problem, start[None], (low[None], high[None]), free)
    if found is None:
        raise IdentificationError("the membrane has no state for curves that were left out")
    return problem, problem.film(found.x), found.x
