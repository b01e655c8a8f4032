"""A voltage at the film that is less than what the supply reads."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.film.reduction import Block
from calibration.film.suspects.base import Context, Kind, Shape

REMEDY = "measure the voltage at the film's electrodes with a high-impedance probe, at the first and the last sweep"
CONSTANT = "constant loss of voltage"
GROWING = "loss of voltage that grows"


def _constant(context: Context) -> Sequence[Shape]:
    if not context.charged:
        return []
    return [Shape(CONSTANT, context.at_nodes(-context.by["voltage"] * context.voltage[:, None]))]


def _growing(context: Context) -> Sequence[Shape]:
    """With the voltage, with the displacement (electrodes that are stretched), with time."""
    if not context.charged:
        return []
    volts = context.voltage[:, None]
    found = []
    if len(set(np.rint(context.voltage[context.voltage > 0.0]))) > 1:
        share = volts / volts.max()
        found.append(Shape(f"{GROWING} with the voltage", context.at_nodes(-context.by["voltage"] * volts * share)))
    found.append(Shape(f"{GROWING} with stretch", context.at_nodes(-context.by["voltage"] * volts * context.way)))
    if context.timed:
        loss = -context.by["voltage"] * volts

        def later(row: int, block: Block) -> NDArray[np.float64]:
            return np.asarray(context.interpolated(loss, row, block) * context.elapsed(row, block))

        found.append(Shape(f"{GROWING} with time", context.at_samples(later)))
    return found


SUSPECTS = [
    Kind(CONSTANT, "1", 1, 0.02, REMEDY, _constant, part="voltage at the film"),
    Kind(GROWING, "1", 1, 0.1, REMEDY, _growing, key="voltage-loss"),
]
