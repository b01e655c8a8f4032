"""Least squares from many starting points at once.

Membrane states cost far less when many are solved together, so all starting points take their steps side by side:
Levenberg's and Marquardt's method with the damping rule of Nielsen (1999), bounds kept by projection, one call of the
model an iteration for all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.film.problem import Evaluation, Problem

Array = NDArray[np.float64]

LARGEST_CHANGE = 0.5  # of an exponent, or of the permittivity, in one step, relative
STUCK = 1e9  # damping at which no step helps any more


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where one starting point led: parameter vector, sum of squares, Jacobian there; whether it came to rest."""

    x: Array
    cost: float
    jacobian: Array
    converged: bool


def minimise_many(
    problem: Problem,
    starts: Array,
    bounds: tuple[Array, Array],
    free: NDArray[np.bool_],
    *,
    decrease: float = 0.01,
    limit: int = 40,
) -> list[Minimum | None]:
    """Minima of ``problem`` from ``starts`` (S, P); None where the membrane has no state at the starting point.

    Parameters
    ----------
    bounds : pair of ndarray, shape (S, P) each
    free : ndarray of bool, shape (P,)
        Parameters that may move.
    decrease : float
        A starting point is at rest when the next step promises less decrease of chi-square than this.
    limit : int
        Iterations; what still moves then is returned as it is, not converged.
    """
    low, high = bounds
    x = np.where(free, np.clip(starts, low, high), starts)
    now = problem.evaluate(x)
    jacobian, residual = now.jacobian.copy(), now.residual.copy()
    cost = now.cost
    damping, growth = np.full(len(x), 1e-3), np.full(len(x), 2.0)
    scale = np.zeros_like(x)
    moving = now.answered.copy()
    slow = np.zeros(len(x), dtype=np.intp)
    for _ in range(limit):
        k = np.flatnonzero(moving)
        if k.size == 0:
            break
        step, promised, scale[k] = _step(
            x[k], residual[k], jacobian[k], (low[k], high[k]), free, damping[k], scale[k], problem
        )
        trial = np.where(free, np.clip(x[k] + step, low[k], high[k]), x[k])
        there: Evaluation = problem.evaluate(trial)
        gain = np.where(there.answered, cost[k] - there.cost, -np.inf)
        better = gain > 0.0
        won, lost = k[better], k[~better]
        share = np.clip(gain[better] / np.maximum(promised[better], 1e-30), -1.0, 2.0)
        slow[won] = np.where(gain[better] < decrease, slow[won] + 1, 0)
        x[won], cost[won] = trial[better], there.cost[better]
        residual[won], jacobian[won] = there.residual[better], there.jacobian[better]
        damping[won] *= np.maximum(0.1, 1.0 - (2.0 * share - 1.0) ** 3)
        growth[won] = 2.0
        damping[lost] *= growth[lost]
        growth[lost] *= 2.0
        moving[k] = ~((promised < decrease) & (better | (damping[k] > 1.0)) | (slow[k] >= 2) | (damping[k] > STUCK))
    return [
        Minimum(x[s], float(cost[s]), jacobian[s], not moving[s]) if now.answered[s] else None for s in range(len(x))
    ]


def _step(
    x: Array,
    residual: Array,
    jacobian: Array,
    bounds: tuple[Array, Array],
    free: NDArray[np.bool_],
    damping: Array,
    scale: Array,
    problem: Problem,
) -> tuple[Array, Array, Array]:
    """Damped steps, the decrease of chi-square that they promise, and the scale of every parameter so far."""
    gradient = np.einsum("srp,sr->sp", jacobian, residual)
    normal = np.matmul(jacobian.transpose(0, 2, 1), jacobian)
    diagonal = np.einsum("spp->sp", normal)
    scale = np.maximum(scale, diagonal)
    floor = np.maximum(scale, 1e-12 * scale.max(axis=1, keepdims=True))
    blocked = ~free | ((x <= bounds[0]) & (gradient > 0.0)) | ((x >= bounds[1]) & (gradient < 0.0))
    gradient = np.where(blocked, 0.0, gradient)
    open_pair = ~blocked[:, :, None] & ~blocked[:, None, :]
    damped = np.where(open_pair, normal, 0.0)
    unit = np.eye(x.shape[1])
    damped += unit * np.where(blocked, 1.0, damping[:, None] * floor)[:, None, :]
    step = -np.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
    big = slice(
        problem.moduli, problem.film_parameters
    )  # exponents and permittivity, beyond whose reach the model is too bent
    ratio = (np.abs(step[:, big]) / (LARGEST_CHANGE * np.maximum(1.0, np.abs(x[:, big])))).max(axis=1)
    step /= np.maximum(ratio, 1.0)[:, None]
    clipped = np.clip(x + step, *bounds) - x
    step = np.where(free, clipped, 0.0)
    promised = -(2.0 * (gradient * step).sum(axis=1) + np.einsum("sp,spq,sq->s", step, normal, step))
    return step, promised, scale
