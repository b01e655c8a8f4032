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
from rig.sim.instruments.cia404 import CiA404
from rig.sim.instruments.gsv8 import GSV8
from rig.sim.instruments.iseg import IsegEDCP
from rig.sim.instruments.keyence import KeyenceLKG
from rig.sim.instruments.shvps import Shvps
from rig.sim.instruments.zaber import ZaberStage
from rig.sim.operator import Operator
from rig.sim.settings import (
    LINK_FAULTS,
    CiA404Truth,
    DisplacementTruth,
    Fault,
    ForceTruth,
    HVTruth,
    LinkTruth,
    ShvpsTruth,
    SimulationSettings,
    StageTruth,
)
from rig.sim.wire import ByteWire, FrameWire
from rig.sim.world import World

ROLES = ("stage", "force", "displacement", "hv")

OnLine = ZaberStage | GSV8 | KeyenceLKG | Shvps
OnBus = IsegEDCP | CiA404
Instrument = OnLine | OnBus


Unasked = ZaberStage | KeyenceLKG | IsegEDCP | CiA404
"""Those that can send what nobody asked for."""


class _Timed(Protocol):
    """Something that acts by itself."""

    @property
    def next_time(self) -> float: ...

    def advance(self, t: float) -> None: ...


class SimulatedBench:
    """The instruments of ``roles`` (stage, force, displacement, hv) and the specimen between them.

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
        self.world = World(settings, specimen, "hv" in roles, solve)
        self.operator = Operator(self.world, self._rng("operator"))
        self.instruments: dict[str, Instrument] = {}
        self._lines: dict[str, tuple[ByteWire, OnLine]] = {}
        self._buses: dict[str, tuple[FrameWire, OnBus]] = {}
        self._upsets: dict[tuple[str, str], Upset] = {}
        self.now = 0.0
        for role in ROLES:
            if role in roles:
                self._build(role)
        # The order of things that happen at one time: sensors see the world as it was, then it moves on.
        self._sensors: list[_Timed] = [self.instruments[r] for r in ("force", "displacement") if r in roles]
        self._actors: list[_Timed] = [self.world, *(self.instruments[r] for r in ("stage", "hv") if r in roles)]
        self._wires: list[ByteWire | FrameWire] = [self.wire(role) for role in self.instruments]
        self._due: list[tuple[float, int, bool, Fault]] = []
        self._injected = 0
        for fault in settings.fault:
            if fault.role in roles:
                self.inject(fault)

    def _rng(self, name: str) -> np.random.Generator:
        return np.random.default_rng([self.settings.seed & 0xFFFF_FFFF_FFFF_FFFF, zlib.crc32(name.encode())])

    def _build(self, role: str) -> None:
        s, rng = self.settings, self._rng(role)
        truth = {"stage": s.stage, "force": s.force, "displacement": s.displacement, "hv": s.hv}[role]
        match truth:
            case HVTruth() | CiA404Truth():
                bus = FrameWire(truth.latency_ms * 1e-3, truth.bitrate)
                node: OnBus
                if isinstance(truth, HVTruth):
                    node = IsegEDCP(truth, self.world, bus, rng)
                else:
                    node = CiA404(truth, self.world, bus, rng)
                self._buses[role] = bus, node
                self.instruments[role] = node
                return
        wire = _wire(truth.link)
        instrument: OnLine
        match truth:
            case StageTruth():
                instrument = ZaberStage(truth, self.world, wire)
            case ForceTruth():
                instrument = GSV8(truth, self.world, wire, rng)
            case ShvpsTruth():
                instrument = Shvps(truth, self.world, wire, rng)
            case DisplacementTruth():
                instrument = KeyenceLKG(truth, self.world, wire, rng)
        self._lines[role] = wire, instrument
        self.instruments[role] = instrument

    def prepare(self) -> None:
        """Do now what takes long (the film's table), so that nothing waits for it later."""
        _ = self.world.film

    def wire(self, role: str) -> ByteWire | FrameWire:
        """The wire to the instrument of ``role``; the host uses its ``host_write`` and ``host_read``."""
        return self._buses[role][0] if role in self._buses else self._lines[role][0]

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
        for wire, instrument in self._lines.values():
            if wire.next_delivery <= t:
                for arrived, data in wire.deliveries(t):
                    instrument.receive(data, arrived)
        for bus, node in self._buses.values():
            if bus.next_delivery <= t:
                for arrived, frame in bus.deliveries(t):
                    node.receive(frame, arrived)

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
        if isinstance(instrument, Unasked) and fault.kind == "alert":
            if fault.value == 0:
                instrument.before_reply = self._interleave(instrument, fault, number) if begins else None
            else:
                self._alert(instrument, fault, begins, t)
            return
        if fault.kind == "reset":
            if begins:
                instrument.reset(t)
            return
        if fault.kind == "freeze":
            instrument.freeze(t, begins)
            return
        match instrument:
            case ZaberStage():
                instrument.wrong_status = "FS" if begins else None
            case GSV8() | CiA404() if fault.kind == "saturate":
                instrument.saturated = _sign(fault) if begins else 0
            case GSV8():
                instrument.set_status((3 if fault.value is None else int(fault.value) & 3) if begins else 0)
            case CiA404():
                instrument.status_bits = (1 if fault.value is None else int(fault.value) & 7) if begins else 0
            case KeyenceLKG():
                match fault.kind:
                    case "saturate":
                        instrument.saturated = _sign(fault) if begins else 0
                    case "no_value":
                        instrument.no_value = begins
                    case _:
                        instrument.wrong_status = begins
            case IsegEDCP() | Shvps():
                self._switch_supply(instrument, fault, begins, t)

    def _alert(self, instrument: Unasked, fault: Fault, begins: bool, t: float) -> None:
        """Unsolicited lines: one, or one every ``value`` seconds for the duration of the fault."""
        if not begins:
            return
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

    def _switch_supply(self, supply: IsegEDCP | Shvps, fault: Fault, begins: bool, t: float) -> None:
        match fault.kind:
            case "stuck_on":
                supply.stuck_on = begins
            case "breakdown":
                self.world.broken_down = begins
            case "over_current":
                leak = supply.largest_current * 2 if fault.value is None else fault.value
                self.world.extra_leakage = leak if begins else 0.0
            case "sag":
                supply.set_sag(t, (0.5 if fault.value is None else fault.value) if begins else 1.0)
            case "interlock" if isinstance(supply, IsegEDCP):
                supply.open_interlock(t, begins)
            case "inhibit" if isinstance(supply, IsegEDCP):
                supply.inhibit(t, begins)
            case "wrong_status":
                if isinstance(supply, Shvps):
                    supply.wrong_mode = int(fault.value or 0) if begins else None
                else:
                    bits = 0xFFFF if fault.value is None else int(fault.value) & 0xFFFF
                    supply.wrong_status = bits if begins else 0


def _sign(fault: Fault) -> int:
    return -1 if fault.value is not None and fault.value < 0 else 1


def _wire(link: LinkTruth) -> ByteWire:
    return ByteWire(link.latency_ms * 1e-3, link.baud)
