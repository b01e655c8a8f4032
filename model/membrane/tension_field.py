r"""Wrinkled films: the relaxed energy, with a cut in the elements at every edge of a wrinkled zone.

Where the plain equations give a hoop stress below zero the film folds instead, and only its natural width
``l2*(l1)``, with ``sigma2(l1, l2*) = 0``, makes stress. The relaxed energy ``min over l2 of W*`` then carries no hoop
stress and the stiffness ``W11 - W12^2/W22``; the meridian of a wrinkled zone is straight. The solution has a kink at
the zone's edge, so the elements are cut there: each is wrinkled or taut as a whole and smooth, and the cut moves with
Newton's steps to where the hoop stress of the taut side vanishes. A misplaced cut errs in the force by the third power
of its distance only, and each step leaves a distance of the square of the last.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.material.law import stack, stress
from model.membrane import refinement, ritz
from model.membrane.output import FINE, fine_table
from model.membrane.refinement import Answer, Finished, Iterate, Start
from model.membrane.ritz import Grid, Points, Problem, State
from model.membrane.soft_cone import Along, SoftCones, along
from model.membrane.wrinkled_cone import NEAR, Cones, Springs, natural_width, whole

START_MODES = 5
# To begin with. A narrow zone may be there only with more: its cut runs out of the film with fewer.
START_CUT_MODES, MORE_CUT_MODES = 3, 8
MOST_ZONES = 5
ROUNDS = 4
MISSED = 0.02  # of the tolerance: third power of the wrong tension that a careful solution lets stand beside a cut
UNSEEN = 0.05  # of the tolerance: share of the pull along the film that a zone which is not cut out may push around
UNSEEN_SOFT = 0.005  # the same near loss of convexity, where folds stretch the film by that much more
SLACK = 5.0  # times Newton's goal: share of the largest tension that may have a wrong sign, as it has beside a cut
STEPS, CAREFUL_STEPS = 15, 40  # most of a rung
CALM = 1e-4  # change of the strains from which a careful solution moves its cuts
CUT_WEIGHT = 0.1  # of a cut's shift beside the strains' change
CUT_POWER = (
    2.6  # of its power 1.5: the force errs by some half of the third power of the shift, the estimate allows two
)
CUT_GOAL = 0.9  # a cut stays where it has settled: what it lacks must leave room for the rest of the estimate
CAREFUL_WEIGHT = 1.0  # where the folds have hardly any stiffness left: the force feels it that much more


def guess(problem: Problem, grid: Grid) -> State:
    """A first state like that of `ritz.guess`, with the relaxed law where a straight cone would wrinkle."""
    mean = problem.height / -np.expm1(-problem.span)
    square = mean * mean
    log1 = 0.5 * np.log1p(square) + problem.log_prestretch
    plain = stress(problem.film, stack(log1, problem.log_prestretch))
    natural, law = natural_width(problem, log1, problem.log_prestretch - 0.0 * log1, 1e-6)
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
    finished = Finished(state.w.shape[2])
    for n in range(1, limit + 1):
        at = ritz.evaluate(problem, grid, state)
        step = ritz.newton(problem, grid, state, at)
        new, change = refinement.advance(state, step, at, grid)
        relief = at.law.relief
        assert state.relaxed is not None and state.natural is not None and new.natural is not None
        assert relief is not None
        # A folded point stays folded while its circle is narrower than its natural width.
        folded = np.where(state.relaxed, at.hoop < state.natural + relief.change, at.law.t2 < 0.0)
        flips = (folded != state.relaxed).any(axis=(0, 1))
        state = State(new.c, new.w, np.where(folded & state.relaxed, new.natural, at.hoop), folded)
        wider = np.abs(np.where(folded, relief.change, 0.0)).max(axis=(0, 1), initial=0.0)
        quiet = (change <= goal) & (wider <= NEAR) & ~flips
        ok = quiet & step.stable & relief.regular.all(axis=(0, 1)) & (step.lam > 0.0)
        found = Iterate(grid, state, step.lam, change, np.zeros(len(ok)), step.stable, ok, np.full(len(ok), n))
        if finished.ending(quiet | (n == limit)) and finished.put(found):
            break
        rest = finished.rest()
        if rest is not None:
            problem, grid, state = problem.take(rest), grid.take(rest), state.take(rest)
    return finished.all()


def wrong_sign(tolerance: float, careful: bool = False) -> float:
    """Share of the largest tension that may have a wrong sign: beside a cut that stands as well as Newton asks for.

    A cut that stands off leaves one in proportion, and the energy errs by its third power. The force feels a zone that
    has no cut at all by the second: what such a zone may do is bounded by `UNSEEN`.
    """
    share = SLACK * refinement.goal(max(tolerance, 1e-8))
    return min(share, math.cbrt(MISSED * tolerance)) if careful else share


@dataclass(slots=True)
class Zones:
    """Where the sign of the hoop tension changes."""

    changes: NDArray[np.intp]  # (S,)
    first: NDArray[np.bool_]  # (S,): wrinkled at the disk
    where: Array  # (MOST_ZONES - 1, S): ln(R/b) of the changes, in order


def zones(
    grid: Grid,
    state: State,
    at: Points,
    slack: float = 0.0,
    unseen: float = 0.0,
    *,
    between: bool = True,
    cones: Along | None = None,
) -> Zones:
    """Zones of a state, by the hoop stress where taut and by the slack in the width where wrinkled.

    A sign against the element's own kind counts only beyond ``slack`` times the largest value: with cuts in place their
    vicinity is round-off. Smaller ones count where what taut elements push around is more than a share ``unseen`` of
    what the film pulls along: its force errs by about as much. Without ``between`` the points alone are asked, and both
    ends of taut elements: near loss of convexity the stretch is too steep for the polynomial through them. Straight
    ``cones`` are asked at even steps of their stretch.
    """
    tension = at.law.t2 if state.relaxed is None else np.where(state.relaxed, at.hoop - at.log[1], at.law.t2)
    if cones is not None and state.relaxed is not None:
        tension = np.where(state.relaxed, cones.hoop - cones.log2, tension)
    points, m, states = tension.shape
    whole = state.relaxed is None or bool((state.relaxed == state.relaxed[:1]).all())
    smooth = whole and between
    if smooth:
        fine = fine_table(grid.table.modes) @ tension.reshape(points, m * states)
        fine = fine.reshape(FINE, m, states).swapaxes(0, 1).reshape(m * FINE, states)
        share = 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, FINE)))
    else:  # each point decides for itself: no polynomial passes through them
        share = 0.5 * (1.0 + grid.table.xi)
        if whole:  # a narrow zone may stand between the disk and the first point
            ends = np.tensordot(grid.table.ends, tension, 1)
            if state.relaxed is not None:
                ends = np.where(state.relaxed[:1], tension[[0, -1]], ends)
            tension = np.concatenate((ends[:1], tension, ends[1:]))
            share = np.concatenate(([0.0], share, [1.0]))
        fine = tension.swapaxes(0, 1).reshape(m * len(share), states)
    x = grid.breaks[:-1, None] + share[:, None] * (grid.breaks[1:] - grid.breaks[:-1])[:, None]
    if cones is not None and not smooth:
        x[:, 1:-1] = cones.x.swapaxes(0, 1)
    folded = fine < 0.0
    if slack > 0.0 and whole and state.relaxed is not None:
        kind = np.repeat(state.relaxed[0], len(share), axis=0)
        bound = slack * np.maximum(fine.max(axis=0), -fine.min(axis=0))
        every = np.where(kind, fine < bound, folded)
        folded = np.where(kind, fine < bound, fine < -bound)
        pushed = np.where(kind, 0.0, np.maximum(-fine, 0.0)).reshape(m, len(share), states)
        pushed *= np.exp(2.0 * x)
        missed = (0.5 * (pushed[:, 1:] + pushed[:, :-1]) * np.diff(x, axis=1)).sum(axis=(0, 1))
        folded = np.where(missed > unseen * (grid.twice * at.law.t1).sum(axis=(0, 1)), every, folded)
    flips = folded[1:] != folded[:-1]
    changes = flips.sum(axis=0)
    where = np.full((MOST_ZONES - 1, states), np.nan)
    columns, rows = np.nonzero(flips.T)
    rank = np.arange(len(columns)) - (np.cumsum(changes) - changes)[columns]
    few = rank < MOST_ZONES - 1
    columns, rows, rank = columns[few], rows[few], rank[few]
    low, high = fine[rows, columns], fine[rows + 1, columns]
    part = np.clip(low / (low - high), 0.05, 0.95)
    part = np.where(np.isfinite(part), part, 0.5)
    x = x.reshape(len(fine), states)
    where[rank, columns] = x[rows, columns] + part * (x[rows + 1, columns] - x[rows, columns])
    return Zones(changes, folded[0], where)


def remap(old: Grid, state: State, natural: Array, breaks: Array, modes: int, wrinkled: NDArray[np.bool_]) -> Start:
    """A ``state`` of ``old`` carried to other elements, of which those ``wrinkled`` (M,) are relaxed.

    ``natural`` is ``ln(l2)`` at the points of ``old`` to begin with where there are folds.
    """
    grid = Grid.lay(modes, breaks)
    t, states = grid.table, breaks.shape[1]
    x = 0.5 * (t.xi[:, None, None] + 1.0) * (breaks[1:] - breaks[:-1]) + breaks[:-1]

    def carry(x: Array) -> Callable[[Array], Array]:
        """Takes point values (Q, M, S) of the old elements, as polynomials, to ``x`` (..., S)."""
        inner = old.breaks[1:-1].reshape(-1, *(1,) * (x.ndim - 1), states)
        element, columns = (x > inner).sum(axis=0), np.arange(states)
        left, right = old.breaks[element, columns], old.breaks[element + 1, columns]
        xi = np.clip(2.0 * (x - left) / (right - left) - 1.0, -1.0, 1.0)

        def at(values: Array) -> Array:
            c = (old.table.to_legendre @ values.reshape(len(values), -1)).reshape(values.shape)
            return np.asarray(np.polynomial.legendre.legval(xi, c[:, element, columns], tensor=False))

        return at

    to_points, to_cuts = carry(x), carry(breaks[1:-1])
    e, q = old.strain(state.c)
    bubbles = np.tensordot(t.to_modes, to_points(q - e) / grid.dxi, 1).swapaxes(0, 1)
    c = np.concatenate((bubbles.reshape(-1, states), to_cuts(e)))
    w = np.maximum(to_points(state.w), state.w.min(axis=(0, 1)))
    return Start(grid, State(c, w, to_points(natural), np.broadcast_to(wrinkled[:, None], w.shape)))


def settle(
    problem: Problem, grid: Grid, state: State, goal: float, kind: type[Cones] = Cones, *, careful: bool = False
) -> Iterate:
    """Newton on the state together with the cuts, every wrinkled element a cone of this ``kind``.

    ``careful`` moves the cuts only once the strains have nearly settled: a taut zone that is about to vanish hangs on
    a hoop tension that is a small rest, and steps of both together overshoot.
    """
    assert state.relaxed is not None
    goal *= CUT_GOAL
    zones = state.relaxed[0, :, 0].tolist()
    folded = tuple(k for k, wrinkled in enumerate(zones) if wrinkled)
    taut = tuple(k for k, wrinkled in enumerate(zones) if not wrinkled)
    modes, m = grid.table.modes, grid.elements
    own = np.concatenate([np.arange(k * modes, (k + 1) * modes) for k in taut] + [np.arange(m * modes, grid.unknowns)])
    film = State(state.c[own.astype(np.intp)], state.w[:, list(taut)])
    cones = kind.of(problem, grid, state, folded)
    if careful:
        return _settle(problem, grid, film, taut, cones, min(goal, CALM), CAREFUL_STEPS, careful)
    return _settle(problem, grid, film, taut, cones, goal, STEPS, careful)


def _settle(
    problem: Problem,
    grid: Grid,
    film: State,
    taut: tuple[int, ...],
    cones: Cones,
    goal: float,
    limit: int,
    careful: bool,
) -> Iterate:
    finished = Finished(film.w.shape[2])
    for n in range(1, limit + 1):
        panels = grid.part(taut)
        at = ritz.evaluate(problem, panels, film)
        system = ritz.reduce(panels, film.w, at)
        springs = Springs.of(problem, grid, panels, cones, film.c)
        springs.join(system)
        step = ritz.solve(problem, panels, system)
        before, pulled = film, cones.pull
        film, change = refinement.advance(film, step, at, panels)
        cones, bent = springs.advance(step.dc, step.lam)
        # A cut that moves carries the strains with it: they must have settled as well as the slopes.
        de, dq = panels.strain(step.dc)
        size = (np.abs(at.q) + before.w**2).max(axis=(0, 1), initial=1e-300)
        change = np.maximum(change, np.abs(dq).max(axis=(0, 1), initial=0.0) / size)
        tension = at.law.t2 + at.law.h12 * (at.along * dq + at.down * step.dw) + at.law.h22 * at.around * de
        breaks, shift = _moved(grid, panels, taut, cones.which, tension)
        if careful and pulled is not None and cones.pull is not None:
            # A cone that ends where the law is all but flat has no end before the cut stands where it should.
            calm = np.maximum(change, np.abs(cones.pull / pulled - 1.0).max(axis=0, initial=0.0)) <= CALM
            breaks = np.where(calm, breaks, grid.breaks)
        change = np.maximum(change, bent)
        off = np.maximum((CAREFUL_WEIGHT if careful else CUT_WEIGHT) * shift, CUT_POWER * shift * np.sqrt(shift))
        change = np.maximum(change, off)
        done = change <= goal
        # Where it has settled the state belongs to the cuts as they were.
        grid = Grid.lay(grid.table.modes, np.where(done, grid.breaks, breaks))
        stable = step.stable & springs.regular
        if finished.ending(done | (n == limit)):
            ends = refinement.tail(problem, panels, film, step)
            state = whole(grid, film, taut, cones.unrolled(problem, grid), cones.straight())
            ok = done & stable & (step.lam > 0.0)
            if finished.put(Iterate(grid, state, step.lam, change, ends, stable, ok, np.full(len(ok), n))):
                break
        rest = finished.rest()
        if rest is not None:
            problem, grid, film, cones = problem.take(rest), grid.take(rest), film.take(rest), cones.take(rest)
    return finished.all()


def _moved(
    grid: Grid, panels: Grid, taut: tuple[int, ...], folded: tuple[int, ...], tension: Array
) -> tuple[Array, Array]:
    """Breaks moved to where the hoop ``tension`` of the panels vanishes, and the largest shift over an element."""
    t, breaks = grid.table, grid.breaks.copy()
    length = breaks[1:] - breaks[:-1]
    largest = np.zeros(breaks.shape[1])
    for panel, element in enumerate(taut):
        for end, side in ((0, 1.0), (1, -1.0)):
            beside = element - int(side)
            if beside not in folded:
                continue
            value = t.ends[end] @ tension[:, panel]
            slope = (t.end_slopes[end] @ tension[:, panel]) * panels.dxi[panel] * side
            # Towards the taut zone where it is not taut, away from it where it pulls at the cut.
            shift = -value / slope * side
            shift = np.where(slope > 0.0, shift, -0.2 * np.sign(value) * side * length[element])
            cut = max(element, beside)
            shift = np.clip(np.nan_to_num(shift), -0.5 * length[cut - 1], 0.5 * length[cut])
            breaks[cut] += shift
            largest = np.maximum(largest, np.abs(shift) / np.minimum(length[element], length[beside]))
    breaks[1:-1] = np.clip(breaks[1:-1], breaks[:-2], breaks[2:])
    return breaks, largest


def _cut(film: Problem, edges: Array, first: bool, pieces: tuple[int, ...]) -> tuple[Array, NDArray[np.bool_]]:
    """Breaks at the zones' ``edges`` and inside zones that are too long, and which elements are wrinkled."""
    ends = np.concatenate((-film.span[None], edges, np.zeros((1, len(film.span)))))
    breaks, wrinkled = [ends[:1]], []
    for number, ((left, right), many) in enumerate(zip(pairwise(ends), pieces, strict=True)):
        breaks.append(left + (right - left) * np.linspace(0.0, 1.0, many + 1)[1:, None])
        wrinkled += [(number % 2 == 0) == first] * many
    return np.concatenate(breaks), np.array(wrinkled)


def admissible(grid: Grid, state: State) -> NDArray[np.bool_]:
    """Whether every cut still separates two elements."""
    length = grid.breaks[1:] - grid.breaks[:-1]
    good: NDArray[np.bool_] = (length > 1e-9 * (grid.breaks[-1] - grid.breaks[0])).all(axis=0)
    return good


def solve(
    problem: Problem, tolerance: float, *, sensitivities: bool, begin: Start | None = None, careful: bool = False
) -> tuple[list[Answer], NDArray[np.intp], NDArray[np.intp]]:
    """Solve states of which some part is wrinkled. Returns what `refinement.refine` does.

    ``begin`` is a state of the plain equations, or one with every point taut or wrinkled by itself; found by `search`
    when not given. ``careful`` is for states near loss of convexity or of a zone: `SoftCones`, and patient cuts.
    """
    index = np.arange(len(problem.span))
    steps = np.zeros(len(index), dtype=np.intp)
    answers: list[Answer] = []
    lost = [index[:0]]
    if begin is None:
        grid = Grid.lay(START_MODES, problem.cut())
        found = search(problem, grid, guess(problem, grid))
        steps += found.steps
        begin = Start(grid, found.state)
        lost.append(index[~found.ok])
        index = index[found.ok]
        begin = begin.take(found.ok)
    pending = [(index, begin, START_CUT_MODES)]
    for _ in range(ROUNDS):
        queue, pending = pending, []
        for some, begun, modes in queue:
            if len(some):
                _round(problem, tolerance, sensitivities, careful, some, begun, modes, steps, answers, lost, pending)
    lost.extend(some for some, _, _ in pending)
    return answers, np.concatenate(lost), steps


def _round(
    problem: Problem,
    tolerance: float,
    sensitivities: bool,
    careful: bool,
    index: NDArray[np.intp],
    start: Start,
    fewest: int,
    steps: NDArray[np.intp],
    answers: list[Answer],
    lost: list[NDArray[np.intp]],
    again: list[tuple[NDArray[np.intp], Start, int]],
) -> None:
    """Cut the elements where the zones of ``start`` end, and solve with ``fewest`` modes or more.

    Once more (``again``) are solved those with other zones than before, and with more modes those that do not settle.
    """
    here = problem.take(index)
    settler = partial(settle, kind=SoftCones, careful=True) if careful else settle
    state = start.state
    mixed: NDArray[np.bool_] = np.zeros(len(index), dtype=np.bool_)
    if state.relaxed is not None:
        mixed = np.asarray((state.relaxed.any(axis=0) & ~state.relaxed.all(axis=0)).any(axis=0))
    for single in (False, True):
        some = np.flatnonzero(mixed == single)
        if len(some) == 0:
            continue
        part, grid, chosen = here.take(some), start.grid.take(some), state.take(some)
        at = ritz.evaluate(part, grid, chosen)
        zone = _zones(part, grid, chosen, at, tolerance, careful)
        pattern = 2 * zone.changes + zone.first
        for number in np.unique(pattern).tolist():
            changes, first = number // 2, bool(number % 2)
            of = np.flatnonzero(pattern == number)
            if changes >= MOST_ZONES:
                lost.append(index[some[of]])
                continue
            for cut in _alike(part.take(of), zone.where[:changes, of], tolerance, fewest):
                here_of = of[cut.index]
                film = part.take(here_of)
                breaks, wrinkled = _cut(film, zone.where[:changes, here_of], first, cut.pieces)
                old, begun_of = grid.take(here_of), chosen.take(here_of)
                begun = remap(old, begun_of, at.log[1][..., here_of], breaks, cut.modes, wrinkled)
                if chosen.relaxed is not None and np.array_equal(chosen.relaxed[0, :, 0], wrinkled):
                    begun.state.cones = begun_of.cones
                done, missed, spent = refinement.refine(
                    film,
                    tolerance,
                    begun,
                    sensitivities=sensitivities,
                    settle=settler,
                    factor=refinement.CUT_LEVEL_FACTOR,
                    soft=careful or bool(wrinkled.all()),
                )
                where = index[some[here_of]]
                if changes and cut.modes < MORE_CUT_MODES:
                    again.append((where[missed], Start(old, begun_of).take(missed), MORE_CUT_MODES))
                else:
                    lost.append(where[missed])
                steps[where] += spent
                for answer in done:
                    solved = film.take(answer.index)
                    at_end = ritz.evaluate(solved, answer.grid, answer.state)
                    now = _zones(solved, answer.grid, answer.state, at_end, tolerance, careful)
                    same = (now.changes == changes) & (now.first == first) & admissible(answer.grid, answer.state)
                    answer.index = where[answer.index]
                    answer.steps = steps[answer.index]
                    answers.append(answer.take(same))
                    if not same.all():
                        again.append((answer.index[~same], Start(answer.grid, answer.state).take(~same), cut.modes))


def _zones(problem: Problem, grid: Grid, state: State, at: Points, tolerance: float, careful: bool) -> Zones:
    """Zones of a state that is to be solved, or has been, to the tolerance."""
    cones = along(problem, grid, state, at) if state.cones is not None else None
    allowed = wrong_sign(tolerance, careful), (UNSEEN_SOFT if careful else UNSEEN) * tolerance
    return zones(grid, state, at, *allowed, between=not careful, cones=cones)


@dataclass(slots=True)
class _Alike:
    """States to be cut into as many elements and begun with as many modes."""

    index: NDArray[np.intp]
    pieces: tuple[int, ...]  # of every zone
    modes: int


def _alike(film: Problem, edges: Array, tolerance: float, fewest: int) -> list[_Alike]:
    """Groups of the states with these zones, so that what a state gets does not depend on the others."""
    ends = np.concatenate((-film.span[None], edges, np.zeros((1, len(film.span)))))
    length = ends[1:] - ends[:-1]
    pieces = np.maximum(1, np.ceil(length / ritz.LONGEST)).astype(np.intp)
    kind, modes = refinement.groups((length / pieces).max(axis=0), tolerance)
    key = np.vstack((pieces, kind))
    if (key == key[:, :1]).all():
        rows, group = key[:, :1], np.zeros(key.shape[1], dtype=np.intp)
    else:
        rows, group = np.unique(key, axis=1, return_inverse=True)
    return [
        _Alike(np.flatnonzero(group.ravel() == k), tuple(row[:-1].tolist()), max(fewest, modes[row[-1]]))
        for k, row in enumerate(rows.T)
    ]
