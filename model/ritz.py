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

All arrays have the states along the last axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from model.law import Array, Film, Stress, stack, stress


@dataclass(frozen=True, slots=True)
class Table:
    """Modes and quadrature on [-1, 1]: N modes, Q Gauss points."""

    modes: int
    points: int
    xi: Array  # (Q,)
    weight: Array  # (Q,)
    phi: Array  # (Q, N)
    dphi: Array  # (Q, N)
    both: Array  # (2Q, N): phi over dphi
    both_t: Array  # (N, 2Q): phi and dphi side by side, transposed
    pairs: Array  # (N (N+1)/2, 3Q): products of modes for the Hessian
    square: NDArray[np.intp]  # (N, N): where each entry of the matrix stands among the pairs
    ends: Array  # (2, Q): barycentric extrapolation to xi = -1 and xi = 1


def barycentric(xi: Array, at: Array) -> Array:
    """Matrix (len(at), len(xi)) of polynomial interpolation from Gauss-Legendre points ``xi`` to ``at``."""
    n = len(xi)
    _, weight = np.polynomial.legendre.leggauss(n)
    lam = (-1.0) ** np.arange(n) * np.sqrt((1.0 - xi * xi) * weight)
    gap = at[:, None] - xi[None, :]
    hit = gap == 0.0
    ratio = lam / np.where(hit, 1.0, gap)
    out: Array = ratio / ratio.sum(axis=1, keepdims=True)
    rows = hit.any(axis=1)
    out[rows] = hit[rows]
    return out


@lru_cache(maxsize=64)
def table(modes: int, points: int) -> Table:
    """Tables for ``modes`` integrated Legendre modes and ``points`` Gauss points, made once."""
    xi, weight = np.polynomial.legendre.leggauss(points)
    k = np.arange(1, modes + 1).astype(np.float64)
    legendre = np.polynomial.legendre.legvander(xi, modes + 1)
    phi = (legendre[:, 2:] - legendre[:, :-2]) / np.sqrt(4.0 * k + 2.0)
    dphi = (legendre[:, 1:-1] * np.sqrt(k + 0.5)).astype(np.float64, copy=False)
    i, j = np.tril_indices(modes)
    square = np.empty((modes, modes), dtype=np.intp)
    square[i, j] = square[j, i] = np.arange(len(i))
    products = np.concatenate(
        (phi[:, i] * phi[:, j], phi[:, i] * dphi[:, j] + dphi[:, i] * phi[:, j], dphi[:, i] * dphi[:, j])
    )
    return Table(
        modes=modes,
        points=points,
        xi=xi,
        weight=weight,
        phi=phi,
        dphi=dphi,
        both=np.concatenate((phi, dphi)),
        both_t=np.ascontiguousarray(np.concatenate((phi, dphi)).T),
        pairs=np.ascontiguousarray(products.T),
        square=square,
        ends=barycentric(xi, np.array([-1.0, 1.0])),
    )


@lru_cache(maxsize=256)
def transfer(old: int, new: int) -> Array:
    """Matrix (new, old) that carries point values from ``old`` to ``new`` Gauss points."""
    xi, _ = np.polynomial.legendre.leggauss(old)
    at, _ = np.polynomial.legendre.leggauss(new)
    return barycentric(xi, at)


@dataclass(slots=True)
class Grid:
    """A table laid on the films' spans ``ln(b/a)``: radii and weights at the points, (Q, S)."""

    table: Table
    radius: Array  # R/b
    once: Array  # weight dx R
    twice: Array  # weight dx R^2
    dxi: Array  # d(xi)/dx, (S,)

    @classmethod
    def lay(cls, modes: int, span: Array) -> Grid:
        t = table(modes, modes + 4)
        half = 0.5 * span
        radius = np.exp((t.xi[:, None] - 1.0) * half)
        once = radius * (t.weight[:, None] * half)
        return cls(t, radius, once, once * radius, 1.0 / half)

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Grid:
        return Grid(self.table, self.radius[:, index], self.once[:, index], self.twice[:, index], self.dxi[index])

    def strain(self, c: Array) -> tuple[Array, Array]:
        """``e = r/R - 1`` and ``q = dr/dR - 1`` at the points."""
        q = self.table.points
        values = self.table.both @ c
        e = values[:q]
        return e, values[q:] * self.dxi + e

    def project(self, on_e: Array, on_q: Array) -> Array:
        """``sum over points of on_e phi_k + on_q (phi_k + dphi_k/dx)`` for every mode k, (N, S)."""
        return self.table.both_t @ np.concatenate((on_e + on_q, on_q * self.dxi))

    def matrix(self, ee: Array, eq: Array, qq: Array) -> Array:
        """``sum over points of ee e_j e_k + eq (e_j q_k + q_j e_k) + qq q_j q_k``, (N, N, S)."""
        mixed = (qq + eq) * self.dxi
        stacked = np.concatenate((ee + eq + eq + qq, mixed, qq * (self.dxi * self.dxi)))
        return (self.table.pairs @ stacked)[self.table.square]


@dataclass(slots=True)
class Problem:
    """A block of states to solve: dimensionless numbers, each (S,)."""

    film: Film
    log_prestretch: Array
    span: Array  # ln(b/a)
    height: Array  # h/b > 0

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Problem:
        return Problem(self.film.take(index), self.log_prestretch[index], self.span[index], self.height[index])


@dataclass(slots=True)
class Points:
    """The state at the points: strains, stresses and what Newton needs, (Q, S) each."""

    e: Array
    q: Array
    log: Array  # (3, Q, S)
    law: Stress
    along: Array  # dL1/dp
    down: Array  # dL1/dw
    around: Array  # dL2/de
    metric: Array  # p^2 + w^2


def evaluate(problem: Problem, grid: Grid, c: Array, w: Array) -> Points:
    """Strains, stresses and tangents of the state ``(c, w)``."""
    e, q = grid.strain(c)
    g = q * (q + 2.0)
    g += w * w
    log1 = np.log1p(g)
    log1 *= 0.5
    log1 += problem.log_prestretch
    log2 = np.log1p(e)
    log2 += problem.log_prestretch
    log = stack(log1, log2)
    g += 1.0
    return Points(
        e=e,
        q=q,
        log=log,
        law=stress(problem.film, log),
        along=(q + 1.0) / g,
        down=w / g,
        around=1.0 / (e + 1.0),
        metric=g,
    )


@dataclass(slots=True)
class Step:
    """One Newton step: directions, the force it predicts, and what it says about the state."""

    dc: Array  # (N, S)
    dw: Array  # (Q, S)
    lam: Array  # (S,) force multiplier after the step
    stable: NDArray[np.bool_]  # reduced matrix positive definite, d2W/dw2 > 0 everywhere
    tangent: tuple[Array, Array, Array] | None = None  # dc/dh, dw/dh, dlam/dh


@dataclass(slots=True)
class Reduced:
    """What is left after the slopes are eliminated."""

    matrix: Array  # (N, N, S)
    rhs: Array  # (N, S)
    coupling: Array  # (N, S)
    give: Array  # (S,): d(h)/d(lam) at fixed c
    lam0: Array
    hw: Array
    kqw: Array
    kew: Array
    gw: Array
    positive: NDArray[np.bool_]


def reduce(problem: Problem, grid: Grid, w: Array, at: Points) -> Reduced:
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
    qq = (d / at.metric + tm) * thw  # K_qq - K_qw^2 / K_ww without the cancellation
    eq = h12a * along
    eq *= thw
    ee = law.h22 - law.t2
    ee *= around * around
    ee -= kew * kew * hw
    matrix = grid.matrix(grid.twice * ee, grid.twice * eq, grid.twice * qq)
    hr = grid.once * hw
    coupling = grid.project(hr * kew, hr * kqw)
    hg = hw * gw
    residual = grid.project(grid.twice * (law.t2 * around - hg * kew), grid.twice * (law.t1 * along - hg * kqw))
    give = (hr / grid.radius).sum(axis=0)
    lam0 = (problem.height + (grid.once * (hg - w)).sum(axis=0)) / give
    matrix += coupling[:, None] * (coupling / give)[None]
    rhs = lam0 * coupling
    rhs += residual
    np.negative(rhs, out=rhs)
    return Reduced(matrix, rhs, coupling, give, lam0, hw, kqw, kew, gw, kww.min(axis=0) > 0.0)


FEW = 8  # below this many states one LAPACK call beats elimination vectorised over the states


def factor_solve(matrix: Array, rhs: list[Array]) -> tuple[list[Array], NDArray[np.bool_]]:
    """Solve symmetric systems (N, N, S) for right-hand sides (N, S); also tell which matrices are positive definite."""
    n, _, states = matrix.shape
    if states < FEW:
        a = np.moveaxis(matrix, -1, 0)
        b = np.stack(rhs, axis=-1).transpose(1, 0, 2)
        try:
            x: Array = np.linalg.solve(a, b).astype(np.float64, copy=False)
        except np.linalg.LinAlgError:
            x = np.full(b.shape, np.nan)
        finite = np.isfinite(matrix).all(axis=(0, 1))
        lowest = np.full(states, -1.0)
        if finite.any():
            lowest[finite] = np.linalg.eigvalsh(a[finite])[:, 0]
        return [x[:, :, i].T for i in range(len(rhs))], lowest > 0.0
    a = np.concatenate((matrix, np.stack(rhs, axis=1)), axis=1)
    positive = np.ones(states, dtype=bool)
    for k in range(n):
        pivot = a[k, k]
        positive &= pivot > 0.0
        a[k, k + 1 :] /= pivot
        if k + 1 < n:
            a[k + 1 :, k + 1 :] -= a[k + 1 :, k, None] * a[k, None, k + 1 :]
    x = a[:, n:]
    for k in range(n - 2, -1, -1):
        x[k] -= (a[k, k + 1 : n, None] * x[k + 1 :]).sum(axis=0)
    return [x[:, i] for i in range(len(rhs))], positive


def newton(problem: Problem, grid: Grid, w: Array, at: Points, *, tangent: bool = False) -> Step:
    """The Newton step at the state ``at``; with ``tangent`` also the derivative of the state with respect to h/b."""
    system = reduce(problem, grid, w, at)
    rhs = [system.rhs]
    if tangent:
        rhs.append(-system.coupling / system.give)
    solutions, positive = factor_solve(system.matrix, rhs)

    def slopes(dc: Array, lam: Array, gradient: Array | float) -> Array:
        de, dq = grid.strain(dc)
        return system.hw * (lam / grid.radius - gradient - system.kqw * dq - system.kew * de)

    dc = solutions[0]
    lam = system.lam0 + (system.coupling * dc).sum(axis=0) / system.give
    step = Step(dc, slopes(dc, lam, system.gw), lam, positive & system.positive)
    if tangent:
        tc = solutions[1]
        stiffness = (1.0 + (system.coupling * tc).sum(axis=0)) / system.give
        step.tangent = (tc, slopes(tc, stiffness, 0.0), stiffness)
    return step


def guess(problem: Problem, grid: Grid) -> tuple[Array, Array]:
    """A first state: r = R, and slopes that follow the power law ``w ~ R^(-1/n)`` of the film at its mean slope.

    ``R sigma1 w/(1+w^2) = const`` makes n the logarithmic derivative of that stress at the mean slope.
    """
    mean = problem.height / -np.expm1(-problem.span)
    square = mean * mean
    log1 = 0.5 * np.log1p(square) + problem.log_prestretch
    law = stress(problem.film, stack(log1[None], problem.log_prestretch[None]))
    t1, h11 = law.t1[0], law.h11[0]
    taut = t1 > 0.0
    part = square / (1.0 + square)
    power = np.where(taut, 1.0 - 2.0 * part + part * h11 / np.where(taut, t1, 1.0), 1.0)
    power = np.where(power > 0.5, power, 1.0)
    w = np.exp(-np.log(grid.radius) / power)
    w *= problem.height / (grid.once * w).sum(axis=0)
    return np.zeros((grid.table.modes, w.shape[1])), w
