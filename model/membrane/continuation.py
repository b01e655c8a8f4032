"""Following a state from rest, so that the branch is the one an experiment reaches: first h at 0 V, then V at h."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.membrane import convexity, refinement, ritz, tension_field
from model.membrane.refinement import Iterate
from model.membrane.ritz import Grid, Problem, State

LEAST_STEP = 1e-5  # of the leg; a path that cannot be followed in such steps has ended
MOST_STEPS = 60  # of a path: one that needs more creeps up to its end
FIRST_HEIGHT = 0.02  # share of h where the path begins
CORRECTION = 0.3  # largest relative change of a slope by the corrector: more would be a jump to another branch
SOFT = 0.1  # a path that ends with its lowest eigenvalue below this share of the first one has met a limit point


@dataclass(slots=True)
class Trace:
    """The end of the paths."""

    grid: Grid
    state: State
    reached: NDArray[np.bool_]
    progress: Array  # where they ended: 0 to 1 raises the disk, 1 to 2 the voltage
    limit: NDArray[np.bool_]  # a limit point is where the path ends, or close
    steps: NDArray[np.intp]


def at(problem: Problem, index: NDArray[np.intp], progress: Array) -> Problem:
    """The problem at a place of the path: 0 to 1 raises the disk, 1 to 2 the voltage."""
    part = problem.take(index)
    rise = np.minimum(progress, 1.0)
    part.height = part.height * FIRST_HEIGHT ** (1.0 - rise)
    if part.film.field is not None:
        part.film.field = part.film.field * np.clip(progress - 1.0, 0.0, 1.0)
    return part


def lowest(problem: Problem, grid: Grid, state: State) -> Array:
    """Smallest eigenvalue of the reduced Hessian; minus infinity where the slopes themselves are unstable."""
    at = ritz.evaluate(problem, grid, state)
    system = ritz.reduce(grid, state.w, at)
    matrix = np.moveaxis(system.condensed(), -1, 0)
    good = np.isfinite(matrix).all(axis=(1, 2)) & system.positive
    out = np.full(len(good), -np.inf)
    out[good] = np.linalg.eigvalsh(matrix[good])[:, 0]
    return out


def _no_width(problem: Problem, grid: Grid, state: State) -> NDArray[np.bool_]:
    """Where hoop tension is about to vanish and the film has no natural width: it would widen without bound."""
    law = ritz.evaluate(problem, grid, State(state.c, state.w)).law
    return np.asarray(((law.t2 < 0.1 * law.t1) & (law.h22 <= 0.0)).any(axis=(0, 1)))


def leans(grid: Grid, state: State) -> NDArray[np.bool_]:
    """Where a film narrows below its disk: it may be one that nothing leads to from rest."""
    _, q = grid.strain(state.c)
    return np.asarray((q <= -1.0).any(axis=(0, 1)))


def follow(problem: Problem, modes: int, *, relaxed: bool) -> Trace:
    """Follow every state along its path, in steps that each state chooses by itself."""
    states = len(problem.span)
    everyone = np.arange(states)
    grid = Grid.lay(modes, problem.cut())
    correct: Callable[[Problem, Grid, State, float, int], Iterate] = (
        tension_field.search if relaxed else refinement.newton
    )

    def first(part: Problem, laid: Grid) -> State:
        return tension_field.guess(part, laid) if relaxed else ritz.careful_guess(part, laid)

    # Most states are found at once at their height without voltage; the others begin low.
    progress = np.ones(states)
    begin = at(problem, everyone, progress)
    found = correct(begin, grid, first(begin, grid), 1e-3, 15)
    steps = found.steps
    current, alive = found.state, found.ok & ~leans(grid, found.state)
    if not alive.all():
        late = np.flatnonzero(~alive)
        progress[late] = 0.0
        begin = at(problem, late, progress[late])
        found = correct(begin, grid.take(late), first(begin, grid.take(late)), 1e-3, 25)
        steps[late] += found.steps
        current.put(late, found.state)
        alive[late] = found.ok
    end = 1.0 if problem.film.field is None else 2.0
    begun = lowest(at(problem, everyone, progress), grid, current)
    before, before_progress = State(current.c.copy(), current.w.copy()), progress.copy()
    size = np.full(states, 0.5)
    concave = np.zeros(states, dtype=np.bool_)
    for _ in range(MOST_STEPS):
        active = np.flatnonzero(alive & (progress < end))
        if len(active) == 0:
            break
        leg_end = np.where(progress[active] < 1.0, 1.0, 2.0)
        aim = np.minimum(progress[active] + size[active], leg_end)
        part, laid = at(problem, active, aim), grid.take(active)
        here = current.take(active)
        run = progress[active] - before_progress[active]
        ratio = np.where(run > 0.0, (aim - progress[active]) / np.where(run > 0.0, run, 1.0), 0.0)
        w = here.w + ratio * (here.w - before.w[..., active])
        w = np.maximum(w, 0.3 * here.w)
        w *= part.height / (laid.once * w).sum(axis=(0, 1))
        predicted = State(here.c + ratio * (here.c - before.c[:, active]), w, here.natural, here.relaxed)
        found = correct(part, laid, predicted, 1e-3, 8)
        steps[active] += found.steps
        jump = np.abs(found.state.w / w - 1.0).max(axis=(0, 1))
        good = found.ok & (jump < CORRECTION)
        least = np.full(len(active), np.inf)
        some = np.flatnonzero(good & (aim > 1.0))
        if len(some):
            new = convexity.stations(part.take(some), laid.take(some), found.state.take(some), found.lam[some])
            old = convexity.stations(part.take(some), laid.take(some), here.take(some), found.lam[some])
            charged = part.take(some)
            # A step that carries points over a range that is not convex is not a step along a branch.
            least[some] = np.minimum(convexity.margin(charged, new), convexity.margin(charged, old.toward(new, 0.5)))
            good &= least > 0.0
        moved, held = active[good], active[~good]
        before.c[:, moved], before.w[..., moved] = current.c[:, moved], current.w[..., moved]
        before_progress[moved] = progress[moved]
        current.put(moved, found.state.take(good))
        progress[moved] = aim[good]
        size[moved] *= np.where(jump[good] < 0.3 * CORRECTION, 2.0, 1.0)
        size[held] *= 0.35
        crossed = moved[(before_progress[moved] < 1.0) & (progress[moved] >= 1.0)]
        before_progress[crossed] = progress[crossed]  # another direction: the last step predicts nothing
        # Where the law loses convexity in a step that may not be shorter, the branch has ended there.
        concave[active[least <= 0.0]] = True
        concave[moved] = False
        alive[size < LEAST_STEP] = False
    reached = alive & (progress >= end)
    limit = concave
    some = np.flatnonzero(np.isfinite(begun) & (begun > 0.0))
    if len(some):
        end_of = at(problem, some, progress[some]), grid.take(some), current.take(some)
        limit[some] |= lowest(*end_of) < SOFT * begun[some]
        if relaxed:
            limit[some] |= _no_width(*end_of)
    return Trace(grid, current, reached, progress, limit, steps)
