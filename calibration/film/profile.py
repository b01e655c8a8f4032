"""Profile likelihood: how far a quantity can move before the data object, all parameters free to follow.

Two Ogden terms that the data cannot tell apart make a long, bent valley in which the curvature at the minimum tells too
little. Given one exponent, though, the rest is nearly linear. So one exponent is led through its range, everything else
is fitted at each step, and the cost of a value ``q0`` of a quantity q is

    Delta(q0) = min over the steps of  Delta_step + ((q0 - q_step) / u_step)^2

with ``q_step`` and its conditional standard uncertainty ``u_step`` at the step's own minimum. The 95 % interval is
where it is below 3.84 (in units of the misfit): the union of the steps' own intervals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.film.charged import KINDS
from calibration.film.problem import Problem
from calibration.film.propagation import NUISANCES, Covariance, secant, shear_slopes
from calibration.film.result import Quantity, verdict
from calibration.film.search import Minimum, minimise_many
from calibration.film.systematic import SYSTEMATIC

Array = NDArray[np.float64]
Target = Callable[[Array], tuple[float, Array]]  # value and gradient of a quantity at x

COST_95 = 3.841  # 95 % quantile of chi-square with one degree of freedom
NORMAL_95 = 1.960  # its square root
STEP_LIMIT, ROUNDS = 15, 1
EXPONENTS = (0.2, 1.0, 2.0, 3.0, 4.0, 4.7, 5.4, 6.1, 7.0, 8.0, 10.0, 14.0, 20.0)


def intervals(
    problem: Problem,
    x: Array,
    bounds: tuple[Array, Array],
    varied: NDArray[np.bool_],
    quantities: Mapping[str, Quantity],
    aims: Mapping[str, Target],
    misfit: float,
) -> dict[str, tuple[float, float]]:
    """95 % intervals of the quantities in ``aims`` by noise and zeros alone.

    Parameters
    ----------
    x : ndarray
        Parameter vector at the minimum, with ``bounds``; ``varied`` marks the parameters that may follow.
    misfit : float
        Lack of fit over its expectation; divides the cost.
    """
    n = problem.moduli
    ends = {
        name: [quantities[name].value + side * NORMAL_95 * _random(quantities[name], misfit) for side in (-1.0, 1.0)]
        for name in aims
    }
    if not problem.law.series or n == 1 or not varied[n]:
        return {name: (low, high) for name, (low, high) in ends.items()}
    steps = _steps(problem, x, bounds, varied)
    least = min(step.cost for step in steps)
    ends = {name: [math.inf, -math.inf] for name in aims}
    for step in steps:
        room = COST_95 - (step.cost - least) / misfit
        if room <= 0.0:
            continue
        free = varied.copy()
        free[n : 2 * n] &= step.x[:n] > 100 * bounds[0][:n]  # a vanished term's exponent means nothing
        free[n] = False
        for name, target in aims.items():
            value, gradient = target(step.x)
            for side, end in ((-1.0, 0), (1.0, 1)):
                reached = value + side * _half(step, n, free, bounds, gradient * side, room * misfit)
                ends[name][end] = (min, max)[end](ends[name][end], reached)
    return {name: (low, high) for name, (low, high) in ends.items()}


def _half(
    step: Minimum, n: int, free: NDArray[np.bool_], bounds: tuple[Array, Array], gradient: Array, room: float
) -> float:
    """How far a quantity can rise before chi-square has risen by ``room``; no share leaves its bounds on the way."""
    for _ in range(n + 1):
        response = Covariance(step.jacobian, free).response
        rows = gradient @ response
        deviation = float(np.linalg.norm(rows))
        if deviation == 0.0:
            return 0.0
        end = step.x + math.sqrt(room) / deviation * (response @ rows)
        outside = free[:n] & ((end[:n] < bounds[0][:n]) | (end[:n] > bounds[1][:n]))
        if not outside.any():
            return math.sqrt(room) * deviation
        free = free.copy()
        free[:n] &= ~outside
    return 0.0


def _steps(problem: Problem, x: Array, bounds: tuple[Array, Array], varied: NDArray[np.bool_]) -> list[Minimum]:
    """Minima with the first exponent held, for every exponent of the range that has one.

    All are sought at once from the minimum, and then again from what was found for the neighbours.
    """
    n = problem.moduli
    sign = math.copysign(1.0, x[n])
    ladder = sign * np.array(sorted({*EXPONENTS, abs(float(x[n]))}))
    fitted = varied.copy()
    fitted[n] = False

    def sought(starts: list[Array]) -> list[Minimum | None]:
        points = np.array(starts)
        points[:, :n] = np.maximum(points[:, :n], 0.02)  # off the bound, where a term could not come back to life
        sides = (np.broadcast_to(bounds[0], points.shape), np.broadcast_to(bounds[1], points.shape))
        return minimise_many(problem, points, sides, fitted, limit=STEP_LIMIT)

    def moved(point: Array, exponent: float) -> Array:
        return np.concatenate((point[:n], [exponent], point[n + 1 :]))

    best = sought([moved(x, exponent) for exponent in ladder])
    for _ in range(ROUNDS):
        pairs = [
            (k, near.x)
            for k in range(len(ladder))
            for j in (k - 1, k + 1)
            if 0 <= j < len(ladder) and (near := best[j]) is not None
        ]
        again = sought([moved(point, ladder[k]) for k, point in pairs])
        for (k, _), found in zip(pairs, again, strict=True):
            here = best[k]
            if found is not None and (here is None or found.cost < here.cost):
                best[k] = found
    return [one for one in best if one is not None]


def targets(problem: Problem, stretch: tuple[float, float], held: Collection[str]) -> dict[str, Target]:
    """``G``, ``stiffness`` and, where it was fitted, ``eps_r`` as functions of the parameter vector."""
    n = problem.film_numbers
    flat = np.zeros(())

    def shear_modulus(x: Array) -> tuple[float, Array]:
        film = problem.film(x)
        return film.shear_modulus, problem.by_parameters(x, *shear_slopes(film), flat)

    def stiffness(x: Array) -> tuple[float, Array]:
        film = problem.film(x)
        value, by_mu, by_alpha = secant(film, np.array([stretch[0]]), stretch[1])
        return float(value[0]), problem.by_parameters(x, by_mu[0], by_alpha[0], flat)

    def permittivity(x: Array) -> tuple[float, Array]:
        gradient = np.zeros(x.size)
        gradient[n] = 1.0
        return float(x[n]), gradient

    found: dict[str, Target] = {"G": shear_modulus, "stiffness": stiffness}
    if problem.electric and "eps_r" not in held:
        found["eps_r"] = permittivity
    return found


def widened(quantity: Quantity, ends: tuple[float, float], misfit: float) -> Quantity:
    """``quantity`` with its 95 % interval, and with a part "nonlinearity" where the profile is wider than the line.

    The profile knows noise, zeros and misfit; the systematic parts, and what an imperfection that was found does to
    the quantity, are added to its half-widths in squares.
    """
    parts = [*(part for part, *_ in SYSTEMATIC), "eccentricity"]
    known = (misfit - 1.0) * quantity.budget["noise"] ** 2  # of the lack of fit: the profile is as much wider
    bias = math.sqrt(max(0.0, quantity.budget.get("lack of fit", 0.0) ** 2 - known))
    systematic = math.hypot(bias, *(quantity.budget.get(part, 0.0) for part in parts))
    low, high = (
        quantity.value + math.copysign(math.hypot(end - quantity.value, NORMAL_95 * systematic), end - quantity.value)
        for end in ends
    )
    half = max(high - quantity.value, quantity.value - low)
    if not math.isfinite(half):
        return replace(quantity, interval=(low, high), verdict=verdict(math.inf, quantity.at_bound))
    random = math.hypot(_random(quantity, misfit), quantity.budget.get("other solutions", 0.0))
    excess = (half / NORMAL_95) ** 2 - systematic**2 - random**2
    if excess <= 0.0:
        return replace(quantity, interval=(low, high))
    budget = {**quantity.budget, "nonlinearity": math.sqrt(excess)}
    total = math.hypot(*budget.values())
    return replace(
        quantity,
        uncertainty=total,
        budget=budget,
        interval=(low, high),
        verdict=verdict(total / abs(quantity.value), quantity.at_bound),
    )


def _random(quantity: Quantity, misfit: float) -> float:
    """Linear standard uncertainty from noise and zeros, enlarged by the misfit."""
    kinds = ("noise", "current_noise", *NUISANCES, *KINDS)
    return math.hypot(*(quantity.budget.get(kind.replace("_", " "), 0.0) for kind in kinds)) * math.sqrt(misfit)
