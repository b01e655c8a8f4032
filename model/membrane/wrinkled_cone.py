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
from model.membrane.straight import Straight

NEAR = 1e-2  # of ln(l2): from here Newton on the whole film takes the natural width along

CURVED = 2.0  # Newton's error is this squared times what like changes of a taut element leave


def natural_width(
    problem: Problem, log1: Array, start: Array, within: float, where: NDArray[np.bool_] | None = None
) -> tuple[Array, Stress]:
    """``ln l2`` that makes no hoop stress at ``log1``, after a step smaller than ``within``; and the law before it.

    Each state steps for itself, so that none depends on the others; elsewhere than ``where`` nothing is sought.
    """
    everywhere = np.ones(log1.shape, dtype=np.bool_) if where is None else where
    log2, axes = start, tuple(range(log1.ndim - 1))
    moving = np.ones(log1.shape[-1], dtype=np.bool_)
    kept: Stress | None = None
    for _ in range(8):
        law = relax(problem.film, stress(problem.film, stack(log1, log2)), everywhere)
        assert law.relief is not None
        kept = law if kept is None else kept.where(moving, law)
        log2 = np.where(moving, log2 + np.clip(law.relief.change, -0.3, 0.3), log2)
        moving &= np.abs(law.relief.change).max(axis=axes, initial=0.0) > within
        if not moving.any():
            break
    assert kept is not None
    return log2, kept


def folded(problem: Problem, u: Array, natural: Array) -> Stress:
    """The relaxed law at ``u = ln(l1/lp)``, linearised at ``natural``."""
    log1 = u + problem.log_prestretch
    return relax(problem.film, stress(problem.film, stack(log1, natural)), np.ones(log1.shape, dtype=np.bool_))


def maxwell_share(law: Stress) -> Array:
    """Largest Maxwell stress over meridional stress, (S,), at least one."""
    if law.maxwell is None:
        return np.ones(law.t1.shape[-1])
    share: Array = np.abs(law.maxwell / law.t1).max(axis=(0, 1), initial=1.0)
    return share


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

    def pulled(self, problem: Problem, grid: Grid) -> Pulled:
        """Linearise the law along the cones."""
        index = list(self.which)
        radius, once = grid.radius[:, index], grid.once[:, index]
        law = folded(problem, self.u, self.natural)
        assert law.relief is not None
        stretch = np.exp(self.u)
        s1 = law.t1 / stretch
        rate = stretch / (law.h11 - law.t1)
        pull = self.pull if self.pull is not None else (once * radius * s1).sum(axis=0) / once.sum(axis=0)
        rest = pull / radius - s1
        return Pulled(
            pull,
            excess=(once * (np.expm1(self.u) + stretch * rate * rest)).sum(axis=0),
            axial=(once / radius * stretch * rate).sum(axis=0),
            rate=rate,
            rest=rest,
            radius=radius,
            change=law.relief.change,
            follow=law.relief.rate,
            share=maxwell_share(law),
            regular=np.asarray(law.relief.regular.all(axis=(0, 1)) & (rate > 0.0).all(axis=(0, 1))),
        )

    def unrolled(self, problem: Problem, grid: Grid) -> Cones:
        """The cones with their stretches at the points in R."""
        return self

    def straight(self) -> Straight | None:
        """What a state must keep of them beside its points."""
        return None

    def take(self, index: Index) -> Cones:
        """The states at ``index``."""
        pull = None if self.pull is None else self.pull[:, index]
        return type(self)(
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
class Pulled:
    """How cones answer a change of their pull, at stations (P, K, S): points, or the two ends of `SoftCones`."""

    pull: Array  # (K, S)
    excess: Array  # (K, S): X at that pull
    axial: Array  # (K, S): B = dX/dC
    rate: Array  # du = rate (C/R - S1)
    rest: Array  # C/R - S1
    radius: Array
    change: Array  # of the natural width, apart from following u, wherever there is one
    follow: Array
    share: Array  # (S,): largest Maxwell stress over stress
    regular: NDArray[np.bool_]  # (S,): a natural width, and a stress that rises with the stretch
    spread: Array | None = None  # share of the inner end's change of u that the other points take


@dataclass(slots=True)
class Springs:
    """Cones linearised: what they add to the film's Newton system, and how they follow its step."""

    cones: Cones
    law: Pulled
    cut: NDArray[np.intp]  # (K, 2): unknowns of the strains at both ends, -1 where clamped
    ends: Array  # (K, 2, S): -R and R there
    miss: Array  # (K, S): what the ends stand apart beyond what the pull explains
    soft: Array  # d(distance)/dH
    skew: Array  # d(distance)/dlam = d(height)/dH
    give: Array  # d(height)/dlam at fixed distance
    height: Array
    regular: NDArray[np.bool_]  # (S,): a natural width and a stable spring

    @classmethod
    def of(cls, problem: Problem, grid: Grid, panels: Grid, cones: Cones, c: Array) -> Springs:
        """Linearise ``cones`` of ``grid``; ``c`` are the unknowns of ``panels``, its other elements."""
        index = list(cones.which)
        law = cones.pulled(problem, grid)
        pull, excess, axial = law.pull, law.excess, law.axial
        cos, sin = cones.cos, cones.sin
        first, last = np.exp(grid.breaks[index]), np.exp(grid.breaks[[k + 1 for k in index]])
        across = (last - first + excess) / pull
        soft = axial * cos * cos + across * sin * sin
        skew = (axial - across) * cos * sin
        cut = np.array([(_cut(panels, k), _cut(panels, k + 1)) for k in index], dtype=np.intp).reshape(-1, 2)
        ends = np.stack((-first, last), axis=1)
        strain = np.concatenate((c, np.zeros((1, c.shape[1]))))[cut]
        miss = (ends * strain).sum(axis=1) - (excess * cos - (last - first) * sin * sin / (1.0 + cos))
        regular = law.regular & (soft > 0.0).all(axis=0)
        height = across * pull * sin
        return cls(cones, law, cut, ends, miss, soft, skew, axial * across / soft, height, regular)

    def join(self, system: Reduced) -> None:
        """Add the springs to the system of the other elements."""
        h, lam = self.law.pull * self.cones.cos, self.law.pull * self.cones.sin
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
        cones, law = self.cones, self.law
        moved = (self.ends * np.concatenate((dc, np.zeros((1, dc.shape[1]))))[self.cut]).sum(axis=1)
        h = law.pull * cones.cos + (self.miss + moved - self.skew * (lam - law.pull * cones.sin)) / self.soft
        pull = np.hypot(h, lam)
        du = law.rate * (law.rest + (pull - law.pull) / law.radius)
        every = du if law.spread is None else np.concatenate((du[1] + (du[0] - du[1]) * law.spread, du))
        sin = lam / pull
        size = np.abs(np.expm1(cones.u)).max(axis=0) + cones.sin**2
        wider = law.change + law.follow * every
        change = np.maximum(np.abs(du).max(axis=0), np.abs(wider).max(axis=0)) / size
        change = np.maximum(change, np.abs(lam / (law.pull * cones.sin) - 1.0))
        change = CURVED * change.max(axis=0, initial=0.0) * np.sqrt(law.share)
        u = cones.u + np.clip(du, -0.5, 0.5)
        natural = cones.natural + np.clip(wider, -0.5, 0.5)
        return type(cones)(cones.which, u, natural, h / pull, sin, pull), change


def _cut(panels: Grid, number: int) -> int:
    """Unknown of the strain at a break of the film, -1 at disk and ring."""
    inside = 0 < number < len(panels.breaks) - 1
    return panels.elements * panels.table.modes + number - 1 if inside else -1


def whole(grid: Grid, panels: State, taut: tuple[int, ...], cones: Cones, straight: Straight | None = None) -> State:
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
    return State(c, w, natural, relaxed, straight)
