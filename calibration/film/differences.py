"""What dimensions of several specimens have in common, and how they differ.

Errors ``w`` of K parts with equal correlations c are a common error of variance ``c + (1 - c)/K`` and K - 1 contrasts
of variance 1 - c. Contrasts are fitted; the common error no data can tell from another film.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.film.assumed import UNKNOWN_CORRELATION
from calibration.film.curve import Curve

Array = NDArray[np.float64]

# Dimensions of a specimen, and the field of a curve with their relative standard uncertainty.
DIMENSIONS = {
    "thickness": "thickness_uncertainty",
    "prestretch": "prestretch_uncertainty",
    "disk_radius": "disk_radius_uncertainty",
    "ring_radius": "ring_radius_uncertainty",
}


def parts(curves: Sequence[Curve], dimension: str) -> list[str]:
    """Which parts (films, disks, rings) have errors of their own of a dimension; see `Curve.part`."""
    return list(dict.fromkeys(curve.part(dimension) for curve in curves))


def _correlation(curves: Sequence[Curve], dimension: str) -> float:
    """Of the errors of a dimension of two parts: 0 where each film names its batch, else unknown."""
    known = dimension == "thickness" and all(curve.batch for curve in curves)
    return 0.0 if known else UNKNOWN_CORRELATION


def common(curves: Sequence[Curve], dimension: str) -> float:
    """Standard deviation of what the errors of a dimension have in common, in units of that of one part."""
    c, count = _correlation(curves, dimension), len(parts(curves, dimension))
    return math.sqrt(c + (1.0 - c) / count)


def contrasts(curves: Sequence[Curve], dimension: str) -> Array:
    """What the contrasts of a dimension do to each part, in units of its uncertainty; (K, K - 1)."""
    count = len(parts(curves, dimension))
    base = np.linalg.qr(np.column_stack((np.ones(count), np.eye(count)[:, : count - 1])))[0][:, 1:]
    found: Array = base * math.sqrt(1.0 - _correlation(curves, dimension))
    return found


def contrast_weights(curves: Sequence[Curve], dimension: str) -> list[tuple[float, ...]]:
    """By how much (relative) one prior of each contrast changes the dimension of every curve; empty without any."""
    which = parts(curves, dimension)
    sizes = [getattr(curve, DIMENSIONS[dimension]) for curve in curves]
    if len(which) == 1 or not any(sizes):
        return []
    own = [which.index(curve.part(dimension)) for curve in curves]
    return [
        tuple(float(size * mode[group]) for size, group in zip(sizes, own, strict=True))
        for mode in contrasts(curves, dimension).T
    ]
