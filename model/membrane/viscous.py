r"""Films with Maxwell branches at one instant: equilibrium of an implicit stage, and its answer to a small change.

A stage ``v = v* + g dt dv/dt`` asks at each point and branch for the elastic logarithmic strains ``x`` with

.. math:: x + c P S(x)/(2 G) = u - v^*, \qquad c = g\,dt/\tau, \qquad P = \tfrac13 [[2, -1], [-1, 2]]

and the membrane for equilibrium under ``S(u) + sum_k beta_k S(x^k) - eps E^2``. Newton's method takes both at once: at
each point the ``x`` are eliminated, which leaves the tangent ``C (I + c P C/2)^-1`` of a branch, a symmetric matrix, so
that unknowns, reduced matrix and test of stability are those of the elastic film (`model.membrane.ritz`).

A disk that is free to move has one unknown more, its height, and one equation: the film's force is that of its load. It
is stable where the film's force grows faster with the height than the load does.

Where the relaxed energy is asked for, each point with a negative hoop stress takes its natural width in place of the
film's, by itself (as `model.membrane.tension_field.search` does): viscous strains stay at their points, and so do they.

Arrays at points have the shape (Q, M, S), those of branches (K, Q, M, S): points of an element, elements, films.
Columns of derivatives stand before the films, (..., P, S).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.material.law import Evaluations, Film, Stress, relax
from model.membrane import refinement, ritz
from model.membrane.ritz import Problem
from model.membrane.viscous_films import FLAT, Films, Instant, Load, State

MOST_STEPS = 25
LONGEST_STRAIN_STEP = 0.5  # of an elastic strain of a branch, in one step of Newton's method
LONGEST_RISE, LONGEST_FALL = 0.1, 0.8  # of a free disk: over the ring radius, or its height where that is more; of it
LEAST_SLACK = 1e-15  # of a point that has begun to fold
MOST_FLIPS = 12  # steps of Newton's method in which points may fold or get taut again


@dataclass(slots=True)
class _Branches:
    """The branches at one iterate: stresses and inverses, (K, Q, M, S) each.

    s : their stresses (2, ...); a : ``I + c P C/2`` over its determinant; b : ``C (I + c P C/2)^-1``
    """

    s: tuple[Array, Array]
    half: Array  # c/2, (K, 1, 1, S)
    a: tuple[Array, Array, Array, Array]
    b: tuple[Array, Array, Array]

    def follow(self, r1: Array, r2: Array) -> tuple[Array, Array]:
        """The change of ``x`` that takes these residuals away."""
        a11, a12, a21, a22 = self.a if r1.ndim == self.a[0].ndim else tuple(one[..., None, :] for one in self.a)
        return a22 * r1 - a12 * r2, a11 * r2 - a21 * r1


@dataclass(slots=True)
class _Folds:
    """How natural widths follow where the film is folded: ``dL2 = -give t2 + rate dL1``; zero elsewhere, (Q, M, S)."""

    where: NDArray[np.bool_]
    give: Array
    rate: Array


@dataclass(slots=True)
class _Free:
    """Free disks: what the modes do when the height grows (n, S), stiffness of the film, and its excess (S,)."""

    modes: Array
    stiffness: Array
    excess: Array  # stiffness of the film less that of the load
    push: Array  # the load


@dataclass(slots=True)
class Balance:
    """Films in equilibrium, with what their derivatives need.

    state, lam : state, and the dimensionless force (S,)
    answer : the force, of a free disk its height over the ring radius
    u : logarithmic stretches (2, Q, M, S)
    ok : (S,): found, in tension, and stable
    tail : error of the answer by the number of modes
    raw : stresses and tangents before folds take the hoop stress away
    folds : where the film is folded, how the natural width follows; None where no point is
    free : of free disks, what follows when they move
    """

    films: Films
    state: State
    lam: Array
    u: Array
    ok: NDArray[np.bool_]
    tail: Array
    logs: Array
    points: ritz.Points
    system: ritz.Reduced
    inverse: Array
    branches: _Branches
    raw: Stress
    folds: _Folds | None
    free: _Free | None

    @property
    def folded(self) -> NDArray[np.bool_]:
        """Which films are folded somewhere."""
        found = np.zeros(len(self.lam), dtype=np.bool_)
        return found if self.folds is None else found | self.folds.where.any(axis=(0, 1))

    @property
    def answer(self) -> Array:
        return self.lam if self.free is None or self.state.height is None else self.state.height

    def respond(
        self, on_stress: Array | float, gap: Array, height: Array | float = 0.0
    ) -> tuple[Array, tuple[Array, Array], tuple[Array, Array]]:
        """The linear answer to small changes, P at a time.

        Parameters
        ----------
        on_stress : change of the stresses at fixed strains, (2, Q, M, P, S)
        gap : change of ``u - v* - c P S/2`` at fixed strains, (2, K, Q, M, P, S)
        height : change of the height over the ring radius, (P, S)

        Returns
        -------
        Changes of the answer (P, S), of the logarithmic stretches by motion, and of the branches' elastic strains. A
        change of the height is, of a free disk, one of its load.
        """
        system, at, films = self.system, self.points, self.films
        b11, b12, b22 = (one[..., None, :] for one in self.branches.b)
        ratio = films.ratio[..., None, :]
        t1 = (ratio * (b11 * gap[0] + b12 * gap[1])).sum(axis=0)
        t2 = (ratio * (b12 * gap[0] + b22 * gap[1])).sum(axis=0)
        if not isinstance(on_stress, float):
            t1 += on_stress[0]
            t2 += on_stress[1]
        shape = t1.shape
        count, size = shape[-2:]
        grid = films.grid.take(np.tile(np.arange(size), count))
        hw, kqw, kew, along, around, down = (
            one[..., None, :] for one in (system.hw, system.kqw, system.kew, at.along, at.around, at.down)
        )
        flat = (*shape[:2], count * size)
        if self.folds is not None:
            fold_give, fold_rate = self.folds.give[..., None, :], self.folds.rate[..., None, :]
            t1, natural = t1 + fold_rate * t2, -fold_give * t2
            t2 = t2 * ~self.folds.where[..., None, :]
        pull = t1 * down
        give = hw * pull
        twice, once = films.grid.twice[..., None, :], films.grid.once[..., None, :]
        residual = grid.project(
            (twice * (t2 * around - give * kew)).reshape(flat), (twice * (t1 * along - give * kqw)).reshape(flat)
        ).reshape(-1, count, size)
        free = self.free
        lam0 = ((height if free is None else 0.0) + (once * give).sum(axis=(0, 1))) / system.give
        coupling = system.coupling[:, None]
        dc = -np.einsum("sij,jps->ips", self.inverse, residual + lam0 * coupling)
        answer = lam = lam0 + (coupling * dc).sum(axis=0) / system.give
        if free is not None:
            answer = (height - lam) / free.excess
            dc += free.modes[:, None] * answer
            lam = lam + free.stiffness * answer
        de, dq = (one.reshape(shape) for one in grid.strain(dc.reshape(-1, count * size)))
        dw = hw * (lam / films.grid.radius[..., None, :] - pull - kqw * dq - kew * de)
        du1, du2 = along * dq + down * dw, around * de
        if self.folds is not None:
            du2 = np.where(self.folds.where[..., None, :], natural + fold_rate * du1, du2)
        return answer, (du1, du2), self.branches.follow(gap[0] + du1, gap[1] + du2)


def balance(
    films: Films, instant: Instant, start: Array, lag: Array, state: State, goal: float, limit: int = MOST_STEPS
) -> Balance:
    """Equilibrium of films whose viscous strains follow ``start`` (2, K, Q, M, S) with ``lag`` (K, 1, 1, S).

    Newton's method from ``state``, until slopes (relative) and strains change by less than ``goal``. Of a film that
    its load leaves flat the height is nearly zero.
    """
    grid, load = films.grid, instant.load
    field = films.field * instant.voltage**2 if instant.voltage.any() else None
    c, w, x, slack = state.c, state.w, state.x, state.slack if instant.relaxed else None
    height = instant.height(films) if load is None or state.height is None else state.height
    if instant.relaxed and slack is None:
        slack = np.zeros_like(w)
    count = Evaluations()
    for iteration in range(limit):
        at = _evaluate(films, field, start, lag, State(c, w, x, None, slack), count)
        points, folds, branches, (r1, r2) = at.points, at.folds, at.branches, at.residual
        system = ritz.reduce(grid, w, points)
        matrix = np.moveaxis(system.condensed(), 2, 0)
        try:
            inverse: Array = np.linalg.inv(matrix).astype(np.float64, copy=False)
        except np.linalg.LinAlgError:
            inverse = np.full(matrix.shape, np.nan)
        lam0 = (height - system.reach) / system.give
        dc = -np.einsum("sij,js->is", inverse, system.residual + lam0 * system.coupling)
        lam = lam0 + (system.coupling * dc).sum(axis=0) / system.give
        free, rise = None, np.zeros_like(lam)
        if load is not None:
            free = _freed(films, load, system, inverse, height)
            rise = (free.push - lam) / np.where(free.excess > 0.0, free.excess, 1e-9)
            rise = np.clip(rise, -LONGEST_FALL * height, np.maximum(LONGEST_RISE, height))
            rise = np.where(load.share == 0.0, FLAT - height, rise)
            dc += free.modes * rise
            lam = lam + free.stiffness * rise
        de, dq = grid.strain(dc)
        dw = system.hw * (lam / grid.radius - system.gw - system.kqw * dq - system.kew * de)
        du1, du2 = points.along * dq + points.down * dw, points.around * de
        if folds is not None:
            du2 = np.where(folds.where, -folds.give * at.raw.t2 + folds.rate * du1, du2)
        dx = np.array(branches.follow(r1 + du1, r2 + du2))
        change = np.abs(dw / w).max(axis=(0, 1))
        if points.law.maxwell is not None:
            change *= np.sqrt(np.abs(points.law.maxwell / points.law.t1).max(axis=(0, 1), initial=1.0))
        change = np.maximum(change, np.abs(dx).max(axis=(0, 1, 2, 3), initial=0.0))
        short = np.where(change > 2.0, 2.0 / change, 1.0)
        if slack is not None:
            before, slack = slack, _slackened(films, at, short * du2, short * de, iteration < MOST_FLIPS)
            change = np.maximum(change, np.where(((before > 0.0) != (slack > 0.0)).any(axis=(0, 1)), 2.0 * goal, 0.0))
        largest = change.max()
        height = height + short * rise
        if largest <= goal:
            c, w, x = c + dc, w + dw, x + dx
            break
        moved = w + short * dw
        c, w = c + short * dc, np.where(moved > 0.2 * w, moved, 0.2 * w)
        x = x + np.clip(short * dx, -LONGEST_STRAIN_STEP, LONGEST_STRAIN_STEP)
        if not (change > goal).any():
            break
    u = np.array((at.logs[0, 0] + du1, at.logs[1, 0] + du2))
    with np.errstate(invalid="ignore"):
        ok = (change <= goal) & (lam > 0.0) & system.positive & _definite(matrix)
        if folds is not None:
            ok &= (~folds.where | (at.raw.h22 > 0.0)).all(axis=(0, 1))
        if free is not None:
            ok &= (free.excess > 0.0) | (free.push == 0.0)
    diagonal = np.einsum("sii->is", matrix)
    problem = Problem(Film(points.law, field, count), films.log_prestretch, films.span, height)  # type: ignore[arg-type]
    step = ritz.Step(dc, dw, lam, ok, diagonal)
    state = State(c, w, x, height, slack)
    # Strains are of the order of the slopes' square. What is more in a nearly flat film Newton's method has left there.
    last = ritz.State(np.minimum(np.abs(c), (w * w).max(axis=(0, 1))), w)
    tail = lam * np.where(height > 2.0 * FLAT, np.abs(refinement.tail(problem, grid, last, step)), 0.0)
    if free is not None:
        tail = tail / np.abs(free.excess)
    return Balance(films, state, lam, u, ok, tail, at.logs, points, system, inverse, branches, at.raw, folds, free)


def _freed(films: Films, load: Load, system: ritz.Reduced, inverse: Array, height: Array) -> _Free:
    """Free disks at an iterate."""
    modes = -np.einsum("sij,js->is", inverse, system.coupling / system.give)
    stiffness = (1.0 + (system.coupling * modes).sum(axis=0)) / system.give
    push, slope = load.at(films, height)
    return _Free(modes, stiffness, stiffness - slope, push)


def _slackened(films: Films, at: _Iterate, du2: Array, de: Array, flips: bool) -> Array:
    """How far natural widths are above the film's own after a step; with ``flips`` points may fold or get taut."""
    fold = np.where(at.raw.t2 < 0.0, LEAST_SLACK, 0.0) if flips else np.zeros_like(de)
    if at.folds is None:
        return fold
    kept = at.logs[1, 0] + du2 - np.log1p(np.maximum(at.points.e + de, -0.9)) - films.log_prestretch
    return np.where(at.folds.where, np.maximum(kept, 0.0 if flips else LEAST_SLACK), fold)


def _definite(matrix: Array) -> NDArray[np.bool_]:
    """Which of the matrices (S, n, n) are positive definite."""
    if not np.isfinite(matrix).all():
        whole: NDArray[np.bool_] = np.isfinite(matrix.sum(axis=(1, 2)))
        whole[whole] = _definite(matrix[whole])
        return whole
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        least: NDArray[np.bool_] = np.linalg.eigvalsh(matrix).min(axis=1) > 0.0
        return least
    return np.ones(len(matrix), dtype=np.bool_)


@dataclass(slots=True)
class _Iterate:
    """An iterate at the points; ``residual``: what the strains of the branches miss, (K, Q, M, S) each."""

    logs: Array
    points: ritz.Points
    raw: Stress
    folds: _Folds | None
    branches: _Branches
    residual: tuple[Array, Array]


def _evaluate(
    films: Films, field: Array | None, start: Array, lag: Array, state: State, count: Evaluations
) -> _Iterate:
    """Strains, stresses and tangents with the branches' strains eliminated, and what these miss."""
    e, q = films.grid.strain(state.c)
    metric = (q + 2.0) * q
    metric += state.w * state.w
    logs = np.empty((3, 1 + films.branches, *e.shape))
    logs[0, 0] = 0.5 * np.log1p(metric) + films.log_prestretch
    hoop = np.log1p(e) + films.log_prestretch
    logs[1, 0] = hoop
    if state.slack is not None:
        logs[1, 0] += state.slack
    logs[:2, 1:] = state.x
    np.add(logs[0], logs[1], out=logs[2])
    np.negative(logs[2], out=logs[2])
    metric += 1.0
    count.mechanical += logs[0].size
    s1, s2, h11, h12, h22 = films.law.derivatives(logs)
    c11, c12, c22, p1, p2 = h11[1:], h12[1:], h22[1:], s1[1:], s2[1:]
    half = 0.5 * lag
    third = half / 3.0
    gap = logs[:2, :1] - start - state.x
    r1, r2 = gap[0] - third * (2.0 * p1 - p2), gap[1] - third * (2.0 * p2 - p1)
    twice12 = 2.0 * c12
    a11, a12 = 1.0 + third * (2.0 * c11 - c12), third * (twice12 - c22)
    a21, a22 = third * (twice12 - c11), 1.0 + third * (2.0 * c22 - c12)
    over = 1.0 / (a11 * a22 - a12 * a21)
    a11, a12, a21, a22 = a11 * over, a12 * over, a21 * over, a22 * over
    five = np.empty((5, *c11.shape))
    b11, b12, b22 = five[2:]
    np.subtract(c11 * a22, c12 * a21, out=b11)
    np.subtract(c12 * a11, c11 * a12, out=b12)
    np.subtract(c22 * a11, c12 * a12, out=b22)
    np.add(p1, b11 * r1 + b12 * r2, out=five[0])
    np.add(p2, b12 * r1 + b22 * r2, out=five[1])
    sums = (films.ratio * five).sum(axis=1)
    maxwell = None
    sums[0] += s1[0]
    sums[1] += s2[0]
    sums[2] += h11[0]
    sums[3] += h12[0]
    sums[4] += h22[0]
    if field is not None:
        maxwell = field * np.exp(-2.0 * logs[2, 0])
        sums[:2] -= maxwell
        sums[2:] -= 2.0 * maxwell
    raw = law = Stress(sums[0], sums[1], sums[2], sums[3], sums[4], maxwell)
    folds = None
    if state.slack is not None and state.slack.any():
        folded = state.slack > 0.0
        law = relax(Film(films.law, field, count), raw, folded)
        assert law.relief is not None
        folds = _Folds(folded, folded / raw.h22, law.relief.rate)
    points = ritz.Points(
        e=e,
        q=q,
        log=logs[:, 0],
        law=law,
        along=(q + 1.0) / metric,
        down=state.w / metric,
        around=1.0 / (e + 1.0),
        metric=metric,
        hoop=hoop,
    )
    branches = _Branches((p1, p2), half, (a11, a12, a21, a22), (b11, b12, b22))
    return _Iterate(logs, points, raw, folds, branches, (r1, r2))


def flow(films: Films, x: Array) -> Array:
    """``dv/dt`` of branches with the elastic strains ``x`` (2, K, Q, M, S)."""
    s1, s2, *_ = films.law.derivatives(np.concatenate((x, -(x[:1] + x[1:]))))
    return np.array((2.0 * s1 - s2, 2.0 * s2 - s1)) / (6.0 * films.time)


@dataclass(slots=True)
class Slopes:
    """Derivatives by every column (`Films.columns`): of the answer (P, S), of x and v (2, K, Q, M, P, S)."""

    answer: Array
    x: Array
    viscous: Array


def slopes(at: Balance, instant: Instant, start: Array) -> Slopes:
    """Derivatives of films in equilibrium by their parameters; ``start`` (2, K, Q, M, P, S) has those of ``v*``."""
    films, branches = at.films, at.branches
    by_mu, by_alpha = films.law.by_parameters(at.logs)
    laws = np.moveaxis(np.concatenate((by_mu, by_alpha)), 0, -2)  # (2, K+1, Q, M, law's parameters, S)
    count, size, n = films.columns, at.lam.shape[0], laws.shape[-2]
    kinds = films.branches
    field, ratios, times, pre = n, n + 1, n + 1 + kinds, n + 1 + 2 * kinds
    points = at.u.shape[1:3]
    on_stress = np.zeros((2, *points, count, size))
    on_branch = np.zeros((2, kinds, *points, count, size))
    on_stress[..., :n, :] = laws[:, 0]
    on_branch[..., :n, :] = laws[:, 1:]
    law = at.raw
    if law.maxwell is not None:
        on_stress[..., field, :] = -law.maxwell
    lag = np.zeros((kinds, count, size))  # relative change of ``c``
    lag[:, :n] = -films.shear_slopes
    s1, s2 = branches.s
    for k in range(kinds):
        on_stress[0, ..., ratios + k, :] = s1[k]
        on_stress[1, ..., ratios + k, :] = s2[k]
        lag[k, times + k] = -1.0
    # The tangent has the branches in it; of the pre-stretch only film and field feel the motion that is not in ``gap``.
    b11, b12, b22 = ((films.ratio * one).sum(axis=0) for one in branches.b)
    on_stress[0, ..., pre, :] = law.h11 + law.h12 - b11 - b12
    on_stress[1, ..., pre, :] = law.h12 + law.h22 - b12 - b22
    on_stress += (films.ratio[..., None, :] * on_branch).sum(axis=1)
    gap = -start
    gap[..., pre, :] += 1.0
    if branches.half.any():
        third = branches.half[..., None, :] / 3.0
        on_branch[0] += lag[:, None, None] * s1[..., None, :]
        on_branch[1] += lag[:, None, None] * s2[..., None, :]
        gap[0] -= third * (2.0 * on_branch[0] - on_branch[1])
        gap[1] -= third * (2.0 * on_branch[1] - on_branch[0])
    height = np.zeros((count, size))
    height[-1] = instant.side / films.ring if at.free is None else at.free.push
    answer, (du1, du2), x = at.respond(on_stress, gap, height)
    viscous = np.array((du1 - x[0], du2 - x[1]))
    viscous[..., pre, :] += 1.0
    return Slopes(answer, np.array(x), viscous)


def flow_slopes(films: Films, at: Balance, x: Array, rate: Array) -> Array:
    """Derivatives of ``dv/dt`` by every column, (2, K, Q, M, P, S), from those of the elastic strains ``x``."""
    _, _, h11, h12, h22 = films.law.derivatives(at.logs[:, 1:])
    by_mu, by_alpha = films.law.by_parameters(at.logs[:, 1:])
    laws = np.moveaxis(np.concatenate((by_mu, by_alpha)), 0, -2)
    h11, h12, h22 = (one[..., None, :] for one in (h11, h12, h22))
    s = np.array((h11 * x[0] + h12 * x[1], h12 * x[0] + h22 * x[1]))
    n = laws.shape[-2]
    s[..., :n, :] += laws
    found: Array = np.array((2.0 * s[0] - s[1], 2.0 * s[1] - s[0])) / (6.0 * films.time[..., None, :])
    found[..., :n, :] -= films.shear_slopes * rate[..., None, :]
    for k in range(films.branches):
        found[:, k, ..., n + 1 + films.branches + k, :] -= rate[:, k]
    return found
