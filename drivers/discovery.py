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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeVar

from drivers.instruments import cia404, gsv8, iseg_edcp, keyence_lkg, shvps, zaber
from drivers.lines import LineSplitter
from drivers.links.can_link import INTERFACES
from drivers.links.link import ByteLink, CanFrame, DeviceError, FrameLink
from drivers.roles import Identity

M = TypeVar("M")
T = TypeVar("T")

ANSWER_S = 0.15
"""Longer than any of these instruments takes, with an adapter's 16 ms each way."""

ANNOUNCE_S = 10.5
"""An iseg module that no host has registered announces itself every 2 to 10 s."""

LOOK_S = 2e-3

NOBODY = Identity()

FACTORY_BITRATE = 125_000
"""Of iseg modules and of most CANopen transducers."""

_ADAPTER = re.compile(rb"\x07*V[0-9A-Fa-f]{4}")

Keys = dict[str, str | int]


class Clock(Protocol):
    """The part of a clock that is needed to wait."""

    def now(self) -> float: ...

    def sleep_until(self, t: float) -> None: ...


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


def _open_port(port: str, baud: int) -> ByteLink:
    from drivers.links.serial_link import SerialLink

    return SerialLink("devices", port, baud)


def _open_bus(bus: Bus) -> FrameLink:
    from drivers.links.can_link import CanLink

    return CanLink("devices", *bus)


# -- serial ports ------------------------------------------------------------------------------------------------------


class _Line:
    """A serial port on which questions are asked."""

    def __init__(self, clock: Clock, port: str, baud: int, link: ByteLink) -> None:
        self.port, self.baud = port, baud
        self._clock = clock
        self._link = link

    def ask(self, data: bytes, feed: Callable[[bytes], Sequence[M]]) -> Iterator[M]:
        """Send ``data`` and give each message that comes within the time for an answer."""
        self._link.write(data)
        end = self._clock.now() + ANSWER_S
        while True:
            yield from feed(self._link.read())
            now = self._clock.now()
            if now >= end:
                return
            self._clock.sleep_until(min(now + LOOK_S, end))


def _on_port(clock: Clock, port: str, open_port: Callable[[str, int], ByteLink]) -> list[Found]:
    at_115200 = (_zaber, _keyence, _adapter, _shvps)
    for baud, probes in ((115_200, at_115200), (230_400, (_gsv8,)), (9_600, (_zaber, _keyence))):
        try:
            link = open_port(port, baud)
            try:
                line = _Line(clock, port, baud, link)
                for probe in probes:
                    if found := probe(line):
                        return found
            finally:
                link.close()
        except DeviceError as error:
            return [Found(port, remark=str(error))]
    return [Found(port)]


def _zaber(line: _Line) -> list[Found]:
    codec = zaber.Codec()
    replies = (m for m in line.ask(zaber.encode(0, 0, 0, ""), codec.feed) if isinstance(m, zaber.Reply))
    found = []
    for device in sorted({reply.device for reply in replies if reply.id == 0}):
        answers = []
        for number, words in enumerate(("get deviceid", "get system.serial", "get version"), start=1):
            expected = (device, 0, number)
            answer = ""
            for message in line.ask(zaber.encode(device, 0, number, words), codec.feed):
                if isinstance(message, zaber.Reply) and (message.device, message.axis, message.id) == expected:
                    answer = message.data if message.accepted else ""
                    break
            answers.append(answer)
        device_id, serial, version = answers
        identity = Identity(f"Zaber device {device_id}".rstrip(), serial, version)
        found.append(_serial_found(line, "stage", "zaber", identity, {"serial": serial, "device": device}))
    return found


def _keyence(line: _Line) -> list[Found]:
    codec = keyence_lkg.Codec()
    for _ in line.ask(b"\r", codec.feed):  # ends what the question before has left in its buffer
        pass
    for message in line.ask(keyence_lkg.encode("M1"), codec.feed):
        measuring = isinstance(message, keyence_lkg.Measured) and message.command == "M1"
        if measuring or message == keyence_lkg.Refused("M1", 1):
            remark = "" if measuring else "It is in communication mode: another program may be using it."
            identity = Identity("Keyence LK-G")
            return [_serial_found(line, "displacement", "keyence-lkg", identity, {"output": 1}, remark)]
    return []


def _adapter(line: _Line) -> list[Found]:
    """An slcan adapter: what is on its bus is asked in CAN frames, at the bit rate of the bus."""
    answers = line.ask(b"V\r", LineSplitter(b"\r", 64, {}).feed)
    if any(_ADAPTER.fullmatch(answer) for answer in answers):
        remark = f"A CAN adapter: --bus slcan:{line.port}@125000 asks on its bus, at the bit rate of the bus."
        return [Found(line.port, remark=remark)]
    return []


def _shvps(line: _Line) -> list[Found]:
    codec = shvps.Codec()

    def answer(question: str) -> str:
        return next(iter(line.ask(shvps.encode(question), codec.feed)), "")

    kind, version = shvps.version_of(answer("QVer"))
    if not version:
        return []
    name, maximum = answer("QName"), answer("QVmax")
    if kind != "slave":
        return [Found(line.port, identity=shvps.identity(name, version), remark="A switchboard, no supply by itself.")]
    remark = f"At most {maximum} V; measures no current." if maximum.isdecimal() else "Measures no current."
    return [_serial_found(line, "hv", "shvps", shvps.identity(name, version), {}, remark)]


def _gsv8(line: _Line) -> list[Found]:
    decoder = gsv8.Decoder()

    def four_bytes(command: int) -> bytes:
        for message in line.ask(gsv8.encode(command), decoder.feed):
            if isinstance(message, gsv8.Reply) and message.error <= 1 and len(message.data) == 4:
                return message.data
        return b""

    serial = four_bytes(gsv8.GET_SERIAL_NUMBER)
    if not serial:
        return []
    identity = gsv8.identity(serial, four_bytes(gsv8.GET_FIRMWARE_VERSION))
    keys: Keys = {"serial": identity.serial, "certificate": FORCE_CERTIFICATE}
    return [_serial_found(line, "force", "gsv8", identity, keys)]


def _serial_found(line: _Line, role: str, driver: str, identity: Identity, keys: Keys, remark: str = "") -> Found:
    place: Keys = {"port": line.port, "baud": line.baud}
    return Found(line.port, role, driver, identity, _lines(role, driver, place | keys), remark)


# -- CAN buses ---------------------------------------------------------------------------------------------------------


class _Network:
    """A CAN bus on which questions are asked."""

    def __init__(self, clock: Clock, link: FrameLink) -> None:
        self._clock = clock
        self._link = link

    def send(self, frame: CanFrame) -> None:
        self._link.write(frame)

    def listen(self, seconds: float) -> Iterator[CanFrame]:
        """Every frame that comes within the time."""
        end = self._clock.now() + seconds
        while (now := self._clock.now()) < end:
            yield from self._link.read()
            self._clock.sleep_until(min(now + LOOK_S, end))

    def ask(self, request: CanFrame, pick: Callable[[CanFrame], T | None]) -> T | None:
        """Send a request; the first answer that ``pick`` recognises."""
        self.send(request)
        return next((answer for frame in self.listen(ANSWER_S) if (answer := pick(frame)) is not None), None)

    def ask_all(self, requests: Sequence[CanFrame]) -> Iterator[CanFrame]:
        """Send all requests, no faster than a bus at 125 kbit/s takes them, and give what comes meanwhile."""
        for request in requests:
            self.send(request)
            yield from self.listen(LOOK_S)
        yield from self.listen(ANSWER_S)


def _on_bus(clock: Clock, bus: Bus, open_bus: Callable[[Bus], FrameLink]) -> list[Found]:
    where = f"{bus.interface}:{bus.channel}"
    try:
        link = open_bus(bus)
        try:
            network = _Network(clock, link)
            nodes = _nodes(network)
            found = [_node_found(network, bus, node, kind) for node, kind in sorted(nodes.items())]
            modules = _modules(network, nodes)
            found += [_module_found(network, bus, module) for module in sorted(modules)]
            if not found:
                found = _announced(network, bus)
        finally:
            link.close()
    except DeviceError as error:
        return [Found(where, remark=str(error))]
    return found or [Found(where)]


def _nodes(network: _Network) -> dict[int, int]:
    """Device type (object 1000h) by CANopen node; 0 where it could not be told."""
    decoders = {node: cia404.Decoder(node) for node in range(1, 128)}
    nodes: dict[int, int] = {}
    for frame in network.ask_all([cia404.upload_request(node, 0x1000, 0) for node in decoders]):
        if frame.id & 0x780 == 0x580 and (node := frame.id & 0x7F):
            match decoders[node].feed(frame):
                case cia404.Uploaded(0x1000, 0, value):
                    nodes[node] = int.from_bytes(value, "little")
                case cia404.Aborted(0x1000, 0):
                    nodes.setdefault(node, 0)
    return nodes


def _node_found(network: _Network, bus: Bus, node: int, kind: int) -> Found:
    where = f"{bus.interface}:{bus.channel}"
    decoder = cia404.Decoder(node)

    def identity_object(sub: int) -> int | None:
        def pick(frame: CanFrame) -> tuple[int | None] | None:
            match decoder.feed(frame):
                case cia404.Uploaded(0x1018, index, value) if index == sub:
                    return (int.from_bytes(value, "little"),)
                case cia404.Aborted(0x1018, index) if index == sub:
                    return (None,)
            return None

        answer = network.ask(cia404.upload_request(node, 0x1018, sub), pick)
        return None if answer is None else answer[0]

    identity = cia404.identity(*[identity_object(sub) for sub in range(1, 5)])
    if kind & 0xFFFF != cia404.PROFILE:
        return Found(where, identity=identity, remark=f"CANopen node {node}, profile {kind & 0xFFFF}: no driver.")
    keys: Keys = {"node": node, "serial": identity.serial, "certificate": FORCE_CERTIFICATE}
    return Found(where, "force", "cia404", identity, _bus_lines("force", "cia404", bus, keys), f"node {node}")


def _modules(network: _Network, nodes: dict[int, int]) -> set[int]:
    """Addresses of the iseg modules that answer."""
    process_data = {base + node for base in (0x200, 0x300) for node in nodes}
    decoders = {module: iseg_edcp.Decoder(module) for module in range(64)}
    requests = [iseg_edcp.read_request(module, iseg_edcp.SERIAL_NUMBER) for module in decoders]
    modules: set[int] = set()
    for frame in network.ask_all([request for request in requests if request.id not in process_data]):
        message = decoders[frame.id >> 3 & 0x3F].feed(frame)
        if isinstance(message, iseg_edcp.Data) and message.item == iseg_edcp.SERIAL_NUMBER:
            modules.add(frame.id >> 3 & 0x3F)
    return modules


def _module_found(network: _Network, bus: Bus, module: int) -> Found:
    decoder = iseg_edcp.Decoder(module)

    def value(item: iseg_edcp.Item) -> iseg_edcp.Value | None:
        def pick(frame: CanFrame) -> iseg_edcp.Data | None:
            message = decoder.feed(frame)
            return message if isinstance(message, iseg_edcp.Data) and message.item == item else None

        data = network.ask(iseg_edcp.read_request(module, item), pick)
        return None if data is None else data.value

    items = (iseg_edcp.SERIAL_NUMBER, iseg_edcp.FIRMWARE_RELEASE, iseg_edcp.FIRMWARE_NAME)
    identity = iseg_edcp.identity(*[value(item) for item in items])
    keys: Keys = {"module": module, "channel": 0, "serial": identity.serial}
    channels = value(iseg_edcp.CHANNEL_COUNT)
    remark = f"module {module}" + (f", {channels} channels" if isinstance(channels, int) and channels > 1 else "")
    where = f"{bus.interface}:{bus.channel}"
    return Found(where, "hv", "iseg-edcp", identity, _bus_lines("hv", "iseg-edcp", bus, keys), remark)


def _announced(network: _Network, bus: Bus) -> list[Found]:
    """Who says something by himself on a bus on which nobody answers: the first of them."""
    decoders = {module: iseg_edcp.Decoder(module) for module in range(64)}
    for frame in network.listen(ANNOUNCE_S):
        module = frame.id >> 3 & 0x3F
        if isinstance(decoders[module].feed(frame), iseg_edcp.LogOn):
            return [_module_found(network, bus, module)]
        if frame.id & 0x780 == 0x700 and len(frame.data) == 1:
            remark = f"CANopen node {frame.id & 0x7F} is heard but answers no question: it may be stopped."
            return [Found(f"{bus.interface}:{bus.channel}", remark=remark)]
    return []


# -- lines for the scene -----------------------------------------------------------------------------------------------

FORCE_CERTIFICATE = "force.toml"
"""What stands in the proposed lines where the file of the sensor's own certificate must be named."""


def _bus_lines(role: str, driver: str, bus: Bus, keys: Keys) -> str:
    place: Keys = {"interface": bus.interface, "can_channel": bus.channel, "bitrate": bus.bitrate}
    return _lines(role, driver, place | keys)


def _lines(role: str, driver: str, keys: Keys) -> str:
    named: Keys = {"driver": driver}
    named |= {key: value for key, value in keys.items() if value != ""}
    # A JSON string is a TOML basic string.
    return "\n".join([f"[{role}]", *(f"{key} = {json.dumps(value)}" for key, value in named.items())])
