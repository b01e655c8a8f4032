"""Serial ports, on pseudo-terminals: the real pyserial, the real kernel."""

from __future__ import annotations

import errno
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import serial

from drivers.links.link import ByteLink, DeviceError, DeviceLost
from drivers.links.own_directory import user_directory
from drivers.links.port_lock import PortLock
from drivers.links.serial_link import TAKES_S, SerialLink

pty = pytest.importorskip("pty", reason="pseudo-terminals are POSIX")
termios = pytest.importorskip("termios", reason="pseudo-terminals are POSIX")


class Pty:
    def __init__(self) -> None:
        import tty

        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)

    def read(self, count: int) -> bytes:
        """``count`` bytes: one ``read`` of a terminal may bring the first of them alone."""
        data = b""
        while len(data) < count:
            data += os.read(self.master, count - len(data))
        return data

    def unplug(self) -> None:
        for fd in (self.master, self._slave):
            if fd >= 0:
                os.close(fd)
        self.master = self._slave = -1


@pytest.fixture
def other_end() -> Iterator[Pty]:
    end = Pty()
    yield end
    end.unplug()


@pytest.fixture
def link(other_end: Pty) -> Iterator[SerialLink]:
    link = SerialLink("stage", other_end.port, 115200)
    yield link
    link.close()


@pytest.fixture(autouse=True)
def own_temporary_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)


def arrived(link: SerialLink, count: int) -> bytes:
    data, end = b"", time.monotonic() + 30
    while len(data) < count and time.monotonic() < end:
        select.select([link.fileno()], [], [], 0.1)
        data += link.read()
    return data


def test_is_a_byte_link_named_by_its_port(link: SerialLink, other_end: Pty) -> None:
    as_link: ByteLink = link
    assert as_link.name == other_end.port


def test_bytes_go_both_ways_and_nothing_waits(link: SerialLink, other_end: Pty) -> None:
    tries = []
    for _ in range(5):  # a busy machine may hold up one of them
        begin = time.monotonic()
        assert link.read() == b""
        tries.append(time.monotonic() - begin)
    assert min(tries) < 0.05
    link.write(b"/1 0 00 get pos:2D\n")
    assert other_end.read(19) == b"/1 0 00 get pos:2D\n"
    every_byte = bytes(range(256)) * 4
    os.write(other_end.master, every_byte)
    assert arrived(link, len(every_byte)) == every_byte


def test_what_was_set_is_told(link: SerialLink, other_end: Pty) -> None:
    assert link.settings["port"] == other_end.port
    assert link.settings["baud"] == "115200"
    assert link.settings["low_latency"].startswith("not available")  # a pseudo-terminal has no such mode


def test_unplugged_is_one_error_at_read_write_and_fileno(link: SerialLink, other_end: Pty) -> None:
    other_end.unplug()
    for _ in range(3):
        with pytest.raises(DeviceLost, match=rf"stage \({other_end.port}\): the port is gone \(reading"):
            link.read()
    with pytest.raises(DeviceLost, match=r"gone \(writing"):
        link.write(b"x")
    link.close()
    with pytest.raises(DeviceLost):
        link.read()
    with pytest.raises(DeviceLost):
        link.write(b"x")
    with pytest.raises(DeviceLost):
        link.fileno()
    link.close()


def test_bytes_that_arrived_before_it_was_unplugged_do_no_harm(link: SerialLink, other_end: Pty) -> None:
    os.write(other_end.master, b"@01 1 0")
    other_end.unplug()
    with pytest.raises(DeviceLost):
        for _ in range(3):
            link.read()


class Broken:
    """A port that breaks at one chosen call, in each of the ways that a system lets through."""

    def __init__(self, where: str, error: Exception) -> None:
        self._where, self._error = where, error

    def _break(self, where: str) -> None:
        if where == self._where:
            raise self._error

    def read(self) -> bytes:
        self._break("read")
        return b"abc"

    def write(self, data: bytes) -> int:
        self._break("write")
        return len(data)

    def close(self) -> None:
        self._break("close")


@pytest.mark.parametrize("where", ["read", "write"])
@pytest.mark.parametrize(
    "error",
    [OSError(5, "Input/output error"), termios.error(5, "Input/output error"), BrokenPipeError(32, "Broken pipe")],
    ids=lambda error: type(error).__name__,
)
def test_every_way_to_vanish_at_every_call(link: SerialLink, where: str, error: Exception) -> None:
    broken: Any = Broken(where, error)
    real, link._port = link._port, broken
    try:
        with pytest.raises(DeviceLost):
            link.write(b"x")
            link.read()
    finally:
        link._port = real


def test_a_system_without_low_latency_mode_opens_its_ports(other_end: Pty, monkeypatch: pytest.MonkeyPatch) -> None:
    owner = next(kind for kind in serial.Serial.__mro__ if "set_low_latency_mode" in vars(kind))
    monkeypatch.delattr(owner, "set_low_latency_mode")
    link = SerialLink("stage", other_end.port, 115200)
    assert "not available" in link.settings["low_latency"]
    link.close()


@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), termios.error(5, "Input/output error")])
def test_close_of_a_vanished_port_is_quiet_and_releases_the_lock(
    link: SerialLink, other_end: Pty, error: Exception
) -> None:
    broken: Any = Broken("close", error)
    real, link._port = link._port, broken
    link.close()
    assert real is not None
    real.close()
    SerialLink("stage", other_end.port, 115200).close()


def test_stalled_peer_is_told_within_a_second_instead_of_waited_for(link: SerialLink) -> None:
    begin = time.monotonic()
    longest = 0.0
    with pytest.raises(DeviceLost, match="takes no more data"):
        while time.monotonic() < begin + 5.0:
            call = time.monotonic()
            try:
                link.write(b"x" * 500)
                link.read()
            finally:
                longest = max(longest, time.monotonic() - call)
            time.sleep(0.005)
    assert time.monotonic() - begin < 1.0
    assert longest < 0.1  # no single call waits


def test_what_is_not_taken_at_once_goes_out_later(other_end: Pty) -> None:
    """A peer that is slow for less than the allowed time loses nothing, and nothing comes twice or out of order."""
    now = [0.0]
    link = SerialLink("stage", other_end.port, 115200, clock=lambda: now[0])
    sent = bytes(range(256)) * 4
    for k in range(16):
        link.write(sent[k * 64 : (k + 1) * 64])
    while len(link._waiting) == 0:  # fill the kernel's buffer
        link.write(sent)
    now[0] += 0.8 * TAKES_S
    got = b""
    os.set_blocking(other_end.master, False)
    for _ in range(200):
        link.read()
        try:
            got += os.read(other_end.master, 65536)
        except BlockingIOError:
            if not link._waiting:
                break
    assert not link._waiting and got == sent * (len(got) // len(sent)) and len(got) > 4096
    link.close()


def test_a_port_that_comes_back_under_its_name_is_opened_again(tmp_path: Path) -> None:
    first, second = Pty(), Pty()
    name = tmp_path / "ttyHV"
    name.symlink_to(first.port)
    now = [0.0]
    link = SerialLink("hv", str(name), 115200, clock=lambda: now[0])
    name.unlink()
    first.unplug()
    with pytest.raises(DeviceLost):
        link.read()
    now[0] += 0.06
    assert not link.reopen()
    name.symlink_to(second.port)
    assert not link.reopen()  # not more often than allowed
    now[0] += 0.06
    assert link.reopen() and link.counters["reopened"] == 1
    link.write(b"off")
    assert second.read(3) == b"off"
    link.close()
    second.unplug()


def test_a_port_that_is_there_but_cannot_be_opened_is_tried_again(
    other_end: Pty, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    link = SerialLink("hv", other_end.port, 115200, clock=lambda: now[0])

    def busy(self: SerialLink, **keys: Any) -> Any:
        raise OSError(errno.EBUSY, "Device or resource busy")

    with monkeypatch.context() as patch:
        patch.setattr(SerialLink, "_open", busy)
        now[0] += 1.0
        assert not link.reopen() and link.counters.get("reopened", 0) == 0
    now[0] += 1.0
    assert link.reopen() and link.counters["reopened"] == 1
    link.close()


def test_another_adapter_under_the_same_name_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the serial numbers of their USB adapters, which pseudo-terminals lack."""
    first, second = Pty(), Pty()
    serials = {first.port: "A1", second.port: "B2"}
    monkeypatch.setattr("drivers.links.serial_link._usb_serial", lambda device: serials[os.path.realpath(device)])
    name = tmp_path / "ttyHV"
    name.symlink_to(first.port)
    now = [0.0]
    link = SerialLink("hv", str(name), 115200, clock=lambda: now[0])
    first.unplug()
    name.unlink()
    name.symlink_to(second.port)
    now[0] += 1.0
    assert not link.reopen()
    serials[second.port] = "A1"
    now[0] += 1.0
    assert link.reopen()
    link.close()
    second.unplug()


def test_reopening_needs_no_lock_and_no_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = Pty(), Pty()
    name = tmp_path / "ttyHV"
    name.symlink_to(first.port)
    now = [0.0]
    link = SerialLink("hv", str(name), 115200, clock=lambda: now[0])
    held = PortLock("somebody", second.port)  # as another run, or another user, would
    other = os.open(second.port, os.O_RDWR | os.O_NOCTTY)
    import fcntl

    fcntl.flock(other, fcntl.LOCK_EX)
    monkeypatch.setattr("tempfile.tempdir", "/nonexistent")
    first.unplug()
    name.unlink()
    name.symlink_to(second.port)
    now[0] += 1.0
    assert link.reopen()
    link.write(b"off")
    assert second.read(3) == b"off"
    link.close()
    os.close(other)
    held.release()
    second.unplug()


def test_a_port_can_be_handed_to_another_process(link: SerialLink, other_end: Pty) -> None:
    port, lock = (os.dup(descriptor) for descriptor in link.descriptors)
    other = SerialLink("stage", other_end.port, 115200, adopt=(port, lock))
    link.close()  # as if its process had died
    other.write(b"still here")
    assert other_end.read(10) == b"still here"
    with pytest.raises(DeviceError):
        SerialLink("laser", other_end.port, 115200)
    other.close()
    SerialLink("laser", other_end.port, 115200).close()


def test_a_port_needs_one_descriptor(other_end: Pty) -> None:
    open_files = Path("/proc/self/fd")
    if not open_files.exists():
        pytest.skip("needs /proc")
    before = len(list(open_files.iterdir()))
    link = SerialLink("stage", other_end.port, 115200)
    assert len(list(open_files.iterdir())) == before + 2  # the port and its lock
    link.close()


def test_second_opener_in_this_process_is_refused(link: SerialLink, other_end: Pty) -> None:
    with pytest.raises(DeviceError, match=f"port {other_end.port} is in use by process {os.getpid()}"):
        SerialLink("laser", other_end.port, 115200)
    link.read()  # the first is none the worse


def test_other_name_of_the_same_port_is_refused(link: SerialLink, other_end: Pty, tmp_path: Path) -> None:
    alias = tmp_path / "stage-port"
    alias.symlink_to(other_end.port)
    with pytest.raises(DeviceError, match="in use"):
        SerialLink("laser", str(alias), 115200)


def test_port_is_free_again_after_close(other_end: Pty) -> None:
    for _ in range(3):
        SerialLink("stage", other_end.port, 115200).close()


HOLD = """
import sys, time
from drivers.links.port_lock import PortLock
lock = PortLock("stage", sys.argv[1])
print("held", flush=True)
time.sleep(60)
"""


def test_lock_of_another_process_holds_until_it_is_killed(other_end: Pty) -> None:
    holder = subprocess.Popen([sys.executable, "-c", HOLD, other_end.port], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout is not None and holder.stdout.readline() == "held\n"
        with pytest.raises(DeviceError, match=f"in use by process {holder.pid}"):
            SerialLink("stage", other_end.port, 115200)
    finally:
        holder.kill()
        holder.communicate()
    SerialLink("stage", other_end.port, 115200).close()


def test_exclusive_program_without_our_lock_is_noticed(other_end: Pty) -> None:
    other = serial.Serial(other_end.port, exclusive=True)
    with pytest.raises(DeviceError, match=f"port {other_end.port} cannot be opened"):
        SerialLink("stage", other_end.port, 115200)
    other.close()
    SerialLink("stage", other_end.port, 115200).close()  # the failed attempt has left no lock


def test_lock_file_that_is_a_link_to_elsewhere_is_not_followed(other_end: Pty, tmp_path: Path) -> None:
    lock = PortLock("stage", other_end.port)
    path = lock.path
    lock.release()
    assert not path.exists()
    victim = tmp_path / "victim"
    victim.write_text("keep me")
    path = user_directory() / path.name
    path.symlink_to(victim)
    with pytest.raises(DeviceError, match="lock file"):
        SerialLink("stage", other_end.port, 115200)
    assert victim.read_text() == "keep me"


def test_locks_are_in_a_directory_of_the_user_and_are_removed(other_end: Pty, tmp_path: Path) -> None:
    lock = PortLock("stage", other_end.port)
    folder = lock.path.parent
    assert folder.parent == tmp_path and folder.stat().st_mode & 0o777 == 0o700
    assert len(folder.name) > len(f"dea-rig-{os.getuid()}-") + 5  # not to be guessed
    assert lock.path.stat().st_mode & 0o777 == 0o600
    lock.release()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["open to others", "a file", "a link"])
def test_a_directory_that_somebody_else_made_does_not_block(other_end: Pty, tmp_path: Path, kind: str) -> None:
    theirs = tmp_path / f"dea-rig-{os.getuid()}-aaaa"
    if kind == "a file":
        theirs.write_text("")
    elif kind == "a link":
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        theirs.symlink_to(tmp_path / "elsewhere")
    else:
        theirs.mkdir()
        theirs.chmod(0o777)
    lock = PortLock("stage", other_end.port)
    assert lock.path.parent != theirs and theirs.exists()
    lock.release()


def test_a_lock_that_is_removed_while_it_is_waited_for_is_taken_anew(other_end: Pty) -> None:
    """Two programs never hold one port, however their opening and closing mix."""
    import threading

    holders: list[int] = []
    errors: list[str] = []

    def work(k: int) -> None:
        for _ in range(100):
            try:
                lock = PortLock("stage", other_end.port)
            except DeviceError:
                continue
            holders.append(k)
            if len(holders) > 1:
                errors.append("two")
            holders.remove(k)
            lock.release()

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors


def test_port_that_does_not_exist_is_told_with_those_that_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.links.serial_link.ports", lambda: ["/dev/ttyUSB0", "/dev/ttyUSB7"])
    with pytest.raises(DeviceError) as caught:
        SerialLink("stage", "/dev/ttyUSB99", 115200)
    assert str(caught.value) == (
        "stage (/dev/ttyUSB99): port /dev/ttyUSB99 does not exist. Ports on this machine: /dev/ttyUSB0, /dev/ttyUSB7."
    )


def test_machine_without_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.links.serial_link.ports", list)
    with pytest.raises(DeviceError, match="This machine has no serial port"):
        SerialLink("stage", "/dev/ttyUSB99", 115200)


def test_file_that_is_no_port(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text("x")
    with pytest.raises(DeviceError, match="cannot be opened"):
        SerialLink("stage", str(path), 115200)


def test_pyserial_is_imported_only_when_a_port_is_opened() -> None:
    code = "import sys, drivers.links.serial_link; sys.exit('serial' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
