"""The instruments of a scene that can be polled: drivers on their links, one clock for all.

The same drivers sit on real ports and on a bench in memory; which it is has been decided where the links were opened.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from contextlib import suppress
from typing import Protocol, cast

from drivers.links.link import DeviceError, DeviceLost
from drivers.roles import Device, DisplacementSensor, ForceSensor, HVSupply, Remarking, Sample, Stage
from rig.bench.devices import Link, make_device, make_supply
from rig.bench.opening import Opened
from rig.bench.tap import Tap
from rig.scene.scene import Scene


@functools.cache
def _makes_remarks(kind: type[Device]) -> bool:
    """Whether devices of this class are `Remarking`; comparing with a protocol takes too long for each turn."""
    return issubclass(kind, Remarking)


class SupplyProcess(Device, Protocol):
    """The supply, when another process owns its link."""

    link_settings: dict[str, str]

    def fileno(self) -> int:
        """Of the channel to that process."""
        ...

    def attach(self, tap: Tap) -> None:
        """From now on bytes and frames are told to ``tap``."""
        ...


class Bench:
    """The instruments of one scene behind one clock.

    Drivers come to life with `attach`, so that a log can be there before the first byte is sent.

    Attributes
    ----------
    clock : Clock
        Virtual when the bench is in memory, real otherwise.
    simulated : SimulatedBench or None
        The bench in memory, with its hidden truth, for tests and for the demonstration's comparison.
    hv : HVSupply or None
        The supply in memory. On real ports only its guard's process reaches it.

    Parameters
    ----------
    scene : Scene
    opened : Opened
        From `rig.bench.opening`; `close` closes its links.
    supply : SupplyProcess, optional
        Who owns the supply's link, when there is HV on real ports; `close` ends it.
    """

    stage: Stage
    force: ForceSensor

    def __init__(self, scene: Scene, opened: Opened, supply: SupplyProcess | None = None) -> None:
        self.scene = scene
        self.clock = opened.clock
        self.simulated = opened.simulated
        self.displacement: DisplacementSensor | None = None
        self.hv: HVSupply | None = None
        self.devices: dict[str, Device] = {}
        self._opened = opened
        self._supply = supply
        self._polled_at: float | None = None
        self._tap: Tap | None = None

    def attach(self, tap: Tap) -> None:
        """Put the drivers on their links; from here on they may be polled."""
        self._tap = tap
        for role, table in self.scene.instruments.items():
            if table is self.scene.hv:
                if self._supply is not None:
                    self._supply.attach(tap)
                    self.devices[role] = self._supply
                else:
                    self.devices[role] = self.hv = make_supply(self.scene.hv, self._link(role), tap, self._when)
                continue
            self.devices[role] = device = make_device(role, table, self._link(role), tap, self._when)
            match role:
                case "stage":
                    self.stage = cast(Stage, device)
                case "force":
                    self.force = cast(ForceSensor, device)
                case "displacement":
                    self.displacement = cast(DisplacementSensor, device)

    def _link(self, role: str) -> Link:
        return self._opened.links[role]

    def poll(self, role: str, now: float) -> Sequence[Sample]:
        """New samples of one instrument.

        Whatever passes on its wire meanwhile is told to the tap with the time ``now``: it is all the time that the
        driver knows, so that its samples can be worked out again from what the tap was told. So is an error, which may
        leave no other trace.
        """
        self._polled_at = now
        try:
            return self.devices[role].poll(now)
        except DeviceError as error:
            error.role = role
            if self._tap is not None and role in self._opened.links and not isinstance(error, DeviceLost):
                self._tap(role, "failed", b"", now)
            raise
        finally:
            self._polled_at = None

    def _when(self) -> float:
        return self.clock.now() if self._polled_at is None else self._polled_at

    def link_settings(self, role: str) -> dict[str, str]:
        """What the link of ``role`` set and what its adapter made of it; nothing for links in memory."""
        if role not in self._opened.links:
            return dict(self._supply.link_settings) if self._supply is not None else {}
        return dict(getattr(self._link(role), "settings", {}))

    def remarks(self, role: str) -> list[str]:
        """What a device has to say that the operator should know, since the last call."""
        device = self.devices[role]
        return cast(Remarking, device).remarks() if _makes_remarks(type(device)) else []

    def has_link(self, role: str) -> bool:
        """Whether the instrument is on a link of this process."""
        return role in self._opened.links

    def descriptor(self, role: str) -> int | None:
        """By what the system says that something has come for ``role``; None where it has nothing of the kind."""
        if not self.has_link(role):
            return None if self._supply is None else self._supply.fileno()
        descriptors = getattr(self._opened.links[role], "descriptors", ())
        return descriptors[0] if descriptors else None

    def too_slow(self, role: str) -> str:
        """Why an instrument cannot give samples as often as the scene says, by its round trips so far; else nothing."""
        table, counters = self.scene.instruments[role], self.devices[role].counters
        trips, asks = counters.get("round_trips", 0), table.asks_per_sample
        if not trips or not asks:
            return ""
        trip_s = 1e-6 * counters["round_trip_sum_us"] / trips
        if trip_s * asks * table.sample_rate <= 1.0:
            return ""
        several = f", and a sample takes {asks}" if asks > 1 else ""
        timer = self.link_settings(role).get("latency_timer_ms", "")
        why = f"; the adapter's latency timer is {timer} ms, Linux can set 1" if timer not in ("", "1") else ""
        return (
            f"{table.rate_key} = {table.sample_rate:g} Hz cannot be kept: a question has taken {trip_s * 1e3:.1f} ms "
            f"on average{several}, so at most {1.0 / (trip_s * asks):.3g} Hz{why}"
        )

    def close(self) -> None:
        """Close every device and link, whatever state they are in; one that fails does not keep the others open."""
        for device in self.devices.values():
            with suppress(Exception):
                device.close()
        self._opened.close()
        if self._supply is not None:
            with suppress(Exception):
                self._supply.close()
