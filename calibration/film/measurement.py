"""Which single measurement beside the curves would make the results more certain, and by how much."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from calibration.film.curve import Curve
from calibration.film.result import Measurement, Quantity
from calibration.film.systematic import SYSTEMATIC

FACTOR = 5.0  # by which a measurement that is made for the purpose is better than what is known
WORTH_SAYING = 0.9  # factor by which it must shrink an uncertainty at least
WANTED = ("stiffness", "eps_r")


def assumed_parts(curves: Sequence[Curve]) -> dict[str, float]:
    """Entries of the budget that nobody stated, with the relative standard uncertainty that was assumed."""
    return {
        part: max(float(getattr(curve, name)) for curve in curves)
        for part, name, _ in SYSTEMATIC
        if any(name in curve.assumed for curve in curves)
    }


def most_useful(quantities: Mapping[str, Quantity], curves: Sequence[Curve]) -> Measurement | None:
    """The input of the budget whose better knowledge shrinks stiffness and permittivity most; None if none does."""
    silent = assumed_parts(curves)
    found: list[tuple[float, Measurement]] = []
    for part, name, _ in SYSTEMATIC:
        now = max(float(getattr(curve, name)) for curve in curves)
        relative = {
            wanted: (quantities[wanted].relative, _without(quantities[wanted], part))
            for wanted in WANTED
            if wanted in quantities and 0.0 < quantities[wanted].relative < math.inf
        }
        if now == 0.0 or not relative:
            continue
        gain = sum(math.log(after / before) for before, after in relative.values())
        if min(after / before for before, after in relative.values()) < WORTH_SAYING:
            found.append((gain, Measurement(part, now, now / FACTOR, part in silent, relative)))
    return min(found, key=lambda one: one[0])[1] if found else None


def _without(quantity: Quantity, part: str) -> float:
    """The relative uncertainty with one entry of the budget `FACTOR` times smaller."""
    size = quantity.budget.get(part, 0.0)
    rest = math.hypot(*(other for name, other in quantity.budget.items() if name != part))
    return math.hypot(rest, size / FACTOR) / abs(quantity.value)
