"""A film that works against a bias: where the two balance, and which of those states are stable.

At displacement ``h`` the film pulls back with ``F(h, V)`` and the bias pushes with ``B(h)``. In equilibrium ``F = B``;
it is stable where the film's force grows faster than the bias's, ``dF/dh > dB/dh``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.actuator.bias import Bias, forces
from model.actuator.roots import bracketed
from model.arrays import Array
from model.membrane.solve import Solutions, Status, Wrinkling, solve_many
from model.specimen import Specimen

POINTS = 129  # displacements at which equilibria are looked for
FAR = 2.0  # the furthest displacement looked at, in ring radii, where the bias reaches further


@dataclass(frozen=True)
class Actuator:
    """A film and what pushes its disk.

    Parameters
    ----------
    film : the driven film
    bias : what pushes its disk to positive displacements
    wrinkling : "tension_field", or "plain" for the paper's equations whatever the hoop stress
    """

    film: Specimen
    bias: Bias
    wrinkling: Wrinkling = "tension_field"

    @property
    def span(self) -> tuple[float, float]:
        """Displacements looked at (m): the bias's reach, within 0 and two ring radii."""
        low, high = self.bias.reach
        low, high = max(low, 0.0), min(high, FAR * self.film.ring_radius)
        if not low < high:
            raise ValueError(f"the bias acts from {low:g} m to {high:g} m: the film cannot meet it there")
        return low, high


@dataclass(frozen=True)
class Equilibrium:
    """One balance of film and bias.

    Attributes
    ----------
    h, voltage : displacement (m) and voltage (V)
    force : of film and bias (N)
    stiffness : ``dF/dh - dB/dh`` (N/m), positive when stable
    stable : whether a small push comes back
    status : of the film
    error_estimate : estimated error of ``h`` (m)
    peak_field, min_hoop_stress, max_stretch : of the film (V/m, Pa, 1)
    """

    h: float
    voltage: float
    force: float
    stiffness: float
    stable: bool
    status: Status
    error_estimate: float
    peak_field: float
    min_hoop_stress: float
    max_stretch: float


@dataclass(frozen=True)
class Equilibria:
    """All equilibria found at one voltage, in order of displacement.

    Attributes
    ----------
    found : the equilibria
    blind : ranges of displacement (m) in which film or bias has no answer, with the film's status: none is known there
    sampled : displacements looked at
    """

    found: tuple[Equilibrium, ...]
    blind: tuple[tuple[float, float, Status], ...]
    sampled: int

    @property
    def stable(self) -> tuple[Equilibrium, ...]:
        return tuple(one for one in self.found if one.stable)


@dataclass(frozen=True)
class Balance:
    """Film and bias at given states; every array has one row an actuator. A slack film pulls with no force.

    ``known`` marks where both have a force; ``film`` holds the film's answers, ``pull`` and ``push`` the two forces and
    ``by_h``, ``by_voltage``, ``bias_by_h`` their derivatives.
    """

    h: Array
    voltage: Array
    film: Solutions
    pull: Array
    push: Array
    by_h: Array
    by_voltage: Array
    bias_by_h: Array
    known: NDArray[np.bool_]

    @property
    def excess(self) -> Array:
        """``F - B`` (N)."""
        return self.pull - self.push

    @property
    def stiffness(self) -> Array:
        """``dF/dh - dB/dh`` (N/m)."""
        return self.by_h - self.bias_by_h


def films_of(actuators: Sequence[Actuator], h: Array) -> NDArray[np.object_]:
    """The actuators' films as a column that broadcasts with ``h``."""
    films = np.empty(len(actuators), dtype=object)
    films[:] = [one.film for one in actuators]
    return films.reshape((len(actuators),) + (1,) * (h.ndim - 1))


def balance(actuators: Sequence[Actuator], h: Array, voltage: Array, tolerance: float = 1e-8) -> Balance:
    """Film and bias of every actuator at its row of ``h`` and ``voltage`` (both (actuators, ...))."""
    film = solve_films(films_of(actuators, h), h, voltage, kind_of(actuators), tolerance)
    return weigh(h, voltage, film, *forces([one.bias for one in actuators], h))


def kind_of(actuators: Sequence[Actuator]) -> Wrinkling:
    """The treatment of folds that all of them share."""
    kinds = {one.wrinkling for one in actuators}
    if len(kinds) != 1:
        raise ValueError('the actuators of one call must all be "plain" or all "tension_field"')
    return kinds.pop()


def weigh(h: Array, voltage: Array, film: Solutions, push: Array, bias_by_h: Array) -> Balance:
    """The balance of solved films with known forces of their biases."""
    assert film.dforce is not None
    slack = film.status == Status.SLACK
    pull = np.where(slack, 0.0, film.force)
    by_h = np.where(slack, 0.0, film.dforce["h"])
    by_voltage = np.where(slack, 0.0, film.dforce["voltage"])
    known = np.isfinite(pull) & np.isfinite(push)
    return Balance(h, voltage, film, pull, push, by_h, by_voltage, bias_by_h, known)


def solve_films(
    films: NDArray[np.object_], h: Array, voltage: Array, wrinkling: Wrinkling, tolerance: float
) -> Solutions:
    """Solve with derivatives; a state that misses the tolerance asked for is tried once more with a looser one."""
    found = solve_many(films, h, voltage, tolerance=tolerance, wrinkling=wrinkling, sensitivities=True)
    again = found.status == Status.NOT_CONVERGED
    if tolerance >= 1e-6 or not again.any():
        return found
    films, h, voltage = np.broadcast_arrays(films, h, voltage)
    part = solve_many(
        films[again], h[again] * (1.0 + 1e-10), voltage[again], tolerance=1e-6, wrinkling=wrinkling, sensitivities=True
    )
    return _patched(found, again, part)


def _patched(whole: Solutions, where: NDArray[np.bool_], part: Solutions) -> Solutions:
    assert whole.dforce is not None and part.dforce is not None
    changed: dict[str, Any] = {}
    for name in Solutions.__dataclass_fields__:
        values = getattr(whole, name)
        if isinstance(values, np.ndarray):
            changed[name] = values.copy()
            changed[name][where] = getattr(part, name)
    changed["dforce"] = {name: values.copy() for name, values in whole.dforce.items()}
    for name, values in changed["dforce"].items():
        values[where] = part.dforce[name]
    return replace(whole, **changed)


def equilibria(
    actuator: Actuator,
    voltage: float = 0.0,
    *,
    span: tuple[float, float] | None = None,
    points: int = POINTS,
    tolerance: float = 1e-9,
) -> Equilibria:
    """Every displacement at which film and bias balance at ``voltage``.

    The excess ``F - B`` and its slope are computed at many displacements at once; a change of sign, and an extremum of
    the cubic through two neighbours that crosses zero and comes back, is closed in on. Two equilibria that lie closer
    than that cubic can tell, with ``span/points`` between its ends, are missed.

    Raises
    ------
    ValueError : the voltage or the span is not usable
    """
    if not math.isfinite(voltage):
        raise ValueError(f"voltage = {voltage!r} V: it must be finite")
    low, high = actuator.span if span is None else span
    if not 0.0 <= low < high < math.inf:
        raise ValueError(f"span = {low!r} to {high!r} m: it must rise and not be negative")
    h = np.linspace(low, high, points)

    def at(x: Array) -> Balance:
        return balance([actuator], x[None], np.full((1, x.size), float(voltage)), tolerance)

    here = at(h)
    h, excess = _with_extrema(at, h, here)
    known = np.isfinite(excess)
    change = known[:-1] & known[1:] & (np.sign(excess[:-1]) * np.sign(excess[1:]) < 0.0)
    change |= known[:-1] & known[1:] & (excess[1:] == 0.0) & (excess[:-1] != 0.0)
    left = np.flatnonzero(change)
    found: tuple[Equilibrium, ...] = ()
    if left.size:

        def value(x: Array, _: NDArray[np.intp]) -> tuple[Array, Array]:
            there = at(x)
            return there.excess[0], there.stiffness[0]

        close = np.full(left.size, tolerance * actuator.film.ring_radius)
        root = bracketed(value, h[left], h[left + 1], excess[left] < 0.0, close)
        there = at(root)
        found = tuple(_equilibrium(there, i) for i in range(left.size))
    return Equilibria(found, _blind(here), len(h))


def _equilibrium(there: Balance, i: int) -> Equilibrium:
    """State ``i``. The displacement errs by the excess that is left and the force's own error, over the stiffness."""
    film, stiffness = there.film, float(there.stiffness[0, i])
    left = abs(float(there.excess[0, i])) + float(film.error_estimate[0, i] * abs(there.pull[0, i]))
    return Equilibrium(
        h=float(there.h[0, i]),
        voltage=float(there.voltage[0, i]),
        force=float(there.pull[0, i]),
        stiffness=stiffness,
        stable=stiffness > 0.0,
        status=Status(int(film.status[0, i])),
        error_estimate=left / abs(stiffness) if stiffness != 0.0 else math.inf,
        peak_field=float(film.peak_field[0, i]),
        min_hoop_stress=float(film.min_hoop_stress[0, i]),
        max_stretch=float(film.max_stretch[0, i]),
    )


def _with_extrema(at: Callable[[Array], Balance], h: Array, here: Balance) -> tuple[Array, Array]:
    """Displacements and excess, with the extrema between samples where the excess comes towards zero and turns back."""
    excess, slope = np.where(here.known, here.excess, np.nan)[0], here.stiffness[0]
    towards = (excess[:-1] * slope[:-1] < 0.0) & (excess[1:] * slope[1:] > 0.0) & (excess[:-1] * excess[1:] > 0.0)
    left = np.flatnonzero(towards)
    if left.size == 0:
        return h, excess

    def value(x: Array, _: NDArray[np.intp]) -> tuple[Array, Array]:
        return at(x).stiffness[0], np.full(x.shape, np.nan)

    close = np.full(left.size, 1e-6 * (h[-1] - h[0]) / len(h))
    turn = bracketed(value, h[left], h[left + 1], slope[left] < 0.0, close)
    there = at(turn)
    at_turn = np.where(there.known, there.excess, np.nan)[0]
    return np.insert(h, left + 1, turn), np.insert(excess, left + 1, at_turn)


def _blind(here: Balance) -> tuple[tuple[float, float, Status], ...]:
    """Runs of samples without an answer, out to their neighbours that have one."""
    unknown = ~here.known[0]
    ends = np.flatnonzero(np.diff(np.concatenate(([False], unknown, [False])).astype(np.int8)))
    h, status = here.h[0], here.film.status[0]
    return tuple(
        (float(h[max(first - 1, 0)]), float(h[min(last, len(h) - 1)]), Status(int(status[first])))
        for first, last in zip(ends[::2], ends[1::2], strict=True)
    )
