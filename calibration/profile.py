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

from calibration.problem import Problem
from calibration.propagation import SYSTEMATIC, Covariance, secant
from calibration.result import Quantity, verdict

Array = NDArray[np.float64]
Target = Callable[[Array], tuple[float, Array]]  # value and gradient of a quantity at x

COST_95 = 3.841  # 95 % quantile of chi-square with one degree of freedom
NORMAL_95 = 1.960  # its square root
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
    n = problem.terms
    ends = {
        name: [quantities[name].value + side * NORMAL_95 * _random(quantities[name], misfit) for side in (-1.0, 1.0)]
        for name in aims
    }
    if n == 1 or not varied[n]:
        return {name: (low, high) for name, (low, high) in ends.items()}
    steps = _steps(problem, x, bounds, varied)
    least = min(cost for _, cost, _ in steps)
    for name, target in aims.items():
        reached: list[float] = []
        for at, cost, free in steps:
            room = COST_95 - (cost - least) / misfit
            if room > 0.0:
                value, gradient = target(at)
                for side in (-1.0, 1.0):
                    reached.append(value + side * _half(problem, at, free, bounds, gradient * side, room * misfit))
        ends[name] = [min(reached), max(reached)]
    return {name: (low, high) for name, (low, high) in ends.items()}


def _half(
    problem: Problem,
    at: Array,
    free: NDArray[np.bool_],
    bounds: tuple[Array, Array],
    gradient: Array,
    room: float,
) -> float:
    """How far a quantity can rise before chi-square has risen by ``room``; no share leaves its bounds on the way."""
    n = problem.terms
    for _ in range(n + 1):
        response = Covariance(problem, at, free).response
        rows = gradient @ response
        deviation = float(np.linalg.norm(rows))
        if deviation == 0.0:
            return 0.0
        end = at + math.sqrt(room) / deviation * (response @ rows)
        outside = free[:n] & ((end[:n] < bounds[0][:n]) | (end[:n] > bounds[1][:n]))
        if not outside.any():
            return math.sqrt(room) * deviation
        free = free.copy()
        free[:n] &= ~outside
    return 0.0


def _steps(
    problem: Problem, x: Array, bounds: tuple[Array, Array], varied: NDArray[np.bool_]
) -> list[tuple[Array, float, NDArray[np.bool_]]]:
    """The minimum with the first exponent held, for every exponent of the range that has one: x, cost, free entries."""
    n = problem.terms
    sign = math.copysign(1.0, x[n])
    ladder = sorted({*EXPONENTS, abs(float(x[n]))})
    middle = ladder.index(abs(float(x[n])))
    steps = []
    for way in (ladder[middle:], ladder[:middle][::-1]):  # outwards from the minimum, each from its neighbour
        start = x
        for exponent in way:
            found = _held(problem, start, sign * exponent, bounds, varied)
            if found is not None:
                steps.append(found)
                start = found[0]
    return steps


def _held(
    problem: Problem, start: Array, exponent: float, bounds: tuple[Array, Array], varied: NDArray[np.bool_]
) -> tuple[Array, float, NDArray[np.bool_]] | None:
    from scipy.optimize import least_squares

    n = problem.terms
    fitted = varied.copy()
    fitted[n] = False
    first = start.copy()
    first[n] = exponent
    first[:n] = np.maximum(first[:n], 0.02)  # off the bound, where a term could not come back to life
    first[fitted] = np.clip(first[fitted], bounds[0][fitted] + 1e-9, bounds[1][fitted] - 1e-9)
    if not problem.answers(first):
        return None

    def full(part: Array) -> Array:
        whole = first.copy()
        whole[fitted] = part
        return whole

    def residual(part: Array) -> Array:
        return problem.residual(full(part))

    def jacobian(part: Array) -> Array:
        return problem.jacobian(full(part))[:, fitted]

    found = least_squares(
        residual,
        first[fitted],
        jacobian,
        bounds=(bounds[0][fitted], bounds[1][fitted]),
        x_scale="jac",
        ftol=1e-5,
        max_nfev=30,
    )
    at = full(found.x)
    if not problem.answers(at):
        return None
    free = fitted.copy()
    free[n : 2 * n] &= at[:n] > 100 * bounds[0][:n]  # a vanished term's exponent means nothing
    return at, float(2.0 * found.cost), free


def targets(problem: Problem, stretch: tuple[float, float], held: Collection[str]) -> dict[str, Target]:
    """``G``, ``stiffness`` and, where it was fitted, ``eps_r`` as functions of the parameter vector."""
    n = problem.terms
    flat = np.zeros(())

    def shear_modulus(x: Array) -> tuple[float, Array]:
        film = problem.film(x)
        alpha, mu = np.array(film.alpha), np.array(film.mu)
        return film.shear_modulus, problem.by_parameters(x, alpha / 2.0, mu / 2.0, flat)

    def stiffness(x: Array) -> tuple[float, Array]:
        film = problem.film(x)
        value, by_mu, by_alpha = secant(np.array(film.mu), np.array(film.alpha), np.array([stretch[0]]), stretch[1])
        return float(value[0]), problem.by_parameters(x, by_mu[0], by_alpha[0], flat)

    def permittivity(x: Array) -> tuple[float, Array]:
        gradient = np.zeros(x.size)
        gradient[2 * n] = 1.0
        return float(x[2 * n]), gradient

    found: dict[str, Target] = {"G": shear_modulus, "stiffness": stiffness}
    if problem.electric and "eps_r" not in held:
        found["eps_r"] = permittivity
    return found


def widened(quantity: Quantity, ends: tuple[float, float], misfit: float) -> Quantity:
    """``quantity`` with its 95 % interval, and with a part "nonlinearity" where the profile is wider than the line.

    The profile knows noise, zeros and misfit; the systematic parts are added to its half-widths in squares.
    """
    systematic = math.hypot(*(quantity.budget[part] for part, *_ in SYSTEMATIC if part in quantity.budget))
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
    parts = (quantity.budget.get(part, 0.0) for part in ("noise", "force zero", "displacement zero"))
    return math.hypot(*parts) * math.sqrt(misfit)
