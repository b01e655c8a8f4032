"""From an instrument's table in a scene to its link and its driver."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

from drivers.links.link import ByteLink, FrameLink
from drivers.registry import instrument
from drivers.roles import Device, HVSupply
from drivers.settings import CanSettings, InstrumentSettings, SupplySettings
from rig.bench.tap import Tap, TappedByteLink, TappedFrameLink

ROLE = "hv"

Link = ByteLink | FrameLink


def make_device(role: str, table: InstrumentSettings, link: Link, tap: Tap, when: Callable[[], float]) -> Device:
    """The driver on its link (of the kind that ``table.open`` gives), with a tap that is told the time by ``when``.

    The first poll sends the first byte.
    """
    tapped: Link
    if isinstance(table, CanSettings):
        tapped = TappedFrameLink(role, cast(FrameLink, link), tap, when)
    else:
        tapped = TappedByteLink(role, cast(ByteLink, link), tap, when)
    return instrument(role, table.driver).make(role, tapped, table)


def make_supply(table: SupplySettings, link: Link, tap: Tap, when: Callable[[], float]) -> HVSupply:
    """As `make_device`, for the high-voltage supply."""
    return cast(HVSupply, make_device(ROLE, table, link, tap, when))
