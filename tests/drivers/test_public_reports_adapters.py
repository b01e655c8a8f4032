"""What people report of CAN adapters, with adapters of our own on pseudo-terminals: what reached the bus is looked at.

The reports: an adapter that restarts when its port is opened (CANToolz#17); firmware that answers nothing, whose M1 is
silent mode and whose version is a text (canable2-fw, gui_tool#109); no room for a frame (python-can#2004, #310); a full
bus (cantact-fw#14); adapters that have no driver here (python-can#1852).
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import threading
import time
from collections.abc import Callable, Iterator

import can
import pytest

from drivers.links import slcan_link
from drivers.links.can_link import INTERFACES, CanLink, open_bus
from drivers.links.link import CanFrame, DeviceError
from drivers.links.slcan_link import SlcanLink

pty = pytest.importorskip("pty", reason="pseudo-terminals are POSIX")


class Adapter:
    """An slcan adapter between a pseudo-terminal and a bus, in the manner of one firmware."""

    def __init__(self, deaf_s: float = 0.0, silent: bool = False, version: bytes = b"V1013", quiet: bool = False):
        import tty

        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.on_bus: list[bytes] = []  # frames that other nodes saw
        self.commands: list[bytes] = []
        self.silent, self.is_open, self.bitrate = silent, False, b""
        self._version, self._quiet = version, quiet
        self._deaf_s, self._first = deaf_s, 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        line = b""
        while not self._stop.is_set():
            if not select.select([self.master], [], [], 0.005)[0]:
                continue
            data = os.read(self.master, 4096)
            self._first = self._first or time.monotonic()
            if time.monotonic() - self._first < self._deaf_s:  # in its boot loader
                continue
            *lines, line = (line + data).split(b"\r")
            for one in lines:
                self._line(one)

    def _line(self, line: bytes) -> None:
        self.commands.append(line)
        good = True
        match line[:1]:
            case b"V":
                os.write(self.master, self._version + b"\r")
                return
            case b"C":
                self.is_open = False
            case b"S" if not self.is_open:
                self.bitrate = line
            case b"O":
                self.is_open = bool(self.bitrate)
            case b"M" if self._version[:1] != b"V" and not self.is_open:
                self.silent = line == b"M1"
            case b"L":
                self.is_open = self.silent = True
            case b"t" if self.is_open:
                if not self.silent:
                    self.on_bus.append(line)
            case b"":
                pass
            case _:
                good = False
        if not self._quiet:
            os.write(self.master, b"\r" if good else b"\x07")

    def hear(self, line: bytes) -> None:
        """A frame comes over the bus."""
        if self.is_open:
            os.write(self.master, line)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self.master)
        os.close(self._slave)


@pytest.fixture
def plugged() -> Iterator[Callable[..., tuple[Adapter, SlcanLink]]]:
    with contextlib.ExitStack() as stack:

        def plug(**manner: object) -> tuple[Adapter, SlcanLink]:
            adapter = Adapter(**manner)  # type: ignore[arg-type]
            stack.callback(adapter.close)
            link = SlcanLink("hv", adapter.port, 125_000)
            stack.callback(link.close)
            return adapter, link

        yield plug


def turn_until(link: SlcanLink, done: Callable[[], bool], limit_s: float = 30.0) -> list[CanFrame]:
    frames: list[CanFrame] = []
    end = time.monotonic() + limit_s
    while not done():
        assert time.monotonic() < end
        frames += link.read()
        time.sleep(0.002)
    return frames


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same in a quarter of the time."""
    monkeypatch.setattr(slcan_link, "AGAIN_S", 0.1)
    monkeypatch.setattr(slcan_link, "OPENING_S", 1.0)


Plug = Callable[..., tuple[Adapter, SlcanLink]]
CANABLE = b"ba6b1dd github.com/normaldotcom/canable-fw.git"


@pytest.mark.usefixtures("quick")
def test_an_adapter_that_restarts_when_it_is_opened_is_opened_again(
    plugged: Plug, caplog: pytest.LogCaptureFixture
) -> None:
    adapter, link = plugged(deaf_s=0.3)
    with caplog.at_level(logging.WARNING):
        turn_until(link, lambda: "remark" in link.settings)
    assert adapter.is_open and adapter.bitrate == b"S4"
    assert "deaf for" in link.settings["remark"] and "opened again" in caplog.text
    assert link.settings["adapter"] == "V1013"
    link.write(CanFrame(0x201, b"\x10\x00"))
    turn_until(link, lambda: adapter.on_bus == [b"t20121000"])
    sent = len(adapter.commands)
    time.sleep(0.3)
    link.read()
    assert len(adapter.commands) == sent  # nothing is opened twice once it has answered


@pytest.mark.usefixtures("quick")
def test_lines_that_were_lost_in_the_middle_are_not_taken_for_an_open_bus(plugged: Plug) -> None:
    """It woke up between C and S4, and would be open at a bit rate that nobody chose."""
    adapter, link = plugged(deaf_s=0.05)
    adapter.commands.clear()
    os.write(adapter.master, b"\r\x07")  # it answers to less than was sent
    turn_until(link, lambda: link._opening is None)
    assert adapter.is_open and adapter.bitrate == b"S4"


@pytest.mark.usefixtures("quick")
def test_an_adapter_that_never_answers_is_told_within_the_stated_time(plugged: Plug) -> None:
    begin = time.monotonic()
    _, link = plugged(deaf_s=60.0)
    turn_until(link, lambda: "remark" in link.settings)
    assert "answered nothing" in link.settings["remark"] and time.monotonic() - begin < 2.5
    assert link.read() == []


@pytest.mark.parametrize("version", [CANABLE, b"b158aa7 https://x.y/canable2-fw", b"+Board: MKS\tMCU: STM32G431"])
def test_a_canable_that_was_left_silent_speaks_again(plugged: Plug, version: bytes) -> None:
    adapter, link = plugged(silent=True, quiet=True, version=version)
    adapter.hear(b"t20122108\r")  # a silent adapter hears the bus, which is no sign that it can send
    turn_until(link, lambda: b"M0" in adapter.commands and adapter.is_open)
    link.write(CanFrame(0x201, b"\x10\x00"))
    turn_until(link, lambda: adapter.on_bus == [b"t20121000"])
    assert not adapter.silent and link.settings["adapter"] == version.decode()
    assert link.counters["garbage"] == link.counters["foreign_frames"] == 0  # its version is no frame


@pytest.mark.parametrize("version", [b"V1013", b"VL2K0", CANABLE])
def test_no_adapter_is_ever_silenced(plugged: Plug, version: bytes) -> None:
    adapter, link = plugged(version=version)
    turn_until(link, lambda: link._opening is None)
    link.resume()
    link._begin_opening()
    turn_until(link, lambda: link._opening is None and adapter.is_open)
    assert not adapter.silent
    assert not {b"M1", b"L", b"l"} & set(adapter.commands)
    assert (b"M0" in adapter.commands) == (version == CANABLE)  # elsewhere M sets a filter


def test_a_full_bus_is_read_in_bulk_and_within_a_bounded_time(plugged: Plug) -> None:
    adapter, link = plugged()
    turn_until(link, lambda: link._opening is None)
    waiting = b"t20081122334455667788\r" * 6000
    os.set_blocking(adapter.master, False)
    received: list[CanFrame] = []
    longest, calls, end = 0.0, 0, time.monotonic() + 30.0  # a busy machine
    while len(received) < 6000:
        assert time.monotonic() < end
        with contextlib.suppress(BlockingIOError):
            waiting = waiting[os.write(adapter.master, waiting) :]
        began = time.thread_time()
        frames = link.read()
        longest = max(longest, time.thread_time() - began)
        calls += bool(frames)
        received += frames
    assert longest < 0.05 and calls < 200 and link.counters["garbage"] == 0


def test_an_urgent_frame_overtakes_what_an_adapter_has_not_taken(
    plugged: Plug, monkeypatch: pytest.MonkeyPatch
) -> None:
    adapter, link = plugged()
    turn_until(link, lambda: link._opening is None)
    port = link._port._port  # type: ignore[union-attr]
    write, room = port.write, [7]  # type: ignore[union-attr]
    monkeypatch.setattr(port, "write", lambda data: write(data[: room[0]]) if room[0] else 0)
    link.write(CanFrame(0x201, b"\x40\x00\x00"))  # half of it is on its way
    room[0] = 0
    link.write(CanFrame(0x201, b"\x40\x02\x00"))
    link.write(CanFrame(0x200, b"\x40\x01\x00\x00\x20"), urgent=True)
    room[0] = 4096
    turn_until(link, lambda: len(adapter.on_bus) == 3)
    assert adapter.on_bus == [b"t2013400000", b"t20054001000020", b"t2013400200"]


def test_frames_for_which_there_is_no_room_keep_their_order_behind_an_emergency(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [0.0]
    other = can.Bus(interface="virtual", channel="no-room")
    link = CanLink("hv", "virtual", "no-room", clock=lambda: now[0])
    assert link._bus is not None
    send, full = link._bus.send, [True]

    def refuse(message: can.Message, timeout: float | None = None) -> None:
        if full[0]:
            raise can.CanOperationError("Failed to transmit: [Errno 105] No buffer space available", 105)
        send(message)

    monkeypatch.setattr(link._bus, "send", refuse)
    for data in (b"one", b"two"):
        link.write(CanFrame(0x201, data))
    link.write(CanFrame(0x200, b"off"), urgent=True)
    link.write(CanFrame(0x200, b"off"), urgent=True)
    now[0] += 0.005
    full[0] = False
    link.read()  # the next turn of the loop, within milliseconds
    seen = [bytes(message.data) for message in iter(lambda: other.recv(0), None)]
    assert seen == [b"off", b"one", b"two"]
    link.close()
    other.shutdown()


@pytest.mark.parametrize("interface", ["gs_usb", "kvaser", "ixxat", "pcan", "vector"])
def test_adapters_without_a_driver_here_say_what_to_install(interface: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert interface in INTERFACES

    def missing(*_: object, **__: object) -> None:
        raise can.CanInterfaceNotImplementedError(f"Cannot import module for interface '{interface}'")

    monkeypatch.setattr(can, "Bus", missing)
    with pytest.raises(DeviceError, match=r"cannot be used here") as told:
        open_bus("hv", interface, "0")
    assert "nstall" in told.value.advice or "needs" in told.value.advice


def test_an_adapters_number_reaches_its_library_as_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    bus = can.Bus(interface="virtual", channel="numbered")
    monkeypatch.setattr(can, "Bus", lambda **keys: asked.append(keys["channel"]) or bus)
    open_bus("hv", "gs_usb", "1").close()
    assert asked == [1]
    with pytest.raises(DeviceError, match="'-1' is no number"):
        open_bus("hv", "gs_usb", "-1")
