"""The film from disk to ring: shape, stretches, stresses and field of solved states."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.material.law import relax, stack, stress
from model.membrane import ritz
from model.membrane.output import edges
from model.membrane.ritz import Grid, Problem, State


@dataclass(frozen=True, eq=False)
class Profile:
    """Values along the undeformed radius ``R``, from the disk to the ring: (points,), or (states, points).

    Attributes
    ----------
    R : radius in the pre-stretched flat film (m)
    r, z : where that point is now: radius and distance from the ring's plane (m)
    slope : angle of the meridian to the ring's plane, positive downwards from the disk (rad)
    stretch_1, stretch_2 : total principal stretches, along the meridian and around; where wrinkled the natural one
    stress_1, stress_2 : true stresses (Pa)
    field : true electric field (V/m)
    wrinkled : whether the film is folded there
    """

    R: Array
    r: Array
    z: Array
    slope: Array
    stretch_1: Array
    stretch_2: Array
    stress_1: Array
    stress_2: Array
    field: Array
    wrinkled: NDArray[np.bool_]

    @property
    def thinning(self) -> Array:
        """Thickness at rest over thickness, the product of the stretches in the plane."""
        return self.stretch_1 * self.stretch_2

    @classmethod
    def blank(cls, states: int, points: int) -> Profile:
        """Profiles without values: NaN."""
        arrays = {f.name: np.full((states, points), np.nan) for f in fields(cls)}
        arrays["wrinkled"] = np.zeros((states, points), dtype=np.bool_)
        return cls(**arrays)

    def put(self, index: NDArray[np.intp], other: Profile) -> None:
        """Take over the profiles ``other`` as those at ``index``."""
        for f in fields(self):
            getattr(self, f.name)[index] = getattr(other, f.name)

    def of(self, state: int) -> Profile:
        """The profile of one state."""
        return Profile(**{f.name: getattr(self, f.name)[state] for f in fields(self)})


def dense(grid: Grid, points: int) -> Array:
    """Places ``ln(R/b)`` (points, S), so many an element and denser towards its ends."""
    share = 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, points)))
    places = grid.breaks[:-1, None] + share[1:, None] * (grid.breaks[1:, None] - grid.breaks[:-1, None])
    places[:, -1] = grid.breaks[1:]
    return np.concatenate((grid.breaks[:1], places.reshape(-1, grid.breaks.shape[1])))


def profile(
    problem: Problem, grid: Grid, state: State, lam: Array, x: Array, *, ring: Array, shear: Array, field: Array
) -> Profile:
    """Profiles of S states at places ``x = ln(R/b)`` (points, S), of which the first is the disk and the last the ring.

    ``ring`` is b (m), ``shear`` is G (Pa), ``field`` is V/T (V/m), (S,) each.
    """
    legendre = np.polynomial.legendre
    at = ritz.evaluate(problem, grid, state)
    element = (x > grid.breaks[1:-1, None]).sum(axis=0)
    states = np.arange(x.shape[1])
    left, right = grid.breaks[element, states], grid.breaks[element + 1, states]
    xi = np.clip(2.0 * (x - left) / (right - left) - 1.0, -1.0, 1.0)

    def coefficients(values: Array) -> Array:
        """Of the polynomials through point values (Q, M, S)."""
        return np.tensordot(grid.table.to_legendre, values, 1)

    def sampled(c: Array) -> Array:
        return np.asarray(legendre.legval(xi, c[:, element, states], tensor=False))

    log1, log2, q, e = (sampled(coefficients(values)) for values in (at.log[0], at.log[1], at.q, at.e))
    wrinkled = np.zeros(x.shape, dtype=np.bool_)
    if state.relaxed is not None:
        wrinkled = state.relaxed[0][element, states]
    edge = edges(problem, grid, state, at, lam)
    log1[[0, -1]], log2[[0, -1]], e[[0, -1]] = edge.log1, edge.log2, 0.0
    law = stress(problem.film, stack(log1, log2))
    if state.relaxed is not None:
        law = relax(problem.film, law, wrinkled)
    # The drop to the ring: the polynomial through R w, integrated in closed form.
    drop = legendre.legint(coefficients(grid.radius * state.w), lbnd=1.0, axis=0) / -grid.dxi
    below = np.cumsum(np.asarray(legendre.legval(-1.0, drop))[::-1], axis=0)[::-1]
    below = np.concatenate((below[1:], np.zeros((1, x.shape[1]))))
    z = sampled(drop) + below[element, states]
    long = np.exp(2.0 * (log1 - problem.log_prestretch))
    radius = ring * np.exp(x)
    found = {
        "R": radius,
        "r": radius * (1.0 + e),
        "z": ring * (z - z[-1]),
        "slope": np.arctan2(np.sqrt(np.maximum(long - (1.0 + q) ** 2, 0.0)), 1.0 + q),
        "stretch_1": np.exp(log1),
        "stretch_2": np.exp(log2),
        "stress_1": shear * law.t1,
        "stress_2": shear * law.t2,
        "field": field * np.exp(log1 + log2),
    }
    return Profile(**{name: values.T for name, values in found.items()}, wrinkled=wrinkled.T)
