"""Roots of many functions at once, each kept between two points where it has different signs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from model.law import Array

Function = Callable[[Array, NDArray[np.intp]], tuple[Array, Array]]
ROUNDS = 60


def bracketed(
    function: Function, low: Array, high: Array, rising: NDArray[np.bool_], tolerance: Array, start: Array | None = None
) -> Array:
    """Newton's method, halving where a step leaves the bracket, leaves it slowly wide, or meets no number.

    ``function(x, which)`` gives values and slopes of the functions numbered ``which``; slopes may be NaN. ``rising``
    says which are below zero at ``low``. Ends when a bracket, or a step and the value it leads to, is within
    ``tolerance``. A value that is not a number counts as beyond the root, on the side of ``high``.
    """
    low, high = np.array(low, dtype=float), np.array(high, dtype=float)
    x = 0.5 * (low + high) if start is None else np.clip(start, low, high)
    x = np.where((x > low) & (x < high), x, 0.5 * (low + high))
    active = np.arange(x.size)
    width = high - low
    for n in range(ROUNDS):
        value, slope = function(x[active], active)
        known = np.isfinite(value)
        below = known & ((value < 0.0) == rising[active])
        low[active] = np.where(below, x[active], low[active])
        high[active] = np.where(below, high[active], x[active])
        with np.errstate(all="ignore"):
            new = x[active] - value / slope
        middle = 0.5 * (low[active] + high[active])
        inside = np.isfinite(new) & (new >= low[active]) & (new <= high[active])
        if n % 4 == 3:  # a bracket that has not shrunk by half in four rounds is halved
            inside &= high[active] - low[active] < 0.5 * width[active]
            width[active] = high[active] - low[active]
        new = np.where(inside, new, middle)
        step = np.abs(new - x[active])
        x[active] = np.where(known & (value == 0.0), x[active], new)
        done = (high[active] - low[active] <= tolerance[active]) | (inside & (step <= tolerance[active]))
        done |= known & (value == 0.0)
        active = active[~done]
        if active.size == 0:
            break
    return x
