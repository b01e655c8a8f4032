"""A zero of the force that wanders."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.film.reduction import Block
from calibration.film.suspects.base import Context, Kind, Shape

WARM_UP = 0.25  # part of the run after which a thermal drift has done 63 % of its way
NAME = "drift of the force zero"
REMEDY = "let amplifier and cell warm up; take the zero of the force at the end of the run too"


def _drift(context: Context) -> Sequence[Shape]:
    if not context.timed:
        return []

    def linear(row: int, block: Block) -> NDArray[np.float64]:
        return context.elapsed(row, block)

    def thermal(row: int, block: Block) -> NDArray[np.float64]:
        return np.asarray(-np.expm1(-context.elapsed(row, block) / WARM_UP))

    return [
        Shape(f"{NAME}, linear", context.at_samples(linear)),
        Shape(f"{NAME}, thermal", context.at_samples(thermal)),
    ]


def _offset(context: Context) -> Sequence[Shape]:
    return [] if "force_zero" in context.fitted else [Shape("zero of the force", context.at_nodes(np.ones(1)))]


SUSPECTS = [
    Kind(NAME, "N", 0, 10e-3, REMEDY, _drift, key="zero-drift"),
    Kind("zero of the force", "N", 0, 2e-3, "take the zero of the force before the run", _offset),
]
