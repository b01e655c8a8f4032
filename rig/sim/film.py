r"""The mounted film as a table: its force at any indentation and voltage, for instruments that ask all day.

The membrane solver is asked once, at Chebyshev nodes; what is interpolated is smooth and even in the indentation s:

.. math:: F = s\,G(w, u), \quad w = (s/s_{max})^2, \quad u = (V/V_c(w))^2

where V_c is a smooth bound just above the voltage at which the film breaks down at that indentation. The
interpolation is checked against the solver between the nodes before it is used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from model.specimen import Specimen

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

# (specimen, disk displacement, voltage) -> (force, peak field, solution found), arrays of one shape
Solve = Callable[[Specimen, Floats, Floats], tuple[Floats, Floats, Bools]]

TOLERANCE = 1e-5  # interpolation error aimed at, of the largest force in the table
WORST = 1e-3  # above this no table is made
SIZES = ((20, 8), (30, 12), (44, 18))
BREAKDOWN_SIZE = 20
BREAKDOWN_TOLERANCE = 1e-4
BOUND_DEGREE = 5
DEFAULT_FIELD = 80e6  # V/m, where the material names no breakdown field
REACH = 1.25  # largest indentation, in widths of the annulus; beyond it the film tears


class FilmTableError(Exception):
    """The film's behaviour cannot be tabulated; the simulated bench cannot be made."""


def solve_membrane(specimen: Specimen, h: Floats, voltage: Floats) -> tuple[Floats, Floats, Bools]:
    """Ask the membrane model; wrinkled films by their relaxed energy, slack ones carry nothing and see no field."""
    from model.membrane import Status, solve_many

    solutions = solve_many(specimen, h, voltage, wrinkling="tension_field")
    status = np.asarray(solutions.status)
    slack = status == Status.SLACK
    found = (status == Status.TAUT) | (status == Status.WRINKLED) | slack
    return np.where(slack, 0.0, solutions.force), np.where(slack, 0.0, solutions.peak_field), found


def _nodes(n: int) -> Floats:
    """Chebyshev nodes of the first kind on (0, 1)."""
    nodes: Floats = 0.5 - 0.5 * np.cos(np.pi * (np.arange(n) + 0.5) / n)
    return nodes


def _coefficients(values: Floats) -> Floats:
    """Chebyshev coefficients on (0, 1) from values at `_nodes`, along the first axis."""
    n = values.shape[0]
    basis = np.cos(np.outer(np.arange(n), np.pi * (1.0 - (np.arange(n) + 0.5) / n)))
    basis[0] *= 0.5
    coefficients: Floats = np.tensordot(basis, values, axes=(1, 0)) * (2.0 / n)
    return coefficients


def _clenshaw(coefficients: Floats, x: Floats) -> Floats:
    """Sum of c_k T_k(2 x - 1) over the first axis of ``coefficients`` (k, ..., 1 or n), for x (n,)."""
    y = 4.0 * x - 2.0  # twice the argument of T_k
    b1 = b2 = np.zeros_like(x)
    for c in coefficients[:0:-1]:
        b1, b2 = c + y * b1 - b2, b1
    total: Floats = coefficients[0] + 0.5 * y * b1 - b2
    return total


def _clenshaw_at(coefficients: list[float], x: float) -> float:
    """The same for one x: plain numbers, because instruments ask one at a time."""
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
    _force: Floats  # Chebyshev coefficients of G, (n_w, n_u)
    _bound: Floats | None  # of V_c, (few,); None where no voltage ever comes
    _breakdown: Floats | None  # of the breakdown voltage, (n_w,), which has kinks

    def _w(self, s: Floats) -> Floats:
        x = np.minimum(s / self.reach, 1.0)
        w: Floats = x * x
        return w

    def force(self, s: Floats, voltage: Floats | None = None) -> Floats:
        """Equilibrium force (N) at indentation ``s`` (m) and ``voltage`` (V), both (n,); at 0 V when it is left out."""
        w = self._w(s)
        if self._bound is None:
            return s * _clenshaw(self._force[:, 0], w)
        ratio = 0.0 if voltage is None else voltage / _clenshaw(self._bound, w)
        u = np.minimum(ratio * ratio, 1.0) + np.zeros_like(w)
        return s * _clenshaw(_clenshaw(self._force[:, :, None], w), u)

    def force_at(self, s: float, voltage: float) -> float:
        """`force` at one indentation and voltage."""
        x = min(s / self.reach, 1.0)
        w = x * x
        columns, bound, _ = self._lists
        u = 0.0
        if bound:
            ratio = voltage / _clenshaw_at(bound, w)
            u = min(ratio * ratio, 1.0)
        return s * _clenshaw_at([_clenshaw_at(column, w) for column in columns], u)

    def breakdown_voltage_at(self, s: float) -> float:
        """Voltage (V) at which the peak field reaches the film's strength at indentation ``s`` (m)."""
        _, _, breakdown = self._lists
        x = min(s / self.reach, 1.0)
        return _clenshaw_at(breakdown, x * x) if breakdown else math.inf

    @cached_property
    def _lists(self) -> tuple[list[list[float]], list[float], list[float]]:
        """Columns of G, V_c and breakdown voltage as plain numbers; empty where there is none."""
        return (
            self._force.T.tolist(),
            [] if self._bound is None else self._bound.tolist(),
            [] if self._breakdown is None else self._breakdown.tolist(),
        )

    def bound(self, s: Floats) -> Floats:
        """Largest voltage (V) in the table at indentation ``s`` (n,)."""
        return np.full_like(s, np.inf) if self._bound is None else _clenshaw(self._bound, self._w(s))


def tabulate(specimen: Specimen, compliance: float, with_voltage: bool, solve: Solve = solve_membrane) -> FilmTable:
    """Make the table for ``specimen`` on a rig of ``compliance`` (m/N): s = displacement + compliance x force."""
    reach = REACH * (specimen.ring_radius - specimen.disk_radius)
    empty = FilmTable(reach, np.inf, np.zeros((1, 1)), None, None)
    if with_voltage:
        w = _nodes(BREAKDOWN_SIZE)
        at_nodes = _breakdown(specimen, reach * np.sqrt(w), solve)
        fit = np.polynomial.Chebyshev.fit(w, at_nodes, BOUND_DEGREE, domain=(0.0, 1.0))
        bound = np.asarray(fit.coef, dtype=np.float64) * float(np.max(at_nodes / fit(w)))
        empty = replace(empty, _bound=bound, _breakdown=_coefficients(at_nodes))
    best = empty
    for n_w, n_u in SIZES:
        table = _fit(specimen, compliance, empty, n_w, n_u if with_voltage else 1, solve)
        best = min(best, table, key=lambda one: one.error)
        largest = float(best.force(np.array([reach]))[0])
        if best.error <= TOLERANCE * largest:
            return best
    if not best.error <= WORST * largest:
        raise FilmTableError(
            f"the film of specimen {specimen.name!r} cannot be tabulated: the interpolation is wrong by up to"
            f" {best.error:.2g} N. Films that wrinkle do this; simulate more pre-stretch, or leave out the HV supply"
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


def _fit(specimen: Specimen, compliance: float, empty: FilmTable, n_w: int, n_u: int, solve: Solve) -> FilmTable:
    h = empty.reach * np.sqrt(_nodes(n_w))
    voltage = np.zeros((n_w, 1))
    if n_u > 1:
        voltage = empty.bound(h)[:, None] * np.sqrt(_nodes(n_u))
    force, _, found = solve(specimen, np.broadcast_to(h[:, None], voltage.shape), voltage)
    if not found.all():
        i, j = np.argwhere(~found)[0]
        raise FilmTableError(f"no membrane solution for the film at {h[i] * 1e3:.4g} mm and {voltage[i, j]:.4g} V")
    table = replace(empty, _force=_coefficients(_coefficients(force / h[:, None]).T).T)
    if compliance > 0:
        table = _on_rig(table, compliance, h, n_u)
    return replace(table, error=_check(specimen, table, compliance, n_w, n_u, solve))


def _on_rig(table: FilmTable, compliance: float, s: Floats, n_u: int) -> FilmTable:
    """The same table against indentation of film and rig together instead of displacement of the film."""
    force = np.empty((len(s), n_u))
    bound = table.bound(s)
    for j, u in enumerate(_nodes(n_u)):
        voltage = None if n_u == 1 else np.sqrt(u) * bound
        low, high = np.zeros_like(s), s
        for _ in range(60):
            h = 0.5 * (low + high)
            short = h + compliance * table.force(h, voltage) < s
            low, high = np.where(short, h, low), np.where(short, high, h)
        force[:, j] = table.force(h, voltage)
    return replace(table, _force=_coefficients(_coefficients(force / s[:, None]).T).T)


def _check(specimen: Specimen, table: FilmTable, compliance: float, n_w: int, n_u: int, solve: Solve) -> float:
    """Largest difference (N) between table and solver at points between the nodes and at the edges."""
    x = np.arange(n_w + 1) / n_w
    u = np.arange(n_u + 1) / n_u if n_u > 1 else np.zeros(1)
    s = table.reach * np.sqrt(np.repeat(np.maximum(0.5 - 0.5 * np.cos(np.pi * x), 1e-4), len(u)))
    voltage = np.zeros_like(s)
    if n_u > 1:
        voltage = np.sqrt(np.tile(0.5 - 0.5 * np.cos(np.pi * u), n_w + 1)) * table.bound(s)
    force = table.force(s, voltage)
    exact, _, found = solve(specimen, s - compliance * force, voltage)
    return float(np.max(np.abs(force - exact))) if found.all() else float("inf")
