"""One simulated instrument, as everything outside its file sees it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from rig.sim.truth import Fault, InstrumentTruth, Role
from rig.sim.world import World


class SimulatedInstrument(Protocol):
    """An instrument at its end of the wire. Times never go backwards."""

    @property
    def next_time(self) -> float:
        """When it acts by itself next; inf if never."""
        ...

    def advance(self, t: float) -> None:
        """Do what is due up to ``t``."""
        ...

    def receive(self, data: Any, t: float) -> None:
        """Bytes, or one CAN frame, from the host; the last bit arrived at ``t``."""
        ...

    def reset(self, t: float) -> None:
        """Lose power and come back."""
        ...

    def freeze(self, t: float, frozen: bool) -> None:
        """A fault: what it measures stays what it was at ``t``."""
        ...

    def switch(self, fault: Fault, begins: bool, t: float) -> None:
        """Let another of its faults (`InstrumentTruth.faults`) begin or end."""
        ...


@runtime_checkable
class Unasked(Protocol):
    """An instrument that can send what nobody asked for.

    ``before_reply``, if it is not None, is called with the time before each reply is sent.
    """

    before_reply: Callable[[float], None] | None

    def alert(self, t: float) -> None: ...


@dataclass(frozen=True)
class Twin:
    """What a simulated instrument's file declares, once.

    Parameters
    ----------
    driver : str
        Name of the driver in whose scenes it takes the instrument's place.
    role : str
        What it does on the rig.
    truth : type of InstrumentTruth
        Its keys under ``[simulation.ROLE]``, and its faults.
    make : callable
        ``make(truth, world, wire, rng)`` gives the instrument.
    """

    driver: str
    role: Role
    truth: type[InstrumentTruth]
    make: Callable[[Any, World, Any, np.random.Generator], SimulatedInstrument]
