"""The monitor of the voltage in the guard's process, while the engine that read it is stopped, hangs or has ended."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from drivers.links.link import DeviceLost
from drivers.roles import Device, MonitorSample
from rig.bench.devices import Link, make_device
from rig.log.schema import Way
from rig.scene.scene import Scene

NOTHING: Sequence[MonitorSample] = ()


def _untold(role: str, way: Way, data: bytes, t: float) -> None:
    """The log has these readings, not their bytes: those would follow on those of another driver's dialogue."""


class TakenOver:
    """Reads on where the engine has left off, on the descriptors that it lent; sends nothing before the first `poll`.

    Attributes
    ----------
    gain : float
        Volts per volt that the monitor states, from its certificate.
    """

    def __init__(self, scene: Scene, handles: Sequence[int]) -> None:
        self.role = scene.second_reading
        self.gain = 1.0
        self._table = scene.monitors[self.role]
        self._handles = handles
        self._link: Link | None = None
        self._device: Device | None = None

    def poll(self, now: float) -> Sequence[MonitorSample]:
        """New readings. Whatever goes wrong with it is only that there are none."""
        try:
            if self._link is None:
                self._link = self._table.open(self.role, self._handles)
            if self._device is None:
                self._device = make_device(self.role, self._table, self._link, _untold, lambda: now)
            samples = [sample for sample in self._device.poll(now) if isinstance(sample, MonitorSample)]
        except DeviceLost:
            if self._link is not None and self._link.reopen():
                self._device = None  # it may have lost its power: from the beginning
            return NOTHING
        except Exception:
            self._device = None
            return NOTHING
        return [replace(sample, value=sample.value * self.gain) for sample in samples]

    def leave(self) -> None:
        """The engine goes on and reads by itself. An answer that is still to come its driver takes, or drops."""
        self._device = None

    def close(self) -> None:
        """Let go of it."""
        if self._link is not None:
            self._link.close()
