"""Which ports and buses this machine has, and which instruments answer on them.

Only questions are sent, never a command. To a serial port, at the baud rates that these instruments come with: a Zaber
status poll, ``M1`` of the Keyence LK-G, ``V`` of slcan adapters, ``QVer`` of the shvps and the GSV-8's request for its
serial number. To a CAN bus: reads of object 1000h of all CANopen nodes, then reads of the serial number of each iseg
module, except where that identifier would be process data of a node that has answered. If nobody answers, the bus is
listened to for those who announce themselves. An instrument of another kind gets the same bytes and may take them for
something else, so name the ports if there is one.

Asking takes a second or two for a port on which nobody answers, up to twelve for a bus. A bus is asked at one bit rate
only: at a wrong one our frames would disturb all others.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from drivers.instrument import Instrument
from drivers.lines import LineSplitter
from drivers.links.can_link import INTERFACES
from drivers.links.link import ByteLink, DeviceError, FrameLink
from drivers.links.slcan_link import is_version
from drivers.probe import Answered, BusProbe, Clock, Keys, Line, Network, SerialProbe
from drivers.registry import registered
from drivers.roles import Identity

ANNOUNCE_S = 10.5
"""An iseg module that no host has registered announces itself every 2 to 10 s."""

NOBODY = Identity()

FACTORY_BITRATE = 125_000
"""Of iseg modules and of most CANopen transducers."""


class Bus(NamedTuple):
    """A CAN interface to ask: as in the tables of a scene."""

    interface: str
    channel: str
    bitrate: int = FACTORY_BITRATE

    @classmethod
    def parse(cls, text: str) -> Bus:
        """From ``INTERFACE:CHANNEL`` or ``INTERFACE:CHANNEL@BITRATE``. Raises ValueError saying what is allowed."""
        interface, _, rest = text.partition(":")
        channel, at, rate = rest.rpartition("@") if "@" in rest else (rest, "", "")
        if interface not in INTERFACES:
            raise ValueError(f"{interface!r} is no CAN interface; there are {', '.join(INTERFACES)}")
        if not channel:
            raise ValueError(f"{text!r} names no channel; e.g. slcan:/dev/ttyACM0 or slcan:/dev/ttyACM0@250000")
        if not at:
            return cls(interface, channel)
        if not re.fullmatch(r"[1-9][0-9]{3,6}", rate):
            raise ValueError(f"{rate!r} is no bit rate; e.g. 125000 or 250000")
        return cls(interface, channel, int(rate))


@dataclass(frozen=True, slots=True)
class Found:
    """What is on a port or bus.

    ``role`` and ``driver`` are empty when nobody answers; ``remark`` says then why nobody could be asked, if so.
    ``scene`` holds the lines that name the instrument in a scene.
    """

    where: str
    role: str = ""
    driver: str = ""
    identity: Identity = NOBODY
    scene: str = ""
    remark: str = ""


def discover(
    clock: Clock,
    ports: Sequence[str] | None = None,
    buses: Sequence[Bus] | None = None,
    *,
    open_port: Callable[[str, int], ByteLink] | None = None,
    open_bus: Callable[[Bus], FrameLink] | None = None,
) -> list[Found]:
    """Ask on every port and bus who is there.

    Parameters
    ----------
    clock : Clock
        To wait for answers.
    ports : sequence of str, optional
        Serial ports; all that the machine has if it is left out.
    buses : sequence of Bus, optional
        CAN interfaces. If left out, those that the system can name: socketcan's are asked, since their bit rate is
        set; the others are only listed.
    open_port, open_bus : callable, optional
        Open a link to a port at a baud rate, and to a bus; real ones if left out.

    Returns
    -------
    list of Found
        At least one for each port and bus.
    """
    found: list[Found] = []
    if ports is None:
        from drivers.links.serial_link import ports as existing_ports

        ports = existing_ports()
    if buses is None:
        from drivers.links.can_link import channels

        known = [Bus(interface, channel) for interface, channel in channels()]
        buses = [bus for bus in known if bus.interface == "socketcan"]
        for bus in known:
            if bus not in buses:
                where = f"{bus.interface}:{bus.channel}"
                found.append(Found(where, remark=f"Not asked, its bit rate is not known: --bus {where}@125000 asks."))
    for port in ports:
        found += _on_port(clock, port, open_port or _open_port)
    for bus in buses:
        found += _on_bus(clock, bus, open_bus or _open_bus)
    return found


def renumber(clock: Clock, port: str, *, open_port: Callable[[str, int], ByteLink] | None = None) -> list[Found]:
    """Give each instrument on a serial line an address of its own, and ask who is there now.

    Nothing moves. Scenes that name the old addresses are wrong afterwards.

    Raises
    ------
    DeviceError
        Nobody there can be given an address, or the port cannot be opened.
    """
    opening = open_port or _open_port
    for _, probe in _serial_probes():
        for baud in probe.bauds if probe.renumber is not None else ():
            link = opening(port, baud)
            try:
                assert probe.renumber is not None
                done = probe.renumber(Line(clock, port, baud, link))
            finally:
                link.close()
            if done:
                return _on_port(clock, port, opening)
    raise DeviceError(port, "nobody answers there who can be given an address", "Ask who is there with --port.")


def _open_port(port: str, baud: int) -> ByteLink:
    from drivers.links.device_server import open_line

    return open_line("devices", port, baud)


def _open_bus(bus: Bus) -> FrameLink:
    from drivers.links.can_link import open_bus

    return open_bus("devices", *bus)


# -- serial ports ------------------------------------------------------------------------------------------------------


def _adapter(line: Line) -> list[Answered]:
    """An slcan adapter: what is on its bus is asked in CAN frames, at the bit rate of the bus."""
    answers = line.ask(b"V\r", LineSplitter(b"\r", 64, {}).feed)
    if any(is_version(answer.lstrip(b"\x07")) for answer in answers):
        remark = f"A CAN adapter: --bus slcan:{line.port}@125000 asks on its bus, at the bit rate of the bus."
        return [Answered(Identity(), {}, remark, usable=False)]
    return []


def _serial_probes() -> list[tuple[Instrument | None, SerialProbe]]:
    """The questions for serial ports, in the order in which they are asked; None for the CAN adapter."""
    probes: list[tuple[Instrument | None, SerialProbe]] = [(None, SerialProbe(_adapter, order=30))]
    probes += [(one, one.probe) for one in registered().instruments.values() if isinstance(one.probe, SerialProbe)]
    return sorted(probes, key=lambda pair: pair[1].order)


def _on_port(clock: Clock, port: str, open_port: Callable[[str, int], ByteLink]) -> list[Found]:
    probes = _serial_probes()
    uses = Counter(baud for _, probe in probes for baud in probe.bauds)
    for baud, _ in uses.most_common():
        try:
            link = open_port(port, baud)
            try:
                line = Line(clock, port, baud, link)
                for instrument, probe in probes:
                    if baud in probe.bauds and (answered := probe.ask(line)):
                        return [_found(port, instrument, one, {"port": port, "baud": baud}) for one in answered]
            finally:
                link.close()
        except DeviceError as error:
            return [Found(port, remark=str(error))]
    return [Found(port)]


# -- CAN buses ---------------------------------------------------------------------------------------------------------


def _bus_probes() -> list[tuple[Instrument, BusProbe]]:
    probes = [(one, one.probe) for one in registered().instruments.values() if isinstance(one.probe, BusProbe)]
    return sorted(probes, key=lambda pair: pair[1].order)


def _on_bus(clock: Clock, bus: Bus, open_bus: Callable[[Bus], FrameLink]) -> list[Found]:
    where = f"{bus.interface}:{bus.channel}"
    place: Keys = {"interface": bus.interface, "can_channel": bus.channel, "bitrate": bus.bitrate}
    try:
        link = open_bus(bus)
        try:
            network = Network(clock, link)
            answered = [(one, answer) for one, probe in _bus_probes() for answer in probe.ask(network)]
            if not answered:
                answered = _announced(network)
        finally:
            link.close()
    except DeviceError as error:
        return [Found(where, remark=str(error))]
    return [_found(where, instrument, one, place) for instrument, one in answered] or [Found(where)]


def _announced(network: Network) -> list[tuple[Instrument, Answered]]:
    """Who says something by itself on a bus on which nobody answers: the first of them."""
    for frame in network.listen(ANNOUNCE_S):
        for instrument, probe in _bus_probes():
            if (heard := probe.hear(network, frame)) is not None:
                return [(instrument, heard)]
    return []


# -- lines for the scene -----------------------------------------------------------------------------------------------


def _found(where: str, instrument: Instrument | None, one: Answered, place: Keys) -> Found:
    if instrument is None or not one.usable:
        return Found(where, identity=one.identity, remark=one.remark)
    role, driver = instrument.role, instrument.driver
    return Found(where, role, driver, one.identity, _lines(role, driver, place | one.keys), one.remark)


def _lines(role: str, driver: str, keys: Keys) -> str:
    named: Keys = {"driver": driver}
    named |= {key: value for key, value in keys.items() if value != ""}
    # A JSON string is a TOML basic string.
    return "\n".join([f"[{role}]", *(f"{key} = {json.dumps(value)}" for key, value in named.items())])
