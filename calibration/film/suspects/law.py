"""A film that follows another law than the one that is fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.film.suspects.base import Context, Kind, Shape

Array = NDArray[np.float64]

NAME = "law that stiffens unlike the fitted one (as Gent's does)"


def _stiffening(context: Context) -> Sequence[Shape]:
    """Gent's energy ``-(G Jm/2) ln(1 - (I1 - 3)/Jm)`` to the first order in 1/Jm beyond the neo-Hookean one."""
    modulus = context.film.shear_modulus

    def density(l1: Array, l2: Array, field: Array) -> Array:
        invariant = l1**2 + l2**2 + (l1 * l2) ** -2.0 - 3.0
        return np.asarray(0.25 * modulus * invariant**2)

    return [Shape(NAME, context.at_nodes(context.from_energy(density)))]


SUSPECTS = [Kind(NAME, "1", 0, 0.02, "fit with another law or one more term and compare", _stiffening)]
