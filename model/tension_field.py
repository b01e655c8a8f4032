r"""Wrinkled films: the relaxed energy, with a cut in the elements at every edge of a wrinkled zone.

Where the plain equations give a hoop stress below zero the film folds instead, and only its natural width
``l2*(l1)``, with ``sigma2(l1, l2*) = 0``, makes stress. The relaxed energy ``min over l2 of W*`` then carries no hoop
stress and the stiffness ``W11 - W12^2/W22``; the meridian of a wrinkled zone is straight. The solution has a kink at
the zone's edge, so the elements are cut there: each is wrinkled or taut as a whole and smooth, and the cut moves with
Newton's steps to where the hoop stress of the taut side vanishes. A misplaced cut errs in the force by the third power
of its distance only, and each step leaves a distance of the square of the last.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from model import ladder, ritz
from model.ladder import Answer, Iterate, Start
from model.law import Array, Stress, relax, stack, stress
from model.ritz import Grid, Points, Problem, State

FINE = 65  # points of an element where the sign of the hoop stress is read
START_MODES = 5
MOST_ZONES = 5
ROUNDS = 4
CUT_WEIGHT = 0.1  # of a cut's shift beside the strains' change: the force feels its third power


def natural_width(problem: Problem, log1: Array, start: Array) -> tuple[Array, Stress]:
    """``ln l2`` that makes no hoop stress at ``log1``, and the relaxed law there."""
    everywhere = np.ones(log1.shape, dtype=np.bool_)
    log2 = start
    for _ in range(8):
        law = relax(problem.film, stress(problem.film, stack(log1, log2)), everywhere)
        assert law.relief is not None
        log2 = log2 + np.clip(law.relief.change, -0.3, 0.3)
        if not np.abs(law.relief.change).max() > 1e-6:
            break
    return log2, law


def guess(problem: Problem, grid: Grid) -> State:
    """A first state like that of `ritz.guess`, with the relaxed law where a straight cone would wrinkle."""
    mean = problem.height / -np.expm1(-problem.span)
    square = mean * mean
    log1 = 0.5 * np.log1p(square) + problem.log_prestretch
    plain = stress(problem.film, stack(log1, problem.log_prestretch))
    natural, law = natural_width(problem, log1, problem.log_prestretch - 0.0 * log1)
    folded = plain.t2 < 0.0
    t1, h11 = np.where(folded, law.t1, plain.t1), np.where(folded, law.h11, plain.h11)
    part = square / (1.0 + square)
    power = np.where(t1 > 0.0, 1.0 - 2.0 * part + part * h11 / t1, np.inf)
    power = np.where(power > 0.5, power, 1.0)
    w = np.exp(np.log(grid.radius) / -power)
    w *= problem.height / (grid.once * w).sum(axis=(0, 1))
    hoop = np.where(folded, natural, problem.log_prestretch) + 0.0 * w
    return State(np.zeros((grid.unknowns, w.shape[2])), w, hoop, np.broadcast_to(folded, w.shape))


def search(problem: Problem, grid: Grid, state: State, goal: float = 2e-2, limit: int = 30) -> Iterate:
    """Newton with every point taut or wrinkled by itself: no order of convergence, but it finds the zones."""
    states = state.w.shape[2]
    steps = np.zeros(states, dtype=np.intp)
    n = 0
    while True:
        n += 1
        at = ritz.evaluate(problem, grid, state)
        step = ritz.newton(problem, grid, state, at)
        new, change = ladder.advance(state, step, at, grid)
        assert state.relaxed is not None and state.natural is not None and new.natural is not None
        assert at.law.relief is not None
        # A folded point stays folded while its circle is narrower than its natural width.
        folded = np.where(state.relaxed, at.hoop < state.natural + at.law.relief.change, at.law.t2 < 0.0)
        flips = (folded != state.relaxed).any(axis=(0, 1))
        state = State(new.c, new.w, np.where(folded & state.relaxed, new.natural, at.hoop), folded)
        steps += 1
        quiet = (change <= goal) & ~flips
        if quiet.all() or n >= limit:
            break
        if n >= 5 and states > 1 and quiet.mean() > 0.5:
            rest = np.flatnonzero(~quiet)
            more = search(problem.take(rest), grid.take(rest), state.take(rest), goal, limit - n)
            state.put(rest, more.state)
            lam, stable = step.lam, step.stable
            lam[rest], change[rest], stable[rest] = more.lam, more.change, more.stable
            quiet[rest] = more.ok
            steps[rest] += more.steps
            return Iterate(grid, state, lam, change, np.zeros(states), stable, quiet & stable & (lam > 0.0), steps)
    stable = step.stable & at.law.relief.regular.all(axis=(0, 1))
    return Iterate(grid, state, step.lam, change, np.zeros(states), stable, quiet & stable & (step.lam > 0.0), steps)


@dataclass(slots=True)
class Zones:
    """Where the sign of the hoop tension changes."""

    changes: NDArray[np.intp]  # (S,)
    first: NDArray[np.bool_]  # (S,): wrinkled at the disk
    where: Array  # (MOST_ZONES - 1, S): ln(R/b) of the changes, in order


def zones(grid: Grid, state: State, at: Points, slack: float = 0.0) -> Zones:
    """Zones of a state, by the hoop stress where taut and by the slack in the width where wrinkled.

    A sign against the element's own kind counts only beyond ``slack`` times the largest value: with cuts in place their
    vicinity is round-off.
    """
    tension = at.law.t2 if state.relaxed is None else np.where(state.relaxed, at.hoop - at.log[1], at.law.t2)
    xi = np.linspace(-1.0, 1.0, FINE)
    whole = state.relaxed is None or bool((state.relaxed.all(axis=0) | ~state.relaxed.any(axis=0)).all())
    if whole:
        flat = ritz.barycentric(grid.table.xi, xi) @ tension.reshape(len(tension), -1)
        fine = flat.reshape(FINE, *tension.shape[1:]).swapaxes(0, 1)
        half = 0.5 * (grid.breaks[1:] - grid.breaks[:-1])
        x = (grid.breaks[:-1] + half)[:, None] + half[:, None] * xi[:, None]
    else:  # each point decides for itself: no polynomial passes through them
        fine, x = tension.swapaxes(0, 1), np.log(grid.radius).swapaxes(0, 1)
    fine, x = fine.reshape(-1, fine.shape[2]), x.reshape(-1, x.shape[2])
    folded = fine < 0.0
    if slack > 0.0 and whole and state.relaxed is not None:
        kind = np.repeat(state.relaxed[0], FINE, axis=0)
        folded = np.where(np.abs(fine) <= slack * np.abs(fine).max(axis=0), kind, folded)
    flips = folded[1:] != folded[:-1]
    changes = flips.sum(axis=0)
    where = np.full((MOST_ZONES - 1, fine.shape[1]), np.nan)
    rank = np.cumsum(flips, axis=0) - 1
    rows, columns = np.nonzero(flips & (rank < MOST_ZONES - 1))
    low, high = fine[rows, columns], fine[rows + 1, columns]
    share = np.clip(low / (low - high), 0.05, 0.95)
    share = np.where(np.isfinite(share), share, 0.5)
    where[rank[rows, columns], columns] = x[rows, columns] + share * (x[rows + 1, columns] - x[rows, columns])
    return Zones(changes, folded[0], where)


def remap(problem: Problem, start: Start, breaks: Array, modes: int, wrinkled: NDArray[np.bool_]) -> Start:
    """A state carried to other elements, of which those ``wrinkled`` (M,) are relaxed."""
    old, state = start.grid, start.state
    at = ritz.evaluate(problem, old, state)
    grid = Grid.lay(modes, breaks)
    t, m, states = grid.table, grid.elements, breaks.shape[1]
    x = np.log(grid.radius).reshape(-1, states)
    cuts = breaks[1:-1]
    points = np.concatenate((x, cuts))
    element = (points[None] > old.breaks[1:-1, None]).sum(axis=0)
    columns = np.arange(states)
    left, right = old.breaks[element, columns], old.breaks[element + 1, columns]
    xi = np.clip(2.0 * (points - left) / (right - left) - 1.0, -1.0, 1.0)
    weights = ritz.barycentric(old.table.xi, xi.ravel()).reshape(*xi.shape, -1)

    def carried(values: Array) -> Array:
        """From (Q, M, S) to the new points and cuts."""
        result: Array = np.einsum("psq,psq->ps", weights, values[:, element, columns].transpose(1, 2, 0))
        return result

    e, slope = carried(at.e), carried(at.q - at.e)
    inner = len(x)
    e_xi = slope[:inner].reshape(t.points, m, states) / grid.dxi
    bubbles = np.einsum("qk,qms->mks", t.values[t.points :, :modes] * t.weight[:, None], e_xi)
    c = np.concatenate((bubbles.reshape(-1, states), e[inner:]))
    w = np.maximum(carried(state.w)[:inner], state.w.min(axis=(0, 1))).reshape(t.points, m, states)
    hoop = carried(at.log[1])[:inner].reshape(t.points, m, states)
    relaxed = np.broadcast_to(wrinkled[:, None], w.shape)
    return Start(grid, State(c, w, hoop, relaxed))


def settle(problem: Problem, grid: Grid, state: State, goal: float, limit: int = 30) -> Iterate:
    """Newton on the state together with the cuts."""
    t, m = grid.table, grid.elements
    assert state.relaxed is not None
    kinds = state.relaxed[0, :, 0]
    states = state.w.shape[2]
    steps = np.zeros(states, dtype=np.intp)
    n = 0
    while True:
        n += 1
        at = ritz.evaluate(problem, grid, state)
        step = ritz.newton(problem, grid, state, at)
        new, change = ladder.advance(state, step, at, grid)
        assert at.law.relief is not None
        steps += 1
        de, dq = grid.strain(step.dc)
        # A cut that moves carries the strains with it: they must have settled as well as the slopes.
        size = (np.abs(at.q) + state.w**2).max(axis=(0, 1))
        change = np.maximum(change, np.abs(dq).max(axis=(0, 1)) / size)
        if m > 1:
            tension = at.law.t2 + at.law.h12 * (at.along * dq + at.down * step.dw) + at.law.h22 * at.around * de
            breaks = grid.breaks.copy()
            length = grid.breaks[1:] - grid.breaks[:-1]
            for cut in range(1, m):
                if kinds[cut - 1] == kinds[cut]:
                    continue
                taut, end, side = (cut, 0, 1.0) if kinds[cut - 1] else (cut - 1, 1, -1.0)
                value = t.ends[end] @ tension[:, taut]
                slope = (t.end_slopes[end] @ tension[:, taut]) * grid.dxi[taut] * side
                # Towards the taut zone where it is not taut, away from it where it pulls at the cut.
                shift = -value / slope * side
                shift = np.where(slope > 0.0, shift, -0.2 * np.sign(value) * side * length[taut])
                shift = np.clip(np.nan_to_num(shift), -0.5 * length[cut - 1], 0.5 * length[cut])
                breaks[cut] += shift
                change = np.maximum(change, CUT_WEIGHT * np.abs(shift) / np.minimum(length[cut - 1], length[cut]))
            breaks[1:-1] = np.clip(breaks[1:-1], breaks[:-2], breaks[2:])
            # Where it has settled the state belongs to the cuts as they were.
            grid = Grid.lay(t.modes, np.where(change <= goal, grid.breaks, breaks))
        state = new
        done = change <= goal
        stable = step.stable & at.law.relief.regular.all(axis=(0, 1))
        if done.all() or n >= limit:
            break
        if n >= 5 and states > 1 and done.mean() > 0.5:
            rest = np.flatnonzero(~done)
            more = settle(problem.take(rest), grid.take(rest), state.take(rest), goal, limit - n)
            state.put(rest, more.state)
            lam = step.lam
            lam[rest], change[rest], stable[rest] = more.lam, more.change, more.stable
            steps[rest] += more.steps
            ends = ladder.tail(problem, grid, state, step)
            ends[rest] = more.tail
            breaks = grid.breaks.copy()
            breaks[:, rest] = more.grid.breaks
            grid = Grid.lay(t.modes, breaks)
            done = change <= goal
            return Iterate(grid, state, lam, change, ends, stable, done & stable & (lam > 0.0), steps)
    ends = ladder.tail(problem, grid, state, step)
    return Iterate(grid, state, step.lam, change, ends, stable, done & stable & (step.lam > 0.0), steps)


def _cut(film: Problem, edges: Array, first: bool) -> tuple[Array, NDArray[np.bool_]]:
    """Breaks at the zones' ``edges`` and inside zones that are too long, and which elements are wrinkled."""
    ends = np.concatenate((-film.span[None], edges, np.zeros((1, len(film.span)))))
    breaks, wrinkled = [ends[:1]], []
    for number, (left, right) in enumerate(pairwise(ends)):
        pieces = ritz.elements(right - left)
        breaks.append(left + (right - left) * np.linspace(0.0, 1.0, pieces + 1)[1:, None])
        wrinkled += [(number % 2 == 0) == first] * pieces
    return np.concatenate(breaks), np.array(wrinkled)


def admissible(grid: Grid, state: State) -> NDArray[np.bool_]:
    """Whether every cut still separates two elements."""
    length = grid.breaks[1:] - grid.breaks[:-1]
    good: NDArray[np.bool_] = (length > 1e-9 * (grid.breaks[-1] - grid.breaks[0])).all(axis=0)
    return good


def solve(
    problem: Problem,
    tolerance: float,
    *,
    sensitivities: bool,
    begin: tuple[Grid, State] | None = None,
) -> tuple[list[Answer], NDArray[np.intp], NDArray[np.intp]]:
    """Solve states of which some part is wrinkled. Returns what `ladder.climb` does.

    ``begin`` is a state with every point taut or wrinkled by itself; found by `search` when not given.
    """
    index = np.arange(len(problem.span))
    steps = np.zeros(len(index), dtype=np.intp)
    if begin is None:
        grid = Grid.lay(START_MODES, problem.cut())
        found = search(problem, grid, guess(problem, grid))
        steps += found.steps
        start, good = Start(grid, found.state), found.ok
    else:
        start, good = Start(*begin), np.ones(len(index), dtype=np.bool_)
    answers: list[Answer] = []
    lost = [index[~good]]
    pending = [(index[good], Start(start.grid.take(good), start.state.take(good)))]
    for _ in range(ROUNDS):
        queue, pending = pending, []
        for some, begun in queue:
            if len(some):
                _round(problem, tolerance, sensitivities, some, begun, steps, answers, lost, pending)
    lost.extend(some for some, _ in pending)
    return answers, np.concatenate(lost), steps


def _round(
    problem: Problem,
    tolerance: float,
    sensitivities: bool,
    index: NDArray[np.intp],
    start: Start,
    steps: NDArray[np.intp],
    answers: list[Answer],
    lost: list[NDArray[np.intp]],
    again: list[tuple[NDArray[np.intp], Start]],
) -> None:
    """Cut the elements where the zones of ``start`` end, and solve; other zones than before: once more (``again``)."""
    here = problem.take(index)
    state = start.state
    mixed: NDArray[np.bool_] = np.zeros(len(index), dtype=np.bool_)
    if state.relaxed is not None:
        mixed = np.asarray((state.relaxed.any(axis=0) & ~state.relaxed.all(axis=0)).any(axis=0))
    for kind in (False, True):
        some = np.flatnonzero(mixed == kind)
        if len(some) == 0:
            continue
        part, grid, chosen = here.take(some), start.grid.take(some), state.take(some)
        zone = zones(grid, chosen, ritz.evaluate(part, grid, chosen))
        pattern = 2 * zone.changes + zone.first
        for number in np.unique(pattern).tolist():
            changes, first = number // 2, bool(number % 2)
            of = np.flatnonzero(pattern == number)
            if changes >= MOST_ZONES:
                lost.append(index[some[of]])
                continue
            film = part.take(of)
            breaks, wrinkled = _cut(film, zone.where[:changes, of], first)
            modes = max(3, ladder.first_modes(float((breaks[1:] - breaks[:-1]).max()), tolerance))
            begun = remap(film, Start(grid.take(of), chosen.take(of)), breaks, modes, wrinkled)
            done, missed, spent = ladder.climb(film, tolerance, begun, sensitivities=sensitivities, settle=settle)
            where = index[some[of]]
            lost.append(where[missed])
            steps[where] += spent
            for answer in done:
                solved = film.take(answer.index)
                now = zones(
                    answer.grid, answer.state, ritz.evaluate(solved, answer.grid, answer.state), slack=tolerance**0.5
                )
                same = (now.changes == changes) & (now.first == first) & admissible(answer.grid, answer.state)
                answer.index = where[answer.index]
                answer.steps = steps[answer.index]
                answers.append(answer.take(same))
                if not same.all():
                    again.append((answer.index[~same], Start(answer.grid.take(~same), answer.state.take(~same))))
