"""A permittivity that is no constant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.film.suspects.base import Context, Kind, Shape

Array = NDArray[np.float64]

STRETCH = "permittivity that falls with stretch"
FIELD = "permittivity that changes with the field"
FIELD_V_PER_M = 50e6  # true field at which the change has its stated size


def with_stretch(context: Context) -> Sequence[Shape]:
    r"""``eps = eps_r (1 - c ln(l1 l2 / lp^2))``; c in one unit is the loss at an area stretched e times."""
    if not context.charged:
        return []
    eps = context.film.permittivity
    flat = np.array([2.0 * np.log(curve.specimen.prestretch) for curve in context.curves])[:, None, None]

    def density(l1: Array, l2: Array, field: Array) -> Array:
        area = l1 * l2
        return np.asarray(0.5 * eps * (field * area) ** 2 * (np.log(area) - flat))

    return [Shape(STRETCH, context.at_nodes(context.from_energy(density)))]


def _with_field(context: Context) -> Sequence[Shape]:
    """``D = eps E (1 + c (E/E_ref)^2)``: the energy at given voltage is less by the integral of D over E."""
    if not context.charged:
        return []
    eps = context.film.permittivity

    def density(l1: Array, l2: Array, field: Array) -> Array:
        true = field * l1 * l2
        return np.asarray(-0.25 * eps * true**4 / FIELD_V_PER_M**2)

    return [Shape(FIELD, context.at_nodes(context.from_energy(density)))]


SUSPECTS = [
    Kind(
        STRETCH,
        "1",
        1,
        0.3,
        "measure the capacitance of the film at rest and stretched",
        with_stretch,
        key="eps-stretch",
    ),
    Kind(FIELD, "1", 0, 0.05, "compare fits of single voltages", _with_field),
]
