"""The instruments that a scene may name, made from the registry of drivers: one table of keys for each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Union

from pydantic import Field

from drivers.registry import of_role
from drivers.settings import ForceSettings, InstrumentSettings, MonitorSettings, StageSettings, SupplySettings


def _any_of(role: str) -> Any:
    """The tables of all instruments of a role, told apart by ``driver``."""
    tables = tuple(one.settings for one in of_role(role).values())
    if len(tables) == 1:  # nothing to tell apart
        return tables[0]
    return Annotated[Union[tables], Field(discriminator="driver")]  # noqa: UP007 # made at run time


if TYPE_CHECKING:
    AnyStage = StageSettings
    AnyForce = ForceSettings
    AnyDisplacement = InstrumentSettings
    AnySupply = SupplySettings
    AnyMonitor = MonitorSettings
else:
    AnyStage = _any_of("stage")
    AnyForce = _any_of("force")
    AnyDisplacement = _any_of("displacement")
    AnySupply = _any_of("hv")
    AnyMonitor = _any_of("monitor")
