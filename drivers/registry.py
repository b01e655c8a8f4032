"""Which instruments there are: those of `drivers.instruments`, and those of other packages.

Every module (or package) in ``drivers/instruments`` registers itself by having ``INSTRUMENTS``, a tuple of
`drivers.instrument.Instrument`. Another package does the same with a module of its own, named by an entry point of the
group ``dea_rig.instruments``::

    [project.entry-points."dea_rig.instruments"]
    acme = "acme_rig.laser"
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pkgutil import iter_modules
from types import ModuleType
from typing import NamedTuple

import drivers.instruments
from drivers.instrument import Instrument, role_of

GROUP = "dea_rig.instruments"


class UnknownInstrument(LookupError):
    """No such instrument is registered."""


class Registered(NamedTuple):
    """What has been found: instruments by role and driver name, and why packages could not be used, in words."""

    instruments: dict[tuple[str, str], Instrument]
    broken: list[str]


@cache
def registered() -> Registered:
    """Everything there is, the project's own instruments first."""
    found = Registered({}, [])
    for module in iter_modules(drivers.instruments.__path__, "drivers.instruments."):
        _add(found, _declared_in(import_module(module.name)))
    for entry in entry_points(group=GROUP):
        package = entry.dist.name if entry.dist is not None else entry.value
        try:
            declared = _declared_in(_load(entry))
            for one in declared:
                one.settings.model_rebuild()  # keys that cannot be: told here, not to whoever reads a scene
            _add(found, declared)
        except Exception as error:  # whatever a package does on import must not stop a run that does not need it
            found.broken.append(f"Package {package} registers instruments, but cannot be used: {error!r}.")
    return found


def instrument(role: str, driver: str) -> Instrument:
    """The instrument of that name; ``role`` may be a scene's name for it.

    Raises
    ------
    UnknownInstrument
        Saying which there are for this role, and which packages could not be imported.
    """
    try:
        return registered().instruments[role_of(role), driver]
    except KeyError:
        known = ", ".join(of_role(role)) or "none"
        broken = "".join(f" {text}" for text in registered().broken)
        raise UnknownInstrument(f"no {role} instrument {driver!r}; there are {known}.{broken}") from None


def of_role(role: str) -> dict[str, Instrument]:
    """The instruments of a role, by driver name; ``role`` may be a scene's name for it."""
    return {one.driver: one for one in registered().instruments.values() if one.role == role_of(role)}


def _add(found: Registered, instruments: tuple[Instrument, ...]) -> None:
    for one in instruments:
        known = found.instruments.setdefault((one.role, one.driver), one)
        if known is not one:
            raise ValueError(f"there is a {one.role} instrument {one.driver!r} already")


def _load(entry: EntryPoint) -> ModuleType:
    loaded = entry.load()
    if not isinstance(loaded, ModuleType):
        raise TypeError(f"entry point {entry.name} = {entry.value} must name a module")
    return loaded


def _declared_in(module: ModuleType) -> tuple[Instrument, ...]:
    found = module.INSTRUMENTS
    if not (isinstance(found, tuple) and all(isinstance(one, Instrument) for one in found)):
        raise TypeError(f"{module.__name__}.INSTRUMENTS must be a tuple of Instrument")
    return found
