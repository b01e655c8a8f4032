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
    alone = {
        "comparing": False,
        "profiles": False,
        "posterior": False,
        "each": False,
        "starts": STARTS,
        "near": (found.identification.material,),
        "along": [key for key in settings.get("along", ()) if key != SOFTENING],
    }
    by_force = identify_logs(paths, **{**settings, **alone}).identification.quantities.get("eps_r")
    film = found.identification.material
    shaped = [replace(one, specimen=one.specimen.with_material(film)) for one in data]
    other = None if by_force is None or not by_force.uncertainty < math.inf else (by_force.value, by_force.uncertainty)
    both = ByCharge(_by_charge(shaped, known), other)
    words = [] if found.identification.charge is None else [found.identification.charge.words]
    said = [one for one in words if one not in found.identification.warnings]
    return replace(found, charge=both, notes=[*found.notes, *said, *_remarks(both)])


def _without(found: Found, why: str) -> Found:
    """A result by the force alone, where the charge was asked for and cannot be told."""
    settings = {**found.identification.provenance["settings"], "charge": True}  # so that the fit can be done again
    provenance = {**found.identification.provenance, "settings": settings}
    note = f"{why}. The charge was left out: the fit is by the force alone"
    identification = replace(found.identification, provenance=provenance)
    charge = ByCharge(None, None, why)
    return replace(found, identification=identification, charge=charge, notes=[note, *found.notes])


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
        f"the permittivity by the charge alone is {charge.value:.4g} +- {charge.standard_uncertainty:.2g}, by the "
        f"force alone, if the film did not soften, {force[0]:.4g} +- {force[1]:.2g}"
    ]
