"""Which ports and buses this machine has, and which instruments answer on them.

Only questions are sent, never a command: to a serial port a Zaber status poll, ``M1`` of the Keyence LK-G, and the
GSV-8's request for its serial number, at the baud rates that these instruments come with; to a CAN bus read requests
for the serial number of each iseg module, after which it is listened for modules that announce themselves. An
instrument of another kind gets the same bytes and may take them for something else, so name the ports if there is one.

Asking takes a second or two for a port on which nobody answers, up to ten more for a bus.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeVar

from drivers import gsv8, iseg_edcp, keyence_lkg, zaber
from drivers.link import ByteLink, CanFrame, DeviceError, FrameLink
from drivers.roles import Identity

M = TypeVar("M")

ANSWER_S = 0.15
"""Longer than any of these instruments takes, with an adapter's 16 ms each way."""

ANNOUNCE_S = 10.5
"""An iseg module that no host has registered announces itself every 2 to 10 s."""

LOOK_S = 2e-3

NOBODY = Identity()

Keys = dict[str, str | int]


class Clock(Protocol):
    """The part of a clock that is needed to wait."""

    def now(self) -> float: ...

    def sleep_until(self, t: float) -> None: ...


class Bus(NamedTuple):
    """A CAN interface to ask: as in the ``[hv]`` table of a scene."""

    interface: str
    channel: str
    bitrate: int = 125_000


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
    buses: Sequence[Bus] = (),
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
    buses : sequence of Bus
        CAN interfaces; which ones there are cannot be found out on every system.
    open_port, open_bus : callable, optional
        Open a link to a port at a baud rate, and to a bus; real ones if left out.

    Returns
    -------
    list of Found
        At least one for each port and bus.
    """
    if ports is None:
        from drivers.serial_link import ports as existing

        ports = existing()
    found: list[Found] = []
    for port in ports:
        found += _on_port(clock, port, open_port or _open_port)
    for bus in buses:
        found += _on_bus(clock, bus, open_bus or _open_bus)
    return found


def _open_port(port: str, baud: int) -> ByteLink:
    from drivers.serial_link import SerialLink

    return SerialLink("devices", port, baud)


def _open_bus(bus: Bus) -> FrameLink:
    from drivers.can_link import CanLink

    return CanLink("devices", *bus)


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
    for baud, probes in ((115_200, (_zaber, _keyence)), (230_400, (_gsv8,)), (9_600, (_zaber, _keyence))):
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


def _gsv8(line: _Line) -> list[Found]:
    decoder = gsv8.Decoder()
    serial, version = "", ""
    for message in line.ask(gsv8.encode(gsv8.GET_SERIAL_NUMBER), decoder.feed):
        if isinstance(message, gsv8.Reply) and message.error <= 1 and len(message.data) == 4:
            serial = str(int.from_bytes(message.data, "big"))
            break
    if not serial:
        return []
    for message in line.ask(gsv8.encode(gsv8.GET_FIRMWARE_VERSION), decoder.feed):
        if isinstance(message, gsv8.Reply) and message.error <= 1 and len(message.data) == 4:
            version = ".".join(str(int.from_bytes(message.data[at : at + 2], "big")) for at in (0, 2))
            break
    keys: Keys = {"serial": serial, "certificate": "the force sensor's certificate.toml"}
    return [_serial_found(line, "force", "gsv8", Identity("GSV-8", serial, version), keys)]


def _on_bus(clock: Clock, bus: Bus, open_bus: Callable[[Bus], FrameLink]) -> list[Found]:
    where = f"{bus.interface}:{bus.channel}"
    try:
        link = open_bus(bus)
        try:
            modules = _iseg_modules(clock, link)
        finally:
            link.close()
    except DeviceError as error:
        return [Found(where, remark=str(error))]
    found = []
    for module, serial in sorted(modules.items()):
        keys: Keys = {
            "interface": bus.interface,
            "can_channel": bus.channel,
            "bitrate": bus.bitrate,
            "module": module,
            "serial": serial,
        }
        scene = _lines("hv", "iseg-edcp", keys)
        found.append(Found(where, "hv", "iseg-edcp", Identity(f"iseg EDCP, module {module}", serial), scene))
    return found or [Found(where)]


def _iseg_modules(clock: Clock, link: FrameLink) -> dict[int, str]:
    """Serial numbers by module address; empty for a module that announces itself and does not answer."""
    decoders = {module: iseg_edcp.Decoder(module) for module in range(64)}
    modules: dict[int, str] = {}

    def listen(seconds: float) -> Iterator[int]:
        end = clock.now() + seconds
        while (now := clock.now()) < end:
            for frame in link.read():
                module = _hear(decoders, frame, modules)
                if module is not None:
                    yield module
            clock.sleep_until(min(now + LOOK_S, end))

    for module in decoders:
        link.write(iseg_edcp.read_request(module, iseg_edcp.SERIAL_NUMBER))
        list(listen(LOOK_S))  # a frame takes 1 ms at 125 kbit/s
    list(listen(ANSWER_S))
    if not modules:
        for module in listen(ANNOUNCE_S):
            link.write(iseg_edcp.read_request(module, iseg_edcp.SERIAL_NUMBER))
            list(listen(ANSWER_S))
            break
    return modules


def _hear(decoders: dict[int, iseg_edcp.Decoder], frame: CanFrame, modules: dict[int, str]) -> int | None:
    """The module that a frame comes from, noted in ``modules``; None when it is none of an iseg module."""
    module = frame.id >> 3 & 0x3F
    message = decoders[module].feed(frame)
    if isinstance(message, iseg_edcp.LogOn):
        modules.setdefault(module, "")
        return module
    if isinstance(message, iseg_edcp.Data) and message.item == iseg_edcp.SERIAL_NUMBER:
        modules[module] = f"{message.value:d}" if isinstance(message.value, int) else ""
        return module
    return None


def _serial_found(line: _Line, role: str, driver: str, identity: Identity, keys: Keys, remark: str = "") -> Found:
    place: Keys = {"port": line.port, "baud": line.baud}
    return Found(line.port, role, driver, identity, _lines(role, driver, place | keys), remark)


def _lines(role: str, driver: str, keys: Keys) -> str:
    named: Keys = {"driver": driver}
    named |= {key: value for key, value in keys.items() if value != ""}
    # A JSON string is a TOML basic string.
    return "\n".join([f"[{role}]", *(f"{key} = {json.dumps(value)}" for key, value in named.items())])
