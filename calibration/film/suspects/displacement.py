"""A displacement that is not what the sensor reads."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.film.reduction import Block
from calibration.film.suspects.base import Context, Kind, Shape


def _gain(context: Context) -> Sequence[Shape]:
    return [Shape("displacement gain", context.at_nodes(-context.by["h"] * context.nodes))]


def _axis(context: Context) -> Sequence[Shape]:
    """A beam at an angle t to the stage reads ``h / cos t``."""
    return [Shape("laser off the axis of the stage", context.at_nodes(-context.by["h"] * context.nodes))]


def _bow(context: Context) -> Sequence[Shape]:
    """A reading that is too large in the middle of the way, by one unit, and right at its ends."""
    bow = 4.0 * context.way * (1.0 - context.way)
    return [Shape("bowed characteristic of the displacement sensor", context.at_nodes(-context.by["h"] * bow))]


def _zero(context: Context) -> Sequence[Shape]:
    if "displacement_zero" in context.fitted:
        return []
    return [Shape("zero of the displacement", context.at_nodes(context.by["h"]))]


def _compliance(context: Context) -> Sequence[Shape]:
    if "compliance" in context.fitted:
        return []
    shape = context.at_nodes(-context.force * context.by["h"])
    return [Shape("compliance of the rig that is not taken off", shape)]


def _lag(context: Context) -> Sequence[Shape]:
    """Force read at a time is that of where the disk was one unit before."""
    if "lag" in context.fitted or not context.timed:
        return []

    def late(row: int, block: Block) -> NDArray[np.float64]:
        slope = context.interpolated(context.by["h"], row, block)
        return np.asarray(-context.curves[row].velocity[block.rows] * slope)

    return [Shape("force that is behind the displacement", context.at_samples(late))]


CALIBRATE = "`dea-rig calibrate displacement` in place, along the stage's own axis"
SUSPECTS = [
    Kind("displacement gain", "1", 0, 0.005, CALIBRATE, _gain, part="displacement axis"),
    Kind("laser off the axis of the stage", "1", 1, 0.005, CALIBRATE, _axis, part="displacement axis"),
    Kind("bowed characteristic of the displacement sensor", "m", 0, 2e-5, CALIBRATE, _bow),
    Kind("zero of the displacement", "m", 0, 2e-5, "take the displacement zero in contact", _zero),
    Kind(
        "compliance of the rig that is not taken off",
        "m/N",
        1,
        3e-4,
        "press on a rigid dummy in place of the film; what the displacement sensor reads then is compliance",
        _compliance,
    ),
    Kind("force that is behind the displacement", "s", 0, 5e-3, "`dea-rig calibrate timing`", _lag),
]
