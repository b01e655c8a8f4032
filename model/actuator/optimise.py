"""The best actuator within bounds: largest stroke, largest work, and the front between them; robust if asked.

A global start (a scrambled Sobol sequence, solved in batches on any executor) is followed by a local search with the
gradients of `model.actuator.sensitivity` (SLSQP). The front is the largest work for a stroke of at least so much, step
by step.

A robust optimum holds its voltage back and counts only on what is sure. With the material's parameters uncertain
(covariance ``S``) the end voltage is lowered by ``k u(V)``, so that a film somewhat softer or more permittive does not
break down, and stroke and work there are counted less ``k u``; ``u^2 = g S g`` with the gradient ``g``, to first order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from model.actuator.design import Point
from model.actuator.sensitivity import changed, gradient, read, strokes_of
from model.actuator.stroke import Criteria, Strokes
from model.arrays import Array

Objective = Literal["stroke", "work"]
TOLERANCE = 1e-8
TASK = 16  # designs of the global start solved together
BEST = 2  # of them, from which a local search begins
STEPS = 15
CLOSE = 1e-5  # of the objective, relative: where a search ends
DIFFERENCE = 1e-4  # of a variable's range, for gradients of robust objectives
Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Uncertain:
    """Covariance of material parameters ("mu1", "alpha1", ..., "eps_r"); how many standard deviations to keep off."""

    names: tuple[str, ...]
    covariance: Array
    coverage: float = 2.0

    def deviation(self, by: dict[str, float]) -> float:
        """Standard uncertainty of what has these derivatives."""
        slope = np.array([by[name] for name in self.names])
        return math.sqrt(max(float(slope @ self.covariance @ slope), 0.0))


@dataclass(frozen=True)
class Task:
    """What to optimise.

    Parameters
    ----------
    point : an actuator; what is not varied is as in it
    bounds : lowest and highest value by name of the variable (`model.actuator.sensitivity.read`), SI
    uncertain : the material's uncertainty, for a robust optimum
    """

    point: Point
    bounds: dict[str, tuple[float, float]]
    uncertain: Uncertain | None = None

    def __post_init__(self) -> None:
        if not self.bounds:
            raise ValueError("nothing to vary: give bounds of at least one variable")
        for name, (low, high) in self.bounds.items():
            read(self.point, name)
            if not (math.isfinite(low) and low < high < math.inf):
                raise ValueError(f"bounds of {name}: {low!r} to {high!r}; they must rise and be finite")

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.bounds)

    def at(self, shares: Array) -> Point:
        """The actuator at shares 0 to 1 of the bounds."""
        values = {
            name: low + float(share) * (high - low)
            for (name, (low, high)), share in zip(self.bounds.items(), shares, strict=True)
        }
        return changed(self.point, values)


@dataclass(frozen=True)
class Sure:
    """What can be counted on: voltage held back (V), and stroke (m) and work (J) there less their uncertainty."""

    voltage: float
    stroke: float
    work: float


@dataclass(frozen=True)
class Design:
    """One actuator and what it does (SI); ``sure`` where a robust optimum is asked for.

    ``slope`` holds the derivatives of stroke and work with respect to the shares of the bounds, where asked for.
    """

    shares: tuple[float, ...]
    values: dict[str, float]
    stroke: float
    work: float
    voltage: float
    limit: int
    stroke_error: float
    sure: Sure | None = None
    slope: dict[str, Array] = field(default_factory=dict)

    def counted(self, objective: Objective) -> float:
        """What counts: the sure value where there is one; 0 where the actuator has no stroke."""
        value: float = getattr(self if self.sure is None else self.sure, objective)
        return value if math.isfinite(value) else 0.0


def evaluate(task: Task, shares: Sequence[Array], slopes: bool = False) -> list[Design]:
    """Designs at shares of the bounds, solved together."""
    points = [task.at(x) for x in shares]
    found = strokes_of(points, TOLERANCE)
    width = np.array([high - low for low, high in task.bounds.values()])
    designs = []
    for i, (x, point) in enumerate(zip(shares, points, strict=True)):
        slope = {}
        if slopes:
            own = gradient(point, found, i, task.names)
            for name, by in (("stroke", own.stroke), ("work", own.work)):
                slope[name] = np.nan_to_num(np.array([by[key] for key in task.names]) * width)
        designs.append(
            Design(
                shares=tuple(float(share) for share in x),
                values={name: read(point, name) for name in task.names},
                stroke=float(found.stroke[i]),
                work=float(found.work[i]),
                voltage=float(found.voltage[i]),
                limit=int(found.limit[i]),
                stroke_error=float(found.error_estimate[i]),
                sure=None if task.uncertain is None else _sure(task.uncertain, point, found, i),
                slope=slope,
            )
        )
    return designs


def _sure(uncertain: Uncertain, point: Point, found: Strokes, index: int) -> Sure:
    """Hold the voltage back, and count what is left there."""
    by = gradient(point, found, index, uncertain.names)
    voltage = float(found.voltage[index]) - uncertain.coverage * uncertain.deviation(by.voltage)
    if not voltage > 0.0:
        return Sure(0.0, 0.0, 0.0)
    held = replace(point, criteria=Criteria(voltage=voltage))
    there = strokes_of([held], TOLERANCE)
    by = gradient(held, there, 0, uncertain.names)
    return Sure(
        voltage,
        float(there.stroke[0]) - uncertain.coverage * uncertain.deviation(by.stroke),
        float(there.work[0]) - uncertain.coverage * uncertain.deviation(by.work),
    )


@dataclass(frozen=True)
class Optimum:
    """The best designs found.

    Attributes
    ----------
    best : by objective
    front : from the largest work to the largest stroke, none beaten in both by another
    tried : designs of the global start
    solved : designs solved in all
    """

    best: dict[Objective, Design]
    front: list[Design]
    tried: list[Design]
    solved: int


def optimise(
    task: Task,
    *,
    start: int = 64,
    front: int = 7,
    seed: int = 1,
    executor: Executor | None = None,
    progress: Progress = lambda share, what: None,
) -> Optimum:
    """Largest stroke, largest work, and ``front`` designs between them."""
    from scipy.stats import qmc

    grid = qmc.Sobol(len(task.names), seed=seed).random(start)
    blocks = [list(grid[first : first + TASK]) for first in range(0, start, TASK)]
    tasks = [task] * len(blocks)
    tried: list[Design] = []
    for some in map(evaluate, tasks, blocks) if executor is None else executor.map(evaluate, tasks, blocks):
        tried += some
        progress(0.4 * len(tried) / start, "global start")
    search = _Search(task)
    best: dict[Objective, Design] = {}
    for k, objective in enumerate(_OBJECTIVES):
        progress(0.4 + 0.2 * k, f"largest {objective}")
        order = sorted(tried, key=lambda design: -design.counted(objective))
        for design in order[:BEST]:
            search.maximise(objective, np.array(design.shares))
    # Where two limits meet the best is at a kink, where a search may pass it: every design counts that was met.
    for objective in _OBJECTIVES:
        best[objective] = max([*tried, *search.met], key=lambda design: design.counted(objective))
    low, high = best["work"].counted("stroke"), best["stroke"].counted("stroke")
    begin = np.array(best["work"].shares)
    for k in range(1, front + 1):
        progress(0.8 + 0.2 * (k - 1) / max(front, 1), "front")
        least = low + (high - low) * k / (front + 1)
        near = begin + (np.array(best["stroke"].shares) - begin) * k / (front + 1)
        search.maximise("work", near, least=least)
    met = [*tried, *search.met]
    return Optimum(best, undominated(met, front + 2), tried, len(tried) + search.solved)


_OBJECTIVES: tuple[Objective, Objective] = ("stroke", "work")


def undominated(designs: Sequence[Design], most: int) -> list[Design]:
    """Those that no other beats in stroke and work, by rising stroke; of more than ``most``, some at like distances."""
    front: list[Design] = []
    for design in sorted(designs, key=lambda d: (-d.counted("stroke"), -d.counted("work"))):
        if not front or design.counted("work") > front[-1].counted("work"):
            front.append(design)
    front.reverse()
    if len(front) <= most:
        return front
    strokes = np.array([design.counted("stroke") for design in front])
    wanted = np.linspace(strokes[0], strokes[-1], most)
    return [front[k] for k in np.unique([int(np.abs(strokes - one).argmin()) for one in wanted])]


class _Search:
    """Local searches; ``met`` are the designs that they evaluated."""

    def __init__(self, task: Task) -> None:
        self.task, self.solved = task, 0
        self.met: list[Design] = []
        self._known: dict[tuple[float, ...], Design] = {}

    def design(self, shares: Array) -> Design:
        """The design with its slopes."""
        key = tuple(float(share) for share in np.clip(shares, 0.0, 1.0))
        if key not in self._known:
            if self.task.uncertain is None:
                self._known[key] = evaluate(self.task, [np.array(key)], slopes=True)[0]
                self.solved += 1
            else:
                self._known[key] = self._by_differences(np.array(key))
            self.met.append(self._known[key])
        return self._known[key]

    def _by_differences(self, at: Array) -> Design:
        """Robust objectives hold gradients themselves: theirs are differences, all solved together."""
        steps = np.where(at > 0.5, -DIFFERENCE, DIFFERENCE)
        here, *others = evaluate(self.task, [at, *(at + step for step in np.diag(steps))])
        self.solved += 1 + len(others)
        slope: dict[str, Array] = {
            name: np.array([one.counted(name) - here.counted(name) for one in others]) / steps for name in _OBJECTIVES
        }
        return replace(here, slope=slope)

    def maximise(self, objective: Objective, begin: Array, least: float | None = None) -> None:
        """SLSQP from ``begin``, with a stroke of at least ``least``."""
        import scipy.optimize

        minimize: Any = scipy.optimize.minimize
        first = self.design(begin)
        scale = {name: max(first.counted(name), 1e-30) for name in _OBJECTIVES}
        constraints = []
        if least is not None:
            constraints = [
                {
                    "type": "ineq",
                    "fun": lambda x: (self.design(x).counted("stroke") - least) / scale["stroke"],
                    "jac": lambda x: self.design(x).slope["stroke"] / scale["stroke"],
                }
            ]
        minimize(
            lambda x: -self.design(x).counted(objective) / scale[objective],
            np.clip(begin, 0.0, 1.0),
            jac=lambda x: -self.design(x).slope[objective] / scale[objective],
            method="SLSQP",
            bounds=[(0.0, 1.0)] * len(begin),
            constraints=constraints,
            options={"maxiter": STEPS, "ftol": CLOSE},
        )
