"""What a bench in memory, simulated or replayed, offers to the host."""

from __future__ import annotations

from typing import Protocol

from rig.sim.wire import ByteWire, FrameWire


class Wired(Protocol):
    """A bench in memory, simulated or replayed, as seen from the host's ends of its wires."""

    def wire(self, role: str) -> ByteWire | FrameWire: ...

    def advance(self, t: float) -> None:
        """Let everything up to time ``t`` happen."""
        ...
