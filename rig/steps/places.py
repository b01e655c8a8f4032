"""Where a film may be held: displacements and voltages within the limits, with a margin, by the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.membrane.solution import Solutions
from model.membrane.solve import Status, solve_many
from model.specimen import Specimen
from rig.base.errors import LimitError
from rig.safety.limits import Limits
from rig.scene.scene import Scene

Array = NDArray[np.float64]

MARGIN = 0.95  # of the limits of force, field, displacement and voltage: the film is not quite what is believed of it
LEVELS, DISPLACEMENTS = 7, 25  # of the grid of places


@dataclass(frozen=True, eq=False)
class Grid:
    """Places (K,) in metres and volts, the states there by the film believed, and which of them are ``allowed``."""

    h: Array
    voltage: Array
    states: Solutions
    allowed: NDArray[np.bool_]


def grid(scene: Scene, specimen: Specimen, *, sensitivities: bool = False) -> Grid:
    """All places on a grid over displacement and voltage.

    Raises
    ------
    LimitError
        None of them is allowed.
    """
    limits = Limits.of(scene)
    top_h = MARGIN * limits.displacement.high
    top_v = MARGIN * limits.voltage.high if scene.hv is not None else 0.0
    levels = np.unique(np.floor(np.linspace(0.0, top_v, LEVELS) / 10.0) * 10.0)
    h, voltage = (
        one.ravel() for one in np.meshgrid(np.round(np.linspace(0.05 * top_h, top_h, DISPLACEMENTS), 5), levels)
    )
    states = solve_many(specimen, h, voltage, sensitivities=sensitivities)
    allowed = (
        (states.status == Status.TAUT)
        & (states.force <= MARGIN * limits.force.high)
        & (states.peak_field <= MARGIN * limits.field.high)
        & (states.min_hoop_stress >= limits.hoop_stress.low + (1.0 - MARGIN) * specimen.material.shear_modulus)
    )
    if not allowed.any():
        raise LimitError("The model knows no displacement and voltage at which this film may be held: see the limits.")
    return Grid(h, voltage, states, allowed)


def connected(scene: Scene, specimen: Specimen) -> dict[float, tuple[float, ...]]:
    """Displacements (m, rising) that may be held at each voltage (V), such that the way between any two is allowed.

    The way is at the lower voltage of the two. So the displacements of a voltage are neighbours, and each of them is
    among those of every lower voltage.
    """
    places = grid(scene, specimen)
    found: dict[float, tuple[float, ...]] = {}
    below: Array | None = None
    for level in np.unique(places.voltage):
        here = places.voltage == level
        run = _longest(places.h[here], places.allowed[here])
        if below is not None:
            run = run[np.isin(run, below)]
        if run.size < 2:
            break
        below = run
        found[float(level)] = tuple(run.tolist())
    if not found:
        raise LimitError("The film may be held at no two neighbouring displacements without voltage: see the limits.")
    return found


def _longest(h: Array, allowed: NDArray[np.bool_]) -> Array:
    """The longest run of neighbours that are allowed."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], allowed.astype(np.int8), [0]))))
    runs = [h[begin:end] for begin, end in zip(edges[::2], edges[1::2], strict=True)]
    return max(runs, key=len, default=h[:0])
