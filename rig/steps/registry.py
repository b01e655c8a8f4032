"""All kinds of steps by their ``do``: those of the house, and those that other packages register.

Another package registers a step by an entry point in the group ``dea_rig.steps``, named like the step's ``do``::

    [project.entry-points."dea_rig.steps"]
    relax = "my_package.relax:Relax"

It is loaded when a protocol names it, and not before.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import get_args

from rig.base.errors import ConfigError
from rig.steps.approach import Approach
from rig.steps.base import Step
from rig.steps.breakdown import Breakdown
from rig.steps.cycle import Cycle
from rig.steps.follow import Follow
from rig.steps.glide import Glide
from rig.steps.hold import Hold
from rig.steps.home import Home
from rig.steps.jog import Jog
from rig.steps.learn import Learn
from rig.steps.meter import Meter
from rig.steps.mount import Mount
from rig.steps.precondition import Precondition
from rig.steps.press import Press
from rig.steps.prompt import Prompt
from rig.steps.ramp import Ramp
from rig.steps.relax import Relax
from rig.steps.return_ import Return
from rig.steps.sweep import Sweep
from rig.steps.visit import Visit
from rig.steps.voltage import Voltage
from rig.steps.weigh import Weigh
from rig.steps.zero import Zero

GROUP = "dea_rig.steps"


def name_of(step: type[Step]) -> str:
    """The ``do`` of a kind of steps."""
    return str(get_args(step.model_fields["do"].annotation)[0])


OWN: Mapping[str, type[Step]] = {
    name_of(step): step
    for step in (
        Home,
        Zero,
        Approach,
        Precondition,
        Ramp,
        Hold,
        Prompt,
        Voltage,
        Sweep,
        Relax,
        Breakdown,
        Cycle,
        Learn,
        Return,
        Follow,
        Mount,
        Weigh,
        Visit,
        Glide,
        Press,
        Meter,
        Jog,
    )
}


def names() -> list[str]:
    """All kinds, the house's own first; what other packages register is only named, not loaded."""
    return [*OWN, *(name for name in _registered() if name not in OWN)]


def find(name: str) -> type[Step] | None:
    """The step of that name; None where nobody has registered one.

    Raises
    ------
    ConfigError
        Another package's step cannot be loaded, or is none; names the package.
    """
    return OWN.get(name) or _load(name)


def joining(kinds: Iterable[str]) -> set[str]:
    """Those of ``kinds`` whose data, where they follow each other at one voltage, are one curve.

    A step of another package that cannot be loaded counts as none of them.
    """
    found = set()
    for name in kinds:
        with suppress(ConfigError):
            if (step := find(name)) is not None and step.joins:
                found.add(name)
    return found


@cache
def _registered() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in sorted(entry_points(group=GROUP), key=lambda entry: entry.name)}


@cache
def _load(name: str) -> type[Step] | None:
    entry = _registered().get(name)
    if entry is None:
        return None
    package = entry.dist.name if entry.dist is not None else entry.module
    advice = "Update or remove that package."
    try:
        step = entry.load()
        if isinstance(step, type) and issubclass(step, Step):
            step.model_rebuild()  # keys that cannot be: told here
    except Exception as error:  # whatever another package's code does when it is imported
        raise ConfigError(
            f"The step {name!r} of the package {package} ({entry.value}) cannot be loaded: {error!r}. {advice}"
        ) from error
    if not (isinstance(step, type) and issubclass(step, Step) and "do" in step.model_fields):
        raise ConfigError(
            f"The step {name!r} of the package {package} ({entry.value}) is no rig.steps.base.Step with a key `do`. "
            f"{advice}"
        )
    if name_of(step) != name:
        raise ConfigError(
            f"The package {package} registers {entry.value} as the step {name!r}, but its `do` is {name_of(step)!r}. "
            f"{advice}"
        )
    return step
