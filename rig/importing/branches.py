"""Loading and unloading: turning points of a coordinate, its noise, and places where it jumps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TURN = 0.1  # of the range: smaller ways back are noise or settling
JUMP = 0.1  # of the range, between two rows: a jump, if it is also many times the usual step
TEAR, TEAR_ROWS = 0.9, 2  # of the stress, lost from row to row after next: a tear


@dataclass(frozen=True)
class Leg:
    """Rows ``start`` to ``stop`` (exclusive) in which the coordinate goes one way: +1 up, -1 down."""

    start: int
    stop: int
    direction: int


def noise_of(values: Array) -> float:
    """Standard deviation of independent noise on a smooth series, from its second differences (median, so that turns
    and steps do not count): a second difference of white noise has six times its variance.
    """
    if values.size < 5:
        return 0.0
    second = np.diff(values, 2)
    return float(1.4826 * np.median(np.abs(second - np.median(second))) / np.sqrt(6.0))


def legs_of(values: Array, turn: float = TURN) -> list[Leg]:
    """Parts between turning points; a way back of less than ``turn`` times the range is no turn.

    >>> [(leg.start, leg.stop, leg.direction) for leg in legs_of(np.array([0.0, 1.0, 2.0, 3.0, 2.0, 1.0, 0.0, 1.0]))]
    [(0, 4, 1), (4, 7, -1), (7, 8, 1)]
    """
    if values.size < 2:
        return []
    allowed = max(turn * float(np.ptp(values)), 6.0 * noise_of(values))
    low = high = 0  # where the lowest and the highest value since the last turn stand
    direction = 0
    turns = []
    for k, value in enumerate(values.tolist()):
        if value > values[high]:
            high = k
        if value < values[low]:
            low = k
        if direction >= 0 and values[high] - value > allowed:
            if direction == 0 and high > 0 and values[high] - values[0] <= allowed:
                high = 0
            turns.append(high)
            direction, low = -1, k
            high = k
        elif direction <= 0 and value - values[low] > allowed:
            turns.append(low)
            direction, high = 1, k
            low = k
    if not turns:
        return [Leg(0, values.size, 1 if values[-1] >= values[0] else -1)]
    # The first turn ends the first leg; it may lie at the very beginning.
    edges = [turn for turn in turns if turn > 0]
    ends = [edge + 1 for edge in edges] + [values.size]
    starts = [0, *ends[:-1]]
    return [
        Leg(start, stop, 1 if values[stop - 1] >= values[start - 1 if start else 0] else -1)
        for start, stop in zip(starts, ends, strict=True)
        if stop > start
    ]


def jumps_of(x: Array, y: Array) -> list[int]:
    """Rows (from 1) before which ``x`` jumps while ``y`` goes on as before: a sensor was set to zero, or slipped.

    A fast move is no jump: ``y`` follows it. What ``y`` is at a place is taken from the rows before the jump.
    """
    step = np.abs(np.diff(x))
    moving = step[step > 0.0]
    if moving.size < 8 or not np.ptp(x) > 0.0:
        return []
    large = np.flatnonzero((step > JUMP * np.ptp(x)) & (step > 10.0 * np.median(moving)))
    found = []
    span = float(np.ptp(y))
    for k in large:
        before = slice(0, k + 1)
        near = np.argsort(np.abs(x[before] - x[k + 1]))[:5]
        expected = float(np.median(y[before][near])) - float(y[k])
        happened = float(y[k + 1] - y[k])
        if abs(expected) > 0.1 * span and abs(happened) < 0.3 * abs(expected):
            found.append(int(k) + 1)
    return found


def steps_of(y: Array, x: Array) -> list[int]:
    """Rows (from 1) before which ``y`` steps by a fifth of its range while ``x`` moves as usual."""
    dy, dx = np.abs(np.diff(y)), np.abs(np.diff(x))
    if dy.size < 8 or not np.ptp(y) > 0.0:
        return []
    usual = max(float(np.median(dx)), 1e-3 * float(np.ptp(x)))
    rise = float(np.median(dy))
    found = np.flatnonzero((dy > 0.2 * np.ptp(y)) & (dy > 10.0 * rise) & (dx < 3.0 * usual))
    return [int(k) + 1 for k in found]


def repeated_rows(*columns: Array) -> NDArray[np.bool_]:
    """Rows that are the same as the row before them in every column."""
    same = np.ones(columns[0].size, dtype=np.bool_)
    same[:1] = False
    for column in columns:
        same[1:] &= column[1:] == column[:-1]
    return same


def tear_of(stress: Array) -> int:
    """The first row after a loss of `TEAR` of the stress within `TEAR_ROWS`; one past the last where there is none."""
    before = stress[:-TEAR_ROWS]
    lost = np.flatnonzero((stress[TEAR_ROWS:] < (1.0 - TEAR) * before) & (before > 0.1 * stress.max()))
    return int(lost[0]) + 1 if lost.size else stress.size


def hysteresis_of(stretch: Array, stress: Array, legs: Sequence[Leg]) -> float | None:
    """Largest difference between the first two branches, in parts of the largest stress."""
    first, second = legs[0], legs[1]
    one = slice(first.start, first.stop)
    two = slice(second.start, second.stop)
    order = np.argsort(stretch[two])
    x, y = stretch[two][order], stress[two][order]
    inside = (stretch[one] >= x[0]) & (stretch[one] <= x[-1])
    largest = float(np.abs(stress).max())
    if not inside.any() or not largest > 0.0:
        return None
    return float(np.abs(stress[one][inside] - np.interp(stretch[one][inside], x, y)).max()) / largest
