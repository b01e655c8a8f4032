"""Curves of bounded size: what the page draws of a run of any length."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

MOST_BINS = 1200
MOST_POINTS = 3000


class Binned:
    """A quantity over time as least and largest value of each bin; when they are too many, two become one.

    Parameters
    ----------
    width : float
        Of a bin at first (s).

    Attributes
    ----------
    generation : int
        Rises whenever bins were joined: whoever has a copy must take it anew.
    """

    def __init__(self, width: float = 0.05) -> None:
        self.width = width
        self.generation = 0
        self._least: list[float] = []
        self._largest: list[float] = []

    def add(self, t: Floats, value: Floats) -> None:
        """Take in samples; those that are not finite are left out."""
        sound = np.isfinite(value) & np.isfinite(t) & (t >= 0.0)
        if not sound.any():
            return
        t, value = t[sound], value[sound]
        while (last := int(float(t.max()) // self.width)) >= MOST_BINS:
            self._join()
        missing = last + 1 - len(self._least)
        if missing > 0:
            self._least += [math.inf] * missing
            self._largest += [-math.inf] * missing
        bins = (t // self.width).astype(np.intp)
        for place in np.unique(bins).tolist():
            mine = value[bins == place]
            self._least[place] = min(self._least[place], float(mine.min()))
            self._largest[place] = max(self._largest[place], float(mine.max()))

    def _join(self) -> None:
        self.width *= 2.0
        self.generation += 1
        if len(self._least) % 2:
            self._least.append(math.inf)
            self._largest.append(-math.inf)
        self._least = [min(pair) for pair in zip(self._least[::2], self._least[1::2], strict=True)]
        self._largest = [max(pair) for pair in zip(self._largest[::2], self._largest[1::2], strict=True)]

    def since(self, generation: int, first: int) -> dict[str, Any]:
        """The bins from ``first`` on, all of them for another generation; an empty bin is None."""
        if generation != self.generation or not 0 <= first <= len(self._least):
            first = 0
        return {
            "generation": self.generation,
            "width": self.width,
            "first": first,
            "least": [_short(value) for value in self._least[first:]],
            "largest": [_short(value) for value in self._largest[first:]],
        }


class Loop:
    """Points in the plane in the order of time, each with a level; when they are too many, every other one goes."""

    def __init__(self) -> None:
        self.generation = 0
        self._every = 1
        self._seen = 0
        self._points: list[tuple[float, float, float]] = []

    def add(self, x: float, y: float, level: float) -> None:
        """Take in a point; one that is not finite is left out."""
        if not all(map(math.isfinite, (x, y, level))):
            return
        if self._seen % self._every == 0:
            self._points.append((x, y, level))
        self._seen += 1
        if len(self._points) > MOST_POINTS:
            self._points = self._points[::2]
            self._every *= 2
            self.generation += 1

    def since(self, generation: int, first: int) -> dict[str, Any]:
        """The points from ``first`` on, all of them for another generation."""
        if generation != self.generation or not 0 <= first <= len(self._points):
            first = 0
        points = [[_short(value) for value in point] for point in self._points[first:]]
        return {"generation": self.generation, "first": first, "points": points}


def _short(value: float) -> float | None:
    """Five digits are more than a screen shows."""
    return float(f"{value:.5g}") if math.isfinite(value) else None
