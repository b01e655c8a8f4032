"""Questions to a sample by likelihood ratio, each judged by simulated campaigns in place of chi-squared.

Groups: one distribution for all, against a scale for each (one shape), against everything for each. Distribution:
Weibull against lognormal. Area: whether the scale falls with the area as the weakest link says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from calibration.breakdown.intervals import LEVEL, Interval
from calibration.breakdown.sample import Sample, simulate
from calibration.breakdown.weibull import Array, Flags, fit, lognormal_log_likelihood

DIFFERENCE = 0.2  # of the scale of one group, for which the power is stated
EXPONENTS = (-6.0, 8.0)  # of the area, that are searched
DISTANCES = (0.003, 7.0)  # from an exponent, at which the likelihood is looked at; parted by ratios


@dataclass(frozen=True)
class Groups:
    """``scale_ratio`` is that of each group to the first, with one shape for all, and a 95 % bootstrap interval.

    ``p_*`` is the probability of a likelihood ratio as large or larger if there were no such difference;
    ``power`` that of seeing (p < 0.05) a scale 20 % higher in one group, with these specimens.
    """

    names: list[str]
    log_ratio_scale: float
    p_scale: float
    log_ratio_shape: float
    p_shape: float
    scale_ratio: list[float]
    scale_ratio_interval: list[Interval]
    power: float


@dataclass(frozen=True)
class Lognormal:
    """``log_ratio`` is ln L(Weibull) - ln L(lognormal). ``wrong_*``: how often so many specimens of the one
    distribution would be fitted better by the other."""

    log_ratio: float
    wrong_if_weibull: float
    wrong_if_lognormal: float


@dataclass(frozen=True)
class AreaScaling:
    """Hazard proportional to area^exponent; 1 is the weakest link, 0 no influence. Interval by profile likelihood."""

    exponent: float
    interval: Interval
    p_weakest_link: float
    p_no_influence: float


def compare_groups(sample: Sample, labels: Sequence[str], rng: np.random.Generator, rows: int) -> Groups:
    """Compare groups, each with two failures or more that differ; ``labels`` are (specimens,)."""
    names = list(dict.fromkeys(labels))
    owner = np.array([names.index(label) for label in labels])
    y, failed, log_area = sample.rows
    one, scales = fit(y, failed, log_area), fit(y, failed, log_area, owner)
    shape, common = float(scales.shape[0]), float(one.log_scale[0, 0])
    observed = _ratios(y, failed, log_area, owner)

    def drawn(power: float, log_scale: Array) -> tuple[Array, Flags]:
        values, fell = simulate(sample, power, log_scale, rng, rows)
        enough = np.all([fell[:, owner == k].sum(axis=1) >= 2 for k in range(len(names))], axis=0)
        return values[enough], fell[enough]

    equal = np.full(len(labels), common)
    under_one = _ratios(*drawn(float(one.shape[0]), equal), log_area, owner)[0]
    own = drawn(shape, scales.log_scale[0][owner])
    under_scales = _ratios(*own, log_area, owner)[1]
    apart = drawn(shape, np.where(owner == 0, common + np.log1p(DIFFERENCE), common))
    again = fit(*own, log_area, owner)
    log_ratio = scales.log_scale[0] - scales.log_scale[0, 0]
    pivot = again.shape[:, None] * (again.log_scale - again.log_scale[:, :1] - log_ratio)
    tails = np.quantile(pivot, [(1 + LEVEL) / 2, (1 - LEVEL) / 2], axis=0) / shape
    return Groups(
        names=names,
        log_ratio_scale=float(observed[0][0]),
        p_scale=_probability(under_one, observed[0][0]),
        log_ratio_shape=float(observed[1][0]),
        p_shape=_probability(under_scales, observed[1][0]),
        scale_ratio=[float(value) for value in np.exp(log_ratio)],
        scale_ratio_interval=[Interval(float(a), float(b)) for a, b in np.exp(log_ratio - tails).T],
        power=float(np.mean(_ratios(*apart, log_area, owner)[0] > np.quantile(under_one, LEVEL))),
    )


def _ratios(y: Array, failed: Flags, log_area: Array, owner: np.ndarray) -> tuple[Array, Array]:
    """ln of the likelihood ratio: a scale for each group against one for all; a shape too against one shape."""
    one, scales = fit(y, failed, log_area), fit(y, failed, log_area, owner)
    each = sum(
        fit(y[:, owner == k], failed[:, owner == k], log_area[owner == k]).log_likelihood
        for k in range(owner.max() + 1)
    )
    return scales.log_likelihood - one.log_likelihood, each - scales.log_likelihood


def _probability(simulated: Array, observed: float) -> float:
    return float((1 + np.sum(simulated >= observed)) / (1 + len(simulated)))


def compare_lognormal(sample: Sample, rng: np.random.Generator, rows: int) -> Lognormal:
    """Whether the sample tells Weibull from lognormal. Areas are left aside: a lognormal has no weakest link."""
    plain = Sample(sample.value, sample.failed, np.ones(len(sample.value)))
    y, failed, log_area = plain.rows
    best = fit(y, failed, log_area)
    values, fell = simulate(plain, float(best.shape[0]), np.full(y.shape[1], best.log_scale[0, 0]), rng, rows)
    weibull = _preference(values, fell)
    # The lognormal of the same campaign: moments of ln t, censored as the Weibull was.
    spread = np.pi / np.sqrt(6.0) / best.shape[0]
    middle = best.log_scale[0, 0] - np.euler_gamma / best.shape[0]
    normal = middle + spread * rng.standard_normal(values.shape)
    limit = np.where(fell, np.inf, values)
    fell = normal < limit
    enough = fell.sum(axis=1) >= 2
    lognormal = _preference(np.minimum(normal, limit)[enough], fell[enough])
    return Lognormal(float(_preference(y, failed)[0]), float(np.mean(weibull < 0)), float(np.mean(lognormal > 0)))


def _preference(y: Array, failed: Flags) -> Array:
    found: Array = fit(y, failed, np.zeros(y.shape[1])).log_likelihood - lognormal_log_likelihood(y, failed)
    return found


def area_scaling(sample: Sample, rng: np.random.Generator, rows: int) -> AreaScaling:
    """The exponent of the area, held against the weakest link's. The areas have to differ."""
    y, failed, log_area = sample.rows

    def at(exponent: float) -> float:
        return float(fit(y, failed, exponent * log_area).log_likelihood[0])

    grid = np.linspace(*EXPONENTS, 113)
    k = int(np.clip(np.argmax([at(value) for value in grid]), 1, len(grid) - 2))
    found = minimize_scalar(lambda value: -at(value), bounds=(grid[k - 1], grid[k + 1]), method="bounded")
    exponent, best = float(found.x), -float(found.fun)
    best_fit = fit(y, failed, log_area)
    truth = Sample(sample.value, sample.failed, sample.area)
    values, fell = simulate(truth, float(best_fit.shape[0]), np.full(y.shape[1], best_fit.log_scale[0, 0]), rng, rows)
    none = fit(y, failed, np.zeros_like(log_area))
    flat = Sample(sample.value, sample.failed, np.ones(len(sample.value)))
    unscaled = simulate(flat, float(none.shape[0]), np.full(y.shape[1], none.log_scale[0, 0]), rng, rows)
    under_link = _gain(values, fell, log_area, 1.0)
    allowed = float(np.quantile(under_link, LEVEL))
    distances = np.geomspace(*DISTANCES, 160)
    ends = []
    for sign in (-1.0, 1.0):
        outside = [distance for distance in distances if best - at(exponent + sign * distance) > allowed]
        ends.append(exponent + sign * float(outside[0]) if outside else sign * np.inf)
    return AreaScaling(
        exponent=exponent,
        interval=Interval(*ends),
        p_weakest_link=_probability(under_link, best - at(1.0)),
        p_no_influence=_probability(_gain(*unscaled, log_area, 0.0), best - at(0.0)),
    )


def _gain(y: Array, failed: Flags, log_area: Array, exponent: float) -> Array:
    """By how much the best exponent raises the log-likelihood over that at a stated one."""
    steps = np.geomspace(*DISTANCES, 24)
    heights = [fit(y, failed, (exponent + step) * log_area).log_likelihood for step in (*-steps, *steps)]
    found: Array = np.max(heights, axis=0) - fit(y, failed, exponent * log_area).log_likelihood
    return np.maximum(found, 0.0)
