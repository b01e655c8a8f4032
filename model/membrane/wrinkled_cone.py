r"""Wrinkled elements as straight cones: no modes, one spring each.

Where the hoop stress is relaxed to zero, ``d(R S1 cos(theta))/dR = 0`` beside ``R S1 sin(theta) = lam``: the pull
``C = R S1`` and the slope ``theta`` are constant and the meridian is straight. At every point the stretch follows from
``S1(l1) = C/R``, and the element is a spring between its ends: its meridian is

    L = l0 + X,    l0 = int R dx,    X = int (l1/lp - 1) R dx,    B = dX/dC = int 1/(R dS1/dl1) R dx / lp,

and with ``H = C cos(theta)`` and ``lam = C sin(theta)`` its ends stand ``L cos(theta)`` and ``L sin(theta)`` apart.
The compliance of the spring is B along it and L/C across. Newton eliminates H with it, so that an element adds but a
rank-one matrix to the strains at its two cuts. Strains stay apart from one all the way, as in `model.membrane.ritz`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.material.law import Stress, relax, stack, stress
from model.membrane.ritz import Grid, Index, Problem, Reduced, State

NEAR = 1e-2  # of ln(l2): from here Newton on the whole film takes the natural width along

CURVED = 2.0  # Newton's error is this squared times what like changes of a taut element leave


def natural_width(problem: Problem, log1: Array, start: Array, within: float) -> tuple[Array, Stress]:
    """``ln l2`` that makes no hoop stress at ``log1``, after a step smaller than ``within``; and the law before it."""
    everywhere = np.ones(log1.shape, dtype=np.bool_)
    log2 = start
    for _ in range(8):
        law = relax(problem.film, stress(problem.film, stack(log1, log2)), everywhere)
        assert law.relief is not None
        log2 = log2 + np.clip(law.relief.change, -0.3, 0.3)
        if not np.abs(law.relief.change).max(initial=0.0) > within:
            break
    return log2, law


@dataclass(slots=True)
class Cones:
    """Wrinkled elements: at points (Q, K, S), of elements (K, S)."""

    which: tuple[int, ...]
    u: Array  # ln(l1/lp)
    natural: Array  # ln(l2) that makes no hoop stress
    cos: Array
    sin: Array
    pull: Array | None = None  # R S1, in units of G/lp; None until the law has told

    @classmethod
    def of(cls, problem: Problem, grid: Grid, state: State, which: tuple[int, ...]) -> Cones:
        """Read from a state of the whole film."""
        assert state.natural is not None
        _, q = grid.strain(state.c)
        index = list(which)
        q, w = q[:, index], state.w[:, index]
        once = grid.once[:, index]
        across, down = (once * (1.0 + q)).sum(axis=0), (once * w).sum(axis=0)
        long = np.hypot(across, down)
        u = 0.5 * np.log1p(q * (q + 2.0) + w * w)
        natural, _ = natural_width(problem, u + problem.log_prestretch, state.natural[:, index], NEAR)
        return cls(which, u, natural, across / long, down / long)

    def take(self, index: Index) -> Cones:
        """The states at ``index``."""
        pull = None if self.pull is None else self.pull[:, index]
        return Cones(
            self.which, self.u[..., index], self.natural[..., index], self.cos[:, index], self.sin[:, index], pull
        )

    def put(self, index: Index, other: Cones) -> None:
        self.u[..., index], self.natural[..., index] = other.u, other.natural
        self.cos[:, index], self.sin[:, index] = other.cos, other.sin
        if self.pull is not None and other.pull is not None:
            self.pull[:, index] = other.pull

    def strains(self) -> tuple[Array, Array]:
        """``dr/dR - 1`` and ``-dz/dR`` at the points."""
        stretch = np.expm1(self.u)
        return stretch * self.cos - self.sin * self.sin / (1.0 + self.cos), (1.0 + stretch) * self.sin


@dataclass(slots=True)
class Springs:
    """Cones linearised: what they add to the film's Newton system, and how they follow its step."""

    cones: Cones
    pull: Array
    cut: NDArray[np.intp]  # (K, 2): unknowns of the strains at both ends, -1 where clamped
    ends: Array  # (K, 2, S): -R and R there
    miss: Array  # (K, S): what the ends stand apart beyond what the pull explains
    soft: Array  # d(distance)/dH
    skew: Array  # d(distance)/dlam = d(height)/dH
    give: Array  # d(height)/dlam at fixed distance
    height: Array
    rate: Array  # (Q, K, S): du = (C/R - S1)/(dS1/du)
    rest: Array
    radius: Array
    change: Array  # of the natural width, apart from following u
    follow: Array
    share: Array  # (S,): largest Maxwell stress over stress
    regular: NDArray[np.bool_]  # (S,): a natural width and a stable spring

    @classmethod
    def of(cls, problem: Problem, grid: Grid, panels: Grid, cones: Cones, c: Array) -> Springs:
        """Linearise ``cones`` of ``grid``; ``c`` are the unknowns of ``panels``, its other elements."""
        index = list(cones.which)
        radius, once = grid.radius[:, index], grid.once[:, index]
        log1 = cones.u + problem.log_prestretch
        law = stress(problem.film, stack(log1, cones.natural))
        share = np.ones(c.shape[1]) if law.maxwell is None else np.abs(law.maxwell / law.t1).max((0, 1), initial=1.0)
        law = relax(problem.film, law, np.ones(log1.shape, dtype=np.bool_))
        assert law.relief is not None
        stretch = np.exp(cones.u)
        s1 = law.t1 / stretch
        rate = stretch / (law.h11 - law.t1)
        pull = cones.pull if cones.pull is not None else (once * radius * s1).sum(axis=0) / once.sum(axis=0)
        rest = pull / radius - s1
        cos, sin = cones.cos, cones.sin
        first, last = np.exp(grid.breaks[index]), np.exp(grid.breaks[[k + 1 for k in index]])
        excess = (once * (np.expm1(cones.u) + stretch * rate * rest)).sum(axis=0)
        axial = (once / radius * stretch * rate).sum(axis=0)
        across = (last - first + excess) / pull
        soft = axial * cos * cos + across * sin * sin
        skew = (axial - across) * cos * sin
        cut = np.array([(_cut(panels, k), _cut(panels, k + 1)) for k in index], dtype=np.intp).reshape(-1, 2)
        ends = np.stack((-first, last), axis=1)
        strain = np.concatenate((c, np.zeros((1, c.shape[1]))))[cut]
        miss = (ends * strain).sum(axis=1) - (excess * cos - (last - first) * sin * sin / (1.0 + cos))
        regular = law.relief.regular.all(axis=(0, 1)) & (rate > 0.0).all(axis=(0, 1)) & (soft > 0.0).all(axis=0)
        return cls(
            cones,
            pull,
            cut,
            ends,
            miss,
            soft,
            skew,
            axial * across / soft,
            across * pull * sin,
            rate,
            rest,
            radius,
            law.relief.change,
            law.relief.rate,
            share,
            regular,
        )

    def join(self, system: Reduced) -> None:
        """Add the springs to the system of the other elements."""
        h, lam = self.pull * self.cones.cos, self.pull * self.cones.sin
        ratio = self.skew / self.soft
        force = h + self.miss / self.soft + ratio * lam
        for k, cut in enumerate(self.cut.tolist()):
            for one, place in zip(self.ends[k], cut, strict=True):
                if place < 0:
                    continue
                system.residual[place] += one * force[k]
                system.coupling[place] -= one * ratio[k]
                for other, beside in zip(self.ends[k], cut, strict=True):
                    if beside >= 0:
                        system.matrix[place, beside] += one * other / self.soft[k]
        system.reach += (self.height + ratio * self.miss - self.give * lam).sum(axis=0)
        system.give += self.give.sum(axis=0)

    def advance(self, dc: Array, lam: Array) -> tuple[Cones, Array]:
        """The cones after the step ``dc``, with the force ``lam``; and the largest relative change."""
        cones = self.cones
        moved = (self.ends * np.concatenate((dc, np.zeros((1, dc.shape[1]))))[self.cut]).sum(axis=1)
        h = self.pull * cones.cos + (self.miss + moved - self.skew * (lam - self.pull * cones.sin)) / self.soft
        pull = np.hypot(h, lam)
        du = self.rate * (self.rest + (pull - self.pull) / self.radius)
        sin = lam / pull
        size = np.abs(np.expm1(cones.u)).max(axis=0) + cones.sin**2
        wider = self.change + self.follow * du
        change = np.maximum(np.abs(du), np.abs(wider)).max(axis=0) / size
        change = np.maximum(change, np.abs(lam / (self.pull * cones.sin) - 1.0))
        change = CURVED * change.max(axis=0, initial=0.0) * np.sqrt(self.share)
        u = cones.u + np.clip(du, -0.5, 0.5)
        natural = cones.natural + np.clip(wider, -0.5, 0.5)
        return Cones(cones.which, u, natural, h / pull, sin, pull), change


def _cut(panels: Grid, number: int) -> int:
    """Unknown of the strain at a break of the film, -1 at disk and ring."""
    inside = 0 < number < len(panels.breaks) - 1
    return panels.elements * panels.table.modes + number - 1 if inside else -1


def whole(grid: Grid, panels: State, taut: tuple[int, ...], cones: Cones) -> State:
    """The state of the whole film on ``grid``, every element with its modes, from its parts."""
    t, m, states = grid.table, grid.elements, panels.c.shape[1]
    n = t.modes
    index, others = list(cones.which), list(taut)
    c = np.empty((grid.unknowns, states))
    bubbles = c[: m * n].reshape(m, n, states)
    bubbles[others] = panels.c[: len(taut) * n].reshape(-1, n, states)
    c[m * n :] = cuts = panels.c[len(taut) * n :]
    q, slope = cones.strains()
    half, radius = 1.0 / grid.dxi[index], grid.radius[:, index]
    left = np.concatenate((np.zeros((1, states)), cuts))[index] * np.exp(grid.breaks[index])
    run = (t.integrate @ (q * radius).reshape(t.points, -1)).reshape(q.shape)
    e = (left + half * run) / radius
    bubbles[index] = np.tensordot(t.to_modes, (q - e) * half, 1).swapaxes(0, 1)
    w = np.empty(grid.radius.shape)
    natural = np.zeros(grid.radius.shape)
    relaxed = np.zeros(grid.radius.shape, dtype=np.bool_)
    w[:, others], w[:, index] = panels.w, slope
    natural[:, index], relaxed[:, index] = cones.natural, True
    return State(c, w, natural, relaxed)
