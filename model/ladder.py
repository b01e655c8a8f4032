"""Newton on a ladder of resolutions: the answer, and an estimate of its error from one rung to the next."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model import ritz
from model.law import Array
from model.output import Derivatives, Extremes, derivatives, extremes
from model.ritz import Grid, Problem

MOST_MODES = 64
MOST_STEPS = 25


@dataclass(slots=True)
class Iterate:
    """States after Newton at one resolution; a failed one has ``ok`` False."""

    c: Array
    w: Array
    lam: Array
    change: Array  # largest relative change of a slope in the last step
    stable: NDArray[np.bool_]
    ok: NDArray[np.bool_]
    steps: NDArray[np.intp]


def first_modes(span: float, tolerance: float) -> int:
    """Modes that bring the truncation error near ``tolerance`` for ``ln(b/a) = span``: a start, not a promise."""
    return max(2, math.ceil(0.6 - math.log10(tolerance) * (0.25 + 0.12 * span)))


def iterate(problem: Problem, grid: Grid, c: Array, w: Array, goal: float) -> Iterate:
    """Newton from ``(c, w)`` until the slopes change by less than ``goal`` (relative); the error is then its square."""
    states = w.shape[1]
    steps = np.zeros(states, dtype=np.intp)
    lam = np.full(states, np.nan)
    for n in range(1, MOST_STEPS + 1):
        at = ritz.evaluate(problem, grid, c, w)
        step = ritz.newton(problem, grid, w, at)
        change = np.abs(step.dw / w).max(axis=0)
        big = change > 2.0
        if big.any():
            short = np.where(big, 2.0 / change, 1.0)
            c = c + short * step.dc
            moved = w + short * step.dw
            w = np.where(moved > 0.2 * w, moved, 0.2 * w)
        else:
            c = c + step.dc
            moved = w + step.dw
            w = np.where(moved > 0.2 * w, moved, 0.2 * w) if change.max() > 0.8 else moved
        done = change <= goal
        lam = step.lam
        steps += 1
        if done.all() or n == MOST_STEPS:
            break
        if n >= 4 and states > 1 and done.mean() > 0.5:
            rest = np.flatnonzero(~done)
            more = iterate(problem.take(rest), grid.take(rest), c[:, rest], w[:, rest], goal)
            c[:, rest], w[:, rest], lam[rest] = more.c, more.w, more.lam
            change[rest] = more.change
            stable = step.stable
            stable[rest] = more.stable
            steps[rest] += more.steps
            return Iterate(c, w, lam, change, stable, change <= goal, steps)
    return Iterate(c, w, lam, change, step.stable, done, steps)


@dataclass(slots=True)
class Answer:
    """What one rung of the ladder settles: which states, and everything about them."""

    index: NDArray[np.intp]
    modes: int
    c: Array
    w: Array
    lam: Array
    error: Array
    steps: NDArray[np.intp]
    extremes: Extremes
    derivatives: Derivatives | None


@dataclass(slots=True)
class Failed:
    """States for which Newton from the cold start does not settle."""

    index: NDArray[np.intp]
    steps: NDArray[np.intp]


def climb(
    problem: Problem, tolerance: float, *, sensitivities: bool, start: tuple[int, Array, Array] | None = None
) -> tuple[list[Answer], Failed]:
    """Solve a block of states to ``tolerance`` (relative, force), each with the resolution it needs."""
    states = len(problem.span)
    index = np.arange(states)
    total = np.zeros(states, dtype=np.intp)
    answers: list[Answer] = []
    lost: list[NDArray[np.intp]] = []
    goal = min(0.03, max(1e-6, math.sqrt(0.3 * tolerance)))
    modes = start[0] if start else first_modes(float(problem.span.max()), tolerance)
    previous: Array | None = None
    c = w = np.empty((0, 0))
    while True:
        grid = Grid.lay(modes, problem.span)
        if previous is None:
            c, w = (start[1], start[2]) if start else ritz.guess(problem, grid)
        else:
            c = np.concatenate((c, np.zeros((modes - c.shape[0], c.shape[1]))))
            w = ritz.transfer(w.shape[0], grid.table.points) @ w
        result = iterate(problem, grid, c, w, goal)
        total[index] += result.steps
        c, w, lam = result.c, result.w, result.lam
        ok = result.ok & result.stable & (lam > 0.0)
        if previous is None:
            error = np.full(len(index), np.inf)
        else:
            error = np.abs(lam - previous) / np.abs(lam) + result.change**2
        settled = ok & (error <= tolerance)
        if settled.any():
            keep = np.flatnonzero(settled)
            if len(keep) == len(index):
                answers.append(_answer(problem, grid, c, w, lam, sensitivities))
            else:
                part, laid = problem.take(keep), grid.take(keep)
                answers.append(_answer(part, laid, c[:, keep], w[:, keep], lam[keep], sensitivities))
            answers[-1].index = index[keep]
            answers[-1].error = error[keep]
            answers[-1].steps = total[index[keep]]
        lost.append(index[~ok])
        rest = np.flatnonzero(ok & ~settled)
        if len(rest) == 0:
            break
        if modes >= MOST_MODES:
            lost.append(index[rest])
            break
        if len(rest) < len(index):
            problem, index = problem.take(rest), index[rest]
            c, w, lam = c[:, rest], w[:, rest], lam[rest]
        previous = lam
        modes = min(MOST_MODES, modes + 2 if modes < 8 else math.ceil(1.35 * modes))
    failed = np.concatenate(lost)
    return answers, Failed(failed, total[failed])


def _answer(problem: Problem, grid: Grid, c: Array, w: Array, lam: Array, sensitivities: bool) -> Answer:
    at = ritz.evaluate(problem, grid, c, w)
    slopes = None
    if sensitivities:
        step = ritz.newton(problem, grid, w, at, tangent=True)
        assert step.tangent is not None
        slopes = derivatives(problem, grid, w, at, lam, step.tangent)
    empty = np.empty(0, dtype=np.intp)
    return Answer(empty, grid.table.modes, c, w, lam, np.empty(0), empty, extremes(problem, grid, at, lam), slopes)
