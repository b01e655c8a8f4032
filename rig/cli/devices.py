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
@click.option(
    "--renumber",
    metavar="PORT",
    help="Give each device on this serial line an address of its own; asks before. Scenes name addresses.",
)
@click.option("--yes", is_flag=True, help="Renumber without asking.")
def command(ports: tuple[str, ...], buses: tuple[str, ...], renumber: str | None, yes: bool) -> None:
    """List who answers on which port and bus, and propose the lines for a scene. Sends only questions.

    With --renumber the devices on one line get new addresses: for two that answer to the same one.
    """
    from drivers.discovery import Bus, discover
    from rig.base.clock import RealClock
    from rig.cli.show import show

    if renumber is not None:
        show(*devices_table(_renumbered(renumber, yes)))
        return
    try:
        named = [Bus.parse(text) for text in buses]
    except ValueError as error:
        raise click.BadParameter(f"{error}.", param_hint="--bus") from None
    everywhere = not (ports or buses)
    found = discover(RealClock(), None if everywhere else ports, None if everywhere else named)
    show(*devices_table(found))
    if not everywhere and not all(one.role for one in found):
        click.get_current_context().exit(1)


def _renumbered(port: str, yes: bool) -> list[Found]:
    from drivers.discovery import renumber
    from drivers.links.link import DeviceError
    from rig.base.clock import RealClock
    from rig.base.errors import ConfigError

    if not yes:
        click.confirm(f"Give all devices on {port} new addresses? Nothing moves; scenes name addresses", abort=True)
    try:
        return renumber(RealClock(), port)
    except DeviceError as error:
        raise ConfigError(str(error)) from None


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
