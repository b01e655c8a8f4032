r"""Whether the force follows the film: a plausibility watch, with a band so wide that only nonsense is outside.

While the film moves at one voltage, the measured force :math:`F` goes with the model's :math:`M` at the measured
displacement as :math:`F = a + b M`. Its slope :math:`b`, by least squares over the samples since it was last judged,
must lie within :math:`1/k` and :math:`k`, with :math:`k` of ``limits.force_model_factor``; of a film that takes time
the upper bound is as much higher as it is stiffer when pushed in no time. It is judged as soon as the noise
:math:`\sigma` cannot feign a film: when its standard error :math:`\sigma / \sqrt{\sum (M - \bar M)^2}` is
below :math:`1 / 4k`. A load cell that is frozen but for its noise has the slope 0; a blocked cell, a film that has torn
and a disk that is not where the approach believes it to be are found as well.
"""

from __future__ import annotations

import math

import numpy as np

from model.membrane.solve import solve, solve_many
from rig.base.errors import FaultError
from rig.safety.limits import FLAT_M, Limits, Line
from rig.scene.scene import Scene

ERRORS = 4.0  # standard errors of the slope that 1/k must be away from 0
UNKNOWN_PART, LEAST_PART = 1e-3, 1e-4  # of limits.force_N: noise of a sample before it was measured, and at least
SAME_V, SAME_PART = 50.0, 0.05  # a voltage within this is the same one
GRID = 17  # displacements at which the model is asked beforehand


class ForceFollows:
    """Judges force samples against the model of the scene's film."""

    def __init__(self, scene: Scene, limits: Limits) -> None:
        self._specimen = scene.specimen.specimen()
        self._factor = scene.limits.force_model_factor
        self._limit = limits.force.high
        self._noise = UNKNOWN_PART * self._limit
        h = np.linspace(FLAT_M, max(limits.displacement.high, 2 * FLAT_M), GRID)
        force = solve_many(self._specimen, h, 0.0).force
        known = np.isfinite(force)
        self._h, self._model = h[known], force[known]
        self._line = Line(self._h, self._model) if self._h.size > 1 else None
        self._stiffer = self._at_once()
        self._volts = 0.0
        self.restart()

    def _at_once(self) -> float:
        """How much stiffer the film is where it is pushed in no time, at most: 1 of an elastic one."""
        if not self._specimen.material.branches or self._h.size < 2:
            return 1.0
        from model.membrane.history import at_once

        slopes = np.diff(at_once(self._specimen, self._h, 0.0, tolerance=1e-4)) / np.diff(self._model)
        return max(1.0, float(np.nanmax(slopes, initial=1.0)))

    def learn(self, noise: float) -> None:
        """Take the standard deviation (N) of one sample of the unloaded sensor."""
        self._noise = max(noise, LEAST_PART * self._limit)

    def restart(self) -> None:
        """The film is not touched, or under another voltage: what was seen before says nothing."""
        self._count = 0
        self._mean_f = self._mean_m = self._mm = self._mf = 0.0  # means; sums of squares and products about them
        self._between = (math.inf, -math.inf)  # displacements

    def sample(self, force: float, h: float, volts: float) -> None:
        """Judge one good sample: the force (N) with the disk at ``h`` (m) and ``volts`` on.

        Raises
        ------
        FaultError
            The force has not followed the film.
        """
        if self._line is None or not (math.isfinite(force) and math.isfinite(h) and math.isfinite(volts)):
            return
        if abs(volts - self._volts) > max(SAME_V, SAME_PART * self._volts):
            self.restart()
            self._volts = volts
        model = self._line(h)
        self._count += 1
        away = model - self._mean_m
        self._mean_m += away / self._count
        self._mean_f += (force - self._mean_f) / self._count
        self._mm += away * (model - self._mean_m)
        self._mf += away * (force - self._mean_f)
        self._between = min(h, self._between[0]), max(h, self._between[1])
        if math.sqrt(self._mm) >= ERRORS * self._factor * self._noise:
            self._judge(self._mf / self._mm)
            self.restart()

    def _judge(self, slope: float) -> None:
        if self._holds(slope):
            return
        low, high = self._between
        if self._volts > SAME_V:  # ask what the film does under this voltage, and believe it where there is an answer
            states = [solve(self._specimen, max(h, FLAT_M), volts) for volts in (0.0, self._volts) for h in (low, high)]
            at_rest, live = (b.force - a.force for a, b in (states[:2], states[2:]))
            if (
                not all(state.answered for state in states)
                or not live > 0.5 * at_rest
                or self._holds(slope * at_rest / live)
            ):
                return
        k = self._factor
        raise FaultError(
            f"force: it does not follow the film. Between {low * 1e3:.2f} and {high * 1e3:.2f} mm it changed by "
            f"{slope:.2g} times what the model says; allowed are {1 / k:.2g} to {k:g} times "
            f"(limits.force_model_factor = {k:g}). The load cell is frozen or blocked, the disk does not touch the "
            "film, the film has torn, or it is not the film of [specimen]."
        )

    def _holds(self, slope: float) -> bool:
        return 1 / self._factor <= slope <= self._factor * self._stiffer
