"""From a scene to instruments that can be polled: links opened, drivers attached, one clock for all.

The same drivers sit on real ports and on the simulated bench in memory; only this module knows which.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

from drivers.links.link import ByteLink, CanFrame, FrameLink
from drivers.roles import Device, DisplacementSensor, ForceSensor, HVSupply, Sample, Stage
from rig.base.clock import Clock, RealClock, VirtualClock
from rig.scene.scene import (
    CanTable,
    CiA404Table,
    GSV8Table,
    Instrument,
    IsegTable,
    KeyenceTable,
    Scene,
    ShvpsTable,
    ZaberTable,
)

if TYPE_CHECKING:
    from rig.replay.bench import ReplayBench
    from rig.safety.remote import RemoteGuard
    from rig.sim.bench import SimulatedBench
    from rig.sim.wire import ByteWire, FrameWire


class Tap(Protocol):
    """Is told every byte and frame, before it is sent and as soon as it has been read, with the time of that poll."""

    def __call__(self, role: str, way: Literal["rx", "tx"], data: bytes, t: float) -> None: ...


class TappedByteLink:
    """A serial link whose traffic is told to a tap."""

    def __init__(self, role: str, link: ByteLink, tap: Tap, when: Callable[[], float]) -> None:
        self.name = link.name
        self._role = role
        self._link = link
        self._tap = tap
        self._when = when

    def read(self) -> bytes:
        data = self._link.read()
        if data:
            self._tap(self._role, "rx", data, self._when())
        return data

    def write(self, data: bytes) -> None:
        self._tap(self._role, "tx", data, self._when())
        self._link.write(data)

    def close(self) -> None:
        self._link.close()


class TappedFrameLink:
    """A CAN link whose frames are told to a tap as identifier (two bytes, big-endian) and data."""

    def __init__(self, role: str, link: FrameLink, tap: Tap, when: Callable[[], float]) -> None:
        self.name = link.name
        self._role = role
        self._link = link
        self._tap = tap
        self._when = when

    def read(self) -> list[CanFrame]:
        frames = self._link.read()
        for frame in frames:
            self._tap(self._role, "rx", frame.id.to_bytes(2, "big") + frame.data, self._when())
        return frames

    def write(self, frame: CanFrame) -> None:
        self._tap(self._role, "tx", frame.id.to_bytes(2, "big") + frame.data, self._when())
        self._link.write(frame)

    def close(self) -> None:
        self._link.close()


class Wired(Protocol):
    """A bench in memory, simulated or replayed, as seen from the host's ends of its wires."""

    def prepare(self) -> None:
        """Do now what takes long."""
        ...

    def wire(self, role: str) -> ByteWire | FrameWire: ...

    def advance(self, t: float) -> None:
        """Let everything up to time ``t`` happen."""
        ...


class Bench:
    """The instruments of one scene behind one clock.

    Opening a bench opens ports; it sends nothing. Drivers come to life with `attach`, so that a log can be there
    before the first byte is sent.

    Attributes
    ----------
    clock : Clock
        Virtual when the simulated bench is in memory, real otherwise.
    simulated : SimulatedBench or None
        The bench in memory, with its hidden truth, for tests and for the demonstration's comparison.
    hv : HVSupply or None
        The supply in memory. On real ports only ``guard_process`` reaches it.
    guard_process : RemoteGuard or None
        The process that owns the supply's link, when there is HV on real ports; `close` ends it.

    Parameters
    ----------
    scene : Scene
    wired : Wired, optional
        A bench in memory, in place of what the scene names.
    """

    stage: Stage
    force: ForceSensor
    displacement: DisplacementSensor | None
    hv: HVSupply | None

    def __init__(self, scene: Scene, wired: Wired | None = None) -> None:
        self.scene = scene
        self.simulated: SimulatedBench | None = None
        self.guard_process: RemoteGuard | None = None
        self.hv = None
        self.clock: Clock
        self._byte_links: dict[str, ByteLink] = {}
        self._frame_links: dict[str, FrameLink] = {}
        self.devices: dict[str, Device] = {}
        self._polled_at: float | None = None
        try:
            if wired is None and scene.on_real_ports:
                self._open_ports()
            else:
                self._open_memory(wired if wired is not None else wired_bench(scene))
        except BaseException:
            self.close()
            raise

    def _open_ports(self) -> None:
        self.clock = RealClock()
        if self.scene.hv is not None:
            from rig.safety.remote import RemoteGuard

            self.guard_process = RemoteGuard(self.scene, self.clock)
            self.guard_process.opened()  # first: nobody reads the other ports while its process comes up
        for role, table in self.scene.instruments.items():
            if table is self.scene.hv:
                continue
            if isinstance(table, CanTable):
                from drivers.links.can_link import CanLink

                assert table.interface is not None and table.can_channel is not None
                self._frame_links[role] = CanLink(role, table.interface, table.can_channel, table.bitrate)
            else:
                from drivers.links.serial_link import SerialLink

                assert table.port is not None
                self._byte_links[role] = SerialLink(role, table.port, table.baud)

    def _open_memory(self, wired: Wired) -> None:
        from rig.bench.memory_link import MemoryByteLink, MemoryFrameLink
        from rig.sim.bench import SimulatedBench
        from rig.sim.wire import FrameWire

        wired.prepare()
        clock = self._make_clock(wired)
        for role in self.scene.instruments:
            wire = wired.wire(role)
            if isinstance(wire, FrameWire):
                self._frame_links[role] = MemoryFrameLink(role, wire, clock)
            else:
                self._byte_links[role] = MemoryByteLink(role, wire, clock)
        self.simulated = wired if isinstance(wired, SimulatedBench) else None
        self.clock = clock

    def _make_clock(self, wired: Wired) -> VirtualClock:
        return VirtualClock(wired.advance)

    def attach(self, tap: Tap) -> None:
        """Put the drivers on their links; from here on they may be polled."""
        self.displacement = None

        def bytes_of(role: str) -> ByteLink:
            return TappedByteLink(role, self._byte_links[role], tap, self._when)

        def frames_of(role: str) -> FrameLink:
            return TappedFrameLink(role, self._frame_links[role], tap, self._when)

        for role, table in self.scene.instruments.items():
            match table:
                case ZaberTable():
                    from drivers.instruments.zaber import ZaberStage

                    self.stage = ZaberStage(role, bytes_of(role), **arguments(table, ZaberStage))
                    self.devices[role] = self.stage
                case GSV8Table():
                    from drivers.instruments.gsv8 import GSV8

                    self.force = GSV8(role, bytes_of(role), **arguments(table, GSV8))
                    self.devices[role] = self.force
                case CiA404Table():
                    from drivers.instruments.cia404 import CiA404

                    self.force = CiA404(role, frames_of(role), **arguments(table, CiA404))
                    self.devices[role] = self.force
                case KeyenceTable():
                    from drivers.instruments.keyence_lkg import KeyenceLKG

                    self.displacement = KeyenceLKG(role, bytes_of(role), **arguments(table, KeyenceLKG))
                    self.devices[role] = self.displacement
                case IsegTable() | ShvpsTable():
                    if self.guard_process is not None:
                        self.guard_process.attach(tap)
                        self.devices[role] = self.guard_process
                    else:
                        from rig.safety.supply import make_driver

                        link = self._byte_links.get(role) or self._frame_links[role]
                        self.hv = make_driver(table, link, tap, self._when)
                        self.devices[role] = self.hv

    def poll(self, role: str, now: float) -> Sequence[Sample]:
        """New samples of one instrument.

        Whatever passes on its wire meanwhile is told to the tap with the time ``now``: it is all the time that the
        driver knows, so that its samples can be worked out again from what the tap was told.
        """
        self._polled_at = now
        try:
            return self.devices[role].poll(now)
        finally:
            self._polled_at = None

    def _when(self) -> float:
        return self.clock.now() if self._polled_at is None else self._polled_at

    def link_settings(self, role: str) -> dict[str, str]:
        """What the link of ``role`` set and what its adapter made of it; nothing for links in memory."""
        if role == "hv" and self.guard_process is not None:
            return dict(self.guard_process.link_settings)
        link = self._byte_links.get(role) or self._frame_links.get(role)
        return dict(getattr(link, "settings", {}))

    def close(self) -> None:
        """Close every device and link, whatever state they are in; one that fails does not keep the others open."""
        closing = [device.close for device in self.devices.values()]
        closing += [link.close for link in self._byte_links.values()]
        closing += [link.close for link in self._frame_links.values()]
        if self.guard_process is not None:
            closing.append(self.guard_process.close)
        for close in closing:
            with suppress(Exception):
                close()


def arguments(table: Instrument, driver: type[Device]) -> dict[str, Any]:
    """What a scene says to a driver: the keys that are named like its arguments."""
    return table.model_dump(include=set(signature(driver).parameters))


def wired_bench(scene: Scene, *, real_time: bool = False) -> SimulatedBench | ReplayBench:
    """The bench in memory that a scene names: a log that answers in its place, or the simulated one.

    ``real_time`` is for the log: whether it is served in real time.

    Raises
    ------
    ConfigError
        When the log's instruments are not those of the scene.
    LogError
        When the log cannot be read.
    """
    if scene.bench is None:
        return simulated_bench(scene)
    from rig.base.errors import ConfigError
    from rig.replay.bench import ReplayBench
    from rig.replay.recording import load_recording

    recording = load_recording(Path(scene.bench.log))
    then = recording.experiment.scene.instruments
    now = {role: table.driver for role, table in scene.instruments.items()}
    if now != {role: table.driver for role, table in then.items()}:
        listed = ", ".join(f"{role} {table.driver}" for role, table in then.items())
        raise ConfigError(f"{scene.bench.log} was recorded with other instruments than the scene names: {listed}.")
    return ReplayBench(recording, real_time=real_time)


def simulated_bench(scene: Scene) -> SimulatedBench:
    """The simulated bench that a scene's ``[simulation]`` table describes, with only the instruments it names."""
    from rig.base.errors import ConfigError
    from rig.sim.bench import SimulatedBench

    if scene.simulation is None:
        raise ConfigError("This scene has no [simulation] table, so there is nothing to simulate.")
    return SimulatedBench(scene.simulation, scene.specimen.specimen(), set(scene.instruments))
