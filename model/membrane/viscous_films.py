"""Films with Maxwell branches, their states, and what drives them, as `viscous`, `march` and `history` hand them on.

Arrays at points have the shape (Q, M, S), those of branches (K, Q, M, S): points of an element, elements, films.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.material.law import Law
from model.membrane import ritz
from model.membrane.ritz import Grid, Index
from model.specimen import Specimen

FLAT = 1e-9  # height over ring radius that stands for the flat film
LIFTED = 1e-3  # the same, with which a disk begins that its load lifts off
PushLaw = Callable[[NDArray[np.intp], Array], tuple[Array, Array]]  # numbers of films, h (m): force (N), slope (N/m)


@dataclass(slots=True)
class Films:
    """Films of one law, of the same numbers of parameters and branches, along the last axis.

    law : of the relaxed films, moduli over G, (n, S) or (n, 1) where all share it
    ratio, time : of the branches, (K, 1, 1, S)
    log_prestretch, span, ring : ``ln lp``, ``ln(b/a)``, b (m), (S,)
    field : ``eps / (T^2 G)``, which times V^2 is the Maxwell stress, (S,)
    unit : N of the dimensionless force, (S,)
    shear_slopes : derivatives of G/G by moduli (over G) and shape parameters, (n, S)
    grid : the elements
    """

    law: Law
    ratio: Array
    time: Array
    log_prestretch: Array
    span: Array
    ring: Array
    field: Array
    unit: Array
    shear_slopes: Array
    grid: Grid

    @classmethod
    def of(cls, specimens: Sequence[Specimen], modes: int, pieces: int | None = None) -> Films:
        """Films of like specimens, in ``pieces`` elements or as many as the longest asks for."""
        materials = [one.material for one in specimens]
        shear = np.array([one.shear_modulus for one in materials])
        law = materials[0].law
        mu, alpha = np.array([one.mu for one in materials]).T / shear, np.array([one.alpha for one in materials]).T
        slopes = np.array([_shear_slopes(law, m, a) for m, a in zip(mu.T, alpha.T, strict=True)]).T
        if (mu == mu[:, :1]).all() and (alpha == alpha[:, :1]).all():
            mu, alpha = mu[:, :1], alpha[:, :1]
        branches = [one.branches for one in materials]
        thickness = np.array([one.thickness for one in specimens])
        prestretch = np.array([one.prestretch for one in specimens])
        ring = np.array([one.ring_radius for one in specimens])
        span = np.log(ring / np.array([one.disk_radius for one in specimens]))
        pieces = ritz.elements(span) if pieces is None else pieces
        return cls(
            law(mu, alpha.reshape(-1, mu.shape[1])),
            np.array([[b.ratio for b in each] for each in branches], dtype=float).T.reshape(-1, 1, 1, len(specimens)),
            np.array([[b.time for b in each] for each in branches], dtype=float).T.reshape(-1, 1, 1, len(specimens)),
            np.log(prestretch),
            span,
            ring,
            np.array([one.permittivity for one in materials]) / (thickness**2 * shear),
            2.0 * math.pi * ring * thickness * shear / prestretch**2,
            slopes,
            Grid.lay(modes, -span * np.linspace(1.0, 0.0, pieces + 1)[:, None]),
        )

    def take(self, index: Index) -> Films:
        """The films at ``index``."""
        return Films(
            self.law.take(index),
            self.ratio[..., index],
            self.time[..., index],
            self.log_prestretch[index],
            self.span[index],
            self.ring[index],
            self.field[index],
            self.unit[index],
            self.shear_slopes[:, index],
            self.grid.take(index),
        )

    @property
    def branches(self) -> int:
        return len(self.ratio)

    @property
    def columns(self) -> int:
        """Derivatives a film has: by moduli, shape parameters, ln(field), ratios, ln(times), ln(pre-stretch), and
        the height, of a free disk ln(load)."""
        return len(self.shear_slopes) + 2 * self.branches + 3


def _shear_slopes(law: type[Law], mu: Array, alpha: Array) -> list[float]:
    """Derivatives of the shear modulus by moduli and shape parameters, by differences of the fourth order.

    It is linear in the moduli, and of a low degree in the shape parameters.
    """
    slopes = []
    for which in range(len(mu) + len(alpha)):
        value = np.concatenate((mu, alpha))
        step, total = 1e-3 * max(1.0, abs(float(value[which]))), 0.0
        for shift, weight in ((1.0, 8.0), (-1.0, -8.0), (2.0, -1.0), (-2.0, 1.0)):
            moved = value.copy()
            moved[which] += shift * step
            total += weight * law.shear_modulus(moved[: len(mu)].tolist(), moved[len(mu) :].tolist())
        slopes.append(total / (12.0 * step))
    return slopes


@dataclass(slots=True)
class State:
    """Modes and cuts (n, S), slopes (Q, M, S), elastic strains of the branches (2, K, Q, M, S).

    height : over the ring radius (S,), of disks that are free to move
    slack : how far the natural width's logarithm is above that of the film's own, (Q, M, S); zero where it is taut
    """

    c: Array
    w: Array
    x: Array
    height: Array | None = None
    slack: Array | None = None


@dataclass(slots=True)
class Load:
    """What pushes free disks: a ``share`` (S,) of a ``law`` of force for the films ``which``."""

    which: NDArray[np.intp]
    share: Array
    law: PushLaw

    def at(self, films: Films, height: Array) -> tuple[Array, Array]:
        """Dimensionless force and its slope by the height (S,)."""
        force, slope = self.law(self.which, height * films.ring)
        return self.share * force / films.unit, self.share * slope * films.ring / films.unit


@dataclass(slots=True)
class Instant:
    """What drives the films at one instant, (S,) each: displacement (m), voltage (V); in its place a load.

    relaxed : whether the film folds where it has lost its hoop tension
    """

    h: Array
    voltage: Array
    load: Load | None = None
    relaxed: bool = False

    def height(self, films: Films) -> Array:
        """Height over ring radius, that of the flat film not quite zero."""
        found: Array = np.maximum(np.abs(self.h) / films.ring, FLAT)
        return found

    @property
    def driven(self) -> NDArray[np.bool_]:
        """Which of the films are not left flat: zero force means zero height."""
        found: NDArray[np.bool_] = (self.h if self.load is None else self.load.share) != 0.0
        return found

    @property
    def side(self) -> Array:
        """1 where the disk is pushed to positive h, -1 on the other side."""
        found: Array = np.where(self.h < 0.0, -1.0, 1.0)
        return found

    def take(self, index: NDArray[np.intp]) -> Instant:
        """The films at ``index``."""
        load = None if self.load is None else Load(self.load.which[index], self.load.share[index], self.load.law)
        return Instant(self.h[index], self.voltage[index], load, self.relaxed)


def pack(films: Films, state: State) -> Array:
    """One column a film (D, S): what is smooth in time, the slopes over the height."""
    height, slack = state.height, state.slack
    assert height is not None
    size = len(height)
    rows = [height[None], state.c, (state.w / height).reshape(-1, size), state.x.reshape(-1, size)]
    return np.concatenate(rows if slack is None else [*rows, slack.reshape(-1, size)])


def unpack(films: Films, instant: Instant, packed: Array) -> State:
    """The state of `pack`, at the height of another instant; that of a free disk comes with it."""
    size, shape = packed.shape[1], films.grid.radius.shape[:2]
    n, points, kinds = films.grid.unknowns, shape[0] * shape[1], films.branches
    cuts = np.cumsum([1, n, points, 2 * kinds * points])
    height = instant.height(films)
    if instant.load is not None:
        lifted = np.where(packed[0] > 10.0 * FLAT, packed[0], LIFTED)
        height = np.where(instant.load.share == 0.0, FLAT, lifted)
    w = packed[cuts[1] : cuts[2]].reshape(*shape, size) * height
    x = packed[cuts[2] : cuts[3]].reshape(2, kinds, *shape, size)
    slack = np.maximum(packed[cuts[3] :], 0.0).reshape(*shape, size) if instant.relaxed else None
    return State(packed[1 : cuts[1]], w, x, height, slack)
