"""The faults that every simulated supply has: of its output and of what hangs on it."""

from __future__ import annotations

from typing import Protocol

from rig.sim.truth import Fault
from rig.sim.world import World


class Output(Protocol):
    """What the faults need of a supply."""

    stuck_on: bool
    lies: bool  # it says that it is off and measures 0 V, whatever its output does

    @property
    def largest_current(self) -> float: ...

    def set_sag(self, t: float, left: float) -> None: ...


def switch_output(supply: Output, world: World, fault: Fault, begins: bool, t: float) -> None:
    """Let one of `rig.sim.truth.OutputTruth.more_faults` begin or end."""
    match fault.kind:
        case "stuck_on":
            supply.stuck_on = begins
        case "lies":
            supply.lies = supply.stuck_on = begins
        case "breakdown":
            world.broken_down = begins
        case "over_current":
            leak = supply.largest_current * 2 if fault.value is None else fault.value
            world.extra_leakage = leak if begins else 0.0
        case "sag":
            supply.set_sag(t, (0.5 if fault.value is None else fault.value) if begins else 1.0)
