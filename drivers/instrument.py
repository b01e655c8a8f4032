"""One kind of instrument, as everything outside its file sees it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from inspect import signature
from typing import Any, Literal

from drivers.probe import BusProbe, SerialProbe
from drivers.recorded import Dialect
from drivers.roles import Device
from drivers.settings import CanSettings, InstrumentSettings

Role = Literal["stage", "force", "displacement", "hv", "monitor"]
ROLES: tuple[Role, ...] = ("stage", "force", "displacement", "hv", "monitor")
"""In the order in which the instruments of a rig are polled."""
MONITORS = ("monitor", "monitor_2", "monitor_3")
"""A rig may have so many of these; all other roles are there once, under their own name."""


def role_of(name: str) -> str:
    """The role of the instrument that a scene calls so."""
    return "monitor" if name in MONITORS else name


@dataclass(frozen=True)
class Instrument:
    """What an instrument's file declares, once.

    Parameters
    ----------
    driver : str
        Its name in scenes, ``driver = "..."``.
    role : str
        What it does on the rig.
    settings : type of `drivers.settings.InstrumentSettings`
        Its keys in a scene, with descriptions and ranges.
    device : callable
        ``device(name, link, **settings)`` gives the driver; it is given those settings that are named like its
        arguments.
    dialect : Dialect
        How a recorded dialogue of it is served.
    probe : SerialProbe or BusProbe, optional
        How discovery asks for it.
    """

    driver: str
    role: Role
    settings: type[InstrumentSettings]
    device: Callable[..., Device]
    dialect: Dialect
    probe: SerialProbe | BusProbe | None = None

    @property
    def on_bus(self) -> bool:
        """Whether its messages are CAN frames."""
        return issubclass(self.settings, CanSettings)

    def arguments(self, settings: InstrumentSettings) -> dict[str, Any]:
        """What a scene says to the driver: keys, and properties of the settings, that are named like its arguments."""
        named = [key for key in signature(self.device).parameters if key not in ("name", "link")]
        return {key: getattr(settings, key) for key in named if hasattr(settings, key)}

    def make(self, name: str, link: Any, settings: InstrumentSettings) -> Device:
        """The driver on its link; the first poll sends the first byte."""
        return self.device(name, link, **self.arguments(settings))
