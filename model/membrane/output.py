"""What a solved state says: extremes of stress, stretch and field, and derivatives of the force. All dimensionless."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import TypeVar

import numpy as np

from model.arrays import Array
from model.material.law import relax, stack, stress
from model.membrane.ritz import Grid, Index, Points, Problem, State, barycentric, table
from model.membrane.soft_cone import along

FINE = 33  # points of an element where an extreme inside the film is looked for


@dataclass(slots=True)
class Extremes:
    """Extremes over a film, (S,) each; stresses in units of G."""

    log_area: Array  # largest ln(l1 l2): the field's peak
    radius: Array  # R/b where it stands
    hoop: Array
    meridional: Array
    log_stretch: Array
    softening: Array  # largest share of the stiffness that the voltage takes away; 1 where the meridian leans inwards

    def take(self, index: Index) -> Extremes:
        return Extremes(*(getattr(self, f.name)[index] for f in fields(self)))


@lru_cache(maxsize=64)
def edge_tests(modes: int) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Test functions at the points, and their derivatives: 1 at the disk, then 1 at the ring, 0 at the other end."""
    xi = table(modes).xi
    power = modes + 1
    fall, rise = 0.5 * (1.0 - xi), 0.5 * (1.0 + xi)
    half = 0.5 * power
    return (fall**power, -half * fall ** (power - 1)), (rise**power, half * rise ** (power - 1))


@dataclass(slots=True)
class Edges:
    """The state at disk and ring, (2, S) each."""

    log1: Array
    log2: Array
    t1: Array
    t2: Array


def edges(problem: Problem, grid: Grid, state: State, at: Points, lam: Array) -> Edges:
    """Stretches and stresses at disk and ring, as accurate as the force itself.

    The energy's derivative with respect to the radius of a clamped edge is the horizontal reaction there. It is
    computed with a test function that is 1 at that edge and 0 at the other, and so has an error of the order of the
    shape's squared, as the force has; values extrapolated from the points would not.
    """
    t = grid.table
    law = at.law
    on_q = grid.twice * (law.t1 * at.along)
    both = grid.twice * (law.t2 * at.around)
    both += on_q
    (disk, disk_slope), (ring, ring_slope) = edge_tests(t.modes)
    inner = np.exp(-problem.span)
    pull = np.empty((2, len(lam)))  # sigma1 lp/l1: the nominal stress, in units of G/lp
    pull[0] = np.hypot(disk @ both[:, 0] + (disk_slope @ on_q[:, 0]) * grid.dxi[0], lam * inner) / (inner * inner)
    pull[1] = np.hypot(ring @ both[:, -1] + (ring_slope @ on_q[:, -1]) * grid.dxi[-1], lam)
    log1 = np.stack((t.ends[0] @ at.log[0][:, 0], t.ends[1] @ at.log[0][:, -1]))
    log2 = np.broadcast_to(problem.log_prestretch, log1.shape)
    wrinkled = None
    if state.relaxed is not None:
        wrinkled = np.stack((state.relaxed[0, 0], state.relaxed[-1, -1]))
        natural = np.stack((t.ends[0] @ at.log[1][:, 0], t.ends[1] @ at.log[1][:, -1]))
        log2 = np.where(wrinkled, natural, log2)
        # A wrinkled element is a straight cone: its slope tells the pull at its end.
        sin = np.stack((state.w[0, 0], state.w[-1, -1])) / np.sqrt(np.stack((at.metric[0, 0], at.metric[-1, -1])))
        pull = np.where(wrinkled, lam / sin, pull) * np.where(wrinkled, [1.0 / inner, np.ones_like(inner)], 1.0)
        if state.cones is not None:
            for end, here in enumerate(wrinkled[:, 0].tolist()):
                if here:
                    log1[end] = state.cones.u[end, -end] + problem.log_prestretch
                    log2[end] = state.cones.natural[end, -end]
                    pull[end] = state.cones.pull[-end] / (1.0 if end else inner)
    start1, start2 = log1, log2
    for n in range(4):
        now = stress(problem.film, stack(log1, log2))
        if wrinkled is not None:
            now = relax(problem.film, now, wrinkled)
        if n == 3:
            break
        factor = np.exp(problem.log_prestretch - log1)
        step = (pull - now.t1 * factor) / ((now.h11 - now.t1) * factor)
        log1 = log1 + step
        if now.relief is not None:
            log2 = log2 + now.relief.change + now.relief.rate * step
    good = np.abs(log1 - start1) < 0.1 + 0.5 * np.abs(start1 - problem.log_prestretch)
    if not good.all():
        log1, log2 = np.where(good, log1, start1), np.where(good, log2, start2)
        now = stress(problem.film, stack(log1, log2))
        if wrinkled is not None:
            now = relax(problem.film, now, wrinkled)
    return Edges(log1, log2, now.t1, now.t2)


@lru_cache(maxsize=64)
def fine_table(modes: int) -> Array:
    """Interpolation from the points to `FINE` points over the element, ends included."""
    return barycentric(table(modes).xi, -np.cos(np.linspace(0.0, np.pi, FINE)))


Number = TypeVar("Number", float, Array)
POLISH = 3  # Newton steps from the largest of the `FINE` points to the polynomial's own maximum


def series(c: Sequence[Number], xi: Number) -> tuple[Number, Number, Number]:
    """Value and two derivatives at ``xi`` of the Legendre series with coefficients ``c``."""
    before, now = 0.0 * xi + 1.0, xi
    before1, now1 = 0.0 * xi, before
    before2, now2 = before1, before1
    value, slope, curve = c[0] + c[1] * xi, c[1] * now1, before1
    for n in range(2, len(c)):
        k = 2.0 * n - 1.0
        before2, now2 = now2, before2 + k * now1
        before1, now1 = now1, before1 + k * now
        before, now = now, (k * xi * now - (n - 1.0) * before) / n
        value = value + c[n] * now
        slope = slope + c[n] * now1
        curve = curve + c[n] * now2
    return value, slope, curve


def _largest(grid: Grid, values: Array, ends: Array, x: Array | None = None) -> tuple[Array, Array]:
    """Largest values over the film, (K, S), from those at the points (K, Q, M, S) and at both edges (K, 2, S).

    Also R/b where each stands; ``x`` is ln(R/b) of points that are not the grid's (Q, M, S).
    """
    best = ends.max(axis=1)
    radius = np.where(ends[:, 0] >= ends[:, 1], np.exp(grid.breaks[0]), 1.0)
    kind, state = np.nonzero(values.max(axis=(1, 2)) > best)
    if len(state):
        t = grid.table
        inside = values[kind, :, :, state]
        fine = inside.swapaxes(1, 2) @ fine_table(t.modes).T
        element, place = np.divmod(fine.reshape(len(state), -1).argmax(axis=1), FINE)
        c = list(t.to_legendre @ inside[np.arange(len(state)), :, element].T)
        angle = np.pi / (FINE - 1) * (place + np.array([[-1], [0], [1]]))
        low, xi, high = -np.cos(np.clip(angle, 0.0, np.pi))
        for _ in range(POLISH):
            value, slope, curve = series(c, xi)
            step = np.clip(np.where(curve < 0.0, xi - slope / curve, xi), low, high) - xi
            xi = xi + step
        peak = value + step * (slope + 0.5 * curve * step)  # the last step is so short that its cube is nothing
        better = peak > best[kind, state]
        x0, x1 = grid.breaks[element, state], grid.breaks[element + 1, state]
        place = x0 + 0.5 * (1.0 + xi) * (x1 - x0)
        if x is not None:
            place = np.clip(series(list(t.to_legendre @ x[:, element, state]), xi)[0], x0, x1)
        at = np.exp(place)
        best[kind, state] = np.where(better, peak, best[kind, state])
        radius[kind, state] = np.where(better, at, radius[kind, state])
    return best, radius


def extremes(problem: Problem, grid: Grid, state: State, at: Points, lam: Array) -> Extremes:
    """Extremes over the points, between them, and at both edges."""
    edge = edges(problem, grid, state, at, lam)
    law, log = at.law, at.log
    values = np.empty((5, *log.shape[1:]))
    ends = np.empty((5, 2, len(lam)))
    np.negative(log[2], out=values[0])
    np.add(edge.log1, edge.log2, out=ends[0])
    np.negative(law.t2, out=values[1])
    np.negative(edge.t2, out=ends[1])
    np.negative(law.t1, out=values[2])
    np.negative(edge.t1, out=ends[2])
    values[3:] = log[:2]
    ends[3], ends[4] = edge.log1, edge.log2
    x: Array | None = None
    if state.cones is not None:
        seen = along(problem, grid, state, at)
        x = seen.x
        values[:] = seen.log1 + seen.log2, -seen.t2, -seen.t1, seen.log1, seen.log2
    best, radius = _largest(grid, values, ends, x)
    if law.maxwell is None:
        softening = np.zeros(len(lam))
    else:
        softening = (2.0 * law.maxwell / (law.h11 + 2.0 * law.maxwell)).max(axis=(0, 1))
        softening = np.maximum(softening, _softened(problem, log, edge))
    # Like a soap film between rings too far apart, a film that narrows below its disk may be one that no rest leads to.
    softening = np.where((at.along <= 0.0).any(axis=(0, 1)), 1.0, softening)
    return Extremes(
        log_area=best[0],
        radius=radius[0],
        hoop=-best[1],
        meridional=-best[2],
        log_stretch=np.maximum(best[3], best[4]),
        softening=softening,
    )


# Shares of the way from the pre-stretched film to the widest point at which the law is looked at, the last ones where
# the way is ``FAR``; and what a share of the hoop's stiffness counts beside one of the meridian's: a circle is held by
# its neighbours.
WAY, MORE_OF_WAY = (0.5, 1.0), (0.25, 0.75)
FAR = 1.2  # of ln(l1 l2)
HOOP = 0.7


def _softened(problem: Problem, log: Array, edge: Edges) -> Array:
    """Largest share of a stiffness that the voltage takes on the way from the pre-stretched film to its widest point.

    In either direction, the natural width of a wrinkled point included. A point far out, where the law is stiff again,
    has its way through all that is soft; an answer like that may lie beyond the end of the branch from rest.
    """
    states = log.shape[-1]
    log1 = np.concatenate((log[0].reshape(-1, states), edge.log1))
    log2 = np.concatenate((log[1].reshape(-1, states), edge.log2))
    widest, columns = (log1 + log2).argmax(axis=0), np.arange(states)
    start = problem.log_prestretch
    far1, far2 = log1[widest, columns] - start, log2[widest, columns] - start
    softened = _along(problem, far1, far2, WAY)
    far = np.flatnonzero(far1 + far2 > FAR)
    if len(far):
        softened[far] = np.maximum(softened[far], _along(problem.take(far), far1[far], far2[far], MORE_OF_WAY))
    return softened


def _along(problem: Problem, far1: Array, far2: Array, shares: tuple[float, ...]) -> Array:
    """Largest share of a stiffness that the voltage takes at ``shares`` of the way to the log stretches ``far``."""
    share = np.array(shares)[:, None]
    law = stress(problem.film, stack(problem.log_prestretch + share * far1, problem.log_prestretch + share * far2))
    assert law.maxwell is not None
    twice = 2.0 * law.maxwell
    along, around = law.h11 + twice, law.h22 + twice
    both = np.maximum(twice / along, HOOP * twice / around)
    # Where the elastic law itself gives way there is nothing left to share.
    softened: Array = np.where((along > 0.0) & (around > 0.0), both, 1.0).max(axis=0)
    return softened


@dataclass(slots=True)
class Derivatives:
    """Derivatives of the dimensionless force ``lam``: (S,), the two first (moduli, S) and (shape parameters, S)."""

    mu: Array
    alpha: Array
    log_field: Array  # with respect to ln(eps V^2/T^2)
    log_prestretch: Array  # at fixed force unit
    span: Array
    height: Array

    def take(self, index: Index) -> Derivatives:
        return Derivatives(*(getattr(self, f.name)[..., index] for f in fields(self)))


def derivatives(
    problem: Problem, grid: Grid, state: State, at: Points, lam: Array, tangent: tuple[Array, Array, Array]
) -> Derivatives:
    """Derivatives of the force from ``dF/dp = d/dh (dE/dp)``: one tangent, with respect to h, serves every p.

    A cut stays at its share of the span; the relaxed energy is smooth across it, so its motion changes nothing.
    """
    tc, tw, stiffness = tangent
    film, law = problem.film, at.law
    te, tq = grid.strain(tc)
    d1 = at.along * tq + at.down * tw
    around = at.around * te
    d2 = (
        around if state.relaxed is None or law.relief is None else np.where(state.relaxed, law.relief.rate * d1, around)
    )
    w1, w2 = grid.twice * d1, grid.twice * d2
    w3 = -(w1 + w2)
    log = at.log
    mu, alpha = film.law.projected(log, w1, w2)
    maxwell = np.zeros_like(lam) if law.maxwell is None else (law.maxwell * w3).sum(axis=(0, 1))
    prestretch = ((law.h11 + law.h12) * w1 + (law.h12 + law.h22) * w2).sum(axis=(0, 1))

    # With the span L: R = exp(-L depth), dx = L d(depth), de/dx = (1/L) de/d(depth).
    per_span = 1.0 / problem.span
    depth = -np.log(grid.radius) * per_span
    e_depth = (at.q - at.e) * per_span
    te_depth = (tq - te) * per_span
    gp = law.t1 * at.along
    dgp = (law.h11 - 2.0 * law.t1) * at.along * d1 + law.t1 / at.metric * tq + law.h12 * at.along * around
    span = (
        grid.twice * ((per_span - 2.0 * depth) * (law.t1 * d1 + law.t2 * around) - dgp * e_depth - gp * te_depth)
        - grid.once * (per_span - depth) * (stiffness * state.w + lam * tw)
    ).sum(axis=(0, 1))
    return Derivatives(mu, alpha, maxwell, prestretch, span, stiffness)
