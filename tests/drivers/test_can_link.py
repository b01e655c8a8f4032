"""The CAN link: python-can's virtual bus, and slcan on a pty with a tiny adapter at its other end."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator

import pytest

from drivers.can_link import CanLink
from drivers.iseg_edcp import IsegEDCP
from drivers.link import CanFrame, DeviceError, DeviceLost, DeviceRefused, FrameLink

can = pytest.importorskip("can")

_channels = itertools.count()


@pytest.fixture
def pair() -> Iterator[tuple[CanLink, can.BusABC]]:
    """A link and somebody else on the same virtual bus."""
    channel = f"test-{next(_channels)}"
    other = can.Bus(interface="virtual", channel=channel)
    link = CanLink("hv", "virtual", channel)
    yield link, other
    link.close()
    other.shutdown()


def message(identifier: int, data: bytes = b"", **more: object) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False, **more)


def test_it_is_a_frame_link(pair: tuple[CanLink, can.BusABC]) -> None:
    link: FrameLink = pair[0]
    assert link.name.startswith("virtual test-")
    assert link.read() == []


def test_frames_go_both_ways(pair: tuple[CanLink, can.BusABC]) -> None:
    link, other = pair
    for i in range(5):
        other.send(message(0x200 + i, bytes(range(i))))
    assert link.read() == [CanFrame(0x200 + i, bytes(range(i))) for i in range(5)]
    assert link.read() == []
    link.write(CanFrame(0x201, b"\x12\x08"))
    received = other.recv(0)
    assert (received.arbitration_id, bytes(received.data), received.is_extended_id) == (0x201, b"\x12\x08", False)
    assert link.read() == []  # own frames do not come back
    assert link.counters["frames_read"] == 5
    assert link.counters["frames_written"] == 1


def test_what_is_not_a_classic_data_frame_is_counted(pair: tuple[CanLink, can.BusABC]) -> None:
    link, other = pair
    other.send(can.Message(arbitration_id=0x200, data=b"1", is_extended_id=True))
    other.send(message(0x200, is_remote_frame=True))
    other.send(message(0x200, b"1" * 12, is_fd=True))
    other.send(message(0x200, b"ok"))
    assert link.read() == [CanFrame(0x200, b"ok")]
    assert link.counters["foreign_frames"] == 3


def test_only_accepted_identifiers_pass() -> None:
    channel = f"test-{next(_channels)}"
    other = can.Bus(interface="virtual", channel=channel)
    link = CanLink("hv", "virtual", channel, accept=[0x200, 0x201])
    for identifier in (0x1FF, 0x200, 0x201, 0x202):
        other.send(message(identifier))
    assert [f.id for f in link.read()] == [0x200, 0x201]
    assert link.counters["foreign_frames"] == 2
    link.close()
    other.shutdown()


def test_error_frames_are_counted_and_bus_off_is_a_loss(pair: tuple[CanLink, can.BusABC]) -> None:
    link, other = pair
    other.send(can.Message(arbitration_id=0x04, data=bytes(8), is_error_frame=True))
    other.send(message(0x200, b"ok"))
    assert link.read() == [CanFrame(0x200, b"ok")]
    assert link.counters["error_frames"] == 1
    other.send(can.Message(arbitration_id=0x40, data=bytes(8), is_error_frame=True))
    with pytest.raises(DeviceLost, match="bus-off"):
        link.read()


def test_a_closed_link_is_lost_and_closing_twice_does_no_harm(pair: tuple[CanLink, can.BusABC]) -> None:
    link, _ = pair
    link.close()
    link.close()
    with pytest.raises(DeviceLost, match="closed"):
        link.read()
    with pytest.raises(DeviceLost, match="closed"):
        link.write(CanFrame(0, b""))


def test_a_backend_that_fails_is_a_loss(pair: tuple[CanLink, can.BusABC]) -> None:
    link, _ = pair
    assert link._bus is not None
    link._bus.shutdown()
    with pytest.raises(DeviceLost, match="gone"):
        link.read()
    with pytest.raises(DeviceLost, match="cannot be sent"):
        link.write(CanFrame(0, b""))


def test_interface_and_channel_that_do_not_exist() -> None:
    with pytest.raises(DeviceRefused, match=r"no CAN interface 'usb'.*Allowed: socketcan, slcan"):
        CanLink("hv", "usb", "0")
    with pytest.raises(DeviceLost, match="cannot be opened"):
        CanLink("hv", "slcan", "/dev/does-not-exist")
    with pytest.raises(DeviceError):
        CanLink("hv", "socketcan", "can-does-not-exist")


def test_opening_imports_python_can_and_nothing_before_does() -> None:
    code = "import sys, drivers.can_link, drivers.iseg_edcp; assert not {'can', 'serial'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


# -- slcan on a pty ----------------------------------------------------------------------------------------------------

if os.name != "posix":
    pytest.skip("needs a pty", allow_module_level=True)

import pty  # noqa: E402
import select  # noqa: E402
import tty  # noqa: E402


class Adapter:
    """An slcan adapter: acknowledges commands with CR, sends what it is told, and hands frames to ``on_frame``."""

    def __init__(self) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        self._slave = slave
        self.commands: list[bytes] = []
        self.on_frame: Callable[[CanFrame], list[CanFrame]] = lambda f: []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        line = b""
        while not self._stop.is_set():
            if not select.select([self.master], [], [], 0.005)[0]:
                continue
            for byte in os.read(self.master, 1024):
                if byte != 0x0D:
                    line += bytes((byte,))
                    continue
                self._line(line)
                line = b""

    def _line(self, line: bytes) -> None:
        self.commands.append(line)
        if not line.startswith(b"t"):
            self.send(b"\r")
            return
        self.send(b"z\r")
        for f in self.on_frame(CanFrame(int(line[1:4], 16), bytes.fromhex(line[5:].decode()))):
            self.send_frame(f)

    def send(self, data: bytes) -> None:
        os.write(self.master, data)

    def send_frame(self, f: CanFrame) -> None:
        self.send(f"t{f.id:03X}{len(f.data)}{f.data.hex().upper()}\r".encode())

    def vanish(self) -> None:
        if not self._stop.is_set():
            self._stop.set()
            self._thread.join()
            os.close(self.master)
            os.close(self._slave)


@pytest.fixture
def adapter() -> Iterator[Adapter]:
    it = Adapter()
    yield it
    it.vanish()


@pytest.fixture
def link(adapter: Adapter) -> Iterator[CanLink]:
    it = CanLink("hv", "slcan", adapter.port, 125_000)
    yield it
    it.close()


def eventually(look: Callable[[], bool]) -> None:
    """Wait for the adapter's thread, at most a few seconds."""
    done = threading.Event()
    for _ in range(3000):
        if look():
            return
        done.wait(1e-3)
    raise AssertionError("nothing came")


def collect(link: CanLink, n: int) -> list[CanFrame]:
    frames: list[CanFrame] = []

    def look() -> bool:
        frames.extend(link.read())
        return len(frames) >= n

    eventually(look)
    return frames


def test_slcan_opens_at_the_bit_rate_and_carries_frames(adapter: Adapter, link: CanLink) -> None:
    eventually(lambda: b"O" in adapter.commands)
    assert b"S4" in adapter.commands
    adapter.on_frame = lambda f: [CanFrame(f.id - 1, f.data + b"\x01")]
    for _ in range(20):
        link.write(CanFrame(0x201, b"\x12\x08"))
    assert collect(link, 20) == [CanFrame(0x200, b"\x12\x08\x01")] * 20
    assert link.counters["garbage"] == 0


def test_slcan_acknowledgements_do_not_hold_frames_back(adapter: Adapter, link: CanLink) -> None:
    eventually(lambda: b"O" in adapter.commands)
    adapter.send(b"\r\rz\r\x07" + b"t20011A\r" + b"z\r" + b"t20011B\r")
    frames: list[CanFrame] = []
    eventually(lambda: bool(frames.extend(link.read()) or frames))
    assert frames == [CanFrame(0x200, b"\x1a"), CanFrame(0x200, b"\x1b")]


@pytest.mark.parametrize(
    "garbage",
    [b"\xff\xfe\r", b"txyz\r", b"t2\r", b"t200\r", b"t2008AABB\r", b"t2002GG00\r", b"\x80", b"hello\r", b"t200912\r"],
)
def test_slcan_survives_garbage(adapter: Adapter, link: CanLink, garbage: bytes) -> None:
    eventually(lambda: b"O" in adapter.commands)
    link.read()
    adapter.send(garbage + b"\r")
    eventually(lambda: not link.read() and (link.counters["garbage"] > 0 or garbage == b"hello\r"))
    adapter.send(b"t20011A\r")
    assert collect(link, 1) == [CanFrame(0x200, b"\x1a")]


def test_slcan_that_vanishes_is_lost(adapter: Adapter, link: CanLink) -> None:
    eventually(lambda: b"O" in adapter.commands)
    adapter.vanish()

    with pytest.raises(DeviceLost, match="gone"):
        eventually(lambda: bool(link.read()))
    with pytest.raises(DeviceLost):
        link.write(CanFrame(0x201, b""))
    link.close()


def test_slcan_is_opened_by_one_program_only(adapter: Adapter, link: CanLink) -> None:
    with pytest.raises(DeviceError, match="in use"):
        CanLink("other", "slcan", adapter.port)


def test_the_driver_over_slcan(adapter: Adapter, link: CanLink) -> None:
    """Set-up of the HV driver through link, pty and adapter in real time."""
    values = {
        "1000": "7720",
        "1100": "40A00000",
        "1200": "00076378",
        "1201": "00040201",
        "1203": "45313644",
        "1208": "01",
        "400000": "0000",
        "400200": "0000",
        "410000": "00000000",
        "410100": "3A83126F",
        "410200": "3E800000",
        "410300": "00000000",
        "410600": "45BB8000",
        "410700": "3A83126F",
    }

    def module(f: CanFrame) -> list[CanFrame]:
        value = values.get(f.data.hex())
        return [CanFrame(0x200, f.data + bytes.fromhex(value))] if f.id == 0x201 and value else []

    adapter.on_frame = module
    hv = IsegEDCP("hv", link)
    samples = []
    ticks = itertools.count()

    def look() -> bool:
        samples.extend(hv.poll(next(ticks) * 1e-3))
        return len(samples) >= 2

    eventually(look)
    assert hv.nominal[0] == 6000.0
    assert samples[0].voltage == 0.25
