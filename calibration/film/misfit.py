"""Which known imperfection the residuals look like.

The overall chi-square spreads its attention over all shapes that a misfit can have, and a small error of one known kind
hides in it although it biases the result. So the residuals are also held against the shape of each usual suspect: with
``d`` the change of the weighted residuals by one unit of it, and ``P`` the projection off everything that the fitted
parameters can do, its amplitude is ``a = -d P r / |P d|^2`` with standard uncertainty ``1/|P d|`` (a score test).

Gains and dimensions are not fitted, and what their stated uncertainties do to the data is no imperfection: it counts
as a part of the noise, so that the test asks for what lies beyond. With ``D`` those changes, one column for each
standard uncertainty, the products above are taken with ``C^-1 = (1 + P D D^T P)^-1``.

What the parameters can do for themselves no test finds (Neyman & Pearson 1933): an imperfection that looks much like
another stiffness or permittivity biases them before it shows. So each suspect also tells from which size on it would
be reported, and what it does to the result until then. Suspects that explain the residuals equally well are named
together; one whose size would be impossible (a film that pushes) is not proposed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from calibration.film.problem import Problem
from calibration.film.result import SIGNIFICANT, Suspect
from calibration.film.suspects.base import Kind
from calibration.film.suspects.registry import kinds
from calibration.film.systematic import systematic_rows

Array = NDArray[np.float64]

ALMOST_SURE = 1.6449  # standard deviations that 95 of 100 stay below
VISIBLE = 1e-3  # share of a shape that the parameters must leave over; less is round-off and interpolation
# Chi-square by which one suspect must explain the residuals better than another one to be told from it: at least, and
# as a part of what it explains (shapes are of first order).
TELL_APART, TELL_PART = 9.2, 0.05
# Times its usual size. An error that the budget counts is not much larger on any rig, and shapes of first order say
# little of it there: where it would show only beyond, it does not show.
FAR = 5.0


@dataclass(frozen=True, eq=False)
class _Seen:
    """A suspect, its shape, and how much of it the parameters leave over."""

    kind: Kind
    name: str
    shape: Array
    amplitude: float
    uncertainty: float  # inf where the parameters do all that it does


class Left:
    """What the fit leaves over of residual rows, and ``C^-1`` there, with the errors that are stated and not fitted."""

    def __init__(self, problem: Problem, x: Array, free: NDArray[np.bool_]) -> None:
        base, s, _ = np.linalg.svd(problem.jacobian(x)[:, free], full_matrices=False)
        self.base = base[:, s > 1e-10 * s[0]]
        self.residual = problem.residual(x)
        stated = np.array(list(systematic_rows(problem, x).values())).reshape(-1, self.residual.size).T
        self.columns = self.of(stated)  # (residuals, errors)
        self.inner = np.linalg.inv(np.eye(stated.shape[1]) + self.columns.T @ self.columns)

    def of(self, rows: Array) -> Array:
        """Rows without what the parameters can do."""
        return np.asarray(rows - self.base @ (self.base.T @ rows))

    def weighed(self, rows: Array) -> Array:
        """``C^-1`` times rows that the parameters leave over (Woodbury)."""
        return np.asarray(rows - self.columns @ (self.inner @ (self.columns.T @ rows)))


def beyond(problem: Problem, x: Array, free: NDArray[np.bool_]) -> float:
    """Chi-square of the residuals beyond what gains and dimensions do within their stated uncertainties."""
    left = Left(problem, x, free)
    visible = left.of(left.residual)
    return float(visible @ left.weighed(visible))


def suspects(problem: Problem, x: Array, free: NDArray[np.bool_]) -> list[Suspect]:
    """The imperfections that this data could show, most probable first."""
    left, context = Left(problem, x, free), problem.context(x)
    found = []
    for kind in kinds():
        if kind.key and kind.key in context.fitted:
            continue
        for shape in kind.shapes(context):
            visible = left.of(shape.rows)
            size, whole = float(np.linalg.norm(visible)), float(np.linalg.norm(shape.rows))
            if not math.isfinite(size) or whole == 0.0:
                continue
            shown = size > VISIBLE * whole
            weighed = left.weighed(visible)
            square = float(visible @ weighed)
            amplitude = -float(weighed @ left.residual) / square if shown else 0.0
            found.append(_Seen(kind, shape.name, shape.rows, amplitude, square**-0.5 if shown else math.inf))
    count = max(1, sum(math.isfinite(one.uncertainty) for one in found))
    return sorted((_judged(one, count) for one in found), key=lambda one: (one.probability, one.shows_from))


def _judged(one: _Seen, count: int) -> Suspect:
    """A suspect with its probability by chance, counting that ``count`` of them were looked at."""
    sides = 1.0 if one.kind.sign else 2.0
    deviations = one.amplitude / one.uncertainty
    if one.kind.sign == 0:
        deviations = abs(deviations)
    chance = 0.5 * sides * math.erfc(deviations / math.sqrt(2.0))
    reported = NormalDist().inv_cdf(1.0 - SIGNIFICANT / sides / count)
    shows_from = (reported + ALMOST_SURE) * one.uncertainty
    most = FAR * one.kind.usual if one.kind.part else math.inf
    return Suspect(
        name=one.name,
        family=one.kind.name,
        key=one.kind.key,
        amplitude=one.amplitude,
        uncertainty=one.uncertainty,
        unit=one.kind.unit,
        probability=min(1.0, count * chance),
        shows_from=shows_from if shows_from <= most else math.inf,
        usual=one.kind.usual,
        possible=one.kind.sign == 0 or one.amplitude >= 0.0,
        part=one.kind.part,
        remedy=one.kind.remedy,
        shape=one.shape,
    )


def likely(found: Sequence[Suspect]) -> list[Suspect]:
    """Those that the residuals look like and that these data cannot tell apart, best first; empty if there are none."""
    able = [one for one in found if one.possible and math.isfinite(one.uncertainty)]
    if not any(one.significant for one in able):
        return []
    gain = {id(one): (one.amplitude / one.uncertainty) ** 2 for one in able}
    most = max(gain.values())
    least = most - max(TELL_APART, TELL_PART * most)
    return sorted((one for one in able if gain[id(one)] >= least), key=lambda one: -gain[id(one)])
