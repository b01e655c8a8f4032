"""Discovery against scripted ports and buses: who answers, what is proposed, and that nothing is commanded."""

from __future__ import annotations

import tomllib
from collections.abc import Callable

import pytest

from drivers.discovery import Bus, Found, discover
from drivers.link import ByteLink, CanFrame, DeviceError, DeviceLost
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


def test_nobody_takes_little_time() -> None:
    clock = Clock()
    found = discover(clock, ["COM3"], open_port=lambda port, baud: Port(nobody))
    assert found == [Found("COM3")]
    assert clock.t < 2.0


def test_noise_is_nobody() -> None:
    found, _ = look(nobody, noise=b"@01 0 00 OK IDLE WR 0:00\r\n\xffM1,+1e5.000\r\xaa\x54\x01abc\x85")
    assert found == [Found("/dev/ttyUSB0")]


def test_only_questions_are_sent() -> None:
    for device in (nobody, stage(1), Laser(), amplifier):
        for baud in (115_200, 230_400, 9_600):
            _, opened = look(device, baud)
            for data in (data for port in opened for data in port.sent):
                text = data.decode("latin-1")
                question = text.startswith("/") and (" get " in text or text.split(":")[0] == "/0 0 00")
                assert question or data in (b"\r", b"M1\r", b"\xaa\x90\x1f\x85", b"\xaa\x90\x2b\x85")


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
    """iseg modules by address; ``quiet`` ones answer nothing and only announce themselves every 5 s."""

    name = "bus"

    def __init__(self, clock: Clock, serials: dict[int, int], quiet: tuple[int, ...] = ()) -> None:
        self.clock, self.serials, self.quiet = clock, serials, quiet
        self.sent: list[CanFrame] = []
        self.out: list[CanFrame] = []
        self.announced = 0

    def read(self) -> list[CanFrame]:
        if self.clock.t > 5 * (self.announced + 1):
            self.announced += 1
            self.out += [CanFrame(0x201 | m << 3, b"\xd8\x80\x01") for m in self.quiet]
        out, self.out = self.out, []
        return out

    def write(self, frame: CanFrame) -> None:
        self.sent.append(frame)
        module = frame.id >> 3 & 0x3F
        if frame.data == b"\x12\x00" and module in self.serials:
            self.out.append(CanFrame(0x200 | module << 3, b"\x12\x00" + self.serials[module].to_bytes(4, "big")))

    def close(self) -> None:
        pass


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
        assert (f.where, f.role, f.driver, f.identity.serial) == ("socketcan:can0", "hv", "iseg-edcp", serial)
        keys = {"driver": "iseg-edcp", "interface": "socketcan", "can_channel": "can0", "bitrate": 125000}
        assert tomllib.loads(f.scene)["hv"] == keys | {"module": module} | ({"serial": serial} if serial else {})
    # every frame is a read request: its identifier has the direction bit set
    assert all(frame.id & 1 and frame.data == b"\x12\x00" for frame in bus.sent)


def test_bus_without_a_supply_is_listened_to_until_one_would_have_announced_itself() -> None:
    clock = Clock()
    assert discover(clock, [], [Bus("socketcan", "can0")], open_bus=lambda _: CanBus(clock, {})) == [
        Found("socketcan:can0")
    ]
    assert 10 < clock.t < 12


def test_bus_that_cannot_be_opened_is_told() -> None:
    def open_bus(bus: Bus) -> CanBus:
        raise DeviceLost("devices", "no such bus")

    (found,) = discover(Clock(), [], [Bus("slcan", "COM9")], open_bus=open_bus)
    assert found.where == "slcan:COM9" and "no such bus" in found.remark


def test_port_names_with_backslashes_stay_valid_toml() -> None:
    found = discover(Clock(), ["\\\\.\\COM10"], open_port=lambda port, baud: Port(stage(1)))
    assert tomllib.loads(found[0].scene)["stage"]["port"] == "\\\\.\\COM10"
