"""The high-voltage supply of a scene: its link and its driver. Only what the scene names is imported."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

from drivers.links.link import ByteLink, FrameLink
from drivers.roles import HVSupply
from rig.bench.bench import Tap, TappedByteLink, TappedFrameLink, arguments
from rig.scene.scene import IsegTable, ShvpsTable

ROLE = "hv"

SupplyTable = IsegTable | ShvpsTable
Link = ByteLink | FrameLink


def open_link(table: SupplyTable) -> Link:
    """Open the port or bus; sends nothing to the supply.

    Raises
    ------
    drivers.links.link.DeviceError
        It cannot be opened, or somebody else has it.
    """
    if isinstance(table, IsegTable):
        from drivers.links.can_link import CanLink

        assert table.interface is not None and table.can_channel is not None
        return CanLink(ROLE, table.interface, table.can_channel, table.bitrate)
    from drivers.links.serial_link import SerialLink

    assert table.port is not None
    return SerialLink(ROLE, table.port, table.baud)


def make_driver(table: SupplyTable, link: Link, tap: Tap, when: Callable[[], float]) -> HVSupply:
    """The driver on its link (of the kind that `open_link` gives), with a tap that is told the time by ``when``.

    The first poll sends the first byte.
    """
    if isinstance(table, IsegTable):
        from drivers.instruments.iseg_edcp import IsegEDCP

        return IsegEDCP(ROLE, TappedFrameLink(ROLE, cast(FrameLink, link), tap, when), **arguments(table, IsegEDCP))
    from drivers.instruments.shvps import Shvps

    return Shvps(ROLE, TappedByteLink(ROLE, cast(ByteLink, link), tap, when), **arguments(table, Shvps))
