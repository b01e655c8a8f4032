r"""Wrinkled elements near loss of convexity: the same springs, integrated over the stretch in place of the radius.

Where the relaxed law ``S1(l1)`` hardly rises the stretch changes steeply with R, and points in R no longer see it. The
pull ``C = R S1`` gives R as a smooth function of the stretch, however flat the law is, so that with ``u = ln(l1/lp)``
from ``u0`` at the inner end to ``u1`` at the outer one

    X = int (l1/lp - 1) dR = R1 (e^u1 - 1) - R0 (e^u0 - 1) + C B,    B = dX/dC = int_(u1)^(u0) e^u / S1(u) du.

X is stationary in ``u0`` and ``u1`` where ``S1(u) = C/R`` at the ends, so that Newton may let them follow. The points
lie at ``u = u1 + (u0 - u1) share``, with the ``share`` that a linear law would have at the points in ln R.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.arrays import Array
from model.material.law import Stress
from model.membrane.ritz import Grid, Points, Problem, State, transfer
from model.membrane.straight import Straight
from model.membrane.wrinkled_cone import NEAR, Cones, Pulled, folded, maxwell_share, natural_width

EXACT = 1e-9  # of ln(l2), where the state is looked at
INVERSIONS = 60  # halvings and Newton steps that find the stretch at a radius


def _ends(grid: Grid, which: tuple[int, ...]) -> Array:
    """R/b at the inner and the outer end of the elements, (2, K, S)."""
    index = list(which)
    return np.exp(np.stack((grid.breaks[index], grid.breaks[[k + 1 for k in index]])))


def _stations(grid: Grid, which: tuple[int, ...]) -> tuple[Array, Array]:
    """Share of the way from ``u1`` to ``u0`` of the points, and its weight over the element, (Q, K, S) each."""
    index, t = list(which), grid.table
    length = np.maximum(grid.breaks[[k + 1 for k in index]] - grid.breaks[index], 1e-300)
    depth = 0.5 * (1.0 - t.xi)[:, None, None] * length
    whole = np.expm1(length)
    return np.expm1(depth) / whole, 0.5 * length * t.weight[:, None, None] * np.exp(depth) / whole


def _between(
    problem: Problem, grid: Grid, cones: Straight, which: tuple[int, ...], within: float = NEAR
) -> tuple[Array, Array, Array, Stress]:
    """Weights (Q, K, S) of the ways between the ends of ``cones``; ``u``, natural width and law there."""
    share, weight = _stations(grid, which)
    u = cones.u[1] + (cones.u[0] - cones.u[1]) * share
    begin, modes = cones.inner, grid.table.modes
    if len(begin) != grid.table.points:
        carry = transfer(len(begin) + modes - grid.table.points, modes)
        begin = (carry @ begin.reshape(len(begin), -1)).reshape(u.shape)
    natural, law = natural_width(problem, u + problem.log_prestretch, begin, within)
    return weight, u, natural, law


def _read(u: Array, natural: Array, wanted: Array) -> Array:
    """Widths at the stretches ``wanted`` (P, K, S), between those at the points ``u`` (Q, K, S), which fall."""
    after = np.clip((u > wanted[:, None]).sum(axis=1), 1, len(u) - 1)
    (u0, u1), (n0, n1) = ((np.take_along_axis(x, after - k, 0) for k in (1, 0)) for x in (u, natural))
    share = np.clip(np.nan_to_num((wanted - u0) / (u1 - u0)), 0.0, 1.0)
    read: Array = n0 + share * (n1 - n0)
    return read


@dataclass(slots=True)
class Along:
    """What stands along films, at points (Q, M, S) that see every wrinkled element."""

    x: Array  # ln(R/b)
    log1: Array
    log2: Array  # that makes the stress
    hoop: Array  # of the circle
    t1: Array
    t2: Array


def along(problem: Problem, grid: Grid, state: State, at: Points) -> Along:
    """The points ``at`` of a state, but those of straight cones at even steps of their stretch in place of the radius.

    The circle of a cone's point stands where the meridian from the cone's inner end leads: its length up to there is
    ``R - R0 + X`` with the X above between ``u`` and ``u0``.
    """
    x = np.log(grid.radius)
    out = Along(x, at.log[0].copy(), at.log[1].copy(), at.hoop.copy(), at.law.t1.copy(), at.law.t2.copy())
    cones = state.cones
    if cones is None or state.relaxed is None:
        return out
    which = tuple(np.flatnonzero(state.relaxed[0, :, 0]).tolist())
    index, t = list(which), grid.table
    weight, u, natural, law = _between(problem, grid, cones, which, EXACT)
    s1 = law.t1 * np.exp(-u)
    left, right = grid.breaks[index], grid.breaks[[k + 1 for k in index]]
    place = np.clip(np.log(cones.pull / s1), left, right)
    first, radius = np.exp(left), np.exp(place)
    speed = weight / t.weight[:, None, None] * np.exp(u) / s1
    run = (t.integrate @ speed.reshape(t.points, -1)).reshape(u.shape) * (cones.u[0] - cones.u[1])
    extra = radius * np.expm1(u) - first * np.expm1(cones.u[0]) + cones.pull * run
    cuts = state.c[grid.elements * t.modes :]
    start = np.concatenate((np.zeros((1, u.shape[2])), cuts))[index]
    flat = -cones.sin * cones.sin / (1.0 + cones.cos)  # cos - 1
    strain = (first * start + flat * (radius - first) + cones.cos * extra) / radius
    out.x[:, index], out.log1[:, index], out.log2[:, index] = place, u + problem.log_prestretch, natural
    out.hoop[:, index] = np.log1p(strain) + problem.log_prestretch
    out.t1[:, index], out.t2[:, index] = law.t1, law.t2
    return out


@dataclass(slots=True)
class SoftCones(Cones):
    """As `Cones`, but ``u`` stands at both ends, (2, K, S), and ``natural`` at the points and then at both ends."""

    @classmethod
    def of(cls, problem: Problem, grid: Grid, state: State, which: tuple[int, ...]) -> SoftCones:
        """Read from a state of the whole film."""
        if state.cones is not None:
            kept = state.cones
            _, _, natural, _ = _between(problem, grid, kept, which)
            return cls(which, kept.u, np.concatenate((natural, kept.natural)), kept.cos, kept.sin, kept.pull)
        plain = Cones.of(problem, grid, state, which)
        index = list(which)
        radius, once, t = grid.radius[:, index], grid.once[:, index], grid.table
        law = folded(problem, plain.u, plain.natural)
        pull = (once * radius * law.t1 * np.exp(-plain.u)).sum(axis=0) / once.sum(axis=0)
        u = np.tensordot(t.ends, plain.u, 1)
        low, high = plain.u.min(axis=0), plain.u.max(axis=0)
        spread = 0.2 * (high - low) + 1e-300
        u = np.clip(u, low - spread, high + spread)
        share, _ = _stations(grid, which)
        inside = u[1] + (u[0] - u[1]) * share
        everywhere = np.concatenate((inside, u))
        begin = _read(plain.u, plain.natural, everywhere)
        natural, _ = natural_width(problem, everywhere + problem.log_prestretch, begin, NEAR)
        return cls(which, u, natural, plain.cos, plain.sin, pull)

    def pulled(self, problem: Problem, grid: Grid) -> Pulled:
        """Linearise the law along the cones: at the ends for the stretch, everywhere for the width."""
        assert self.pull is not None
        share, weight = _stations(grid, self.which)
        ends, points = _ends(grid, self.which), len(share)
        u = np.concatenate((self.u[1] + (self.u[0] - self.u[1]) * share, self.u))
        law = folded(problem, u, self.natural)
        assert law.relief is not None
        stretch = np.exp(u)
        s1 = law.t1 / stretch
        rate = stretch / (law.h11 - law.t1)
        axial = (self.u[0] - self.u[1]) * (weight * (stretch / s1)[:points]).sum(axis=0)
        rises = ((rate > 0.0) & (s1 > 0.0)).all(axis=(0, 1))
        return Pulled(
            self.pull,
            excess=ends[1] * np.expm1(self.u[1]) - ends[0] * np.expm1(self.u[0]) + self.pull * axial,
            axial=axial,
            rate=rate[points:],
            rest=self.pull / ends - s1[points:],
            radius=ends,
            change=law.relief.change,
            follow=law.relief.rate,
            share=maxwell_share(law),
            regular=law.relief.regular.all(axis=(0, 1)) & rises,
            spread=share,
        )

    def straight(self) -> Straight:
        """What a state must keep of them beside its points."""
        assert self.pull is not None
        return Straight(
            *(x.copy() for x in (self.u, self.natural[-2:], self.natural[:-2], self.cos, self.sin, self.pull))
        )

    def unrolled(self, problem: Problem, grid: Grid) -> Cones:
        """The stretch and the width at the points in R, for the state of the whole film."""
        assert self.pull is not None
        share, _ = _stations(grid, self.which)
        wanted = self.pull / grid.radius[:, list(self.which)]
        low, high = np.minimum(self.u[0], self.u[1]) + 0.0 * wanted, np.maximum(self.u[0], self.u[1]) + 0.0 * wanted
        u = self.u[1] + (self.u[0] - self.u[1]) * share
        natural = self.natural[:-2]
        settled = np.zeros(u.shape[2], dtype=np.bool_)
        for _ in range(INVERSIONS):
            law = folded(problem, u, natural)
            assert law.relief is not None
            stretch = np.exp(u)
            miss = wanted - law.t1 / stretch
            # The stretch that pulls too little is a lower bound: the law rises.
            low, high = np.where(miss > 0.0, u, low), np.where(miss > 0.0, high, u)
            du = miss * stretch / (law.h11 - law.t1)
            inside = (u + du >= low) & (u + du <= high)
            du = np.where(inside, du, 0.5 * (low + high) - u)
            wider = np.clip(law.relief.change + law.relief.rate * du, -0.3, 0.3)
            u = np.where(settled, u, u + du)
            natural = np.where(settled, natural, natural + wider)
            settled |= (np.abs(du) + np.abs(wider)).max(axis=(0, 1), initial=0.0) < 1e-13
            if settled.all():
                break
        return Cones(self.which, u, natural, self.cos, self.sin, self.pull)
