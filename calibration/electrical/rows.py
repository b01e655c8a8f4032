r"""Currents of runs, reduced to as few numbers as carry the same information about the film's capacitance.

At each displacement where the voltage rose, the capacitance is a smooth function of the voltage, given by its values
at a few Chebyshev nodes. Then the current

.. math:: i = \frac{d}{dt}\bigl((C(h, V) + C_p)\,V\bigr) + g_1 V + g_3 V^3 + i_0

is linear in these values, in the leakage and in the offset. Leakage and offset are of no interest: the samples are
projected off what they can do, and a factorisation leaves one number for each direction of the capacitances that the
samples see, as `calibration.film.reduction` does with forces. What no capacitance explains is the noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.electrical.charge import (
    FEWEST,
    WEAK,
    Charging,
    Known,
    NotResolved,
    Rows,
    places_of,
    resolution_of,
    rows_of,
)
from model.specimen import Specimen

Array = NDArray[np.float64]

NODES = 4  # voltages of a place: the capacitance is nearly a quadratic in the voltage
RANK = 1e-9  # singular values, relative to the largest, that carry anything but round-off
LEVELS = 3  # voltages of rests from whose number on a leakage that grows faster than the voltage is told
CUBE_V = 50.0  # rests nearer than this are one


@dataclass(frozen=True, eq=False)
class Place:
    """A displacement (m) of a run at which the voltage rose, the voltages of its nodes (V), and its samples."""

    run: str
    h: float
    nodes: Array
    rows: Rows
    mine: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Currents:
    """The currents of the runs of one specimen, as data on its capacitance C at P places with N nodes each.

    ``root`` (m, P N) times the capacitances of film and cable is compared with ``target`` (m,); both are in units of
    the ``noise`` (A) of a reading, which counts the resolution (A) and that neighbouring readings are alike.
    ``step`` (m,) is what a reading too high by 1 A on all rises does to them.
    """

    specimen: Specimen
    known: Known
    places: list[Place]
    root: Array
    target: Array
    step: Array
    noise: float
    resolution: float
    samples: int

    @property
    def priors(self) -> dict[str, float]:
        """Errors that all readings share, by their kind: standard uncertainties, relative, in F and in A."""
        found = {"current_gain": self.known.gain_error, "cable": self.known.cable_error}
        found["current_step"] = self.resolution / math.sqrt(12.0)
        return {kind: prior for kind, prior in found.items() if prior > 0.0}

    @property
    def nodes(self) -> Array:
        """Voltages (V) of the nodes, (P, N)."""
        return np.array([place.nodes for place in self.places])

    @property
    def h(self) -> Array:
        """Displacements (m) of the places, (P,)."""
        return np.array([place.h for place in self.places])

    def without(self, lost: NDArray[np.bool_]) -> Currents:
        """The same without some places. Raises `NotResolved` where none is left."""
        return reduced(self.specimen, self.known, [p for p, out in zip(self.places, lost, strict=True) if not out])


def currents_of(data: Sequence[Charging], known: Known) -> Currents:
    """The currents of runs of one specimen.

    Raises
    ------
    NotResolved
        No current is measured, the voltage never rises while it is, or its resolution and noise leave more than a
        fifth of the capacitance open.
    """
    if not any(np.isfinite(one.current).any() for one in data):
        raise NotResolved("this supply cannot resolve it: it does not measure its current")
    places = []
    for one in data:
        rows = rows_of(one)
        places += [
            Place(one.run, h, _nodes(float(np.max(rows.voltage[mine]))), rows, mine) for h, mine in places_of(rows)
        ]
    return reduced(data[0].specimen, known, places)


def reduced(specimen: Specimen, known: Known, places: list[Place]) -> Currents:
    """The samples of the places, and those at rest of their runs. Raises `NotResolved` as `currents_of` does."""
    on_ramps = sum(int(np.count_nonzero(place.mine)) for place in places)
    if on_ramps < FEWEST:
        raise NotResolved(f"only {on_ramps} samples of the current lie on rises of the voltage; {FEWEST} are needed")
    rests = list({id(place.rows): place.rows for place in places}.values())
    volts = np.concatenate([*(p.rows.voltage[p.mine] for p in places), *(r.voltage[~r.rises] for r in rests)])
    current = np.concatenate([*(p.rows.current[p.mine] for p in places), *(r.current[~r.rises] for r in rests)])
    design = np.zeros((volts.size, sum(place.nodes.size for place in places)))
    begin = column = 0
    for place in places:
        end, last = begin + int(np.count_nonzero(place.mine)), column + place.nodes.size
        v, slope = place.rows.voltage[place.mine], place.rows.slope[place.mine]
        design[begin:end, column:last] = slope[:, None] * charge_slope(place.nodes, v)
        begin, column = end, last
    resolution = resolution_of(current)
    rise = (np.arange(volts.size) < on_ramps).astype(float)
    off = _without(_leaks(volts, on_ramps))
    u, s, vt = np.linalg.svd(off(design), full_matrices=False)
    seen = s > RANK * s[0]
    base, root = u[:, seen], s[seen, None] * vt[seen]
    target, left = base.T @ off(current), off(current)
    left = left - base @ target
    freedom = max(volts.size - int(np.count_nonzero(seen)) - 3, 1)
    noise = math.sqrt(float(left @ left) / freedom * _alike(left))
    noise = max(noise, resolution / math.sqrt(12.0), 1e-15)
    step = base.T @ off(rise)
    size = float(np.linalg.norm(target))
    left_open = (
        math.hypot(noise, resolution / math.sqrt(12.0) * float(np.linalg.norm(step))) / size if size > 0.0 else math.inf
    )
    if not left_open <= WEAK:
        raise NotResolved(
            f"this supply cannot resolve it: currents of {np.mean(current[:on_ramps]) * 1e9:.3g} nA on rises, read in "
            f"steps of {resolution * 1e9:.3g} nA with a noise of {noise * 1e9:.3g} nA, leave {left_open:.0%} of the "
            "capacitance open. A faster ramp draws more current"
        )
    return Currents(specimen, known, places, root / noise, target / noise, step / noise, noise, resolution, on_ramps)


def charge_slope(nodes: Array, volts: Array) -> Array:
    """d(C V)/dV at ``volts`` by the capacitances at the nodes, (samples, N): C is a polynomial in V."""
    count, most = nodes.size, float(nodes.max())
    powers = np.arange(count)
    to_powers = np.linalg.inv((nodes[:, None] / most) ** powers)
    slope: Array = ((powers + 1) * (volts[:, None] / most) ** powers) @ to_powers
    return slope


def _nodes(most: float) -> Array:
    angle = (2 * np.arange(NODES) + 1) * np.pi / (2 * NODES)
    found: Array = 0.5 * max(most, 1.0) * (1.0 - np.cos(angle))
    return found


def _leaks(volts: Array, on_ramps: int) -> Array:
    """Columns of what is not charge: by V, by V^3 where enough rests tell it, and the offset."""
    x = volts / max(float(np.max(np.abs(volts))), 1.0)
    levels = np.unique(np.round(volts[on_ramps:] / CUBE_V)).size
    return np.stack([x, np.ones_like(x), *([x**3] if levels > LEVELS else [])], axis=1)


def _without(columns: Array) -> Callable[[Array], Array]:
    """What takes off rows all that the columns can do."""
    base, _ = np.linalg.qr(columns)

    def off(rows: Array) -> Array:
        return np.asarray(rows - base @ (base.T @ rows))

    return off


def _alike(left: Array) -> float:
    """Readings that count as one where neighbours are alike: (1 + r)/(1 - r), if their correlation r is no chance."""
    power = float(left @ left)
    r = float(left[1:] @ left[:-1]) / power if power > 0.0 else 0.0
    return (1.0 + r) / (1.0 - r) if r > 3.0 / math.sqrt(left.size) else 1.0
