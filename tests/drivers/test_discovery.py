"""Discovery against scripted ports and buses: who answers, what is proposed, and that nothing is commanded."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from typing import ClassVar

import pytest

from drivers.discovery import Bus, Found, discover
from drivers.links import can_link
from drivers.links.link import ByteLink, CanFrame, DeviceError, DeviceLost
from drivers.roles import Identity


class Clock:
    def __init__(self) -> None:
        self.t = 0.0

    def now(self) -> float:
        return self.t

    def sleep_until(self, t: float) -> None:
        assert t > self.t
        self.t = t


class Port:
    """A port at which ``device(data)`` gives the answer; at another baud rate nothing is understood."""

    name = "port"

    def __init__(self, device: Callable[[bytes], bytes], noise: bytes = b"") -> None:
        self.device, self.noise = device, noise
        self.sent: list[bytes] = []
        self.out = b""
        self.open = True

    def read(self) -> bytes:
        out, self.out = self.noise + self.out, b""
        return out

    def write(self, data: bytes) -> None:
        assert self.open
        self.sent.append(data)
        self.out += self.device(data)

    def close(self) -> None:
        self.open = False


def checked(text: str) -> bytes:
    return f"{text}:{(256 - sum(text[1:].encode())) % 256:02X}\r\n".encode()


def stage(*addresses: int) -> Callable[[bytes], bytes]:
    """Zaber devices on one line."""
    values = {"get deviceid": "50081", "get system.serial": "123{:02d}", "get version": "7.14"}

    def answer(data: bytes) -> bytes:
        if not data.startswith(b"/"):
            return b""
        device, axis, number, *words = data.decode()[1:].partition(":")[0].split()
        asked = [a for a in addresses if device in ("0", str(a))]
        value = values.get(" ".join(words), "0")
        return b"".join(checked(f"@{a:02d} {axis} {number} OK IDLE WR {value.format(a)}") for a in asked)

    return answer


class Laser:
    def __init__(self, answer: bytes = b"M1,+01.2345\r") -> None:
        self.buffer = b""
        self.answer = answer

    def __call__(self, data: bytes) -> bytes:
        self.buffer += data
        *commands, self.buffer = self.buffer.split(b"\r")
        return b"".join(self.answer if c == b"M1" else b"ER,%s,00\r" % c[:2] for c in commands)


def amplifier(data: bytes) -> bytes:
    return {
        b"\xaa\x90\x1f\x85": bytes.fromhex("AA54 00 00D8D264 85"),
        b"\xaa\x90\x2b\x85": b"\xaa\x54\x00\0\1\0\2\x85",
    }.get(data, b"")


class Supply:
    """An shvps: a line for each line."""

    answers: ClassVar = {b"QVer": b"slave 8", b"QName": b"HVPS 7", b"QVmax": b"5000"}

    def __init__(self, version: bytes = b"slave 8") -> None:
        self.buffer = b""
        self.version = version

    def __call__(self, data: bytes) -> bytes:
        self.buffer += data
        *commands, self.buffer = self.buffer.split(b"\r")
        known = self.answers | {b"QVer": self.version}
        return b"".join(known.get(c.strip(), b"Err") + b"\r\n" for c in commands if c)


class Adapter:
    """An slcan adapter: BEL for what it does not know."""

    def __init__(self, version: bytes = b"V1013") -> None:
        self.buffer, self.version = b"", version

    def __call__(self, data: bytes) -> bytes:
        self.buffer += data
        *commands, self.buffer = self.buffer.split(b"\r")
        return b"".join({b"": b"\r", b"V": self.version + b"\r"}.get(c.strip(), b"\x07") for c in commands)


def nobody(data: bytes) -> bytes:
    return b""


def look(device: Callable[[bytes], bytes], baud: int = 115_200, noise: bytes = b"") -> tuple[list[Found], list[Port]]:
    opened: list[Port] = []

    def open_port(port: str, at: int) -> ByteLink:
        assert all(not p.open for p in opened)
        opened.append(Port(device, noise) if at == baud else Port(nobody))
        return opened[-1]

    return discover(Clock(), ["/dev/ttyUSB0"], open_port=open_port), opened


def test_stage() -> None:
    found, opened = look(stage(1))
    assert found == [
        Found(
            "/dev/ttyUSB0",
            "stage",
            "zaber",
            Identity("Zaber device 50081", "12301", "7.14"),
            '[stage]\ndriver = "zaber"\nport = "/dev/ttyUSB0"\nbaud = 115200\nserial = "12301"\ndevice = 1',
        )
    ]
    assert not any(port.open for port in opened)


def test_two_stages_on_one_line() -> None:
    found, _ = look(stage(1, 3))
    assert [f.identity.serial for f in found] == ["12301", "12303"]
    assert [tomllib.loads(f.scene)["stage"]["device"] for f in found] == [1, 3]


def test_stage_at_the_slow_rate() -> None:
    found, _ = look(stage(1), baud=9_600)
    assert tomllib.loads(found[0].scene)["stage"]["baud"] == 9_600


@pytest.mark.parametrize(
    ("answer", "remark"),
    [
        (b"M1,+01.2345\r", False),
        (b"M1,+FFFFFFF\r", False),
        (b"M1,XXXXXXXX\r", False),
        (b"TG,1,+00.0000\rM1,-00001.2\r\n", False),
        (b"ER,M1,01\r", True),
    ],
)
def test_laser(answer: bytes, remark: bool) -> None:
    found, _ = look(Laser(answer))
    assert [(f.role, f.driver, bool(f.remark)) for f in found] == [("displacement", "keyence-lkg", remark)]
    assert tomllib.loads(found[0].scene)["displacement"]["output"] == 1


@pytest.mark.parametrize("noise", [b"", bytes.fromhex("AA10B03F80000085") * 4 + b"\xaa\x85"])
def test_amplifier_also_while_it_streams(noise: bytes) -> None:
    found, _ = look(amplifier, baud=230_400, noise=noise)
    assert [(f.role, f.driver) for f in found] == [("force", "gsv8")]
    assert found[0].identity == Identity("GSV-8", "14209636", "1.2")
    assert tomllib.loads(found[0].scene)["force"]["serial"] == "14209636"


def test_serial_supply() -> None:
    found, opened = look(Supply())
    assert found == [
        Found(
            "/dev/ttyUSB0",
            "hv",
            "shvps",
            Identity("shvps HVPS 7", "", "8"),
            '[hv]\ndriver = "shvps"\nport = "/dev/ttyUSB0"\nbaud = 115200',
            "At most 5000 V; measures no current.",
        )
    ]
    assert not any(port.open for port in opened)


def test_a_switchboard_is_named_and_not_proposed_as_a_supply() -> None:
    (found,), _ = look(Supply(b"master 8"))
    assert (found.role, found.scene) == ("", "") and "switchboard" in found.remark


@pytest.mark.parametrize("version", [b"V1013", b"ba6b1dd github.com/normaldotcom/canable-fw.git", b"+Board: X\tMCU: Y"])
def test_a_can_adapter_is_known_and_says_how_its_bus_is_asked(version: bytes) -> None:
    (found,), _ = look(Adapter(version))
    assert found.role == "" and "--bus slcan:/dev/ttyUSB0@125000" in found.remark


def test_nobody_takes_little_time() -> None:
    clock = Clock()
    found = discover(clock, ["COM3"], open_port=lambda port, baud: Port(nobody))
    assert found == [Found("COM3")]
    assert clock.t < 2.5


def test_noise_is_nobody() -> None:
    found, _ = look(nobody, noise=b"@01 0 00 OK IDLE WR 0:00\r\n\xffM1,+1e5.000\r\xaa\x54\x01abc\x85")
    assert found == [Found("/dev/ttyUSB0")]


def test_only_questions_are_sent() -> None:
    for device in (nobody, stage(1), Laser(), amplifier, Supply(), Adapter()):
        for baud in (115_200, 230_400, 9_600):
            _, opened = look(device, baud)
            for data in (data for port in opened for data in port.sent):
                text = data.decode("latin-1")
                question = text.startswith("/") and (" get " in text or text.split(":")[0] == "/0 0 00")
                question |= data in (b"\r", b"M1\r", b"V\r", b"QVer\r", b"QName\r", b"QVmax\r")
                assert question or data in (b"\xaa\x90\x1f\x85", b"\xaa\x90\x2b\x85")


def test_port_that_cannot_be_opened_or_vanishes_is_told_and_the_next_one_asked() -> None:
    def open_port(port: str, baud: int) -> ByteLink:
        if port == "COM1":
            raise DeviceError("devices (COM1)", "port COM1 is in use by process 7")
        if port == "COM2":
            return Port(vanished)
        return Port(stage(1))

    def vanished(data: bytes) -> bytes:
        raise DeviceLost("devices (COM2)", "the port is gone")

    found = discover(Clock(), ["COM1", "COM2", "COM3"], open_port=open_port)
    assert [(f.where, f.role) for f in found] == [("COM1", ""), ("COM2", ""), ("COM3", "stage")]
    assert found[0].remark == "devices (COM1): port COM1 is in use by process 7."
    assert "gone" in found[1].remark


class CanBus:
    """iseg modules by address; ``quiet`` ones answer nothing and only announce themselves every 5 s.

    CANopen ``nodes`` with their device types, which state vendor 15Fh, product 2Ah, revision 1.4 and their number
    times 1000; ``stopped`` ones only send a heartbeat.
    """

    name = "bus"

    def __init__(
        self,
        clock: Clock,
        serials: dict[int, int],
        quiet: tuple[int, ...] = (),
        nodes: dict[int, int] | None = None,
        stopped: tuple[int, ...] = (),
    ) -> None:
        self.clock, self.serials, self.quiet, self.stopped = clock, serials, quiet, stopped
        self.nodes = nodes or {}
        self.sent: list[CanFrame] = []
        self.out: list[CanFrame] = []
        self.announced = 0
        self.open = True

    def read(self) -> list[CanFrame]:
        if self.clock.t > 5 * (self.announced + 1):
            self.announced += 1
            self.out += [CanFrame(0x201 | m << 3, b"\xd8\x80\x01") for m in self.quiet]
            self.out += [CanFrame(0x700 + n, b"\x04") for n in self.stopped]
        out, self.out = self.out, []
        return out

    def write(self, frame: CanFrame, *, urgent: bool = False) -> None:
        self.sent.append(frame)
        if frame.id & 0x780 == 0x600:
            return self.sdo(frame.id & 0x7F, frame.data)
        module = frame.id >> 3 & 0x3F
        if module not in self.serials or not frame.id & 1:
            return None
        values = {
            b"\x12\x00": self.serials[module].to_bytes(4, "big"),
            b"\x12\x01": bytes((0, 4, 2, 1)),
            b"\x12\x03": b"E16D",
            b"\x12\x08": b"\x02",
        }
        if frame.data in values:
            self.out.append(CanFrame(0x200 | module << 3, frame.data + values[frame.data]))
        return None

    def sdo(self, node: int, data: bytes) -> None:
        if node not in self.nodes:
            return
        index, sub = int.from_bytes(data[1:3], "little"), data[3]
        value = {(0x1000, 0): self.nodes[node], (0x1018, 1): 0x15F, (0x1018, 2): 0x2A, (0x1018, 3): 0x10004}.get(
            (index, sub), 1000 * node
        )
        self.out.append(CanFrame(0x580 + node, b"\x43" + data[1:4] + value.to_bytes(4, "little")))

    def close(self) -> None:
        self.open = False


def is_question(frame: CanFrame) -> bool:
    """An SDO upload, or a read of an iseg module's item: its identifier has the direction bit set."""
    if frame.id & 0x780 == 0x600:
        return frame.data[0] == 0x40
    return bool(frame.id & 1) and frame.data[0] == 0x12 and len(frame.data) == 2


@pytest.mark.parametrize(
    ("serials", "quiet", "expected"),
    [
        ({0: 484216, 5: 99}, (), {0: "484216", 5: "99"}),
        ({}, (3,), {3: ""}),
    ],
)
def test_supplies(serials: dict[int, int], quiet: tuple[int, ...], expected: dict[int, str]) -> None:
    clock = Clock()
    bus = CanBus(clock, serials, quiet)
    found = discover(clock, [], [Bus("socketcan", "can0")], open_bus=lambda _: bus)
    for f, (module, serial) in zip(found, expected.items(), strict=True):
        who = Identity("iseg E16D", serial, "0.4.2.1") if serial else Identity("iseg EDCP")
        assert (f.where, f.role, f.driver, f.identity) == ("socketcan:can0", "hv", "iseg-edcp", who)
        assert f.remark == f"module {module}" + (", 2 channels" if serial else "")
        keys = {"driver": "iseg-edcp", "interface": "socketcan", "can_channel": "can0", "bitrate": 125000}
        keys |= {"module": module, "channel": 0}
        assert tomllib.loads(f.scene)["hv"] == keys | ({"serial": serial} if serial else {})
    assert all(is_question(frame) for frame in bus.sent) and not bus.open


def test_load_cells_on_can() -> None:
    clock = Clock()
    bus = CanBus(clock, {}, nodes={5: 0x00020194, 77: 0x00020194, 9: 0x00020192})
    found = discover(clock, [], [Bus("slcan", "COM9", 250_000)], open_bus=lambda _: bus)
    assert [f.role for f in found] == ["force", "", "force"]
    assert found[0].identity == Identity("CiA 404 vendor 15F product 2A", "5000", "1.4")
    assert tomllib.loads(found[2].scene)["force"] == {
        "driver": "cia404",
        "interface": "slcan",
        "can_channel": "COM9",
        "bitrate": 250_000,
        "node": 77,
        "serial": "77000",
        "certificate": "force.toml",
    }
    assert found[1].scene == "" and "node 9, profile 402: no driver" in found[1].remark
    assert all(is_question(frame) for frame in bus.sent) and not bus.open


def test_load_cell_and_supply_on_one_bus() -> None:
    clock = Clock()
    bus = CanBus(clock, {3: 484216}, nodes={5: 0x00020194})
    found = discover(clock, [], [Bus("socketcan", "can0")], open_bus=lambda _: bus)
    assert [(f.role, f.identity.serial) for f in found] == [("force", "5000"), ("hv", "484216")]


def test_no_question_to_a_supply_is_process_data_of_a_node_that_is_there() -> None:
    """201h asks iseg module 0 and is the first receive PDO of CANopen node 1: a drive would move."""
    clock = Clock()
    bus = CanBus(clock, {}, nodes={1: 0x00020192, 9: 0x00020194})
    discover(clock, [], [Bus("socketcan", "can0")], open_bus=lambda _: bus)
    sent = {frame.id for frame in bus.sent}
    assert not sent & {0x201, 0x301, 0x209, 0x309} and {0x211, 0x311} <= sent


def test_a_node_that_is_stopped_is_told() -> None:
    clock = Clock()
    bus = CanBus(clock, {}, stopped=(12,))
    (found,) = discover(clock, [], [Bus("socketcan", "can0")], open_bus=lambda _: bus)
    assert found.role == "" and "node 12 is heard" in found.remark


@pytest.mark.parametrize(
    ("text", "bus"),
    [
        ("slcan:/dev/ttyACM0", Bus("slcan", "/dev/ttyACM0", 125_000)),
        ("slcan:/dev/ttyACM0@250000", Bus("slcan", "/dev/ttyACM0", 250_000)),
        ("slcan:COM7@115200@500000", Bus("slcan", "COM7@115200", 500_000)),
        ("udp_multicast:ff15::1", Bus("udp_multicast", "ff15::1", 125_000)),
    ],
)
def test_a_bus_as_it_is_named(text: str, bus: Bus) -> None:
    assert Bus.parse(text) == bus


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no CAN interface"),
        ("usb:0", "there are socketcan, slcan"),
        ("slcan", "names no channel"),
        ("slcan:@125000", "names no channel"),
        ("slcan:COM1@", "no bit rate"),
        ("slcan:COM1@fast", "no bit rate"),
        ("slcan:COM1@-1", "no bit rate"),
    ],
)
def test_a_bus_that_cannot_be(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Bus.parse(text)


def test_without_names_the_systems_own_buses_are_asked_and_others_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(can_link, "channels", lambda: [("pcan", "PCAN_USBBUS1"), ("socketcan", "can0")])
    clock = Clock()
    asked: list[Bus] = []

    def open_bus(bus: Bus) -> CanBus:
        asked.append(bus)
        return CanBus(clock, {0: 7})

    found = discover(clock, [], open_bus=open_bus)
    assert [bus.channel for bus in asked] == ["can0"]
    assert [(f.where, f.role) for f in found] == [("pcan:PCAN_USBBUS1", ""), ("socketcan:can0", "hv")]
    assert "--bus pcan:PCAN_USBBUS1@" in found[0].remark


def test_the_systems_can_channels_are_listed_whatever_drivers_there_are() -> None:
    assert all(interface in can_link.INTERFACES and channel for interface, channel in can_link.channels())


def test_bus_without_a_supply_is_listened_to_until_one_would_have_announced_itself() -> None:
    clock = Clock()
    assert discover(clock, [], [Bus("socketcan", "can0")], open_bus=lambda _: CanBus(clock, {})) == [
        Found("socketcan:can0")
    ]
    assert 10 < clock.t < 13


def test_bus_that_cannot_be_opened_is_told() -> None:
    def open_bus(bus: Bus) -> CanBus:
        raise DeviceLost("devices", "no such bus")

    (found,) = discover(Clock(), [], [Bus("slcan", "COM9")], open_bus=open_bus)
    assert found.where == "slcan:COM9" and "no such bus" in found.remark


def test_port_names_with_backslashes_stay_valid_toml() -> None:
    found = discover(Clock(), ["\\\\.\\COM10"], open_port=lambda port, baud: Port(stage(1)))
    assert tomllib.loads(found[0].scene)["stage"]["port"] == "\\\\.\\COM10"
