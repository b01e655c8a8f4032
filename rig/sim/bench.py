"""The simulated bench: instruments around one hidden truth, moved through time event by event.

Everything random comes from the seed, one stream an instrument. What an instrument sends depends on what it was told
and when, never on how often the bench was asked.
"""

from __future__ import annotations

import heapq
import math
import zlib
from collections.abc import Callable, Collection
from typing import Protocol

import numpy as np

from model.specimen import Specimen
from rig.sim.faults import Upset
from rig.sim.film import Solve, solve_membrane
from rig.sim.operator import Operator
from rig.sim.settings import SimulationSettings
from rig.sim.truth import LINK_FAULTS, MONITORS, ROLES, Fault, role_of
from rig.sim.twin import SimulatedInstrument, Unasked
from rig.sim.twins import registered
from rig.sim.wire import ByteWire, FrameWire
from rig.sim.world import World


class _Timed(Protocol):
    """Something that acts by itself."""

    @property
    def next_time(self) -> float: ...

    def advance(self, t: float) -> None: ...


class SimulatedBench:
    """The instruments of ``roles`` (`rig.sim.truth.ROLES`) and the specimen between them.

    Attributes
    ----------
    world : World
        The hidden truth.
    instruments : dict
        By role, for tests and faults.
    operator : Operator
        Does by hand what a calibration asks for.
    now : float
        The time up to which everything has happened.
    """

    def __init__(
        self,
        settings: SimulationSettings,
        specimen: Specimen,
        roles: Collection[str],
        *,
        solve: Solve = solve_membrane,
    ) -> None:
        unknown = set(roles) - set(ROLES)
        if unknown:
            raise ValueError(f"no simulated instrument for {', '.join(sorted(unknown))}; there are {', '.join(ROLES)}")
        self.settings = settings
        self.world = World(settings, settings.stage, settings.hv if "hv" in roles else None, specimen, solve)
        self.operator = Operator(self.world, self._rng("operator"))
        self.instruments: dict[str, SimulatedInstrument] = {}
        self._wire: dict[str, ByteWire | FrameWire] = {}
        self._upsets: dict[tuple[str, str], Upset] = {}
        self.now = 0.0
        for role in ROLES:
            if role in roles:
                self._build(role)
        # The order of things that happen at one time: sensors see the world as it was, then it moves on.
        sensors = ("force", "displacement", *MONITORS)
        self._sensors: list[_Timed] = [self.instruments[name] for name in sensors if name in roles]
        self._actors: list[_Timed] = [self.world, *(self.instruments[r] for r in ("stage", "hv") if r in roles)]
        # Serial lines deliver before buses: the order of things that arrive at one time is part of a run.
        wires = [(wire, self.instruments[role]) for role, wire in self._wire.items()]
        self._ends = sorted(wires, key=lambda end: isinstance(end[0], FrameWire))
        self._wires = [wire for wire, _ in wires]
        self._due: list[tuple[float, int, bool, Fault]] = []
        self._injected = 0
        for fault in settings.fault:
            if fault.role in roles:
                self.inject(fault)

    def _rng(self, name: str) -> np.random.Generator:
        return np.random.default_rng([self.settings.seed & 0xFFFF_FFFF_FFFF_FFFF, zlib.crc32(name.encode())])

    def _build(self, role: str) -> None:
        truth = self.settings.truth(role)
        wire = self._wire[role] = truth.wire()
        twin = registered().twins[role_of(role), truth.driver]
        self.instruments[role] = twin.make(truth, self.world, wire, self._rng(role))

    def prepare(self) -> None:
        """Do now what takes long (the film's tables), so that nothing waits for it later."""
        self.world.prepare()

    def wire(self, role: str) -> ByteWire | FrameWire:
        """The wire to the instrument of ``role``; the host uses its ``host_write`` and ``host_read``."""
        return self._wire[role]

    # Time

    def _next_action(self) -> float:
        """When something happens next that sensors must not overlook."""
        due = self._due[0][0] if self._due else math.inf
        for actor in self._actors:
            due = min(due, actor.next_time)
        for wire in self._wires:
            due = min(due, wire.next_delivery)
        return due

    def next_time(self) -> float:
        """When something happens next by itself, or arrives at either end of a wire; inf if nothing will."""
        due = self._next_action()
        for sensor in self._sensors:
            due = min(due, sensor.next_time)
        for wire in self._wires:
            due = min(due, wire.next_arrival)
        return due

    def advance(self, t: float) -> None:
        """Let everything up to time ``t`` happen, in the order of time."""
        while True:
            due = self._next_action()
            step = max(min(due, t), self.now)
            for sensor in self._sensors:
                sensor.advance(step)
            self.now = step
            if due > t:
                return
            for actor in self._actors:
                actor.advance(step)
            self._deliver(step)
            while self._due and self._due[0][0] <= step:
                _, number, begins, fault = heapq.heappop(self._due)
                self._switch(fault, number, begins, step)

    def _deliver(self, t: float) -> None:
        for wire, instrument in self._ends:
            if wire.next_delivery <= t:
                for arrived, data in wire.deliveries(t):
                    instrument.receive(data, arrived)

    # Faults

    def inject(self, fault: Fault) -> None:
        """Let something go wrong, from ``fault.at_s`` on, or from now on if that has passed."""
        if fault.role not in self.instruments:
            raise ValueError(f"there is no {fault.role} on this bench to go wrong")
        self.settings.check(fault)
        self._injected += 1
        number = self._injected  # switching may inject further faults
        begin = max(fault.at_s, self.now)
        if begin > self.now:
            heapq.heappush(self._due, (begin, 2 * number, True, fault))
        else:
            self._switch(fault, 2 * number, True, self.now)
        if fault.duration_s is not None:
            heapq.heappush(self._due, (begin + fault.duration_s, 2 * number + 1, False, fault))

    def _switch(self, fault: Fault, number: int, begins: bool, t: float) -> None:
        if fault.kind == "vanish":
            wire = self.wire(fault.role)
            if begins:
                wire.cut()
            else:
                wire.restore()
        elif fault.kind in LINK_FAULTS:
            self._switch_upset(fault, number // 2, begins)
        else:
            self._switch_device(fault, number // 2, begins, t)

    def _switch_upset(self, fault: Fault, number: int, begins: bool) -> None:
        directions = ["from_device", "to_device"] if fault.direction == "both" else [fault.direction]
        if fault.kind == "silent":
            directions = ["from_device"]
        wire = self.wire(fault.role)
        for direction in directions:
            upset = self._upsets.setdefault((fault.role, direction), Upset())
            if begins:
                upset.add(fault, self._rng(f"fault {number} {direction}"))
            else:
                upset.remove(fault)
            if isinstance(wire, FrameWire):
                hook = upset.on_bus if len(upset) else None
                if direction == "from_device":
                    wire.upset_from_device = hook
                else:
                    wire.upset_to_device = hook
            else:
                bytes_hook = upset.on_line if len(upset) else None
                if direction == "from_device":
                    wire.upset_from_device = bytes_hook
                else:
                    wire.upset_to_device = bytes_hook

    def _switch_device(self, fault: Fault, number: int, begins: bool, t: float) -> None:
        instrument = self.instruments[fault.role]
        match fault.kind:
            case "alert" if isinstance(instrument, Unasked):
                if fault.value == 0:
                    instrument.before_reply = self._interleave(instrument, fault, number) if begins else None
                elif begins:
                    self._alert(instrument, fault, t)
            case "reset":
                if begins:
                    instrument.reset(t)
            case "freeze":
                instrument.freeze(t, begins)
            case _:
                instrument.switch(fault, begins, t)

    def _alert(self, instrument: Unasked, fault: Fault, t: float) -> None:
        """Unsolicited lines: one, or one every ``value`` seconds for the duration of the fault."""
        instrument.alert(t)
        if fault.duration_s is not None:
            period = fault.value or 0.1
            rest = fault.duration_s - period
            if rest > 0:
                self.inject(fault.model_copy(update={"at_s": t + period, "duration_s": rest}))

    def _interleave(self, instrument: Unasked, fault: Fault, number: int) -> Callable[[float], None]:
        rng = self._rng(f"fault {number}")

        def alert_by_chance(t: float) -> None:
            if rng.random() < fault.probability:
                instrument.alert(t)

        return alert_by_chance
