"""The links to a bench's instruments and the clock that they live by, before any driver sits on them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field

from rig.base.clock import Clock, RealClock, VirtualClock
from rig.bench.devices import Link
from rig.bench.memory_link import MemoryByteLink, MemoryFrameLink
from rig.bench.wired import Wired
from rig.scene.scene import Scene
from rig.sim.bench import SimulatedBench
from rig.sim.wire import FrameWire


@dataclass(frozen=True)
class Opened:
    """Links by role. ``simulated`` is the bench at their other end, where it is the simulated one in memory."""

    clock: Clock
    links: dict[str, Link] = field(default_factory=dict)
    simulated: SimulatedBench | None = None

    def close(self) -> None:
        """Close every link, whatever state it is in."""
        for link in self.links.values():
            with suppress(Exception):
                link.close()


def open_ports(scene: Scene, clock: RealClock) -> Opened:
    """Open the ports of all instruments but the supply, which only its guard reaches; sends nothing.

    Raises
    ------
    drivers.links.link.DeviceError
        One cannot be opened, or somebody else has it. Those opened before are closed again.
    """
    opened = Opened(clock)
    try:
        tables = {role: table for role, table in scene.instruments.items() if table is not scene.hv}
        for role, table in tables.items():
            place = table.shared_place
            together = [other for other, one in tables.items() if place is not None and one.shared_place == place]
            if len(together) < 2:
                opened.links[role] = table.open(role)
            elif role == together[0]:
                opened.links.update(zip(together, table.open_shared(together), strict=True))
    except BaseException:
        opened.close()
        raise
    return opened


def open_memory(scene: Scene, wired: Wired, clock: VirtualClock | None = None) -> Opened:
    """The links to a bench in memory, in virtual time; by default a clock that only moves the bench along."""
    opened = Opened(clock or VirtualClock(wired.advance), {}, wired if isinstance(wired, SimulatedBench) else None)
    for role in scene.instruments:
        wire = wired.wire(role)
        kind = MemoryFrameLink if isinstance(wire, FrameWire) else MemoryByteLink
        opened.links[role] = kind(role, wire, opened.clock)  # type: ignore[arg-type] # the wire's own kind
    return opened
