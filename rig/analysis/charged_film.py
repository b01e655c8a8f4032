"""A film identified from force and charge together: the currents of its logs are data beside the forces.

The force alone cannot tell permittivity from a film that has softened since its passive curves were taken: both lower
it under voltage. The charge can: it knows nothing of stiffness. So both stand in one least-squares problem, with the
softening and the supply's errors fitted along; what they do not agree on is told.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from calibration.electrical.charge import ByCharge, Charging, Known, NotResolved, Permittivity, permittivity
from calibration.electrical.rows import currents_of
from calibration.film.suspects.softening import KEY as SOFTENING
from rig.analysis.charge import charging_of
from rig.analysis.film import Found, identify_logs
from rig.base.errors import DataError

STARTS = 2  # of the fit by the force alone, which begins where that of both ended


def identify_with_charge(paths: Sequence[Path], **settings: Any) -> Found:
    """`rig.analysis.film.identify_logs` with the currents of the logs as data beside the forces.

    Where the supply cannot resolve the currents the result is that of the forces, and says so.

    Raises
    ------
    DataError
        As there; eps_r was to be held at a value; the logs are of several specimens or have no supply.
    """
    if "eps_r" in (settings.get("fixed") or {}):
        raise DataError("eps_r cannot be held at a value while the charge tells it: leave out one of them.")
    data, known = charging_of(paths)
    try:
        currents = currents_of(data, known)
    except NotResolved as error:
        return _without(identify_logs(paths, **settings), f"{paths[0]}: {error}")
    found = identify_logs(paths, currents=currents, **settings)
    film = found.identification.material
    alone = _by_charge([replace(one, specimen=one.specimen.with_material(film)) for one in data], known)
    if found.identification.charge is None:
        return _without(found, "no force curve under voltage is used, so the forces do not tell eps_r", alone)
    by_force, why = _by_force(paths, found, settings)
    both = ByCharge(alone, by_force)
    words = [*why, found.identification.charge.words]
    said = [one for one in words if one not in found.identification.warnings]
    return replace(found, charge=both, notes=[*found.notes, *said, *_remarks(both)])


def _by_force(
    paths: Sequence[Path], found: Found, settings: dict[str, Any]
) -> tuple[tuple[float, float] | None, list[str]]:
    """eps_r by the forces alone with its standard uncertainty, or why there is none."""
    alone = {
        "comparing": False,
        "profiles": False,
        "posterior": False,
        "each": False,
        "starts": STARTS,
        "near": (found.identification.material,),
        "along": [key for key in settings.get("along", ()) if key != SOFTENING],
    }
    try:
        one = identify_logs(paths, **{**settings, **alone}).identification.quantities.get("eps_r")
    except DataError as error:
        return None, [f"no permittivity by the force alone: {error}"]
    return (None if one is None or not one.uncertainty < math.inf else (one.value, one.uncertainty)), []


def _without(found: Found, why: str, alone: Permittivity | None = None) -> Found:
    """A result by the force alone, where the charge was asked for and is not used; ``alone`` is what it tells."""
    settings = {**found.identification.provenance["settings"], "charge": True}  # so that the fit can be done again
    provenance = {**found.identification.provenance, "settings": settings}
    note = f"{why}. The charge was left out: the fit is by the force alone"
    identification = replace(found.identification, provenance=provenance)
    told = [] if alone is None else [f"the permittivity by the charge alone is {_stated(alone)}"]
    charge = ByCharge(alone, None, why)
    return replace(found, identification=identification, charge=charge, notes=[note, *told, *found.notes])


def _by_charge(data: Sequence[Charging], known: Known) -> Permittivity | None:
    try:
        return permittivity(data, known)
    except NotResolved:  # just not: what the currents say stands in the fit all the same
        return None


def _remarks(both: ByCharge) -> list[str]:
    charge, force = both.charge, both.by_force
    if charge is None or force is None:
        return []
    return [
        f"the permittivity by the charge alone is {_stated(charge)}, by the force alone, if the film did not soften, "
        f"{force[0]:.4g} +- {force[1]:.2g}"
    ]


def _stated(found: Permittivity) -> str:
    return f"{found.value:.4g} +- {found.standard_uncertainty:.2g}"
