"""The three-parameter Weibull distribution: none fails below a location; above it, t - location is Weibull.

Its likelihood has no maximum for shapes below 1 (it grows without bound as the location nears the lowest failure), so
the shape is held at 1 or above. The location is between 0 and the lowest failure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.breakdown.intervals import LEVEL, Interval
from calibration.breakdown.sample import Sample, simulate
from calibration.breakdown.weibull import Array, Fits, Flags, fit

PLACES = 1.0 - np.append(np.geomspace(1.0, 1e-4, 40), 0.0)[:-1]  # of the location, over the lowest failure


@dataclass(frozen=True)
class LocationFit:
    """``p_none``: probability of a gain in likelihood as large or larger if the location were 0.

    The interval of the location is by profile likelihood, its threshold from simulated campaigns.
    """

    location: float
    location_interval: Interval
    shape: float
    scale: float
    log_likelihood: float
    p_none: float


def fit_location(sample: Sample, rng: np.random.Generator, rows: int) -> LocationFit:
    """Fit location, shape and scale. The sample has to be ``usable``."""
    y, failed, log_area = sample.rows
    unit = float(sample.value.max())
    heights = _heights(y, failed, log_area)[0]
    k = int(np.argmax(heights))
    lowest = float(sample.value[sample.failed].min())
    location = PLACES[k] * lowest
    best = _at(y, failed, log_area, np.array([location]))
    plain = fit(y, failed, log_area, least=1.0)
    scale = np.full(y.shape[1], plain.log_scale[0, 0])
    none = _heights(*simulate(sample, float(plain.shape[0]), scale, rng, rows), log_area)
    gains = none.max(axis=1) - none[:, 0]
    # Campaigns from the three-parameter fit: shifted ones, so that survivors keep their limits.
    shifted = Sample(np.maximum(sample.value - location, 1e-6 * unit), sample.failed, sample.area)
    above, fell = simulate(shifted, float(best.shape[0]), np.full(y.shape[1], best.log_scale[0, 0]), rng, rows)
    again = np.log(location + np.exp(above))
    drops = (
        _heights(again, fell, log_area).max(axis=1)
        - _at(again, fell, log_area, np.full(len(again), location)).log_likelihood
    )
    inside = np.flatnonzero(heights[k] - heights <= max(float(np.quantile(drops, LEVEL)), 0.0))
    places = np.append(PLACES, 1.0)
    low, high = places[max(inside[0] - 1, 0)] if inside[0] else 0.0, places[inside[-1] + 1]
    gain = heights[k] - heights[0]
    return LocationFit(
        location=float(location),
        location_interval=Interval(float(low * lowest), float(high * lowest)),
        shape=float(best.shape[0]),
        scale=float(np.exp(best.log_scale[0, 0])),
        log_likelihood=float(heights[k]),
        p_none=float((1 + np.sum(gains >= gain)) / (1 + len(gains))),
    )


def _heights(y: Array, failed: Flags, log_area: Array) -> Array:
    """The log-likelihood at each of the places of the location; (rows, places)."""
    lowest = np.exp(np.where(failed, y, np.inf).min(axis=1))
    return np.stack([_at(y, failed, log_area, place * lowest).log_likelihood for place in PLACES], axis=1)


def _at(y: Array, failed: Flags, log_area: Array, location: Array) -> Fits:
    """The fit at a stated location (rows,); who survived only to below it says nothing."""
    with np.errstate(divide="ignore", invalid="ignore"):
        above = np.log(np.exp(y) - location[:, None])
    top = np.where(failed, y, -np.inf).max(axis=1, keepdims=True)
    return fit(np.where(np.isfinite(above), above, top - 700.0), failed, log_area, least=1.0)
