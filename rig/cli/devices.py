"""``dea-rig devices``: who answers on which port and bus, and the lines for the scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from rich.console import RenderableType

    from drivers.discovery import Found


@click.command("devices")
@click.option("--port", "ports", multiple=True, help="Ask on this serial port only.")
@click.option("--bus", "buses", multiple=True, metavar="INTERFACE:CHANNEL[@BITRATE]", help="Ask on this CAN bus only.")
def command(ports: tuple[str, ...], buses: tuple[str, ...]) -> None:
    """List who answers on which port and bus, and propose the lines for a scene. Sends only questions."""
    from drivers.discovery import Bus, discover
    from rig.base.clock import RealClock
    from rig.cli.show import show

    try:
        named = [Bus.parse(text) for text in buses]
    except ValueError as error:
        raise click.BadParameter(f"{error}.", param_hint="--bus") from None
    everywhere = not (ports or buses)
    found = discover(RealClock(), None if everywhere else ports, None if everywhere else named)
    show(*devices_table(found))
    if not everywhere and not all(one.role for one in found):
        click.get_current_context().exit(1)


def devices_table(found: Sequence[Found]) -> list[RenderableType]:
    """Who answers where, and below it the lines that name them in a scene."""
    from rich.table import Table
    from rich.text import Text

    if not found:
        return ["The system names no serial port and no CAN channel. Name one with --port or --bus."]
    table = Table(title="Ports and buses")
    for heading in ("where", "role", "driver", "model", "serial number", "firmware", "remark"):
        table.add_column(heading, overflow="fold")
    for one in found:
        who = one.identity
        table.add_row(one.where, one.role, one.driver, who.model, who.serial, who.firmware, one.remark)
    lines: list[RenderableType] = [Text(one.scene) for one in found if one.scene]
    return [table, *(["For the scene:", *lines] if lines else [])]
