"""Weibull and lognormal distributions by maximum likelihood with right censoring, for many data sets at once.

A specimen of relative area w survives the value t with probability ``exp(-w (t/scale)^shape)``: the weakest link of w
independent parts (Weibull 1939). A specimen that did not fail (right-censored) contributes this probability, one that
failed contributes the density of t. Everything is computed on y = ln t, one data set a row, so that thousands of
simulated campaigns cost little more than one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

LOWEST, HIGHEST = -4.0, 9.0  # ln of the shapes that are searched
STEPS = 100  # halvings that reach rounding from there; Newton's steps need about six
CLOSE = 1e-11  # relative change of the shape at which the search ends
LARGEST_EXPONENT = 600.0


@dataclass(frozen=True)
class Fits:
    """Maximum-likelihood Weibull fits, one a row.

    ``shape`` and ``log_likelihood`` (density of the value itself, not of its logarithm) have shape (rows,),
    ``log_scale`` has (rows, groups).
    """

    shape: Array
    log_scale: Array
    log_likelihood: Array


def fit(y: Array, failed: Flags, log_area: Array, groups: NDArray[np.int64] | None = None, least: float = 0.0) -> Fits:
    """Fit shape and scale; with ``groups`` (0, 1, ... per specimen) one common shape and a scale for each group.

    Parameters
    ----------
    y, failed
        ln of the value, and whether the specimen failed there; (rows, specimens).
    log_area
        ln of the area over the reference area; (specimens,).
    least
        Smallest shape that is allowed (the three-parameter likelihood has no maximum below 1).

    Each row needs two failures that differ. A group without failures has an infinite scale.
    """
    owner = np.zeros(y.shape[1], int) if groups is None else groups
    member = np.eye(int(owner.max()) + 1)[owner]  # specimens x groups
    failures = failed @ member
    total = failed.sum(axis=1)
    top = np.stack([np.where(one > 0, y, -np.inf).max(axis=1) for one in member.T], axis=1)
    z = y - top[:, owner]  # at most 0: no power overflows
    log_sum = np.where(failed, z, 0.0).sum(axis=1)

    def score(shape: Array) -> tuple[Array, Array]:
        power = np.exp(shape[:, None] * z + log_area)
        zeroth, first, second = power @ member, (power * z) @ member, (power * z**2) @ member
        mean = first / zeroth
        slope = -total / shape**2 - (failures * (second / zeroth - mean**2)).sum(axis=1)
        return total / shape + log_sum - (failures * mean).sum(axis=1), slope

    shape = np.maximum(_root(score, len(y)), least)
    with np.errstate(divide="ignore"):
        log_mean = np.log(np.exp(shape[:, None] * z + log_area) @ member) - np.log(failures)
    log_scale = top + log_mean / shape[:, None]
    scaled = np.where(failed, y - log_scale[:, owner], 0.0)
    density = np.where(failed, log_area - y, 0.0).sum(axis=1) + total * np.log(shape) + shape * scaled.sum(axis=1)
    return Fits(shape, log_scale, density - total)


def log_likelihood_at_quantile(y: Array, failed: Flags, log_area: Array, share: float, log_quantile: Array) -> Array:
    """The log-likelihood, maximised over the shape, where a ``share`` of the specimens fails below a stated value.

    With share = 1 - 1/e the quantile is the scale. ``log_quantile`` is (rows,).
    """
    hazard = -np.log1p(-share)
    z = y - log_quantile[:, None]
    total = failed.sum(axis=1)
    log_sum = np.where(failed, z, 0.0).sum(axis=1)

    def power(shape: Array) -> Array:
        part: Array = hazard * np.exp(np.minimum(shape[:, None] * z + log_area, LARGEST_EXPONENT))
        return part

    def score(shape: Array) -> tuple[Array, Array]:
        part = power(shape)
        slope = -total / shape**2 - (part * z**2).sum(axis=1)
        return total / shape + log_sum - (part * z).sum(axis=1), slope

    shape = _root(score, len(y))
    constant = np.where(failed, log_area - y, 0.0).sum(axis=1) + total * np.log(hazard)
    found: Array = constant + total * np.log(shape) + shape * log_sum - power(shape).sum(axis=1)
    return found


def log_likelihood_at_shape(y: Array, failed: Flags, log_area: Array, shape: Array) -> Array:
    """The log-likelihood, maximised over the scale, at a stated shape (rows,)."""
    total = failed.sum(axis=1)
    top = y.max(axis=1, keepdims=True)
    log_mean = np.log(np.exp(shape[:, None] * (y - top) + log_area).sum(axis=1) / total)
    constant = np.where(failed, log_area - y, 0.0).sum(axis=1)
    log_sum = np.where(failed, y - top, 0.0).sum(axis=1)
    found: Array = constant + total * (np.log(shape) - log_mean - 1.0) + shape * log_sum
    return found


def lognormal_log_likelihood(y: Array, failed: Flags) -> Array:
    """The largest log-likelihood of a lognormal distribution; (rows,).

    Newton's method in 1/sigma and mu/sigma, in which the censored likelihood is concave (Olsen 1978).
    """
    centre, width = y.mean(axis=1, keepdims=True), y.std(axis=1, keepdims=True)
    x = (y - centre) / width
    total = failed.sum(axis=1)
    a, b = np.ones(len(y)), np.zeros(len(y))
    for _ in range(STEPS):
        z = a[:, None] * x - b[:, None]
        hazard = np.exp(-0.5 * z**2 - 0.5 * np.log(2 * np.pi) - log_ndtr(-z))
        pull = np.where(failed, z, hazard)
        weight = np.where(failed, 1.0, hazard * (hazard - z))
        slope_a, slope_b = total / a - (pull * x).sum(axis=1), pull.sum(axis=1)
        aa, ab, bb = total / a**2 + (weight * x**2).sum(axis=1), -(weight * x).sum(axis=1), weight.sum(axis=1)
        determinant = aa * bb - ab**2
        step_a = (bb * slope_a - ab * slope_b) / determinant
        step_b = (aa * slope_b - ab * slope_a) / determinant
        short = np.minimum(1.0, 0.5 * a / np.maximum(np.abs(step_a), 1e-300))  # a stays positive
        a, b = a + short * step_a, b + short * step_b
        if np.all(np.abs(step_a) < CLOSE * a) and np.all(np.abs(step_b) < CLOSE * (1 + np.abs(b))):
            break
    z = a[:, None] * x - b[:, None]
    density = np.log(a[:, None] / width) - 0.5 * np.log(2 * np.pi) - 0.5 * z**2 - y
    found: Array = np.where(failed, density, log_ndtr(-z)).sum(axis=1)
    return found


def _root(score: Callable[[Array], tuple[Array, Array]], rows: int) -> Array:
    """Where a falling function of the shape is zero: Newton's method, halving where a step leaves the bracket."""
    low, high = np.full(rows, LOWEST), np.full(rows, HIGHEST)
    u = np.full(rows, 1.5)
    for _ in range(STEPS):
        shape = np.exp(u)
        value, slope = score(shape)
        low, high = np.where(value > 0, u, low), np.where(value > 0, high, u)
        step = -value / (shape * slope)
        new = u + step
        new = np.where((new > low) & (new < high), new, 0.5 * (low + high))
        moved, u = np.abs(new - u), new
        if np.all((moved < CLOSE) | (high - low < CLOSE)):
            break
    found: Array = np.exp(u)
    return found
