r"""The Ritz form of the membrane problem and its Newton step.

Coordinate ``x = ln(R/b)`` in [-span, 0]; lengths in units of b, stresses in units of the shear modulus. Unknowns:

- ``e = r/R - 1``, a sum of integrated Legendre modes ``phi_k`` in x that vanish at disk and ring (coefficients ``c``);
- the slope ``w = -dz/dR`` at every quadrature point, free but for the one condition ``int w R dx = h``;
- the multiplier ``lam`` of that condition, which is the force.

With ``p = dr/dR = 1 + e + de/dx`` the stretches are ``l1 = lp sqrt(p^2 + w^2)`` and ``l2 = lp (1 + e)``. Equilibrium
makes ``int W* R^2 dx`` stationary under the condition; at each point that gives the vertical balance
``R dW*/dw = lam``, which is the first integral ``2 pi R (T/lp) S1 sin(theta) = F`` itself. The slopes stand alone at
their points, so Newton eliminates them there by a division, and the system to factor has one unknown a mode. With a
positive ``d2W*/dw2`` at every point (a stable film always has it) the reduced matrix is positive definite exactly
when the state is stable under prescribed displacement.

The film may be cut into elements in x, each with modes of its own and a hat function at every cut: a wrinkled zone ends
in a kink, and convergence is kept by putting a cut there. In a relaxed element the hoop stretch that makes the stress
is not ``lp r/R`` but the natural one, an unknown of its point like the slope, and eliminated there in the same way.

Arrays at points have the shape (Q, M, S): points of an element, elements, states. The states are always the last axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.material.law import Film, Stress, relax, stack, stress
from model.membrane.straight import Straight

Index = NDArray[np.intp] | NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Table:
    """Modes and quadrature on [-1, 1]: N modes and two hats, Q Gauss points."""

    modes: int
    points: int
    xi: Array  # (Q,)
    weight: Array  # (Q,)
    values: Array  # (2Q, N+2): functions over their derivatives; the last two are the hats, left and right
    project: Array  # (N+2, 2Q): the same, functions and derivatives side by side, transposed
    pairs: Array  # ((N+2)(N+3)/2, 3Q): products of functions for the Hessian
    square: NDArray[np.intp]  # (N+2, N+2): where each entry of the matrix stands among the pairs
    ends: Array  # (2, Q): extrapolation to xi = -1 and xi = 1
    end_slopes: Array  # (2, Q): derivative there
    to_legendre: Array  # (Q, Q): Legendre coefficients of the polynomial through the points
    integrate: Array  # (Q, Q): integral from -1 to each point
    to_modes: Array  # (N, Q): modes of a function whose derivative is given


gauss = lru_cache(maxsize=128)(np.polynomial.legendre.leggauss)  # points and weights


@lru_cache(maxsize=64)
def _barycentric_weights(points: int) -> Array:
    xi, weight = gauss(points)
    return np.asarray((-1.0) ** np.arange(points) * np.sqrt((1.0 - xi * xi) * weight))


def barycentric(xi: Array, at: Array) -> Array:
    """Matrix (len(at), len(xi)) of polynomial interpolation from the Gauss points ``xi`` to ``at``."""
    lam = _barycentric_weights(len(xi))
    gap = at[:, None] - xi[None, :]
    hit = gap == 0.0
    ratio = lam / np.where(hit, 1.0, gap)
    out: Array = ratio / ratio.sum(axis=1, keepdims=True)
    rows = hit.any(axis=1)
    out[rows] = hit[rows]
    return out


MORE_POINTS = 3  # Gauss points than modes: with fewer the quadrature's error outgrows the modes', more change nothing


@lru_cache(maxsize=64)
def table(modes: int) -> Table:
    """Tables for ``modes`` integrated Legendre modes, made once."""
    points = modes + MORE_POINTS
    xi, weight = gauss(points)
    k = np.arange(1, modes + 1).astype(np.float64)
    legendre = np.polynomial.legendre.legvander(xi, points)
    half = np.full(points, 0.5)
    phi = np.column_stack(
        ((legendre[:, 2 : modes + 2] - legendre[:, :modes]) / np.sqrt(4.0 * k + 2.0), half - 0.5 * xi, half + 0.5 * xi)
    )
    dphi = np.column_stack((legendre[:, 1 : modes + 1] * np.sqrt(k + 0.5), -half, half))
    i, j = np.tril_indices(modes + 2)
    square = np.empty((modes + 2, modes + 2), dtype=np.intp)
    square[i, j] = square[j, i] = np.arange(len(i))
    products = np.concatenate(
        (phi[:, i] * phi[:, j], phi[:, i] * dphi[:, j] + dphi[:, i] * phi[:, j], dphi[:, i] * dphi[:, j])
    )
    # P_n'(+-1) = (+-1)^(n+1) n (n+1) / 2
    n = np.arange(points).astype(np.float64)
    slope = 0.5 * n * (n + 1.0)
    to_legendre = (legendre[:, :points] * weight[:, None] * (n + 0.5)).T
    end_slopes = np.stack(((-1.0) ** (n + 1.0) * slope, slope)) @ to_legendre
    # The integral of P_n from -1 is (P_(n+1) - P_(n-1))/(2n + 1), of P_0 it is P_1 + P_0.
    integrals = np.empty((points, points))
    integrals[:, 0] = xi + 1.0
    integrals[:, 1:] = (legendre[:, 2:] - legendre[:, : points - 1]) / (2.0 * n[1:] + 1.0)
    return Table(
        modes=modes,
        points=points,
        xi=xi.astype(np.float64),
        weight=weight.astype(np.float64),
        values=np.concatenate((phi, dphi)),
        project=np.ascontiguousarray(np.concatenate((phi, dphi)).T),
        pairs=np.ascontiguousarray(products.T),
        square=square,
        ends=barycentric(xi, np.array([-1.0, 1.0])),
        end_slopes=end_slopes,
        to_legendre=to_legendre,
        integrate=integrals @ to_legendre,
        to_modes=np.ascontiguousarray((dphi[:, :modes] * weight[:, None]).T),
    )


@lru_cache(maxsize=256)
def transfer(old: int, new: int) -> Array:
    """Matrix that carries point values from the points of ``old`` modes to those of ``new``."""
    return barycentric(table(old).xi, table(new).xi)


@lru_cache(maxsize=256)
def places(modes: int, elements: int, some: tuple[int, ...] | None = None) -> NDArray[np.intp]:
    """(M, N+2): the unknown that each function of ``some`` elements, or of all, belongs to; -1 where there is none.

    The modes of these elements come first, then every cut of the film.
    """
    chosen = np.arange(elements) if some is None else np.array(some, dtype=np.intp)
    bubbles = len(chosen) * modes
    cuts = np.concatenate(([-1], bubbles + np.arange(elements - 1), [-1]))
    out = np.empty((len(chosen), modes + 2), dtype=np.intp)
    out[:, :modes] = np.arange(bubbles).reshape(-1, modes)
    out[:, modes] = cuts[chosen]
    out[:, modes + 1] = cuts[chosen + 1]
    return out


@dataclass(slots=True)
class Grid:
    """A table laid on the elements of the films: radii and weights at the points, (Q, M, S)."""

    table: Table
    breaks: Array  # (M+1, S): ln(R/b) from -span to 0
    radius: Array  # R/b
    once: Array  # weight dx R
    twice: Array  # weight dx R^2
    dxi: Array  # d(xi)/dx, (M, S)
    place: NDArray[np.intp]  # (M, N+2), see `places`

    @classmethod
    def lay(cls, modes: int, breaks: Array) -> Grid:
        t = table(modes)
        half = 0.5 * (breaks[1:] - breaks[:-1])
        radius = half * (t.xi[:, None, None] - 1.0)
        radius += breaks[1:]
        np.exp(radius, out=radius)
        once = t.weight[:, None, None] * half
        once *= radius
        return cls(t, breaks, radius, once, once * radius, 1.0 / half, places(modes, len(breaks) - 1))

    @property
    def elements(self) -> int:
        return len(self.place)

    @property
    def unknowns(self) -> int:
        return self.elements * self.table.modes + len(self.breaks) - 2

    def part(self, some: tuple[int, ...]) -> Grid:
        """The elements ``some`` alone, with the same cuts."""
        place = places(self.table.modes, len(self.breaks) - 1, some)
        run = slice(some[0], some[0] + len(some)) if some else slice(0, 0)
        index = run if some == tuple(range(run.start, run.stop)) else list(some)
        radius, once, twice = (values[:, index] for values in (self.radius, self.once, self.twice))
        return Grid(self.table, self.breaks, radius, once, twice, self.dxi[index], place)

    def take(self, index: Index) -> Grid:
        return Grid(
            self.table,
            self.breaks[:, index],
            self.radius[..., index],
            self.once[..., index],
            self.twice[..., index],
            self.dxi[:, index],
            self.place,
        )

    def strain(self, c: Array) -> tuple[Array, Array]:
        """``e = r/R - 1`` and ``q = dr/dR - 1`` (less one, for a change) at the points, from the unknowns (n, S)."""
        t = self.table
        m, states = self.elements, c.shape[1]
        if m == 1 and len(self.breaks) == 2:
            values = t.values[:, : t.modes] @ c
        else:
            padded = np.concatenate((c, np.zeros((1, states))))
            local = padded[self.place.T]  # (N+2, M, S)
            values = t.values @ local.reshape(t.modes + 2, m * states)
        values = values.reshape(2, t.points, m, states)
        e, q = values[0], values[1]
        q *= self.dxi
        q += e
        return e, q

    def project(self, on_e: Array, on_q: Array) -> Array:
        """``sum over points of on_e phi + on_q (phi + dphi/dx)`` for every unknown, (n, S)."""
        t = self.table
        m, states = self.elements, on_e.shape[2]
        stacked = np.empty((2, *on_e.shape))
        np.add(on_e, on_q, out=stacked[0])
        np.multiply(on_q, self.dxi, out=stacked[1])
        if m == 1 and len(self.breaks) == 2:
            return t.project[: t.modes] @ stacked.reshape(2 * t.points, states)
        local = (t.project @ stacked.reshape(2 * t.points, m * states)).reshape(t.modes + 2, m, states)
        out = np.zeros((self.unknowns + 1, states))
        for element, place in enumerate(self.place):
            out[place] += local[:, element]
        return out[:-1]

    def matrix(self, ee: Array, eq: Array, qq: Array) -> Array:
        """``sum over points of ee e e' + eq (e q' + q e') + qq q q'`` for every pair of unknowns, (n, n, S)."""
        t = self.table
        m, states = self.elements, ee.shape[2]
        stacked = np.empty((3, *ee.shape))
        sum_eq = stacked[1]
        np.add(qq, eq, out=sum_eq)
        np.add(ee, eq, out=stacked[0])
        stacked[0] += sum_eq
        sum_eq *= self.dxi
        np.multiply(qq, self.dxi * self.dxi, out=stacked[2])
        if m == 1 and len(self.breaks) == 2:
            n = t.modes
            products = t.pairs[: n * (n + 1) // 2] @ stacked.reshape(3 * t.points, states)
            return products[t.square[:n, :n]]
        products = (t.pairs @ stacked.reshape(3 * t.points, m * states)).reshape(len(t.pairs), m, states)
        n, size = t.modes, self.unknowns
        out = np.zeros((size, size, states))
        for element in range(m):
            own = slice(element * n, (element + 1) * n)
            out[own, own] = products[t.square[:n, :n], element]
            left, right = self.place[element, n:]
            for hat, cut in ((n, left), (n + 1, right)):
                if cut >= 0:
                    out[own, cut] = out[cut, own] = products[t.square[:n, hat], element]
                    out[cut, cut] += products[t.square[hat, hat], element]
            if left >= 0 and right >= 0:
                out[left, right] = out[right, left] = products[t.square[n, n + 1], element]
        return out


@dataclass(slots=True)
class Problem:
    """A block of states to solve: dimensionless numbers, each (S,)."""

    film: Film
    log_prestretch: Array
    span: Array  # ln(b/a)
    height: Array  # h/b > 0

    def take(self, index: Index) -> Problem:
        return Problem(self.film.take(index), self.log_prestretch[index], self.span[index], self.height[index])

    def cut(self, pieces: int | None = None) -> Array:
        """Breaks (M+1, S) of equal elements over the film: as many as the longest span asks for, or ``pieces``."""
        if pieces is None:
            pieces = elements(self.span)
        return -self.span * np.linspace(1.0, 0.0, pieces + 1)[:, None]


# Radii of an element differ by less than e^4 = 55. Over more the weights R^2 cost digits, and modes of a high degree
# are wasted on the far end.
LONGEST = 4.0


def elements(span: Array) -> int:
    """Elements for films of these spans."""
    return max(1, math.ceil(float(span.max()) / LONGEST))


@dataclass(slots=True)
class State:
    """Unknowns of a block of states."""

    c: Array  # (n, S) modes and cuts
    w: Array  # (Q, M, S) slopes
    natural: Array | None = None  # (Q, M, S) natural ln(l2) where relaxed
    relaxed: NDArray[np.bool_] | None = None  # (Q, M, S) where the hoop stress is relaxed to zero
    cones: Straight | None = None  # wrinkled elements where points do not tell enough

    def take(self, index: Index) -> State:
        return State(
            self.c[:, index],
            self.w[..., index],
            None if self.natural is None else self.natural[..., index],
            None if self.relaxed is None else self.relaxed[..., index],
            None if self.cones is None else self.cones.take(index),
        )

    def put(self, index: Index, other: State) -> None:
        self.c[:, index] = other.c
        self.w[..., index] = other.w
        if self.natural is not None and other.natural is not None:
            self.natural[..., index] = other.natural
        if self.relaxed is not None and other.relaxed is not None:
            self.relaxed = self.relaxed.copy()  # often a view that repeats one row
            self.relaxed[..., index] = other.relaxed


@dataclass(slots=True)
class Points:
    """The state at the points: strains, stresses and what Newton needs, (Q, M, S) each."""

    e: Array
    q: Array
    log: Array  # (3, Q, M, S): L1, the L2 that makes the stress, -(L1 + L2)
    law: Stress
    along: Array  # dL1/dp
    down: Array  # dL1/dw
    around: Array  # dL2/de
    metric: Array  # p^2 + w^2
    hoop: Array  # ln(lp r/R), the same as log[1] but where relaxed


def evaluate(problem: Problem, grid: Grid, state: State) -> Points:
    """Strains, stresses and tangents of ``state``."""
    e, q = grid.strain(state.c)
    g = q + 2.0
    g *= q
    g += state.w * state.w
    log1 = np.log1p(g)
    log1 *= 0.5
    log1 += problem.log_prestretch
    hoop = np.log1p(e)
    hoop += problem.log_prestretch
    if state.relaxed is None or state.natural is None:
        log = stack(log1, hoop)
        law = stress(problem.film, log)
    else:
        log = stack(log1, np.where(state.relaxed, state.natural, hoop))
        law = relax(problem.film, stress(problem.film, log), state.relaxed)
    g += 1.0
    return Points(
        e=e, q=q, log=log, law=law, along=(q + 1.0) / g, down=state.w / g, around=1.0 / (e + 1.0), metric=g, hoop=hoop
    )


@dataclass(slots=True)
class Step:
    """One Newton step: the change of the state, the force after it, and whether the state is stable."""

    dc: Array  # (n, S)
    dw: Array  # (Q, M, S)
    lam: Array  # (S,)
    stable: NDArray[np.bool_]
    diagonal: Array  # (n, S) of the reduced matrix
    tangent: tuple[Array, Array, Array] | None = None  # dc/dh, dw/dh, dlam/dh


@dataclass(slots=True)
class Reduced:
    """The Newton system after the slopes are eliminated: ``height = reach + give lam - coupling . dc``."""

    matrix: Array  # (n, n, S) at fixed lam
    residual: Array  # (n, S), to which lam adds ``lam coupling``
    coupling: Array  # (n, S)
    give: Array  # (S,)
    reach: Array  # (S,)
    hw: Array
    kqw: Array
    kew: Array
    gw: Array
    positive: NDArray[np.bool_]  # (S,): d2W*/dw2 > 0 everywhere

    def condensed(self) -> Array:
        """The matrix (n, n, S) with the multiplier eliminated: positive definite where the state is stable."""
        return self.matrix + self.coupling[:, None] * (self.coupling / self.give)[None]


def reduce(grid: Grid, w: Array, at: Points) -> Reduced:
    """Assemble the Newton system of the modes alone."""
    law, along, down, around = at.law, at.along, at.down, at.around
    tm = law.t1 / at.metric
    d = law.h11 - 2.0 * law.t1
    slope = d * down
    kww = slope * down
    kww += tm
    hw = 1.0 / kww
    kqw = slope * along
    h12a = law.h12 * around
    kew = h12a * down
    gw = law.t1 * down
    thw = tm * hw
    d /= at.metric
    d += tm
    d *= thw  # K_qq - K_qw^2 / K_ww without the cancellation
    eq = h12a * along
    eq *= thw
    ee = law.h22 - law.t2
    ee *= around * around
    hkew = hw * kew
    ee -= kew * hkew
    matrix = grid.matrix(grid.twice * ee, grid.twice * eq, grid.twice * d)
    coupling = grid.project(grid.once * hkew, grid.once * (hw * kqw))
    hg = hw * gw
    residual = grid.project(grid.twice * (law.t2 * around - hg * kew), grid.twice * (law.t1 * along - hg * kqw))
    give = (grid.once * hw / grid.radius).sum(axis=(0, 1))
    np.subtract(w, hg, out=hg)
    hg *= grid.once
    positive = kww.min(axis=(0, 1), initial=np.inf) > 0.0
    return Reduced(matrix, residual, coupling, give, hg.sum(axis=(0, 1)), hw, kqw, kew, gw, positive)


FEW_STATES = 8  # below this many states elimination is not vectorised over the states
FEW_UNKNOWNS = 8  # below this many unknowns a loop over Python floats beats LAPACK's call


def factor_solve(matrix: Array, rhs: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Solve symmetric systems (n, n, S) for right-hand sides (n, k, S); tell which matrices are positive definite.

    Elimination without pivoting, which is stable for those; another matrix gets what it gets.
    """
    n, _, states = matrix.shape
    if states < FEW_STATES:
        few = _solve_small if n <= FEW_UNKNOWNS else _solve_large
        solved = [few(matrix[:, :, s], rhs[:, :, s]) for s in range(states)]
        return np.stack([x for x, _ in solved], axis=2), np.array([positive for _, positive in solved])
    a = np.concatenate((matrix, rhs), axis=1)
    positive = np.ones(states, dtype=np.bool_)
    for k in range(n):
        pivot = a[k, k]
        positive &= pivot > 0.0
        a[k, k + 1 :] /= pivot
        if k + 1 < n:
            a[k + 1 :, k + 1 :] -= a[k + 1 :, k, None] * a[k, None, k + 1 :]
    x = a[:, n:]
    for k in range(n - 2, -1, -1):
        x[k] -= (a[k, k + 1 : n, None] * x[k + 1 :]).sum(axis=0)
    return x, positive


def _solve_small(matrix: Array, rhs: Array) -> tuple[Array, bool]:
    n = len(matrix)
    rows = [row + right for row, right in zip(matrix.tolist(), rhs.tolist(), strict=True)]
    positive = True
    for k, row in enumerate(rows):
        pivot = row[k]
        positive = positive and pivot > 0.0
        if pivot == 0.0:
            return np.full(rhs.shape, np.nan), False
        for i in range(k + 1, n):
            other = rows[i]
            factor = other[k] / pivot
            for j in range(k + 1, len(row)):
                other[j] -= factor * row[j]
    for k in range(n - 1, -1, -1):
        row = rows[k]
        for j in range(n, len(row)):
            total = row[j]
            for i in range(k + 1, n):
                total -= row[i] * rows[i][j]
            row[j] = total / row[k]
    return np.array([row[n:] for row in rows]).reshape(rhs.shape), positive


def _solve_large(matrix: Array, rhs: Array) -> tuple[Array, bool]:
    try:
        inverse = np.linalg.inv(np.linalg.cholesky(matrix))
    except np.linalg.LinAlgError:
        try:
            return np.linalg.solve(matrix, rhs).astype(np.float64, copy=False), False
        except np.linalg.LinAlgError:
            return np.full(rhs.shape, np.nan), False
    x: Array = inverse.T @ (inverse @ rhs)
    return x, True


def newton(problem: Problem, grid: Grid, state: State, at: Points, *, tangent: bool = False) -> Step:
    """The Newton step at ``state``; with ``tangent`` also the derivative of the state with respect to h/b."""
    return solve(problem, grid, reduce(grid, state.w, at), tangent=tangent)


def solve(problem: Problem, grid: Grid, system: Reduced, *, tangent: bool = False) -> Step:
    """The Newton step that ``system`` asks for."""
    lam0 = (problem.height - system.reach) / system.give
    rhs = -(system.residual + lam0 * system.coupling)[:, None]
    if tangent:
        rhs = np.concatenate((rhs, -(system.coupling / system.give)[:, None]), axis=1)
    matrix = system.condensed()
    solutions, positive = factor_solve(matrix, rhs)

    def slopes(dc: Array, lam: Array, gradient: Array | float) -> Array:
        de, dq = grid.strain(dc)
        out = lam / grid.radius
        out -= gradient
        dq *= system.kqw
        out -= dq
        de *= system.kew
        out -= de
        out *= system.hw
        return out

    dc = solutions[:, 0]
    lam = lam0 + (system.coupling * dc).sum(axis=0) / system.give
    diagonal = np.einsum("iis->is", matrix)
    step = Step(dc, slopes(dc, lam, system.gw), lam, positive & system.positive, diagonal)
    if tangent:
        tc = solutions[:, 1]
        stiffness = (1.0 + (system.coupling * tc).sum(axis=0)) / system.give
        step.tangent = (tc, slopes(tc, stiffness, 0.0), stiffness)
    return step


def guess(problem: Problem, grid: Grid) -> State:
    """A first state: r = R, and slopes that follow the power law ``w ~ R^(-1/n)`` of the film at its mean slope.

    ``R sigma1 w/(1+w^2) = const`` makes n the logarithmic derivative of that stress at the mean slope.
    """
    mean = problem.height / -np.expm1(-problem.span)
    square = mean * mean
    log1 = 0.5 * np.log1p(square) + problem.log_prestretch
    law = stress(problem.film, stack(log1, problem.log_prestretch))
    t1, h11 = law.t1, law.h11
    part = square / (1.0 + square)
    power = np.where(t1 > 0.0, 1.0 - 2.0 * part + part * h11 / t1, 1.0)
    power = np.where(power > 0.5, power, 1.0)
    w = np.exp(np.log(grid.radius) / -power)
    w *= problem.height / (grid.once * w).sum(axis=(0, 1))
    return State(np.zeros((grid.unknowns, w.shape[2])), w)


def careful_guess(problem: Problem, grid: Grid) -> State:
    """The first state with r = R held exactly: for films whose slopes follow no power law, at many times the cost.

    Each point's balance ``R sigma1 w/(1+w^2) = lam`` is solved for ln(w), and lam for the height.
    """
    state = guess(problem, grid)
    log_w = np.log(np.minimum(state.w, 1.0))
    log_lam = np.full(len(problem.span), np.nan)
    w, open_ = state.w, np.ones(len(problem.span), dtype=np.bool_)  # each state stops by itself
    for outer in range(40):
        moving = open_.copy()
        for _ in range(30 if outer == 0 else 6):
            trial = np.exp(log_w)
            part = trial * trial / (1.0 + trial * trial)
            log1 = 0.5 * np.log1p(trial * trial) + problem.log_prestretch
            law = stress(problem.film, stack(log1, np.broadcast_to(problem.log_prestretch, log1.shape)))
            pull = np.log(np.maximum(law.t1, 1e-300)) + np.log(grid.radius * trial / (1.0 + trial * trial))
            power = np.maximum(1.0 - 2.0 * part + part * law.h11 / law.t1, 0.2)
            if outer == 0:
                log_lam = np.where(np.isfinite(log_lam), log_lam, np.median(pull.reshape(-1, pull.shape[2]), axis=0))
            step = (log_lam - pull) / power
            log_w = np.where(moving, log_w + np.clip(step, -0.7, 0.7), log_w)
            moving &= np.abs(step).max(axis=(0, 1)) > 1e-6
            if not moving.any():
                break
        w = np.where(open_, np.exp(log_w), w)
        reach = (grid.once * w).sum(axis=(0, 1))
        give = (grid.once * w / power).sum(axis=(0, 1)) / reach
        miss = np.log(problem.height / reach)
        log_lam = np.where(open_, log_lam + np.clip(miss / give, -2.0, 2.0), log_lam)
        open_ &= np.abs(miss) > 1e-3
        if not open_.any():
            break
    w *= problem.height / (grid.once * w).sum(axis=(0, 1))
    good = np.isfinite(w).all(axis=(0, 1))
    return State(state.c, np.where(good, w, state.w))
