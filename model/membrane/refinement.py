"""Newton at increasing resolution: the answer, and an estimate of its error from one resolution to the next."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.membrane import ritz
from model.membrane.output import Derivatives, Extremes, derivatives, extremes
from model.membrane.ritz import Grid, Problem, State

MOST_MODES = 64
FIRST_MODES = 36  # the most to begin with
MOST_STEPS = 25
# Newton's step leaves an error of about the square of its relative size; the change of the force from one resolution to
# the next is the error of the coarser one, some times the error of the finer. Tests hold the factors to the truth.
NEWTON_FACTOR = 0.3
FELT = 0.6  # of the largest relative change of a slope or of the meridional stress
LEVEL_FACTOR = 0.5
CUT_LEVEL_FACTOR = 2.0  # with cuts, which move from one resolution to the next
# Two coarse resolutions may agree by chance while their last modes still carry energy. The geometric mean of their
# tails stands between the energy that the coarser one leaves out and the finer one does.
TAIL_FACTOR = 2.0
# Near loss of convexity a finer resolution gains less, and of a film that is one cone two may agree by chance: the
# change before counts as well.
SOFT_BEFORE_FACTOR = 0.2
ROUND_OFF = 1e-13
# Of the meridional stress. A hoop stress below the first will not turn out positive at a finer resolution; one between
# the second and zero is round-off.
CLEARLY_NEGATIVE = -1e-2
ROUND_OFF_TENSION = -1e-9
MANY = 50  # states from which on those that have settled are worth leaving behind
WIDER = 0.3  # of ln(l2): most that a step changes a natural width, where the film hardly resists
LEAST_SHARE = 0.15  # of the tolerance: below it no estimate is claimed, two resolutions may agree by chance


@dataclass(slots=True)
class Iterate:
    """States after Newton at one resolution; a failed one has ``ok`` False."""

    grid: Grid
    state: State
    lam: Array
    change: Array  # largest relative change of a slope or of the meridional stress in the last step
    tail: Array  # share of the energy that the last modes carry
    stable: NDArray[np.bool_]
    ok: NDArray[np.bool_]
    steps: NDArray[np.intp]
    hoop: Array | None = None  # least hoop over largest meridional stress at the points, before the last step

    def _pairs(self, other: Iterate) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
        """Every array with that of the other, but for the grids."""
        mine, its = self.state, other.state
        yield from ((mine.c, its.c), (mine.w, its.w), (self.lam, other.lam), (self.change, other.change))
        yield from ((self.tail, other.tail), (self.stable, other.stable), (self.ok, other.ok))
        yield self.steps, other.steps
        if self.hoop is not None and other.hoop is not None:
            yield self.hoop, other.hoop
        if mine.natural is not None and its.natural is not None:
            yield mine.natural, its.natural
        if mine.relaxed is not None and its.relaxed is not None and mine.relaxed.flags.writeable:
            yield mine.relaxed, its.relaxed
        if mine.cones is not None and its.cones is not None:
            yield from zip(mine.cones.arrays(), its.cones.arrays(), strict=True)

    def restore(self, old: Iterate, these: NDArray[np.bool_]) -> None:
        """Take back ``these`` of an earlier step."""
        if self.grid is not old.grid:
            breaks = np.where(these, old.grid.breaks, self.grid.breaks)
            self.grid = Grid.lay(self.grid.table.modes, breaks)
        for mine, its in self._pairs(old):
            np.copyto(mine, its, where=these)

    def put(self, index: NDArray[np.intp], other: Iterate) -> None:
        """Take over other iterates of the states at ``index``."""
        breaks = self.grid.breaks.copy()
        breaks[:, index] = other.grid.breaks
        self.grid = Grid.lay(self.grid.table.modes, breaks)
        for mine, its in self._pairs(other):
            mine[..., index] = its


class Finished:
    """Iterates put aside at the step that finished them, so that none depends on how long the others need."""

    def __init__(self, states: int) -> None:
        self.here = np.ones(states, dtype=np.bool_)  # of those running, which are not put aside yet
        self.fresh = self.here  # which end at this step
        self.last: Iterate | None = None  # of those running: all that are put aside
        self.left: list[tuple[Iterate, NDArray[np.intp]]] = []  # those left behind, and who of them went on

    def ending(self, ended: NDArray[np.bool_]) -> bool:
        """Whether some ``ended`` at this step, which `put` then takes."""
        self.fresh = ended & self.here
        return bool(self.fresh.any())

    def put(self, every: Iterate) -> bool:
        """Put aside those of ``every`` running one that end here; whether all have."""
        if self.last is not None:
            every.restore(self.last, ~self.here)
        self.last = every
        self.here = self.here & ~self.fresh
        return not self.here.any()

    def rest(self) -> NDArray[np.intp] | None:
        """Those to go on with, by their place among the running ones, when the others are worth leaving behind."""
        count = len(self.here)
        if count < MANY or self.last is None or 2 * np.count_nonzero(self.here) > count:
            return None
        rest = np.flatnonzero(self.here)
        self.left.append((self.last, rest))
        self.last, self.here = None, np.ones(len(rest), dtype=np.bool_)
        return rest

    def all(self) -> Iterate:
        """Every state's iterate, in order."""
        found = self.last
        assert found is not None
        for before, went_on in reversed(self.left):
            before.put(went_on, found)
            found = before
        return found


Settle = Callable[[Problem, Grid, State, float], Iterate]


# Elements of like lengths begin alike, so that few groups are solved apart: with what the longest of a group asks for,
# whoever is there.
SPANS = (2.4, 3.1, ritz.LONGEST)


def groups(span: Array, tolerance: float) -> tuple[NDArray[np.intp], list[int]]:
    """The group of elements of so many ``ln(b/a)``, and the modes to begin with of every group."""
    return np.searchsorted(SPANS[:-1], span), [first_modes(most, tolerance) for most in SPANS]


def first_modes(span: float, tolerance: float) -> int:
    """Modes that bring the truncation error near ``tolerance`` for an element of a group: a start, not a promise."""
    most = next((most for most in SPANS if span <= most), SPANS[-1])
    return min(FIRST_MODES, max(2, math.ceil(-0.4 - math.log10(tolerance) * (0.25 + 0.12 * most))))


def goal(tolerance: float) -> float:
    """Change of a slope at which Newton's error is just below the tolerance."""
    return min(0.03, max(1e-6, math.sqrt(0.9 * tolerance / NEWTON_FACTOR)))


def estimate(
    lam: Array, previous: Array, change: Array, tails: tuple[Array, Array], tolerance: float, factor: float
) -> Array:
    """Estimated relative error of ``lam``, after ``previous`` at the resolution before, which had the second tail."""
    tail, before = tails
    truncated = np.maximum(factor * np.abs((lam - previous) / lam) + tail, TAIL_FACTOR * np.sqrt(tail * before))
    return truncated + NEWTON_FACTOR * change**2 + (ROUND_OFF + LEAST_SHARE * tolerance)


def next_modes(modes: int) -> int:
    """Modes of the next resolution."""
    return min(MOST_MODES, modes + 2 if modes < 8 else math.ceil(1.35 * modes))


def advance(state: State, step: ritz.Step, at: ritz.Points, grid: Grid) -> tuple[State, Array]:
    """The state after a Newton step, shortened where a slope would change beyond reason; and the largest change.

    That is the relative one of a slope or of the meridional stress, as far as the force feels it: a law that stiffens,
    or a tension that is a small rest of elastic and Maxwell stress, makes more of the same step.
    """
    w, law = state.w, at.law
    change = np.abs(step.dw / w).max(axis=(0, 1), initial=0.0)
    de, dq = grid.strain(step.dc)
    along = at.along * dq + at.down * step.dw
    stressed = (law.h11 * along + law.h12 * (at.around * de)) / law.t1
    felt = FELT * np.maximum(change, np.abs(stressed).max(axis=(0, 1), initial=0.0))
    if law.maxwell is not None:
        change = change * np.sqrt(np.abs(law.maxwell / law.t1).max(axis=(0, 1), initial=1.0))
    short: Array | float = 1.0
    if not change.max() <= 0.8:
        short = np.where(change > 2.0, 2.0 / change, 1.0)
        moved = w + short * step.dw
        moved = np.where(moved > 0.2 * w, moved, 0.2 * w)
        c = state.c + short * step.dc
    else:
        moved = w + step.dw
        c = state.c + step.dc
    natural = state.natural
    relief = law.relief
    if natural is not None and relief is not None:
        natural = natural + np.clip(relief.change + relief.rate * short * along, -WIDER, WIDER)
    return State(c, moved, natural, state.relaxed), felt


def tail(problem: Problem, grid: Grid, state: State, step: ritz.Step) -> Array:
    """Energy of the last mode of every element and a tenth of that of the last but one, over ``F h``."""
    modes, m = grid.table.modes, grid.elements
    last = state.c[modes - 1 : m * modes : modes] ** 2 * step.diagonal[modes - 1 : m * modes : modes]
    fore = state.c[modes - 2 : m * modes : modes] ** 2 * step.diagonal[modes - 2 : m * modes : modes]
    energy: Array = (last + 0.1 * fore).sum(axis=0)
    return 0.5 * energy / (step.lam * problem.height)


def newton(problem: Problem, grid: Grid, state: State, goal: float, limit: int = MOST_STEPS) -> Iterate:
    """Newton from ``state`` until the slopes change by less than ``goal`` (relative); the error is then its square."""
    finished = Finished(state.w.shape[2])
    for n in range(1, limit + 1):
        at = ritz.evaluate(problem, grid, state)
        step = ritz.newton(problem, grid, state, at)
        state, change = advance(state, step, at, grid)
        done = change <= goal
        if finished.ending(done | (n == limit)):
            ends = tail(problem, grid, state, step)
            hoop = at.law.t2.min(axis=(0, 1)) / at.law.t1.max(axis=(0, 1))
            ok = done & step.stable & (step.lam > 0.0)
            now = Iterate(grid, state, step.lam, change, ends, step.stable, ok, np.full(len(ok), n), hoop)
            if finished.put(now):
                break
        rest = finished.rest()
        if rest is not None:
            problem, grid, state = problem.take(rest), grid.take(rest), state.take(rest)
    return finished.all()


@dataclass(slots=True)
class Answer:
    """What one resolution settles: which states, and everything about them."""

    index: NDArray[np.intp]
    grid: Grid
    state: State
    lam: Array
    error: Array
    steps: NDArray[np.intp]
    extremes: Extremes
    derivatives: Derivatives | None

    def take(self, index: ritz.Index) -> Answer:
        """The answers at ``index``."""
        return Answer(
            self.index[index],
            self.grid.take(index),
            self.state.take(index),
            self.lam[index],
            self.error[index],
            self.steps[index],
            self.extremes.take(index),
            None if self.derivatives is None else self.derivatives.take(index),
        )


@dataclass(slots=True)
class Start:
    """Where to begin: a resolution, the elements, a state of it."""

    grid: Grid
    state: State

    def take(self, index: ritz.Index) -> Start:
        """The states at ``index``."""
        return Start(self.grid.take(index), self.state.take(index))

    @classmethod
    def join(cls, parts: Sequence[Start]) -> Start:
        """Taut states of one resolution together."""
        if len(parts) == 1:
            return parts[0]
        grid = Grid.lay(parts[0].grid.table.modes, np.concatenate([part.grid.breaks for part in parts], axis=1))
        c, w = ([getattr(part.state, name) for part in parts] for name in ("c", "w"))
        return cls(grid, State(np.concatenate(c, axis=-1), np.concatenate(w, axis=-1)))


def prolonged(start: Start, modes: int) -> Start:
    """The same state with more modes, or without the last ones."""
    old = start.grid.table
    grid = Grid.lay(modes, start.grid.breaks)
    m = grid.elements
    c, states = start.state.c, start.state.c.shape[1]
    bubbles = c[: m * old.modes].reshape(m, old.modes, states)[:, :modes]
    bubbles = np.concatenate((bubbles, np.zeros((m, max(0, modes - old.modes), states))), axis=1)
    c = np.concatenate((bubbles.reshape(-1, states), c[m * old.modes :]))
    carry = ritz.transfer(old.modes, modes)

    def moved(values: Array) -> Array:
        return (carry @ values.reshape(old.points, -1)).reshape(-1, m, states)

    natural, relaxed = start.state.natural, start.state.relaxed
    w = moved(start.state.w)
    w = np.where(w > 0.0, w, start.state.w.min(axis=(0, 1)))
    return Start(
        grid,
        State(
            c,
            w,
            None if natural is None else moved(natural),
            None if relaxed is None else np.broadcast_to(relaxed[:1], w.shape),
            start.state.cones,
        ),
    )


def refine(
    problem: Problem,
    tolerance: float,
    start: Start,
    *,
    sensitivities: bool = False,
    settle: Settle = newton,
    factor: float = LEVEL_FACTOR,
    soft: bool = False,
    folded: list[tuple[NDArray[np.intp], Start]] | None = None,
) -> tuple[list[Answer], NDArray[np.intp], NDArray[np.intp]]:
    """Solve a block of states to ``tolerance`` (relative, force), each with the resolution that it needs.

    A state whose hoop stress is clearly negative is given up at once where ``folded`` is there to take it. Returns the
    answers, the states that have none, and the steps spent on every state.
    """
    index = np.arange(len(problem.span))
    total = np.zeros(len(index), dtype=np.intp)
    answers: list[Answer] = []
    lost: list[NDArray[np.intp]] = []
    aim = goal(tolerance)
    previous: Array | None = None
    tail_before = np.full(len(index), np.nan)
    before = np.full(len(index), np.inf)  # relative change of the force at the resolution before
    while True:
        result = settle(problem, start.grid, start.state, aim)
        start = Start(result.grid, result.state)
        total[index] += result.steps
        lam, ok = result.lam, result.ok
        if folded is not None and result.hoop is not None:
            gone = (result.change <= aim) & (result.hoop <= CLEARLY_NEGATIVE)
            if gone.any():
                folded.append((index[gone], start.take(gone)))
            lost.append(index[~(ok | gone)])
            ok &= ~gone
        else:
            lost.append(index[~ok])
        modes = start.grid.table.modes
        if previous is not None:
            error = estimate(lam, previous, result.change, (result.tail, tail_before), tolerance, factor)
            if soft:
                error = error + SOFT_BEFORE_FACTOR * before
            before = np.abs((lam - previous) / lam)
            settled = np.flatnonzero(ok & (error <= tolerance))
            if len(settled):
                part = (problem, start, lam)
                if len(settled) < len(index):
                    part = (problem.take(settled), start.take(settled), lam[settled])
                answers.append(_answer(*part, sensitivities))
                answers[-1].index = index[settled]
                answers[-1].error = error[settled]
                answers[-1].steps = total[index[settled]]
            rest = np.flatnonzero(ok & ~(error <= tolerance))
        else:
            rest = np.flatnonzero(ok)
        if modes >= MOST_MODES:
            lost.append(index[rest])
            break
        if len(rest) == 0:
            break
        if len(rest) < len(index):
            problem, index, start, lam = problem.take(rest), index[rest], start.take(rest), lam[rest]
            before = before[rest]
        previous, tail_before = lam, result.tail[rest]
        start = prolonged(start, next_modes(modes))
    return answers, np.concatenate(lost), total


def _answer(problem: Problem, start: Start, lam: Array, sensitivities: bool) -> Answer:
    grid, state = start.grid, start.state
    at = ritz.evaluate(problem, grid, state)
    slopes = None
    if sensitivities:
        step = ritz.newton(problem, grid, state, at, tangent=True)
        assert step.tangent is not None
        slopes = derivatives(problem, grid, state, at, lam, step.tangent)
    empty = np.empty(0, dtype=np.intp)
    return Answer(empty, grid, state, lam, np.empty(0), empty, extremes(problem, grid, state, at, lam), slopes)
