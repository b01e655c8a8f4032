"""What a solved state says: extremes of stress, stretch and field, and derivatives of the force. All dimensionless."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.law import Array, stack, stress
from model.ritz import Grid, Points, Problem


@dataclass(slots=True)
class Extremes:
    """Extremes over a film, (S,) each; stresses in units of G."""

    log_area: Array  # largest ln(l1 l2): the field's peak
    radius: Array  # R/b where it stands
    hoop: Array
    meridional: Array
    log_stretch: Array


def edges(problem: Problem, grid: Grid, at: Points, lam: Array) -> tuple[Array, Array, Array]:
    """``L1``, ``sigma1`` and ``sigma2`` at disk and ring, (2, S) each, as accurate as the force itself.

    The energy's derivative with respect to the radius of a clamped edge is the horizontal reaction there. It is
    computed with a test function that is 1 at that edge and 0 at the other, and so has an error of the order of the
    shape's squared, as the force has; values extrapolated from the points would not.
    """
    t = grid.table
    power = t.modes
    half = 0.5 * (1.0 - t.xi)
    test = np.stack((half**power, (1.0 - half) ** power))  # 1 at disk, 1 at ring
    slope = 0.5 * power * np.stack((-(half ** (power - 1)), (1.0 - half) ** (power - 1)))
    law = at.law
    on_q = grid.twice * (law.t1 * at.along)
    both = grid.twice * (law.t2 * at.around) + on_q
    reaction = test @ both + (slope @ on_q) * grid.dxi
    inner = np.exp(-problem.span)
    horizontal = np.stack((-reaction[0] / (inner * inner), reaction[1]))
    vertical = np.stack((lam / inner, lam))
    pull = np.hypot(horizontal, vertical)  # sigma1 lp/l1: nominal stress, in units of G/lp
    log1 = t.ends @ at.log[0]
    log2 = np.broadcast_to(problem.log_prestretch, log1.shape)
    start = log1
    for _ in range(3):
        now = stress(problem.film, stack(log1, log2))
        factor = np.exp(problem.log_prestretch - log1)
        step = (now.t1 * factor - pull) / ((now.h11 - now.t1) * factor)
        log1 = log1 - step
    good = np.abs(log1 - start) < 0.1 + 0.5 * np.abs(start - problem.log_prestretch)
    log1 = np.where(good, log1, start)
    now = stress(problem.film, stack(log1, log2))
    return log1, now.t1, now.t2


def extremes(problem: Problem, grid: Grid, at: Points, lam: Array) -> Extremes:
    """Extremes over the points and both edges."""
    log1, t1, t2 = edges(problem, grid, at, lam)
    area = np.concatenate((-at.log[2], log1 + problem.log_prestretch))
    where = area.argmax(axis=0)
    columns = np.arange(area.shape[1])
    radii = np.concatenate((grid.radius, np.exp(-problem.span)[None], np.ones((1, area.shape[1]))))
    return Extremes(
        log_area=area[where, columns],
        radius=radii[where, columns],
        hoop=np.minimum(at.law.t2.min(axis=0), t2.min(axis=0)),
        meridional=np.minimum(at.law.t1.min(axis=0), t1.min(axis=0)),
        log_stretch=np.maximum(np.maximum(at.log[:2].max(axis=(0, 1)), log1.max(axis=0)), problem.log_prestretch),
    )


@dataclass(slots=True)
class Derivatives:
    """Derivatives of the dimensionless force ``lam``: (S,), the two first (terms, S)."""

    mu: Array
    alpha: Array
    log_field: Array  # with respect to ln(eps V^2/T^2)
    log_prestretch: Array  # at fixed force unit
    span: Array
    height: Array


def derivatives(
    problem: Problem, grid: Grid, w: Array, at: Points, lam: Array, tangent: tuple[Array, Array, Array]
) -> Derivatives:
    """Derivatives of the force from ``dF/dp = d/dh (dE/dp)``: one tangent, with respect to h, serves every p."""
    tc, tw, stiffness = tangent
    film, law = problem.film, at.law
    te, tq = grid.strain(tc)
    d1 = at.along * tq + at.down * tw
    d2 = at.around * te
    w1, w2 = grid.twice * d1, grid.twice * d2
    w3 = -(w1 + w2)
    log = at.log
    rates = np.stack((w1, w2, w3))
    powers = film.powers(log)
    mu = (powers * rates).sum(axis=(1, 2))
    alpha = film.mu * ((powers + 1.0) * (log * rates)).sum(axis=(1, 2))
    maxwell = 0.0 * lam if law.maxwell is None else (law.maxwell * w3).sum(axis=0)
    prestretch = ((law.h11 + law.h12) * w1 + (law.h12 + law.h22) * w2).sum(axis=0)

    # With the span L: R = exp(-L (1 - xi)/2), dx = (L/2) dxi, de/dx = (2/L) de/dxi.
    depth = 0.5 * (1.0 - grid.table.xi)[:, None]
    per_span = 1.0 / problem.span
    e_xi = (at.q - at.e) * per_span
    te_xi = (tq - te) * per_span
    gp = law.t1 * at.along
    slope = law.h11 - 2.0 * law.t1
    dgp = slope * at.along * (at.along * tq + at.down * tw) + law.t1 / at.metric * tq + law.h12 * at.along * d2
    span = (
        grid.twice * ((per_span - 2.0 * depth) * (law.t1 * d1 + law.t2 * d2) - dgp * e_xi - gp * te_xi)
        - grid.once * (per_span - depth) * (stiffness * w + lam * tw)
    ).sum(axis=0)
    return Derivatives(mu, alpha, maxwell, prestretch, span, stiffness)
