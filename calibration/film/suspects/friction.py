"""Force that differs between loading and unloading, whatever the speed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.film.reduction import Block
from calibration.film.suspects.base import Context, Kind, Shape

FRICTION = "friction in the guide of the disk"
HYSTERESIS = "hysteresis: loading above unloading"


def _both_ways(context: Context) -> bool:
    ways = {block.way for block in context.blocks}
    return 1 in ways and -1 in ways


def _friction(context: Context) -> Sequence[Shape]:
    def against(row: int, block: Block) -> NDArray[np.float64]:
        return np.full(block.rows.size, float(block.way))

    return [Shape(FRICTION, context.at_samples(against))] if _both_ways(context) else []


def _hysteresis(context: Context) -> Sequence[Shape]:
    def more(row: int, block: Block) -> NDArray[np.float64]:
        return np.asarray(block.way * context.interpolated(context.force, row, block))

    return [Shape(HYSTERESIS, context.at_samples(more))] if _both_ways(context) else []


SUSPECTS = [
    Kind(
        FRICTION,
        "N",
        1,
        3e-3,
        "move the disk without a film, up and down; what the force reads then is friction",
        _friction,
    ),
    Kind(HYSTERESIS, "1", 1, 0.02, "give the curves with their times, and one more at another speed", _hysteresis),
]
