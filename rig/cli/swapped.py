"""When a bench does not come up: whether another known instrument answers where one was expected."""

from __future__ import annotations

from collections.abc import Iterator

from drivers.instrument import role_of
from drivers.settings import CanSettings
from rig.scene.scene import Scene


def others_on_its_ports(scene: Scene) -> Iterator[str]:
    """A line for each port of the scene on which an instrument of another role answers. Sends only questions."""
    from drivers.discovery import Bus, discover
    from rig.base.clock import RealClock

    clock = RealClock()
    for role, table in scene.instruments.items():
        if isinstance(table, CanSettings):
            if table.interface is None:
                continue
            where = f"{table.interface}:{table.can_channel}"
            found = discover(clock, [], [Bus(table.interface, table.can_channel or "", table.bitrate)])
        else:
            where = getattr(table, "port", None) or ""
            found = discover(clock, [where], []) if where else []
        if any((one.role, one.driver) == (role_of(role), table.driver) for one in found):
            continue
        for one in found:
            if one.role:
                who = f"{one.identity.model} {one.identity.serial}".strip()
                yield (
                    f"On {where}, which the scene names for [{role}], another instrument answers: {one.role}, "
                    f"{one.driver} ({who}). Are two ports swapped? `dea-rig devices` gives the lines for the scene."
                )
