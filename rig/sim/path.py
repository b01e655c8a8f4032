"""A quantity that moves with piecewise constant acceleration: the stage's position, the supply's output voltage."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable

HISTORY_S = 5.0  # what is older than this before a new command is forgotten


class Path:
    """x(t) in pieces ``x = x0 + v0 (t - t0) + a/2 (t - t0)^2``; the last piece lasts for ever.

    Parameters
    ----------
    x : float
        Where it stands from the beginning of time.

    Attributes
    ----------
    changes : int
        How often it was told to go elsewhere.
    """

    def __init__(self, x: float) -> None:
        self._t = [-math.inf]
        self._x = [x]
        self._v = [0.0]
        self._a = [0.0]
        self.changes = 0

    @property
    def end(self) -> float:
        """From when on it moves no more with the last command."""
        return self._t[-1]

    def at(self, t: float) -> tuple[float, float]:
        """Position and velocity at time ``t``."""
        i = max(bisect_right(self._t, t) - 1, 0)
        dt = t - self._t[i] if i else 0.0
        return self._x[i] + (self._v[i] + 0.5 * self._a[i] * dt) * dt, self._v[i] + self._a[i] * dt

    def next_bend(self, t: float) -> float:
        """When after ``t`` it begins its next piece; inf if never."""
        i = bisect_right(self._t, t)
        return self._t[i] if i < len(self._t) else math.inf

    def bends_at(self, t: float) -> bool:
        """Whether a piece begins at ``t``."""
        i = bisect_right(self._t, t) - 1
        return i > 0 and self._t[i] == t

    def follow(self, t: float, pieces: Iterable[tuple[float, float]]) -> None:
        """From time ``t`` on go through ``pieces`` (duration, acceleration), then stand still.

        The velocity is continuous: the pieces must end at a standstill, which is then exact.
        """
        x, v = self.at(t)
        self._cut(t)
        for duration, acceleration in pieces:
            if duration <= 0:
                continue
            self._append(t, x, v, acceleration)
            x += (v + 0.5 * acceleration * duration) * duration
            v += acceleration * duration
            t += duration
        self._append(t, x, 0.0, 0.0)

    def ramp(self, t: float, target: float, rate: float) -> None:
        """From time ``t`` on go to ``target`` at constant ``rate`` > 0, then stand still there."""
        x, _ = self.at(t)
        self._cut(t)
        if x != target:
            self._append(t, x, math.copysign(rate, target - x), 0.0)
            t += abs(target - x) / rate
        self._append(t, target, 0.0, 0.0)

    def rest(self, t: float, x: float) -> None:
        """Stand at ``x`` from time ``t`` on."""
        self._cut(t)
        self._append(t, x, 0.0, 0.0)

    def _cut(self, t: float) -> None:
        self.changes += 1
        while len(self._t) > 1 and self._t[-1] >= t:
            for column in (self._t, self._x, self._v, self._a):
                column.pop()
        while len(self._t) > 1 and self._t[1] < t - HISTORY_S:
            for column in (self._t, self._x, self._v, self._a):
                del column[0]
        # What is left of the oldest piece reaches back for ever; it must be a rest.
        if self._v[0] or self._a[0]:
            self._t.insert(0, -math.inf)
            self._x.insert(0, self._x[0])
            self._v.insert(0, 0.0)
            self._a.insert(0, 0.0)
        else:
            self._t[0] = -math.inf

    def _append(self, t: float, x: float, v: float, a: float) -> None:
        self._t.append(t)
        self._x.append(x)
        self._v.append(v)
        self._a.append(a)


def trapezoid(x: float, v: float, target: float, speed: float, acceleration: float) -> list[tuple[float, float]]:
    """Pieces (duration, acceleration) from position ``x`` and velocity ``v`` to rest at ``target``.

    Time-optimal with |velocity| <= ``speed`` and |acceleration| = ``acceleration``: brake or speed up to the cruising
    velocity, cruise, brake. A start that is too fast to stop in time overshoots and comes back.
    """
    stop_at = x + v * abs(v) / (2 * acceleration)
    sign = 1.0 if target >= stop_at else -1.0
    d, u = sign * (target - x), sign * v  # seen along the way to go
    peak = math.sqrt(max(acceleration * d + 0.5 * u * u, 0.0))
    cruise = 0.0
    if peak > speed:
        # Way left at full speed, after the change from u to speed and the final braking.
        change = (speed * speed - u * u) / (2 * acceleration) * (1.0 if u <= speed else -1.0)
        cruise = max(d - change - speed * speed / (2 * acceleration), 0.0) / speed
        peak = speed
    first = acceleration if peak >= u else -acceleration
    return [
        (abs(peak - u) / acceleration, sign * first),
        (cruise, 0.0),
        (peak / acceleration, -sign * acceleration),
    ]
