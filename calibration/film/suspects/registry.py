"""Which imperfections data are held against: those in this folder, and those of other packages.

Another package adds one by an entry point of the group ``dea_rig.suspects`` that names a `Kind`, or a list of them.
"""

from __future__ import annotations

import importlib
import pkgutil
from importlib.metadata import entry_points

from calibration.film.suspects.base import Kind

GROUP = "dea_rig.suspects"
PACKAGE = "calibration.film.suspects"


def kinds() -> list[Kind]:
    """All of them."""
    found: list[Kind] = []
    for module in pkgutil.iter_modules(importlib.import_module(PACKAGE).__path__):
        found += getattr(importlib.import_module(f"{PACKAGE}.{module.name}"), "SUSPECTS", [])
    for point in entry_points(group=GROUP):
        loaded = point.load()
        found += loaded if isinstance(loaded, list | tuple) else [loaded]
    wrong = [one for one in found if not isinstance(one, Kind)]
    if wrong:
        raise TypeError(f"an entry point of the group {GROUP} names what is no Kind: {wrong[0]!r}")
    return found


def fittable() -> dict[str, Kind]:
    """Those that can be fitted along, by their key."""
    return {one.key: one for one in kinds() if one.key}
