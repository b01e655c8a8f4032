"""The best minimum: over a grid of exponents first, where the moduli follow linearly, and then by least squares.

For given exponents the stresses are linear in the moduli, and with ``mu_n alpha_n > 0`` the best moduli are a small
problem of non-negative least squares (Golub and Pereyra 1973, variable projection). So all sets of exponents of a grid
can be tried, and none of the many minima is missed for want of a starting point.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.sheet.problem import EXPONENT_BOUNDS, SHARE_BOUNDS, SheetProblem
from model.material.ogden import Ogden

Array = NDArray[np.float64]

GRID = {1: 60, 2: 60, 3: 34, 4: 22}  # exponents of both signs, by the number of terms
DISTINCT = 0.05  # by which some parameter of distinct minima differs


@dataclass(frozen=True, eq=False)
class Minimum:
    """A minimum: parameter vector, moduli (Pa), shape parameters, weighted sum of squares."""

    x: Array
    mu: tuple[float, ...]
    alpha: tuple[float, ...]
    cost: float


def minima(problem: SheetProblem, starts: int, seed: int) -> list[Minimum]:
    """Minima from the best ``starts`` points, the best first."""
    points = _ogden_points(problem, starts) if problem.law is Ogden else _drawn_points(problem, starts, seed)
    found = sorted((minimise(problem, x) for x in points), key=lambda one: one.cost)
    best = minimise(problem, found[0].x, confirm=True)
    return [best if best.cost <= found[0].cost else found[0], *found[1:]]


def _drawn_points(problem: SheetProblem, starts: int, seed: int) -> list[Array]:
    random = np.random.default_rng(seed)
    terms = problem.moduli // max(1, len(problem.law.moduli))
    return [problem.held(np.concatenate(problem.law.draw(random, terms))) for _ in range(starts)]


def exponent_grid(terms: int, *, negative: bool = True) -> Array:
    """Exponents of both signs, or positive ones only, evenly spaced in their logarithm."""
    half = GRID[terms] // 2
    sizes = np.exp(np.linspace(math.log(0.2), math.log(0.98 * EXPONENT_BOUNDS[1]), half))
    return np.concatenate((-sizes[::-1], sizes)) if negative else sizes


def _ogden_points(problem: SheetProblem, starts: int) -> list[Array]:
    """The best sets of exponents on a grid, each with its best non-negative shares."""
    terms = problem.moduli
    free = problem.free[terms:]
    grid = exponent_grid(terms, negative=problem.negative_exponents)
    chosen = np.array(list(combinations(range(grid.size), int(free.sum()))), dtype=np.intp)
    sets = np.empty((len(chosen), terms), dtype=np.intp)
    sets[:, free], sets[:, ~free] = chosen, grid.size + np.arange(terms - free.sum())
    grid = np.concatenate((grid, problem.held(np.zeros(problem.size))[terms:][~free]))
    columns = np.stack([_column(problem, exponent) for exponent in grid], axis=1)
    target = problem.measured * problem.weight
    cost, shares = _non_negative(columns, target, sets)
    points: list[Array] = []
    for k in np.argsort(cost):
        # Neighbours on the grid lead to the same minimum.
        near = any(np.abs(sets[k] - sets[j]).max() <= 1 for j in [int(p[-1]) for p in points])
        if near:
            continue
        points.append(np.concatenate((shares[k], grid[sets[k]], [float(k)])))
        if len(points) == starts:
            break
    return [point[:-1] for point in points]


def _column(problem: SheetProblem, exponent: float) -> Array:
    """Weighted stress of one Ogden term with a share of one."""
    unit = np.array([2.0 * problem.scale / exponent]), np.array([exponent])
    stress, _, _ = problem.model(*unit)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.nan_to_num(stress * problem.weight, nan=1e150, posinf=1e150, neginf=-1e150)


def _non_negative(columns: Array, target: Array, sets: NDArray[np.intp]) -> tuple[Array, Array]:
    """Sum of squares and coefficients of the non-negative least-squares problem of every set of columns.

    With N columns the solution is that of one of their 2^N - 1 subsets without a sign constraint: all are tried.
    """
    norms = np.linalg.norm(columns, axis=0)
    norms[norms == 0.0] = 1.0
    scaled = columns / norms
    gram, right, total = scaled.T @ scaled, scaled.T @ target, float(target @ target)
    terms = sets.shape[1]
    best = np.full(sets.shape[0], np.inf)
    shares = np.zeros(sets.shape)
    for size in range(1, terms + 1):
        for subset in combinations(range(terms), size):
            index = sets[:, subset]
            matrix = gram[index[:, :, None], index[:, None, :]] + 1e-13 * np.eye(size)
            vector = right[index]
            solution = np.linalg.solve(matrix, vector[:, :, None])[:, :, 0]
            cost = total - (solution * vector).sum(axis=1)
            better = (solution >= 0.0).all(axis=1) & (cost < best)
            best[better] = cost[better]
            shares[better] = 0.0
            shares[np.flatnonzero(better)[:, None], list(subset)] = (solution / norms[index])[better]
    return best, shares


def minimise(problem: SheetProblem, start: Array, *, confirm: bool = False) -> Minimum:
    """The minimum near ``start``; ``confirm`` lets lmfit go on from there to the last digit."""
    lower, upper = problem.bounds(start)
    x = np.clip(start, lower, upper)
    with np.errstate(all="ignore"):
        if confirm:
            x = _by_lmfit(problem, x, lower, upper)
        elif problem.law is Ogden:
            x = _projected(problem, x, lower, upper)
        else:
            x = _bounded(problem, x, lower, upper)
    if problem.law is Ogden and not problem.fixed:
        order = np.argsort(x[problem.moduli :])
        x = np.concatenate((x[: problem.moduli][order], x[problem.moduli :][order]))
    mu, alpha = problem.film(x)
    residual = problem.residual(x)
    return Minimum(x, tuple(map(float, mu)), tuple(map(float, alpha)), float(residual @ residual))


def _bounded(problem: SheetProblem, start: Array, lower: Array, upper: Array) -> Array:
    """Least squares over all parameters that are not fixed."""
    from scipy.optimize import least_squares

    free = problem.free

    def residual(part: Array) -> Array:
        return problem.residual(problem.filled(start, part))

    def jacobian(part: Array) -> Array:
        return np.asarray(problem.jacobian(problem.filled(start, part))[:, free])

    sides = lower[free], upper[free]
    options: Any = {"x_scale": "jac", "ftol": 1e-10, "xtol": 1e-10, "max_nfev": 200}
    return problem.filled(start, least_squares(residual, start[free], jacobian, bounds=sides, **options).x)


def _projected(problem: SheetProblem, start: Array, lower: Array, upper: Array) -> Array:
    """Least squares over the exponents alone, the shares being the best non-negative ones for each set of them.

    The valleys along which share and exponent make up for each other, in which a search over both creeps, are gone. The
    Jacobian is that of Kaufman 1975: what the change of a term leaves outside the span of the terms.
    """
    from scipy.optimize import least_squares, nnls

    terms = problem.moduli
    target = problem.measured * problem.weight
    free = problem.free[terms:]
    exponents = start[terms:].copy()

    def full(part: Array) -> Array:
        exponents[free] = part
        return exponents

    def solved(alpha: Array) -> tuple[Array, Array, Array]:
        mu = 2.0 * problem.scale / alpha
        _, by_mu, by_alpha = problem.model(mu, alpha)
        columns = np.nan_to_num(by_mu * mu * problem.weight[:, None])
        slopes = np.nan_to_num((by_alpha - by_mu * mu / alpha) * problem.weight[:, None])
        norms = np.linalg.norm(columns, axis=0)
        norms[norms == 0.0] = 1.0
        shares: Array = nnls(columns / norms, target)[0] / norms
        return shares, columns, slopes

    def residual(part: Array) -> Array:
        shares, columns, _ = solved(full(part))
        return np.asarray(columns @ shares - target)

    def jacobian(part: Array) -> Array:
        shares, columns, slopes = solved(full(part))
        active = columns[:, shares > 0.0]
        changes = slopes * shares
        basis, _ = np.linalg.qr(active / np.maximum(np.linalg.norm(active, axis=0), 1e-300))
        return np.asarray(changes - basis @ (basis.T @ changes))[:, free]

    if free.any():
        low, high = lower[terms:][free], upper[terms:][free]
        found = least_squares(
            residual,
            np.clip(start[terms:][free], low, high),
            jacobian,
            bounds=(low, high),
            ftol=1e-12,
            xtol=1e-10,
            gtol=None,
            max_nfev=150,
        )
        full(found.x)
    alpha = exponents
    return np.concatenate((np.clip(solved(alpha)[0], lower[:terms], upper[:terms]), alpha))


def _by_lmfit(problem: SheetProblem, start: Array, lower: Array, upper: Array) -> Array:
    import warnings

    import lmfit

    parameters = lmfit.Parameters()
    for name, value, low, high, free in zip(problem.names, start, lower, upper, problem.free, strict=True):
        parameters.add(name, value=float(value), min=float(low), max=float(high), vary=bool(free))

    def vector(values: lmfit.Parameters) -> Array:
        return np.array([values[name].value for name in problem.names])

    with warnings.catch_warnings():
        # lmfit takes square roots of a covariance that need not be positive definite; ours is used instead.
        warnings.simplefilter("ignore")
        out = lmfit.Minimizer(lambda p: problem.residual(vector(p)), parameters, nan_policy="raise").minimize(
            method="least_squares",
            jac=lambda p: problem.jacobian(vector(p))[:, problem.free],
            x_scale="jac",
            ftol=1e-12,
            xtol=1e-12,
            gtol=None,
            max_nfev=1000,
        )
    return vector(out.params)


def distinct(found: Sequence[Minimum]) -> list[Minimum]:
    """Those that differ from all before them by more than 5 % in some parameter."""
    kept: list[Minimum] = []
    for minimum in found:
        here = np.array(minimum.mu + minimum.alpha)
        if all((np.abs(np.array(k.mu + k.alpha) - here) > DISTINCT * np.abs(here)).any() for k in kept):
            kept.append(minimum)
    return kept


def unconstrained_cost(problem: SheetProblem, terms: int) -> tuple[float, Array, Array]:
    """Least sum of squares on the grid when ``mu_n alpha_n`` may have any sign, with its shares and exponents."""
    grid = exponent_grid(terms)
    columns = np.stack([_column(problem, exponent) for exponent in grid], axis=1)
    norms = np.linalg.norm(columns, axis=0)
    scaled, target = columns / norms, problem.measured * problem.weight
    gram, right = scaled.T @ scaled, scaled.T @ target
    sets = np.array(list(combinations(range(grid.size), terms)))
    solution = np.linalg.solve(gram[sets[:, :, None], sets[:, None, :]] + 1e-9 * np.eye(terms), right[sets][:, :, None])
    cost = float(target @ target) - 2.0 * (solution[:, :, 0] * right[sets]).sum(axis=1)
    cost += np.einsum("ki,kij,kj->k", solution[:, :, 0], gram[sets[:, :, None], sets[:, None, :]], solution[:, :, 0])
    k = int(np.argmin(cost))
    return float(cost[k]), (solution[k, :, 0] / norms[sets[k]]), grid[sets[k]]


__all__ = ["SHARE_BOUNDS", "Minimum", "distinct", "minima", "minimise", "unconstrained_cost"]
