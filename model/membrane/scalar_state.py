"""What `model.membrane.scalar` works on: one film, its elements and the tables of `model.membrane.ritz`, as plain
Python numbers."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from math import exp, expm1, log1p

import numpy as np

from model.arrays import Array
from model.material.law import Point
from model.membrane import output, ritz, wrinkled_cone

Floats = list[float]


@dataclass(frozen=True, slots=True)
class Film:
    """One state, dimensionless."""

    law: Point  # stresses and tangents over G at two log stretches
    field: float  # eps (V/T)^2 / G
    log_prestretch: float
    span: float
    height: float


@dataclass(slots=True)
class Panel:
    """A taut element."""

    number: int
    w: Floats
    place: list[int]  # unknown of each of its functions, -1 where there is none
    radius: Floats = field(default_factory=list)
    once: Floats = field(default_factory=list)
    dxi: float = 0.0
    strain: Floats = field(default_factory=list)  # its functions' sum at the points, and the sum's derivative in xi
    tension: Floats = field(default_factory=list)  # hoop stress at the points


@dataclass(slots=True)
class Cone:
    """A wrinkled element; see `model.membrane.wrinkled_cone`."""

    number: int
    u: Floats
    natural: Floats
    cos: float
    sin: float
    pull: float
    cut: tuple[int, int]
    radius: Floats = field(default_factory=list)
    once: Floats = field(default_factory=list)
    ends: tuple[float, float] = (0.0, 0.0)


@dataclass(slots=True)
class Found:
    """The state, and what `model.membrane.output.Extremes` has."""

    modes: int
    breaks: Floats
    c: Floats
    panels: list[Panel]
    cones: list[Cone]
    lam: float
    error: float
    steps: int
    log_area: float
    radius: float
    hoop: float
    meridional: float
    log_stretch: float
    softening: float

    def arrays(self) -> tuple[ritz.Grid, ritz.State]:
        """The state as the rest of the model has it."""
        grid = ritz.Grid.lay(self.modes, np.array(self.breaks)[:, None])
        c = np.array(self.c)[:, None]
        w = np.empty((grid.table.points, len(self.panels), 1))
        for k, panel in enumerate(self.panels):
            w[:, k, 0] = panel.w
        if not self.cones:
            return grid, ritz.State(c, w)

        def points(name: str) -> Array:
            return np.array([getattr(fold, name) for fold in self.cones]).T[:, :, None]

        def ends(name: str) -> Array:
            return np.array([[getattr(fold, name)] for fold in self.cones])

        which = tuple(fold.number for fold in self.cones)
        folds = wrinkled_cone.Cones(which, points("u"), points("natural"), ends("cos"), ends("sin"), ends("pull"))
        taut = tuple(panel.number for panel in self.panels)
        return grid, wrinkled_cone.whole(grid, ritz.State(c, w), taut, folds)


@dataclass(frozen=True, slots=True)
class Tables:
    """A table of `model.membrane.ritz` as lists; with ``cut`` the hats are among the functions."""

    points: int
    below: Floats  # (1 - xi)/2
    weight: Floats
    values: Array  # (2Q, N)
    assemble: Array  # (N(N+1)/2 + 2N, 7Q): `model.membrane.ritz.Table.pairs`, and twice ``project``
    ends: Array  # (2, Q)
    end_slopes: Array  # (2, Q)
    tests: tuple[Floats, Floats, Floats, Floats]
    fine: Array
    to_legendre: Array  # (Q, Q)


@lru_cache(maxsize=32)
def tables_of(modes: int, cut: bool) -> Tables:
    t = ritz.table(modes)
    (disk, disk_slope), (ring, ring_slope) = output.edge_tests(modes)
    size = modes + 2 if cut else modes
    pairs, points = size * (size + 1) // 2, t.points
    assemble = np.zeros((pairs + 2 * size, 7 * points))
    assemble[:pairs, : 3 * points] = t.pairs[:pairs]
    assemble[pairs : pairs + size, 3 * points : 5 * points] = t.project[:size]
    assemble[pairs + size :, 5 * points :] = t.project[:size]
    return Tables(
        points=t.points,
        below=(0.5 * (1.0 - t.xi)).tolist(),
        weight=t.weight.tolist(),
        values=np.ascontiguousarray(t.values[:, :size]),
        assemble=assemble,
        ends=t.ends,
        end_slopes=t.end_slopes,
        tests=(disk.tolist(), disk_slope.tolist(), ring.tolist(), ring_slope.tolist()),
        fine=output.fine_table(modes),
        to_legendre=t.to_legendre,
    )


@lru_cache(maxsize=64)
def places(modes: int, elements: int, taut: tuple[int, ...]) -> list[list[int]]:
    """Unknowns of each panel's functions; without cuts the hats are none of them."""
    places: list[list[int]] = ritz.places(modes, elements, taut).tolist()
    return places if elements > 1 else [places[0][:modes]] if taut else []


def stress(film: Film, log1: float, log2: float) -> tuple[float, float, float, float, float, float]:
    """t1, t2, h11, h12, h22 and the Maxwell stress; see `model.material.law`."""
    t1, t2, h11, h12, h22 = film.law(log1, log2)
    if film.field == 0.0:
        return t1, t2, h11, h12, h22, 0.0
    b = film.field * exp(2.0 * (log1 + log2))
    return t1 - b, t2 - b, h11 - 2.0 * b, h12 - 2.0 * b, h22 - 2.0 * b, b


def slack(film: Film) -> bool:
    """Where the film, stretched like a straight cone both ways, would push outwards: no tension can hold it."""
    mean = film.height / -expm1(-film.span)
    log = film.log_prestretch + 0.5 * log1p(mean * mean)
    return stress(film, log, log)[0] < 0.0


class NotOrdinary(Exception):
    """A state that the scalar solver leaves to the methods for arrays."""
