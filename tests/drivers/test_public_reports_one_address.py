"""Two devices with one address (MagAOX#362): refused by name, and a way out offered. Whoever shares a line or bus has
it: stages on one serial line, CANopen nodes and iseg modules on one bus."""

from __future__ import annotations

import contextlib
import os
import re
import select
import threading
from collections.abc import Iterator

import pytest
from click.testing import CliRunner

from drivers.instruments.cia404.device import CiA404
from drivers.instruments.iseg_edcp.device import IsegEDCP
from drivers.links.link import CanFrame, DeviceRefused
from rig.cli.app import main

pty = pytest.importorskip("pty", reason="pseudo-terminals are POSIX")


class Chain:
    """Zaber devices on one line, each with its address; all that are addressed answer."""

    def __init__(self, *addresses: int) -> None:
        import tty

        self.addresses = list(addresses)
        self.commands: list[str] = []
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        rest = b""
        while not self._stop.is_set():
            if not select.select([self.master], [], [], 0.005)[0]:
                continue
            *lines, rest = (rest + os.read(self.master, 4096)).split(b"\n")
            for line in lines:
                self._line(line.decode("latin-1").strip("\r"))

    def _line(self, line: str) -> None:
        found = re.fullmatch(r"/(\d+) (\d+) (\d+) ?([^:]*)(?::..)?", line)
        if found is None:
            return
        to, axis, number, words = int(found[1]), int(found[2]), int(found[3]), found[4]
        self.commands.append(words)
        if words == "renumber" and to == 0:
            self.addresses = list(range(1, len(self.addresses) + 1))
        data = {"get deviceid": "50081", "get version": "7.14"}.get(words, "0")
        for place, address in enumerate(self.addresses):
            if to in (0, address):
                value = f"100{place}" if words == "get system.serial" else data
                text = f"{address:02d} {axis} {number:02d} OK IDLE WR {value}"
                os.write(self.master, f"@{text}:{-sum(text.encode()) & 0xFF:02X}\r\n".encode())

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        os.close(self.master)
        os.close(self._slave)


@pytest.fixture
def chain() -> Iterator[Chain]:
    it = Chain(1, 1)
    with contextlib.closing(it):
        yield it


def devices(*arguments: str, typed: str = "") -> tuple[int, str]:
    done = CliRunner().invoke(main, ["devices", *arguments], env={"COLUMNS": "250"}, input=typed)
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, done.output


def test_devices_names_both_and_offers_to_renumber(chain: Chain) -> None:
    code, told = devices("--port", chain.port)
    assert code == 1 and "[stage]" not in told
    assert "2 devices have address 1" in told and "1000 1001" in told and f"--renumber {chain.port}" in told
    assert not any(words.startswith(("move", "home", "renumber", "set")) for words in chain.commands)


def test_renumber_asks_first_and_then_each_has_its_own(chain: Chain) -> None:
    code, _ = devices("--renumber", chain.port, typed="n\n")
    assert code != 0 and chain.addresses == [1, 1] and "renumber" not in chain.commands
    code, told = devices("--renumber", chain.port, typed="y\n")
    assert code == 0 and chain.addresses == [1, 2] and chain.commands.count("renumber") == 1
    assert "device = 1" in told and "device = 2" in told and "1001" in told


def test_renumber_where_nobody_is(chain: Chain) -> None:
    chain.addresses = []
    code, told = devices("--renumber", chain.port, "--yes")
    assert code == 2 and "nobody answers there" in told and "renumber" not in chain.commands


class Bus:
    """Answers of two devices to everything; ``serials`` are theirs."""

    name = "bus"

    def __init__(self, serials: tuple[int, int]) -> None:
        self.serials = serials
        self.out: list[CanFrame] = []
        self.sent: list[CanFrame] = []

    def read(self) -> list[CanFrame]:
        out, self.out = self.out, []
        return out

    def write(self, frame: CanFrame, *, urgent: bool = False) -> None:
        self.sent.append(frame)
        if frame.id == 0x605 and frame.data[0] == 0x40:
            for serial in self.serials:
                head = frame.data[1:4]
                value = {b"\x00\x10\x00": 0x00020194, b"\x18\x10\x04": serial}.get(head, 1)
                self.out.append(CanFrame(0x585, b"\x43" + head + value.to_bytes(4, "little")))
        if frame.id == 0x201:
            for serial in self.serials:
                values = {b"\x10\x00": b"\x77\x20", b"\x12\x00": serial.to_bytes(4, "big")}
                if frame.data in values:
                    self.out.append(CanFrame(0x200, frame.data + values[frame.data]))

    def reopen(self) -> bool:
        return False

    def close(self) -> None:
        """Nothing is open."""


def test_two_nodes_with_one_number_are_refused_by_name() -> None:
    bus = Bus((4711, 4712))
    node = CiA404("force", bus, node=5)
    with pytest.raises(DeviceRefused, match=r"two devices answer as node 5 .*4711 and 4712"):
        for k in range(2000):
            node.poll(k * 1e-3)
    assert not any(frame.id == 0x605 and frame.data[0] != 0x40 for frame in bus.sent)  # nothing was written


def test_two_modules_with_one_address_are_refused_by_name() -> None:
    bus = Bus((484216, 484217))
    hv = IsegEDCP("hv", bus)
    with pytest.raises(DeviceRefused, match=r"two modules answer as 0, serial numbers 484216 and 484217"):
        for k in range(2000):
            hv.poll(k * 1e-3)
    assert {frame.data for frame in bus.sent if frame.id == 0x200} <= {b"\xd8\x01"}


def test_an_answer_that_came_twice_is_no_second_device() -> None:
    bus = Bus((484216, 484216))
    hv = IsegEDCP("hv", bus)
    with pytest.raises(Exception, match="no answer"):  # it answers to little else
        for k in range(5000):
            hv.poll(k * 1e-3)
    assert hv.identity.serial == "484216"
