"""The laws that there are: those of this package, and those that others register.

A law of one's own is a subclass of `model.material.law.Law` in a file of its own, which its package registers under
the entry point group ``dea_rig.laws`` (any name, the class as its object), or a script by `register`.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points

from model.material.gent import Gent
from model.material.law import Law
from model.material.mooney_rivlin import MooneyRivlin
from model.material.neo_hooke import NeoHooke
from model.material.ogden import Ogden
from model.material.yeoh import Yeoh

GROUP = "dea_rig.laws"

_LAWS: dict[str, type[Law]] = {law.name: law for law in (Ogden, NeoHooke, MooneyRivlin, Yeoh, Gent)}


def register(law: type[Law]) -> type[Law]:
    """Make a law known by its name; may be used as a decorator.

    Raises
    ------
    TypeError : it is no complete `Law`
    ValueError : another law has its name already
    """
    if not (isinstance(law, type) and issubclass(law, Law)):
        raise TypeError(f"{law!r} is no law: it must be a subclass of model.material.law.Law")
    if missing := sorted(law.__abstractmethods__):
        raise TypeError(f"the law {law.__name__} lacks {', '.join(missing)}")
    known = _LAWS.setdefault(law.name, law)
    if known is not law:
        raise ValueError(f"two laws are called {law.name!r}: {known.__module__} and {law.__module__}")
    return law


@cache
def _installed() -> tuple[str, ...]:
    """Register the laws of other packages; what is wrong with those that cannot be used, in words."""
    broken = []
    for point in entry_points(group=GROUP):
        try:
            register(point.load())
        except Exception as error:  # whatever a package raises must not stop a run that does not need it
            package = point.dist.name if point.dist else point.value
            broken.append(f"Package {package} registers the law {point.name!r}, but cannot be used: {error!r}.")
    return tuple(broken)


def known_laws() -> dict[str, type[Law]]:
    """Every law by its name."""
    _installed()
    return dict(_LAWS)


def find_law(name: str) -> type[Law]:
    """The law of that name.

    Raises
    ------
    ValueError : there is none; the message lists those there are, and packages that could not be used
    """
    if name in _LAWS:
        return _LAWS[name]
    broken = "".join(f". {text}" for text in _installed())
    if name not in _LAWS:
        raise ValueError(f"law {name!r} is not known; known are {', '.join(_LAWS)}{broken}")
    return _LAWS[name]
