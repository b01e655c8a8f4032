r"""The mounted film as a table: its force at any indentation and voltage, for instruments that ask all day.

The membrane solver is asked once, at nodes; what is interpolated is smooth and even in the indentation s:

.. math:: F = s\,G(w, u), \quad w = (s/s_{max})^2, \quad u = (V/V_c(w))^2

where V_c is a smooth bound just above the voltage at which the film breaks down at that indentation and G is a
Chebyshev series, checked against the solver between its nodes before it is used. A film that goes slack below its
breakdown voltage (no pre-stretch) has kinks there, which no such series follows; the check refuses it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from model.specimen import Specimen
from rig.errors import ConfigError

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

# (specimen, disk displacement, voltage) -> (force, peak field, solution found), arrays of one shape
Solve = Callable[[Specimen, Floats, Floats], tuple[Floats, Floats, Bools]]

TOLERANCE = 1e-5  # interpolation error aimed at, of the largest force in the table
WORST = 1e-3  # above this no table is made
SIZES = ((20, 8), (30, 12))
BREAKDOWN_NODES = 40
BREAKDOWN_TOLERANCE = 1e-4
BOUND_DEGREE = 10
DEFAULT_FIELD = 80e6  # V/m, where the material names no breakdown field
REACH = 1.25  # largest indentation, in widths of the annulus; beyond it the film tears


class FilmTableError(ConfigError):
    """The film of this scene cannot be simulated."""


def solve_membrane(specimen: Specimen, h: Floats, voltage: Floats) -> tuple[Floats, Floats, Bools]:
    """Ask the membrane model; wrinkled films by their relaxed energy, slack ones carry nothing and see no field."""
    from model.membrane import Status, solve_many

    solutions = solve_many(specimen, h, voltage, wrinkling="tension_field")
    status = np.asarray(solutions.status)
    slack = status == Status.SLACK
    found = (status == Status.TAUT) | (status == Status.WRINKLED) | slack
    return np.where(slack, 0.0, solutions.force), np.where(slack, 0.0, solutions.peak_field), found


def _clenshaw(coefficients: list[float], x: float) -> float:
    """Sum of c_k T_k(2 x - 1)."""
    y = 4.0 * x - 2.0
    b1 = b2 = 0.0
    for c in coefficients[:0:-1]:
        b1, b2 = c + y * b1 - b2, b1
    return coefficients[0] + 0.5 * y * b1 - b2


@dataclass(frozen=True)
class FilmTable:
    """Force and breakdown voltage of one film on one rig.

    Attributes
    ----------
    reach : float
        Largest indentation s (m) in the table; the film tears beyond.
    error : float
        Largest difference to the solver found between the nodes (N).
    """

    reach: float
    error: float
    _columns: list[list[float]]  # Chebyshev coefficients of G: for each power of u those in w
    _bound: list[float]  # Chebyshev coefficients of V_c in w; empty where no voltage ever comes
    _breakdown: list[float]  # breakdown voltage at equal steps of s/s_max; it has kinks

    def _w(self, s: float) -> float:
        x = min(s / self.reach, 1.0)
        return x * x

    def force(self, s: float, voltage: float) -> float:
        """Equilibrium force (N) at indentation ``s`` (m) and ``voltage`` (V)."""
        w = self._w(s)
        u = 0.0
        if self._bound:
            ratio = voltage / _clenshaw(self._bound, w)
            u = min(ratio * ratio, 1.0)
        return s * _clenshaw([_clenshaw(column, w) for column in self._columns], u)

    def breakdown_voltage(self, s: float) -> float:
        """Voltage (V) at which the peak field reaches the film's strength at indentation ``s`` (m)."""
        if not self._breakdown:
            return math.inf
        steps = len(self._breakdown) - 1
        x = min(s / self.reach, 1.0) * steps
        i = min(int(x), steps - 1)
        return self._breakdown[i] + (x - i) * (self._breakdown[i + 1] - self._breakdown[i])

    def bound(self, s: float) -> float:
        """Largest voltage (V) in the table at indentation ``s`` (m)."""
        return _clenshaw(self._bound, self._w(s)) if self._bound else 0.0


def _nodes(n: int) -> Floats:
    """Chebyshev nodes of the first kind on (0, 1)."""
    nodes: Floats = 0.5 - 0.5 * np.cos(np.pi * (np.arange(n) + 0.5) / n)
    return nodes


def _series(values: Floats) -> Floats:
    """Chebyshev coefficients from values at the nodes, along the first axis."""
    n = values.shape[0]
    basis = np.cos(np.outer(np.arange(n), np.pi * (1.0 - (np.arange(n) + 0.5) / n)))
    basis[0] *= 0.5
    coefficients: Floats = basis @ values * (2.0 / n)
    return coefficients


def _columns(values: Floats) -> list[list[float]]:
    """Chebyshev coefficients from values at the nodes (n_w, n_u), a list in w for each in u."""
    columns: list[list[float]] = _series(_series(values).T).tolist()
    return columns


@lru_cache(maxsize=8)  # one bench after another asks for the same film
def tabulate(specimen: Specimen, compliance: float, with_voltage: bool, solve: Solve = solve_membrane) -> FilmTable:
    """Make the table for ``specimen`` on a rig of ``compliance`` (m/N): s = displacement + compliance x force."""
    reach = REACH * (specimen.ring_radius - specimen.disk_radius)
    bare = FilmTable(reach, math.inf, [[0.0]], [], [])
    if with_voltage:
        x = np.linspace(0.0, 1.0, BREAKDOWN_NODES)
        x[0] = 1e-3
        breakdown = _breakdown(specimen, reach * x, solve)
        fit = np.polynomial.Chebyshev.fit(x * x, breakdown, BOUND_DEGREE, domain=(0.0, 1.0))
        above = float(np.max(breakdown / fit(x * x)))
        bare = replace(bare, _bound=[float(c) * above for c in fit.coef], _breakdown=breakdown.tolist())
    largest = float(solve(specimen, np.array([reach]), np.zeros(1))[0][0])
    best = bare
    for n_w, n_u in SIZES:
        table = _fit(specimen, compliance, bare, _nodes(n_w), _nodes(n_u if with_voltage else 1), solve)
        best = min(best, table, key=lambda one: one.error)
        if best.error <= TOLERANCE * largest:
            return best
    if not best.error <= WORST * largest:
        raise FilmTableError(
            f"the film of specimen {specimen.name!r} cannot be simulated: its table is wrong by up to"
            f" {best.error:.2g} N; simulate more pre-stretch, or leave out the HV supply"
        )
    return best


def _breakdown(specimen: Specimen, h: Floats, solve: Solve) -> Floats:
    """Voltage at which the film breaks down at the displacements ``h``: by its field, or by losing stability first."""
    strength = specimen.material.breakdown_field or DEFAULT_FIELD
    for _ in range(12):
        voltage = np.ones_like(h)
        for _ in range(20):
            _, field, found = solve(specimen, h, voltage)
            if not found.all():
                break
            ratio = np.where(field > 0, strength / np.where(field > 0, field, 1.0), 1.0)
            voltage = voltage * ratio
            if np.abs(ratio - 1.0).max() < BREAKDOWN_TOLERANCE:
                return voltage
        strength *= 0.9
    raise FilmTableError(f"the film of specimen {specimen.name!r} has no stable state below its breakdown")


def _fit(specimen: Specimen, compliance: float, bare: FilmTable, w: Floats, u: Floats, solve: Solve) -> FilmTable:
    s = bare.reach * np.sqrt(w)
    voltage = np.array([[bare.bound(one) for one in s.tolist()]]).T * np.sqrt(u)
    force, _, found = solve(specimen, np.broadcast_to(s[:, None], voltage.shape), voltage)
    if not found.all():
        i, j = np.argwhere(~found)[0]
        raise FilmTableError(f"no membrane solution for the film at {s[i] * 1e3:.4g} mm and {voltage[i, j]:.4g} V")
    table = replace(bare, _columns=_columns(force / s[:, None]))
    if compliance > 0:
        shared = [
            [_shared(table, compliance, one, v) for v in row]
            for one, row in zip(s.tolist(), voltage.tolist(), strict=True)
        ]
        table = replace(bare, _columns=_columns(np.array(shared) / s[:, None]))
    return replace(table, error=_check(specimen, table, compliance, w, u, solve))


def _shared(film: FilmTable, compliance: float, s: float, voltage: float) -> float:
    """Force (N) when film and rig share the way ``s``."""
    low, high = 0.0, s
    for _ in range(50):
        h = 0.5 * (low + high)
        if h + compliance * film.force(h, voltage) < s:
            low = h
        else:
            high = h
    return film.force(h, voltage)


def _check(specimen: Specimen, table: FilmTable, compliance: float, w: Floats, u: Floats, solve: Solve) -> float:
    """Largest difference (N) between table and solver midway between the nodes and at the edges."""
    w = np.concatenate([[1e-4], 0.5 * (w[1:] + w[:-1]), [1.0]])
    u = np.concatenate([[0.0], 0.5 * (u[1:] + u[:-1]), [1.0]])
    points = [(table.reach * math.sqrt(a), math.sqrt(b)) for a in w.tolist() for b in u.tolist()]
    s = np.array([one for one, _ in points])
    voltage = np.array([part * table.bound(one) for one, part in points])
    force = np.array([table.force(*point) for point in zip(s.tolist(), voltage.tolist(), strict=True)])
    exact, _, found = solve(specimen, s - compliance * force, voltage)
    return float(np.max(np.abs(force - exact))) if found.all() else math.inf
