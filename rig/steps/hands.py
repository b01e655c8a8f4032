"""What an operator is asked to do by hand during a calibration."""

from __future__ import annotations

from typing import Protocol


class Hands(Protocol):
    """Does it in the operator's place; the simulated bench has such hands (`rig.sim.operator.Operator`)."""

    def hang(self, newtons: float, uncertainty: float, name: str) -> None:
        """Hang the weight ``name`` that nominally pulls with ``newtons``, or take all off at 0."""
        ...

    def mount(self, fixture: str, t: float) -> None:
        """Mount what the pusher meets, at clock time ``t``."""
        ...

    def read_meter(self, relative: float, absolute: float, t: float) -> float:
        """What a reference meter of these standard uncertainties shows (V) at clock time ``t``."""
        ...
