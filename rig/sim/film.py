r"""The mounted film as a table: its force at any indentation and voltage, for instruments that ask all day.

The membrane solver is asked once, at nodes; what is interpolated is smooth and even in the indentation s:

.. math:: F = s\,G(w, u), \quad w = (s/s_{max})^2, \quad u = (V/V_c(w))^2

where G is a Chebyshev series, checked against the solver between its nodes before it is used, and V_c a smooth voltage
near to where the film breaks down or goes slack at that indentation.

A film breaks down where its true field reaches its strength. Where it has no state any more before that (pull-in), it
thins without end and breaks down at the voltage of its last state: electromechanical breakdown (Stark & Garton 1955). A
film that goes slack breaks down as a free one, with the thickness at which nothing pulls. V_c then is just below the
voltage at which the last state or the tension is lost, for beyond there is no force to interpolate.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from model.specimen import Specimen
from rig.base.errors import ConfigError

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

# (specimen, disk displacement, voltage) -> (force, peak field, solution found), arrays of one shape
Solve = Callable[[Specimen, Floats, Floats], tuple[Floats, Floats, Bools]]

TOLERANCE = 1e-5  # interpolation error aimed at, of the largest force in the table
WORST = 1e-3  # above this no table is made
SIZES = ((20, 8), (30, 12))
BREAKDOWN_NODES, BOUND_DEGREE = 40, 10
BREAKDOWN_TOLERANCE = 1e-4
EDGE_NODES, EDGE_DEGREE = 20, 6  # of a film that loses state or tension first: fewer nodes, for they take long
FIELD_TOLERANCE, EDGE_TOLERANCE = 2e-4, 6e-3  # of its breakdown voltage: by its strength, by losing its state
FIRST_STEP = 0.75  # of the way to where its strength seems to be without voltage
BELOW_EDGE = 0.985  # up to here the force of such a film is interpolated: its edge has kinks between the nodes
FREE_STRETCH, FREE_NODES = 4.0, 4000  # of a slack film: how far beyond its pre-stretch it is looked for
DEFAULT_FIELD = 80e6  # V/m, where the material names no breakdown field
REACH = 1.25  # largest indentation, in widths of the annulus; beyond it the film tears


class FilmTableError(ConfigError):
    """The film of this scene cannot be simulated."""


def solve_membrane(specimen: Specimen, h: Floats, voltage: Floats) -> tuple[Floats, Floats, Bools]:
    """Ask the membrane model; wrinkled films by their relaxed energy, slack ones carry nothing and are free films."""
    from model.membrane.solve import Status, solve_many

    h, voltage = np.broadcast_arrays(h, voltage)
    solutions = solve_many(specimen, h, voltage, wrinkling="tension_field")
    status = np.asarray(solutions.status)
    slack = status == Status.SLACK
    field = np.asarray(solutions.peak_field)
    if slack.any():
        field = np.where(slack, _free_field(specimen, h, voltage), field)
    found = (status == Status.TAUT) | (status == Status.WRINKLED) | (slack & np.isfinite(field))
    return np.where(slack, 0.0, solutions.force), field, found


def _free_field(specimen: Specimen, h: Floats, voltage: Floats) -> Floats:
    """True field of a slack film: it expands until a cone of its stretch would just be slack. NaN if it never is."""
    from model.stability.limits import slack_voltage

    stretch = np.linspace(1.0, FREE_STRETCH, FREE_NODES)  # beyond the pre-stretch
    balance = slack_voltage(specimen, (specimen.ring_radius - specimen.disk_radius) * np.sqrt(stretch**2 - 1.0))
    falls = np.diff(balance) <= 0.0
    stable = int(falls.argmax()) + 1 if falls.any() else len(balance)  # beyond, it thins without end
    free: Floats = np.interp(voltage, balance[:stable], stretch[:stable], right=np.nan)
    needed = np.hypot(1.0, h / (specimen.ring_radius - specimen.disk_radius))
    area = (specimen.prestretch * free) ** 2
    return np.where(free >= needed * (1.0 - 1e-6), voltage * area / specimen.thickness, np.nan)


def clenshaw(coefficients: list[float], x: float) -> float:
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
    _edge: list[float]  # voltage up to which there is tension, at the same steps; empty where the bound is above
    _beyond: float  # (V/V_c)^2 at that edge

    def _w(self, s: float) -> float:
        x = min(s / self.reach, 1.0)
        return x * x

    def force(self, s: float, voltage: float) -> float:
        """Equilibrium force (N) at indentation ``s`` (m) and ``voltage`` (V)."""
        w = self._w(s)
        u = 0.0
        if self._bound:
            ratio = voltage / clenshaw(self._bound, w)
            u = min(ratio * ratio, self._beyond)
        if self._edge and voltage >= (edge := self._at(self._edge, s)) and edge < self._at(self._breakdown, s):
            return 0.0  # slack
        return s * clenshaw([clenshaw(column, w) for column in self._columns], u)

    def breakdown_voltage(self, s: float) -> float:
        """Voltage (V) at which the film breaks down at indentation ``s`` (m): by its field, or by pull-in before."""
        return self._at(self._breakdown, s) if self._breakdown else math.inf

    def bound(self, s: float) -> float:
        """Largest voltage (V) of the table's nodes at indentation ``s`` (m)."""
        return clenshaw(self._bound, self._w(s)) if self._bound else 0.0

    def top(self, s: float) -> float:
        """Largest voltage (V) that the table is good for at indentation ``s`` (m): the film is taut up to there."""
        return BELOW_EDGE * self._at(self._edge, s) if self._edge else self.bound(s)

    def _at(self, values: list[float], s: float) -> float:
        """``values`` at equal steps of s/s_max, between them."""
        steps = len(values) - 1
        x = min(s / self.reach, 1.0) * steps
        i = min(int(x), steps - 1)
        return values[i] + (x - i) * (values[i + 1] - values[i])


def nodes(n: int) -> Floats:
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


def columns(values: Floats) -> list[list[float]]:
    """Chebyshev coefficients from values at the nodes (n_w, n_u), a list in w for each in u."""
    columns: list[list[float]] = _series(_series(values).T).tolist()
    return columns


@lru_cache(maxsize=8)  # one bench after another asks for the same film
def tabulate(specimen: Specimen, compliance: float, with_voltage: bool, solve: Solve = solve_membrane) -> FilmTable:
    """Make the table for ``specimen`` on a rig of ``compliance`` (m/N): s = displacement + compliance x force."""
    reach = REACH * (specimen.ring_radius - specimen.disk_radius)
    bare = FilmTable(reach, math.inf, [[0.0]], [], [], [], 1.0)
    if with_voltage:
        bare = _bounded(specimen, bare, solve)
    largest = float(solve(specimen, np.array([reach]), np.zeros(1))[0][0])
    best = bare
    for n_w, n_u in SIZES[:1] if bare._edge else SIZES:  # more nodes do not follow kinks better
        table = _fit(specimen, compliance, bare, nodes(n_w), nodes(n_u if with_voltage else 1), solve)
        best = min(best, table, key=lambda one: one.error)
        if best.error <= TOLERANCE * largest:
            return best
    if not best.error <= WORST * largest:
        raise FilmTableError(
            f"the film of specimen {specimen.name!r} cannot be simulated: its table is wrong by up to"
            f" {best.error:.2g} N; simulate more pre-stretch, or leave out the HV supply"
        )
    return best


def _bounded(specimen: Specimen, bare: FilmTable, solve: Solve) -> FilmTable:
    """``bare`` with its breakdown voltages, and with a bound for its force."""
    x = _steps(BREAKDOWN_NODES)
    breakdown = _by_field(specimen, bare.reach * x, solve)
    if breakdown is not None:
        fit = np.polynomial.Chebyshev.fit(x * x, breakdown, BOUND_DEGREE, domain=(0.0, 1.0))
        above = float(np.max(breakdown / fit(x * x)))
        return replace(bare, _bound=[float(c) * above for c in fit.coef], _breakdown=breakdown.tolist())
    x = _steps(EDGE_NODES)
    breakdown, edge = _by_halving(specimen, bare.reach * x, solve)
    fit = np.polynomial.Chebyshev.fit(x * x, edge, EDGE_DEGREE, domain=(0.0, 1.0))
    share = edge / fit(x * x)
    if not np.min(share) > 0.5:
        raise FilmTableError(
            f"the film of specimen {specimen.name!r} cannot be simulated: the voltage at which it goes slack or pulls"
            " in changes too fast with its displacement; simulate more pre-stretch, or leave out the HV supply"
        )
    below = float(np.min(share)) * BELOW_EDGE
    return replace(
        bare,
        _bound=[float(c) * below for c in fit.coef],
        _beyond=float(np.max(share) / below) ** 2,
        _breakdown=breakdown.tolist(),
        _edge=edge.tolist(),
    )


def _steps(n: int) -> Floats:
    """Equal steps of s/s_max; the first is not quite zero."""
    x = np.linspace(0.0, 1.0, n)
    x[0] = 1e-3
    return x


def _strength(specimen: Specimen) -> float:
    return specimen.material.breakdown_field or DEFAULT_FIELD


def _by_field(specimen: Specimen, h: Floats, solve: Solve) -> Floats | None:
    """Voltage at which the film's field reaches its strength; None where state or tension is lost on the way."""
    voltage = np.ones_like(h)
    for _ in range(20):
        force, field, found = solve(specimen, h, voltage)
        if not (found & (force > 0)).all():
            return None
        ratio = _strength(specimen) / field
        voltage = voltage * ratio
        if np.abs(ratio - 1.0).max() < BREAKDOWN_TOLERANCE:
            return voltage
    return None


def _by_halving(specimen: Specimen, h: Floats, solve: Solve) -> tuple[Floats, Floats]:
    """Breakdown voltages, whichever way, and the voltages up to which there is tension.

    The field grows faster than the voltage, so that each state puts a bound to the voltage at which the strength is
    reached; below it is halved, for what lies beyond the last state takes long to solve.
    """
    from model.stability.limits import slack_voltage

    low = np.ones_like(h)
    _, field, found = solve(specimen, h, low)
    if not found.all():
        raise FilmTableError(f"the film of specimen {specimen.name!r} has no stable state even without voltage")
    high = _strength(specimen) / field
    lost, slack = np.zeros(h.shape, dtype=bool), np.zeros(h.shape, dtype=bool)
    voltage, going = FIRST_STEP * high, np.arange(len(h))
    while len(going):
        v = voltage[going]
        force, field, found = solve(specimen, h[going], v)
        ratio = _strength(specimen) / np.where(found, field, 1.0)
        below = found & (ratio > 1.0)
        nearer = below & (v * ratio < high[going])
        low[going] = np.where(below, v, low[going])
        high[going] = np.where(nearer, v * ratio, np.where(below, high[going], v))
        lost[going] = np.where(below, lost[going] & ~nearer, ~found)
        slack[going] = np.where(below, ~(force > 0), slack[going])
        wide = high - low > np.where(lost, EDGE_TOLERANCE, FIELD_TOLERANCE) * high
        going = going[wide[going]]
        voltage = 0.5 * (low + high)
    breakdown = np.where(lost, low, 0.5 * (low + high))
    return breakdown, np.where(slack, np.minimum(slack_voltage(specimen, h), breakdown), breakdown)


def _fit(specimen: Specimen, compliance: float, bare: FilmTable, w: Floats, u: Floats, solve: Solve) -> FilmTable:
    s = bare.reach * np.sqrt(w)
    voltage = np.array([[bare.bound(one) for one in s.tolist()]]).T * np.sqrt(u)
    force, _, found = solve(specimen, np.broadcast_to(s[:, None], voltage.shape), voltage)
    if not found.all():
        i, j = np.argwhere(~found)[0]
        raise FilmTableError(f"no membrane solution for the film at {s[i] * 1e3:.4g} mm and {voltage[i, j]:.4g} V")
    table = replace(bare, _columns=columns(force / s[:, None]))
    if compliance > 0:
        shared = [
            [_shared(table, compliance, one, v) for v in row]
            for one, row in zip(s.tolist(), voltage.tolist(), strict=True)
        ]
        table = replace(bare, _columns=columns(np.array(shared) / s[:, None]))
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
    voltage = np.array([part * table.top(one) for one, part in points])
    force = np.array([table.force(*point) for point in zip(s.tolist(), voltage.tolist(), strict=True)])
    exact, _, found = solve(specimen, s - compliance * force, voltage)
    return float(np.max(np.abs(force - exact))) if found.all() else math.inf
