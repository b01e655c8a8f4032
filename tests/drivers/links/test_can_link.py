"""The CAN link: python-can's virtual bus, and slcan on a pty with a tiny adapter at its other end."""

from __future__ import annotations

import itertools
import os
import random
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator

import can
import pytest

from drivers.instruments.iseg_edcp.device import IsegEDCP
from drivers.links.can_link import INTERFACES, TAKES_S, CanLink, open_bus
from drivers.links.link import CanFrame, DeviceError, DeviceLost, DeviceRefused, FrameLink
from drivers.links.slcan_link import SlcanLink

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
        open_bus("hv", "usb", "0")
    with pytest.raises(DeviceError, match=r"cannot be opened.*does not exist"):
        open_bus("hv", "slcan", "/dev/does-not-exist")
    with pytest.raises(DeviceError, match="cannot be opened at 123 bit/s"):
        open_bus("hv", "slcan", "/dev/does-not-exist", 123)
    with pytest.raises(DeviceError):
        CanLink("hv", "socketcan", "can-does-not-exist")


CHANNELS = {
    "socketcan": "can-does-not-exist",
    "slcan": "/dev/does-not-exist",
    "pcan": "PCAN_USBBUS1",
    "vector": "0",
    "kvaser": "0",
    "ixxat": "0",
    "gs_usb": "0",
    "virtual": "test-open",
    "udp_multicast": "239.74.163.2",
}


@pytest.mark.parametrize("channel", [None, "", "\0", "not a channel", "-1", "99999999999"])
@pytest.mark.parametrize("interface", INTERFACES)
def test_every_interface_opens_or_refuses_plainly(interface: str, channel: str | None) -> None:
    """Whatever drivers this machine has: a link that reads nothing and can be closed, or a message that says why."""
    try:
        link = open_bus("hv", interface, CHANNELS[interface] if channel is None else channel)
    except DeviceError as error:
        text = str(error)
        assert text.startswith(f"hv ({interface} ") and "cannot be" in text
        assert len(error.advice) > 20 and "Traceback" not in text
        assert interface != "virtual"
    else:
        link.read()
        link.close()
        with pytest.raises(DeviceLost, match="closed"):
            link.read()


@pytest.mark.parametrize("interface", [i for i in INTERFACES if i not in ("virtual", "slcan")])
def test_a_library_that_fails_in_its_own_way_is_an_error_of_the_family(
    interface: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for failure in (can.CanInitializationError("no"), OSError(19, "No such device"), ValueError("no"), TypeError("no")):

        def fail(*_: object, failure: Exception = failure, **__: object) -> None:
            raise failure

        monkeypatch.setattr(can, "Bus", fail)
        with pytest.raises(DeviceLost, match="cannot be opened"):
            CanLink("hv", interface, "0")


def test_a_controller_that_has_gone_bus_off_is_a_loss_also_without_an_error_frame(
    pair: tuple[CanLink, can.BusABC], monkeypatch: pytest.MonkeyPatch
) -> None:
    """pcan and socketcan tell the controller's state; an error frame need not have come."""
    link, other = pair
    states = {"now": can.BusState.ACTIVE}
    monkeypatch.setattr(type(link._bus), "state", property(lambda bus: states["now"]))
    for state in (can.BusState.ACTIVE, can.BusState.PASSIVE):  # passive: it still takes part
        states["now"] = state
        other.send(message(0x200, b"ok"))
        assert link.read() == [CanFrame(0x200, b"ok")]
    states["now"] = can.BusState.ERROR
    with pytest.raises(DeviceLost, match=r"bus-off.*cable, termination and bit rate"):
        link.read()
    states["now"] = can.BusState.ACTIVE  # it has recovered
    other.send(message(0x200, b"ok"))
    assert link.read() == [CanFrame(0x200, b"ok")]


def test_an_interface_that_cannot_tell_its_state_counts_as_well(
    pair: tuple[CanLink, can.BusABC], monkeypatch: pytest.MonkeyPatch
) -> None:
    link, other = pair

    def unknown(bus: object) -> None:
        raise NotImplementedError  # as python-can's `BusABC.state` does for interfaces that do not know it

    monkeypatch.setattr(type(link._bus), "state", property(unknown))
    other.send(message(0x200, b"ok"))
    assert link.read() == [CanFrame(0x200, b"ok")]


def test_opening_imports_python_can_and_nothing_before_does() -> None:
    code = (
        "import sys, drivers.links.can_link, drivers.instruments.iseg_edcp; "
        "assert not {'can', 'serial'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def eventually(look: Callable[[], bool]) -> None:
    """Wait for the other end, at most a few seconds."""
    done = threading.Event()
    for _ in range(3000):
        if look():
            return
        done.wait(1e-3)
    raise AssertionError("nothing came")


def collect(link: FrameLink, n: int) -> list[CanFrame]:
    frames: list[CanFrame] = []

    def look() -> bool:
        frames.extend(link.read())
        return len(frames) >= n

    eventually(look)
    return frames


# -- udp_multicast -----------------------------------------------------------------------------------------------------


@pytest.fixture
def group() -> Iterator[tuple[CanLink, CanLink]]:
    """Two programs' links in one multicast group of this computer."""
    links: list[CanLink] = []
    try:
        for name in ("host", "module"):
            links.append(CanLink(name, "udp_multicast", "239.74.163.77"))
    except DeviceError as error:
        pytest.skip(f"no multicast on this machine: {error}")
    yield links[0], links[1]
    for link in links:
        link.close()


def test_multicast_frames_go_both_ways_and_own_ones_do_not_come_back(group: tuple[CanLink, CanLink]) -> None:
    host, module = group
    write, ask = CanFrame(0x200, bytes.fromhex("41000044BB8000")), CanFrame(0x201, bytes.fromhex("410000"))
    host.write(write)
    host.write(ask)
    assert collect(module, 2) == [write, ask]
    module.write(write)  # a module's answer looks exactly like the host's write
    assert collect(host, 1) == [write]
    eventually(lambda: not (host.read() or module.read()) and module.counters["own_echoes"] == 1)
    assert host.counters["own_echoes"] == 2
    assert host.counters["foreign_frames"] == host.counters["garbage"] == 0


def test_an_echo_that_got_lost_does_not_eat_what_others_send(group: tuple[CanLink, CanLink]) -> None:
    host, module = group
    first, second = CanFrame(0x201, b"\x41\x00\x00"), CanFrame(0x201, b"\x41\x02\x00")
    host._sent.append(first)  # sent, and never come back
    host.write(second)
    eventually(lambda: not host.read() and host.counters["own_echoes"] == 1)
    module.write(first)
    assert collect(host, 1) == [first]


def test_anybody_may_send_anything_to_a_multicast_group(group: tuple[CanLink, CanLink]) -> None:
    host, module = group
    rng = random.Random(7)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        for number in range(300):
            stranger.sendto(rng.randbytes(rng.randrange(1, 40)), ("239.74.163.77", 43113))
            if number % 50 == 0:
                host.read()
    module.write(CanFrame(0x200, b"ok"))
    assert collect(host, 1) == [CanFrame(0x200, b"ok")]
    assert host.counters["garbage"] > 200


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
def link(adapter: Adapter) -> Iterator[SlcanLink]:
    it = SlcanLink("hv", adapter.port, 125_000)
    yield it
    it.close()


def test_slcan_opens_at_the_bit_rate_and_carries_frames(adapter: Adapter, link: SlcanLink) -> None:
    eventually(lambda: b"O" in adapter.commands)
    assert b"S4" in adapter.commands
    adapter.on_frame = lambda f: [CanFrame(f.id - 1, f.data + b"\x01")]
    for _ in range(20):
        link.write(CanFrame(0x201, b"\x12\x08"))
    assert collect(link, 20) == [CanFrame(0x200, b"\x12\x08\x01")] * 20
    assert link.counters["garbage"] == 0


def test_slcan_acknowledgements_do_not_hold_frames_back(adapter: Adapter, link: SlcanLink) -> None:
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


def test_slcan_that_vanishes_is_lost(adapter: Adapter, link: SlcanLink) -> None:
    eventually(lambda: b"O" in adapter.commands)
    adapter.vanish()

    with pytest.raises(DeviceLost, match="gone"):
        eventually(lambda: bool(link.read()))
    with pytest.raises(DeviceLost):
        link.write(CanFrame(0x201, b""))
    link.close()


def test_slcan_is_opened_by_one_program_only(adapter: Adapter, link: SlcanLink) -> None:
    with pytest.raises(DeviceError, match="in use"):
        SlcanLink("other", adapter.port)


def test_slcan_refusals_are_counted_and_a_report_of_bus_off_is_a_loss(adapter: Adapter, link: SlcanLink) -> None:
    eventually(lambda: b"O" in adapter.commands)
    adapter.send(b"\x07" + b"t20011A\r" + b"T000002001\x07\r" + b"t20011B1234\r")
    assert collect(link, 2) == [CanFrame(0x200, b"\x1a"), CanFrame(0x200, b"\x1b")]  # the last with a time stamp
    assert link.counters["refused"] == 2 and link.counters["foreign_frames"] == 1
    adapter.send(b"sb256256\r")
    with pytest.raises(DeviceLost, match="bus-off"):
        eventually(lambda: bool(link.read()))


def test_slcan_reads_in_bulk(adapter: Adapter, link: SlcanLink) -> None:
    """A busy bus costs a few reads a turn, not one a byte; what one call may take is bounded."""
    eventually(lambda: b"O" in adapter.commands)
    link.read()
    calls = []
    read = link._port.read
    link._port.read = lambda: calls.append(1) or read()  # type: ignore[method-assign, func-returns-value]
    line = b"t20081122334455667788\r"
    adapter.send(line * 150)  # 3300 bytes, less than a pseudo-terminal holds
    assert len(collect(link, 150)) == 150
    assert len(calls) < 30


def test_a_frame_for_which_there_is_no_room_waits_and_goes_out_first(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    channel = f"test-{next(_channels)}"
    other = can.Bus(interface="virtual", channel=channel)
    link = CanLink("hv", "virtual", channel, clock=lambda: now[0])
    assert link._bus is not None
    send, full = link._bus.send, [True]

    def refuse(message: can.Message, timeout: float | None = None) -> None:
        assert timeout == 0
        if full[0]:
            raise can.CanOperationError("Failed to transmit: No buffer space available", 105)  # ENOBUFS
        send(message)

    monkeypatch.setattr(link._bus, "send", refuse)
    off, ask = CanFrame(0x200, b"off"), CanFrame(0x201, b"ask")
    link.write(off)
    link.write(ask)
    link.write(off)  # repeated: once is enough
    assert other.recv(0) is None
    full[0] = False
    link.read()
    assert [bytes(other.recv(0).data) for _ in range(2)] == [b"off", b"ask"] and other.recv(0) is None
    full[0] = True
    link.write(off)
    now[0] += TAKES_S + 0.01
    with pytest.raises(DeviceLost, match="cannot be sent"):
        link.read()
    link.close()
    other.shutdown()


def test_a_bus_that_comes_back_is_opened_again(pair: tuple[CanLink, can.BusABC]) -> None:
    link, other = pair
    now = [0.0]
    link._clock = lambda: now[0]
    link._next_look = 0.0
    assert link._bus is not None
    link._bus.shutdown()
    with pytest.raises(DeviceLost):
        link.read()
    assert link.reopen() and not link.reopen()
    other.send(message(0x200, b"back"))
    assert link.read() == [CanFrame(0x200, b"back")]


def test_the_driver_over_slcan(adapter: Adapter, link: SlcanLink) -> None:
    """Set-up of the HV driver through link, pty and adapter in real time."""
    values = {
        "1000": "7720",
        "1100": "40A00000",
        "1200": "00076378",
        "1201": "00040201",
        "1203": "45313644",
        "1208": "01",
        "400000": "0000",
        "400100": "0000",
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
