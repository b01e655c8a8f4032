"""Roots of many functions at once, each kept between two points where it has different signs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array

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


def enclosed(
    function: Callable[[Array, NDArray[np.intp]], Array],
    low: Array,
    high: Array,
    at_low: Array,
    at_high: Array,
    tolerance: Array,
) -> Array:
    """The same without slopes, by the Illinois method, for functions below zero at ``low``; ends on that side.

    A value that is not a number counts as beyond the root.
    """
    low, high = np.array(low, dtype=float), np.array(high, dtype=float)
    at_low, at_high = np.array(at_low, dtype=float), np.array(at_high, dtype=float)
    side = np.zeros(low.size)
    active = np.flatnonzero(high - low > tolerance)
    for n in range(ROUNDS):
        if active.size == 0:
            break
        left, right, below, above = low[active], high[active], at_low[active], at_high[active]
        width = right - left
        share = np.where(np.isfinite(above) & (above > 0.0) & (below < 0.0), below / (below - above), 0.5)
        # A known sign change is closed in from both sides: a step never leaves less than a part of the tolerance.
        edge = np.minimum(0.5, 0.4 * tolerance[active] / width)
        share = np.clip(np.where(n % 4 == 3, 0.5, share), edge, 1.0 - edge)
        x = left + share * width
        value = function(x, active)
        under = value < 0.0
        last = side[active]
        at_high[active] = np.where(under, np.where(last < 0.0, 0.5 * above, above), value)
        at_low[active] = np.where(under, value, np.where(last > 0.0, 0.5 * below, below))
        low[active], high[active] = np.where(under, x, left), np.where(under, right, x)
        side[active] = np.where(under, -1.0, 1.0)
        active = active[high[active] - low[active] > tolerance[active]]
    return low
