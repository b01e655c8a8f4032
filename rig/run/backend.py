"""Which bench a scene means: its real ports and the guard of their supply, the simulated bench, or a log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rig.base.clock import RealClock
from rig.base.errors import ConfigError
from rig.bench.bench import Bench
from rig.bench.opening import open_memory, open_ports
from rig.scene.scene import Scene
from rig.sim.bench import SimulatedBench

if TYPE_CHECKING:
    from rig.replay.bench import ReplayBench
    from rig.safety.remote import RemoteGuard


class Backend:
    """The bench of a scene, opened: nothing has been sent.

    Attributes
    ----------
    bench : Bench
    guard : RemoteGuard or None
        The process that owns the supply's link, when there is HV on real ports; `Bench.close` ends it.
    """

    def __init__(self, scene: Scene) -> None:
        self.guard: RemoteGuard | None = None
        if not scene.on_real_ports:
            self.bench = Bench(scene, open_memory(scene, wired_bench(scene)))
            return
        clock = RealClock()
        if scene.hv is not None:
            from rig.safety.remote import RemoteGuard

            self.guard = RemoteGuard(scene, clock)
        try:
            if self.guard is not None:
                self.guard.opened()  # first: nobody reads the other ports while its process comes up
            opened = open_ports(scene, clock)
            self.bench = Bench(scene, opened, self.guard)
            if self.guard is not None and scene.second_reading:
                self.guard.lend_monitor(getattr(opened.links[scene.second_reading], "descriptors", ()))
        except BaseException:
            if self.guard is not None:
                self.guard.close()
            raise


def open_bench(scene: Scene) -> Bench:
    """The bench of a scene; see `Backend`."""
    return Backend(scene).bench


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
    if scene.simulation is None:
        raise ConfigError("This scene has no [simulation] table, so there is nothing to simulate.")
    return SimulatedBench(scene.simulation, scene.specimen.specimen(), set(scene.instruments))
