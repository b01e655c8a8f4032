"""What people report of the start: devices that boot for seconds, ports that somebody else has, and no answer where
something came that was not understood. Devices of our own on pseudo-terminals and loopback; what they got is looked at.

The reports: a node that boots (canopen#401); ModemManager on a fresh ttyACM (libusb_stm32#39); one port under two names
(node-serialport#955); wrong baud rate, another instrument on that port, a display in micrometres or without decimal
point; a Keyence controller that is silent on settings it does not know (`keylkg` of the EPICS device emulators).
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import select
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from drivers.instruments.ascii_stream import AsciiForce
from drivers.instruments.cia404.device import CiA404
from drivers.instruments.gsv8.device import GSV8
from drivers.instruments.iseg_edcp.device import IsegEDCP
from drivers.instruments.keyence_lkg import UNANSWERED, KeyenceLKG
from drivers.instruments.shvps import Shvps
from drivers.instruments.zaber.device import ZaberStage
from drivers.links import serial_link
from drivers.links.link import CanFrame, DeviceError, DeviceSilent
from drivers.links.port_lock import PortLock, one_name
from drivers.links.serial_link import SerialLink

pty = pytest.importorskip("pty", reason="pseudo-terminals are POSIX")

Answering = Callable[[bytes], bytes]


class Instrument:
    """Whatever sits on a port: ``answer(data)`` for what comes, after it has been deaf for ``boot_s``."""

    def __init__(self, answer: Answering, boot_s: float = 0.0) -> None:
        import tty

        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.got = b""
        self._answer, self._boot_s = answer, boot_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        on_since: float | None = None
        while not self._stop.is_set():
            if not select.select([self.master], [], [], 0.005)[0]:
                continue
            data = os.read(self.master, 4096)
            on_since = on_since or time.monotonic()
            self.got += data
            if time.monotonic() - on_since >= self._boot_s and (answer := self._answer(data)):
                os.write(self.master, answer)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self.master)
        os.close(self._slave)


@pytest.fixture
def on_port() -> Iterator[Callable[..., tuple[Instrument, SerialLink]]]:
    with contextlib.ExitStack() as stack:

        def plug(answer: Answering, boot_s: float = 0.0) -> tuple[Instrument, SerialLink]:
            there = Instrument(answer, boot_s)
            stack.callback(there.close)
            link = SerialLink("device", there.port, 115_200)
            stack.callback(link.close)
            return there, link

        yield plug


OnPort = Callable[..., tuple[Instrument, SerialLink]]


def poll_until_ready(device: Any, limit_s: float = 30.0) -> None:
    end = time.monotonic() + limit_s
    while not device.ready:
        assert time.monotonic() < end
        device.poll(time.monotonic())
        time.sleep(0.002)


class Controller:
    """An LK-G controller by lines. ``silent`` commands are not known to it: it says nothing."""

    def __init__(self, value: str = "+01.2345", silent: tuple[str, ...] = ()) -> None:
        self._rest, self._value, self._silent = b"", value, silent
        self.got: list[str] = []

    def __call__(self, data: bytes) -> bytes:
        *lines, self._rest = (self._rest + data).split(b"\r")
        return b"".join(self._one(line.decode()) for line in lines)

    def _one(self, command: str) -> bytes:
        self.got.append(command)
        if command.startswith(self._silent):
            return b""
        if command == "M0":
            return f"M0,{self._value},{self._value}\r".encode()
        if command in ("M1", "M2"):
            return f"{command},{self._value}\r".encode()
        if command.startswith("SR"):
            return f"{command},3\r".encode()
        return (command + (",0" if command == "PR" else "") + "\r").encode()


def supply(data: bytes) -> bytes:
    answers = {b"QVer": b"slave 8", b"QName": b"HVPS 7", b"QVmax": b"5000", b"QPowJack": b"1", b"QJack": b"1"}
    return b"".join(answers.get(one, b"0") + b"\r\n" for one in data.split(b"\r")[:-1])


# -- what boots ------------------------------------------------------------------------------------------------------


def test_a_laser_that_boots_is_waited_for(on_port: OnPort) -> None:
    there, link = on_port(Controller(), boot_s=0.5)
    device = KeyenceLKG("laser", link, timeout_s=0.05, boot_s=3.0)
    poll_until_ready(device)
    assert there.got.count(b"Q0\r") >= 5 and device.counters["unanswered"] == 0


def test_a_supply_that_boots_is_waited_for_and_nothing_is_set(on_port: OnPort) -> None:
    there, link = on_port(supply, boot_s=0.5)
    poll_until_ready(Shvps("hv", link, timeout_s=0.05, boot_s=3.0))
    assert b"S" not in there.got.replace(b"SwMode", b"")


def stage(data: bytes) -> bytes:
    replies = b""
    for line in data.splitlines():
        device, axis, number, *words = line.decode()[1:].partition(":")[0].split()
        values = {
            "get deviceid": "50081",
            "get resolution": "64",
            "get limit.max": "305381",
            "get maxspeed": "1000",
            "warnings": "00",
        }
        text = f"{int(device):02d} {axis} {number} OK IDLE -- {values.get(' '.join(words), '0')}"
        replies += f"@{text}:{-sum(text.encode()) & 0xFF:02X}\r\n".encode()
    return replies


def test_a_stage_that_boots_is_waited_for_and_not_moved(on_port: OnPort) -> None:
    there, link = on_port(stage, boot_s=0.5)
    poll_until_ready(ZaberStage("stage", link, timeout_s=0.05, boot_s=3.0))
    assert there.got.count(b"/1 0 ") > 8 and not re.search(rb"move|home", there.got)


class Node:
    """A CAN bus in memory whose only node has not started: ``boots_at`` is when it says so and begins to answer."""

    name = "bus"

    def __init__(self, boots_at: float) -> None:
        self.t, self.boots_at, self.sent, self._said = 0.0, boots_at, list[CanFrame](), False

    def read(self) -> list[CanFrame]:
        if self.t >= self.boots_at and not self._said:
            self._said = True
            return [CanFrame(0x705, b"\x00")]
        return []

    def write(self, frame: CanFrame, *, urgent: bool = False) -> None:
        self.sent.append(frame)

    def reopen(self) -> bool:
        return False

    def close(self) -> None:
        """Nothing is open."""


@pytest.mark.parametrize(
    ("make", "question"),
    [
        (
            lambda bus, boot_s: CiA404("force", bus, node=5, boot_s=boot_s),
            CanFrame(0x605, bytes.fromhex("4000100000000000")),
        ),
        (lambda bus, boot_s: IsegEDCP("hv", bus, module=0, boot_s=boot_s), CanFrame(0x201, b"\x10\x00")),
    ],
)
def test_no_answer_is_told_after_the_stated_time_and_not_before(
    make: Callable[[Node, float], Any], question: CanFrame
) -> None:
    bus = Node(boots_at=1e9)
    device = make(bus, 8.0)
    with pytest.raises(DeviceSilent, match=r"no answer to .* within 8 s"):
        for _ in range(20_000):
            bus.t += 0.002
            device.poll(bus.t)
    assert 8.0 <= bus.t < 8.6
    assert bus.sent.count(question) > 20


def test_once_it_has_answered_silence_is_told_as_soon_as_ever(on_port: OnPort) -> None:
    _, link = on_port(Controller(silent=("M",)))
    device = KeyenceLKG("laser", link, timeout_s=0.02, boot_s=30.0)
    began = time.monotonic()
    with pytest.raises(DeviceSilent):
        poll_until_ready(device)
    assert time.monotonic() - began < 10.0


# -- what was not understood -----------------------------------------------------------------------------------------


def force(link: SerialLink) -> GSV8:
    return GSV8("force", link, timeout_s=0.1)


def laser(link: SerialLink) -> KeyenceLKG:
    return KeyenceLKG("laser", link, timeout_s=0.1)  # an answer on a busy machine comes in time


@pytest.mark.parametrize(
    ("make", "answer", "words"),
    [
        (laser, lambda data: b"\xfe\x80\x06\x9e\x98\xe6\x00\x18", ["fe 80 06", "another baud rate"]),
        (laser, lambda data: b"@01 1 00 RJ IDLE WR BADCOMMAND\r\n", ["@01 1 00 RJ", "a Zaber stage"]),
        (laser, lambda data: b"V1013\r", ["56 31 30 31 33 0d", "a CAN adapter"]),
        (laser, Controller("+0012345"), ["M0,+0012345", "no decimal point"]),
        (laser, Controller("+00350.1"), ["M0,+00350.1", "micrometres"]),
        (force, lambda data: b"ER,\xaa,00\r", ["45 52 2c"]),
        (lambda link: ZaberStage("stage", link, timeout_s=0.1), lambda data: b"M1,+01.2345\r", ["a Keyence LK-G"]),
        (
            lambda link: ZaberStage("stage", link, timeout_s=0.1),
            lambda data: b"\xaa\x9f\x85\xe0",
            ["aa 9f 85", "baud"],
        ),
        (lambda link: Shvps("hv", link, timeout_s=0.1), lambda data: b"M1,+01.2345\r", ["a Keyence LK-G"]),
        (
            lambda link: AsciiForce("force", link, rate_Hz=100, boot_s=0.1, timeout_s=0.05),
            lambda data: b"",
            ["no valid value", "nothing came"],
        ),
    ],
)
def test_no_answer_says_what_came_and_what_it_looks_like(
    on_port: OnPort, make: Callable[[SerialLink], Any], answer: Answering, words: list[str]
) -> None:
    _, link = on_port(answer)
    device = make(link)
    with pytest.raises(DeviceSilent) as told:
        poll_until_ready(device)
    assert all(word in str(told.value) for word in words), str(told.value)


def test_nothing_that_came_is_not_spoken_of(on_port: OnPort) -> None:
    _, link = on_port(lambda data: b"")
    with pytest.raises(DeviceSilent) as told:
        poll_until_ready(laser(link))
    assert "came" not in str(told.value)


@pytest.mark.parametrize(
    ("make", "frame", "words"),
    [
        (lambda bus: CiA404("force", bus, node=5), CanFrame(0x707, b"\x05"), "CANopen node 7 is there"),
        (lambda bus: IsegEDCP("hv", bus), CanFrame(0x219, b"\xd8\x80\x01"), "iseg module 3 announces itself"),
    ],
)
def test_on_a_bus_it_says_who_was_heard(make: Callable[[Node], Any], frame: CanFrame, words: str) -> None:
    bus = Node(boots_at=1e9)
    bus.read = lambda: [frame]  # type: ignore[method-assign]
    device = make(bus)
    with pytest.raises(DeviceSilent, match=words):
        for _ in range(2000):
            bus.t += 0.002
            device.poll(bus.t)


# -- settings that are not answered ----------------------------------------------------------------------------------


@pytest.mark.parametrize("silent", [("SR",), ("PR",), ("SR", "PR")])
def test_a_controller_that_says_nothing_to_its_settings_measures(on_port: OnPort, silent: tuple[str, ...]) -> None:
    controller = Controller(silent=silent)
    _, link = on_port(controller)
    device = KeyenceLKG("laser", link, timeout_s=0.03, poll_rate_Hz=100)
    poll_until_ready(device)
    assert UNANSWERED in device.settings.values() and controller.got[-1][0] == "M"
    samples: list[Any] = []
    end = time.monotonic() + 30.0
    while len(samples) < 5:
        assert time.monotonic() < end
        samples += device.poll(time.monotonic())
        time.sleep(0.002)
    assert samples[0].displacement == pytest.approx(1.2345e-3)


# -- ports -----------------------------------------------------------------------------------------------------------


def test_modem_manager_is_waited_for_and_named(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    there = Instrument(lambda data: b"")
    open_, tries = SerialLink._open, []

    def busy(self: SerialLink, **keys: Any) -> Any:
        tries.append(time.monotonic())
        if len(tries) <= 2:
            raise OSError(errno.EBUSY, "Device or resource busy")
        return open_(self, **keys)

    monkeypatch.setattr(SerialLink, "_open", busy)
    monkeypatch.setattr(serial_link, "modem_manager", lambda: True)
    with caplog.at_level(logging.WARNING):
        link = SerialLink("hv", there.port, 115_200)
    assert "ModemManager has the port" in caplog.text and "ID_MM_DEVICE_IGNORE" in caplog.text
    assert "ModemManager had the port" in link.settings["remark"] and len(tries) == 3
    link.close()
    there.close()


def test_a_port_that_stays_busy_is_told_with_the_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def busy(self: SerialLink, **keys: Any) -> Any:
        raise OSError(errno.EBUSY, "Device or resource busy")

    monkeypatch.setattr(SerialLink, "_open", busy)
    monkeypatch.setattr(serial_link, "MODEM_S", 0.1)
    monkeypatch.setattr(serial_link, "modem_manager", lambda: True)
    with pytest.raises(DeviceError, match=r"ModemManager.*ID_MM_DEVICE_IGNORE"):
        SerialLink("hv", "/dev/null", 115_200)
    monkeypatch.setattr(serial_link, "modem_manager", lambda: False)
    monkeypatch.setattr(serial_link, "MODEM_S", 10.0)
    began = time.monotonic()
    with pytest.raises(DeviceError, match="cannot be opened"):
        SerialLink("hv", "/dev/null", 115_200)
    assert time.monotonic() - began < 2.0  # nobody else is waited for


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("/dev/tty.usbserial-A9", "/dev/cu.usbserial-A9"),
        ("COM3", r"\\.\COM3"),
        ("COM12", r"\\.\com12"),
        ("com3", "//./COM3:"),
        ("socket://Server:4001", "socket://server:4001"),
    ],
)
def test_two_names_of_a_port_are_one_lock(one: str, other: str) -> None:
    lock = PortLock("stage", one)
    try:
        with pytest.raises(DeviceError, match=f"in use by process {os.getpid()}"):
            PortLock("laser", other)
    finally:
        lock.release()
    assert one_name(one) == one_name(other)


def test_other_ports_are_other_locks() -> None:
    assert (
        len({one_name(name) for name in ("COM3", "COM30", "/dev/tty.a", "/dev/cu.b", "/dev/ttyS0", "/dev/ttyS1")}) == 6
    )
