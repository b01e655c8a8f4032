"""From an instrument's table in a scene to its link and its driver. Only what the scene names is imported."""

from __future__ import annotations

from collections.abc import Callable
from inspect import signature
from typing import Any, cast

from drivers.links.link import ByteLink, FrameLink
from drivers.roles import Device, HVSupply
from rig.bench.tap import Tap, TappedByteLink, TappedFrameLink
from rig.scene.scene import (
    CanTable,
    CiA404Table,
    GSV8Table,
    Instrument,
    IsegTable,
    KeyenceTable,
    ShvpsTable,
    ZaberTable,
)

ROLE = "hv"

SupplyTable = IsegTable | ShvpsTable
Link = ByteLink | FrameLink


def open_link(role: str, table: Instrument) -> Link:
    """Open the port or bus; sends nothing.

    Raises
    ------
    drivers.links.link.DeviceError
        It cannot be opened, or somebody else has it.
    """
    if isinstance(table, CanTable):
        from drivers.links.can_link import CanLink

        assert table.interface is not None and table.can_channel is not None
        return CanLink(role, table.interface, table.can_channel, table.bitrate)
    from drivers.links.serial_link import SerialLink

    assert table.port is not None
    return SerialLink(role, table.port, table.baud)


def make_device(role: str, table: Instrument, link: Link, tap: Tap, when: Callable[[], float]) -> Device:
    """The driver on its link (of the kind that `open_link` gives), with a tap that is told the time by ``when``.

    The first poll sends the first byte.
    """
    if isinstance(table, CanTable):
        frames = TappedFrameLink(role, cast(FrameLink, link), tap, when)
    else:
        serial = TappedByteLink(role, cast(ByteLink, link), tap, when)
    match table:
        case ZaberTable():
            from drivers.instruments.zaber import ZaberStage

            return ZaberStage(role, serial, **arguments(table, ZaberStage))
        case GSV8Table():
            from drivers.instruments.gsv8 import GSV8

            return GSV8(role, serial, **arguments(table, GSV8))
        case CiA404Table():
            from drivers.instruments.cia404 import CiA404

            return CiA404(role, frames, **arguments(table, CiA404))
        case KeyenceTable():
            from drivers.instruments.keyence_lkg import KeyenceLKG

            return KeyenceLKG(role, serial, **arguments(table, KeyenceLKG))
        case IsegTable():
            from drivers.instruments.iseg_edcp import IsegEDCP

            return IsegEDCP(role, frames, **arguments(table, IsegEDCP))
        case ShvpsTable():
            from drivers.instruments.shvps import Shvps

            return Shvps(role, serial, **arguments(table, Shvps))


def make_supply(table: SupplyTable, link: Link, tap: Tap, when: Callable[[], float]) -> HVSupply:
    """As `make_device`, for the high-voltage supply."""
    return cast(HVSupply, make_device(ROLE, table, link, tap, when))


def arguments(table: Instrument, driver: type[Device]) -> dict[str, Any]:
    """What a scene says to a driver: the keys that are named like its arguments."""
    return table.model_dump(include=set(signature(driver).parameters))
