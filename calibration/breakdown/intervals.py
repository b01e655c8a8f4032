"""A two-parameter Weibull fit with 95 % intervals: by profile likelihood and by parametric bootstrap.

With few specimens twice the log-likelihood ratio does not follow chi-squared, and intervals from that are too short.
Its true distribution hardly depends on shape and scale (they are a shape and a location of ln t), so it is simulated:
campaigns of the same design are drawn from the fit, and the 95 % point of their ratios takes chi-squared's place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from calibration.breakdown.sample import Sample, simulate
from calibration.breakdown.weibull import Array, fit, log_likelihood_at_quantile, log_likelihood_at_shape

LEVEL = 0.95
SCALE = 1.0 - np.exp(-1.0)  # the share that fails below the scale
LOW = 0.1  # the share that fails below the low quantile
FARTHEST = 60.0  # in ln of a parameter: where no end is found up to there, the interval is open


@dataclass(frozen=True)
class Interval:
    """Both ends; 0 or infinity where the data do not bound it."""

    low: float
    high: float


@dataclass(frozen=True)
class Estimate:
    """A parameter at the maximum of the likelihood with its two 95 % intervals."""

    value: float
    profile: Interval
    bootstrap: Interval


@dataclass(frozen=True)
class WeibullFit:
    """``scale``: 63.2 % fail below it. ``low_quantile``: 10 % do. Both at the reference area.

    ``shape_bias`` is the median of the fitted over the true shape in simulated campaigns: divide by it.
    ``simulated`` counts these; ``lost`` is the share of them that had too few failures to be fitted.
    """

    specimens: int
    failures: int
    shape: Estimate
    scale: Estimate
    low_quantile: Estimate
    shape_bias: float
    log_likelihood: float
    simulated: int
    lost: float


def fit_weibull(sample: Sample, rng: np.random.Generator, rows: int) -> WeibullFit:
    """Fit, and find the intervals from so many simulated campaigns. The sample has to be ``usable``."""
    y, failed, log_area = sample.rows
    best = fit(y, failed, log_area)
    shape, log_scale = float(best.shape[0]), float(best.log_scale[0, 0])
    drawn, fell = simulate(sample, shape, np.full(len(sample.value), log_scale), rng, rows)
    again = fit(drawn, fell, log_area)

    def quantile(share: float) -> Estimate:
        offset = np.log(-np.log1p(-share))
        value = log_scale + offset / shape

        def at(position: float) -> float:
            point = np.array([position])
            return float(log_likelihood_at_quantile(y, failed, log_area, share, point)[0])

        truth = log_likelihood_at_quantile(drawn, fell, log_area, share, np.full(len(drawn), value))
        pivot = again.shape * (again.log_scale[:, 0] + offset / again.shape - value)
        tail = np.quantile(pivot, [(1 + LEVEL) / 2, (1 - LEVEL) / 2])
        ends = value - tail / shape
        profile = _profile(at, value, float(best.log_likelihood[0]), again.log_likelihood - truth)
        return Estimate(float(np.exp(value)), profile, Interval(*map(float, np.exp(ends))))

    def at_shape(position: float) -> float:
        return float(log_likelihood_at_shape(y, failed, log_area, np.exp([position]))[0])

    ratio = again.shape / shape
    truth = log_likelihood_at_shape(drawn, fell, log_area, np.full(len(drawn), shape))
    ends = shape / np.quantile(ratio, [(1 + LEVEL) / 2, (1 - LEVEL) / 2])
    by_profile = _profile(at_shape, np.log(shape), float(best.log_likelihood[0]), again.log_likelihood - truth)
    return WeibullFit(
        specimens=len(sample.value),
        failures=int(sample.failed.sum()),
        shape=Estimate(shape, by_profile, Interval(*map(float, ends))),
        scale=quantile(SCALE),
        low_quantile=quantile(LOW),
        shape_bias=float(np.median(ratio)),
        log_likelihood=float(best.log_likelihood[0]),
        simulated=len(drawn),
        lost=1.0 - len(drawn) / rows,
    )


def _profile(at: Callable[[float], float], centre: float, best: float, simulated: Array) -> Interval:
    """Where the log-likelihood has fallen by as much as 95 % of the simulated campaigns do not exceed at the truth."""
    allowed = float(np.quantile(simulated, LEVEL))

    def excess(position: float) -> float:
        return best - at(position) - allowed

    ends = []
    for sign in (-1.0, 1.0):
        reach = 0.05
        while excess(centre + sign * reach) < 0.0 and reach < FARTHEST:
            reach *= 2.0
        if reach >= FARTHEST:
            ends.append(0.0 if sign < 0 else np.inf)
        else:
            ends.append(float(np.exp(brentq(excess, centre, centre + sign * reach, xtol=1e-10))))
    return Interval(*ends)
