"""A film identified from force and charge together: the permittivity by its capacitance, the law by its force.

The force alone cannot tell permittivity from a film that has softened since its passive curves were taken: both lower
it under voltage. The charge can: it knows nothing of stiffness. So the permittivity is held at what the charge says,
and its uncertainty is propagated to what the force says by a second fit, one standard uncertainty higher.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from calibration.electrical.charge import ByCharge
from calibration.film.result import Identification, Quantity, verdict
from rig.analysis.charge import permittivity_of
from rig.analysis.film import Found, identify_logs
from rig.base.errors import DataError

PART = "permittivity by charge"  # in the budgets of what the force says
STARTS = 2  # of the fits beside the main one, which begin where it ended
APART = 2.0  # standard uncertainties between two permittivities that are told as different


def identify_with_charge(paths: Sequence[Path], **settings: Any) -> Found:
    """`rig.analysis.film.identify_logs` with the permittivity held at that of the charge.

    Raises
    ------
    DataError
        As there; the permittivity was to be held at another value; the currents cannot resolve it.
    """
    fixed: Mapping[str, float] = settings.pop("fixed", None) or {}
    if "eps_r" in fixed:
        raise DataError("eps_r cannot be held at a value of its own and at that of the charge: leave out one of them.")
    charge = permittivity_of(paths)
    value, error = charge.value, charge.standard_uncertainty

    def fit(eps_r: float | None, **more: Any) -> Found:
        held = fixed if eps_r is None else {**fixed, "eps_r": eps_r}
        return identify_logs(paths, **{**settings, "fixed": held, **more})

    found = fit(value)
    beside: dict[str, Any] = {
        "comparing": False,
        "profiles": False,
        "posterior": False,
        "each": False,
        "starts": STARTS,
        "near": (found.identification.material,),
    }
    higher = fit(value + error, **beside).identification
    by_force = fit(None, **beside).identification.quantities.get("eps_r")
    identification = _with_permittivity(found.identification, higher, charge.value, charge.budget)
    other = None if by_force is None or not by_force.uncertainty < math.inf else (by_force.value, by_force.uncertainty)
    both = ByCharge(charge, other)
    return replace(found, identification=identification, charge=both, notes=[*found.notes, *_remarks(both)])


def _with_permittivity(
    found: Identification, higher: Identification, value: float, budget: Mapping[str, float]
) -> Identification:
    """The result with the permittivity as a quantity, and what its uncertainty does in the other budgets."""
    quantities: dict[str, Quantity] = {}
    for name, one in found.quantities.items():
        if name not in higher.quantities or not math.isfinite(one.uncertainty):
            quantities[name] = one
            continue
        shift = abs(higher.quantities[name].value - one.value)
        parts = {**one.budget, PART: shift}
        quantities[name] = replace(one, budget=parts, uncertainty=math.hypot(one.uncertainty, shift))
    combined = math.hypot(*budget.values())
    quantities["eps_r"] = Quantity(value, combined, "1", dict(budget), verdict(combined / value, False))
    return replace(found, quantities=quantities)


def _remarks(both: ByCharge) -> list[str]:
    charge = both.charge
    words = f"the permittivity is that of the charge, {charge.value:.4g} +- {charge.standard_uncertainty:.2g}"
    if both.by_force is None:
        return [words]
    value, error = both.by_force
    apart = (value - charge.value) / math.hypot(error, charge.standard_uncertainty)
    text = (
        f"{words}; by the force alone it would be {value:.4g} +- {error:.2g}, {abs(apart):.1f} standard uncertainties "
    )
    if abs(apart) <= APART:
        return [text + "away: they agree"]
    return [text + "away: the film has softened, or something else than permittivity changes the force under voltage"]
