"""Which simulated instruments there are: those of `rig.sim.instruments`, and those of other packages.

Every module in ``rig/sim/instruments`` registers itself by having ``TWINS``, a tuple of `rig.sim.twin.Twin`. Another
package does the same with a module of its own, named by an entry point of the group ``dea_rig.twins``.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pkgutil import iter_modules
from typing import NamedTuple

import rig.sim.instruments
from rig.sim.truth import role_of
from rig.sim.twin import Twin

GROUP = "dea_rig.twins"


class Registered(NamedTuple):
    """What has been found: twins by role and driver name, and why packages could not be used, in words."""

    twins: dict[tuple[str, str], Twin]
    broken: list[str]


@cache
def registered() -> Registered:
    """Everything there is, the project's own twins first."""
    found = Registered({}, [])
    for module in iter_modules(rig.sim.instruments.__path__, "rig.sim.instruments."):
        _add(found, import_module(module.name).TWINS)
    for entry in entry_points(group=GROUP):
        package = entry.dist.name if entry.dist is not None else entry.value
        try:
            _add(found, entry.load().TWINS)
        except Exception as error:  # whatever a package does on import must not stop a run that does not need it
            found.broken.append(f"Package {package} registers simulated instruments, but cannot be used: {error!r}.")
    return found


def of_role(role: str) -> dict[str, Twin]:
    """The twins of a role, by driver name; ``role`` may be a bench's name for it."""
    return {one.driver: one for one in registered().twins.values() if one.role == role_of(role)}


def _add(found: Registered, twins: tuple[Twin, ...]) -> None:
    for one in twins:
        if not isinstance(one, Twin):
            raise TypeError(f"TWINS must be a tuple of Twin, and not hold {one!r}")
        if found.twins.setdefault((one.role, one.driver), one) is not one:
            raise ValueError(f"there is a {one.role} twin {one.driver!r} already")
