"""Serial lines over the network: sockets on loopback, and pyserial's own RFC 2217 server as the other end."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import threading
import time
from collections.abc import Iterator

import pytest
import serial
from serial.rfc2217 import PortManager

from drivers.links.device_server import DO, DONT, IAC, SB, SE, WILL, WONT, DeviceServerLink, Telnet, encode, open_line
from drivers.links.link import ByteLink, DeviceError, DeviceLost, DeviceRefused
from drivers.links.serial_link import SerialLink

EVERY_BYTE = bytes(range(256)) * 3 + b"\xff" * 5


class Server:
    """Listens on loopback; one connection."""

    def __init__(self) -> None:
        self.listening = socket.create_server(("127.0.0.1", 0))
        self.port = self.listening.getsockname()[1]
        self._accepted: list[socket.socket] = []

    def accept(self) -> socket.socket:
        connection, _ = self.listening.accept()
        connection.settimeout(5)
        self._accepted.append(connection)
        return connection

    def close(self) -> None:
        for one in (self.listening, *self._accepted):
            one.close()


@pytest.fixture
def server() -> Iterator[Server]:
    it = Server()
    yield it
    it.close()


def read_until(link: ByteLink, count: int, limit_s: float = 30.0) -> bytes:
    data, end = b"", time.monotonic() + limit_s
    while len(data) < count:
        assert time.monotonic() < end, data
        data += link.read()
        time.sleep(0.001)
    return data


def received(connection: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        data += connection.recv(4096)
    return data


def test_a_socket_carries_every_byte_as_it_is(server: Server) -> None:
    link = open_line("stage", f"socket://127.0.0.1:{server.port}", 115_200)
    other = server.accept()
    link.write(EVERY_BYTE)
    assert received(other, len(EVERY_BYTE)) == EVERY_BYTE
    other.sendall(EVERY_BYTE)
    assert read_until(link, len(EVERY_BYTE)) == EVERY_BYTE
    tries = []
    for _ in range(5):  # a busy machine may hold up one of them
        began = time.monotonic()
        assert link.read() == b""
        tries.append(time.monotonic() - began)
    assert min(tries) < 0.05
    other.close()
    with pytest.raises(DeviceLost, match="closed"):
        for _ in range(1000):
            link.read()
            time.sleep(0.001)
    link.close()
    link.close()


def test_a_server_that_takes_nothing_is_lost_and_not_waited_for(server: Server) -> None:
    link = DeviceServerLink("stage", f"socket://127.0.0.1:{server.port}", 115_200)
    server.accept()
    longest = 0.0
    with pytest.raises(DeviceLost, match="takes no more"):
        for _ in range(10_000):
            began = time.monotonic()
            link.write(bytes(8192))
            longest = max(longest, time.monotonic() - began)
    assert longest < 0.2
    link.close()


def test_one_program_at_a_time_has_it_and_it_comes_back_by_itself(server: Server) -> None:
    where = f"socket://127.0.0.1:{server.port}"
    link = open_line("stage", where, 115_200)
    first = server.accept()
    with pytest.raises(DeviceError, match=f"in use by process {os.getpid()}"):
        open_line("laser", where, 115_200)
    first.close()
    with pytest.raises(DeviceLost):
        read_until(link, 1)
    end = time.monotonic() + 30
    while not link.reopen():
        assert time.monotonic() < end
        time.sleep(0.01)
    server.accept().sendall(b"back")
    assert read_until(link, 4) == b"back"
    link.close()
    open_line("laser", where, 115_200).close()


@pytest.mark.parametrize(
    "address", ["socket://", "socket://x", "http://x:80", "rfc2217://x:0", "socket://h:1/p", "rfc2217://x:99999"]
)
def test_what_is_no_address_is_told(address: str) -> None:
    with pytest.raises(DeviceError, match=r"no address.*socket://HOST:PORT"):
        open_line("stage", address, 115_200)


def test_nobody_there() -> None:
    with pytest.raises(DeviceError, match="no connection"):
        open_line("stage", "socket://127.0.0.1:9", 115_200)


@pytest.mark.skipif(os.name != "posix", reason="descriptors are handed over on POSIX")
def test_it_can_be_handed_to_another_process(server: Server) -> None:
    where = f"socket://127.0.0.1:{server.port}"
    link = DeviceServerLink("hv", where, 115_200)
    there = server.accept()
    heir = DeviceServerLink("hv", where, 115_200, adopt=[os.dup(one) for one in link.descriptors])
    link.close()
    heir.write(b"still")
    assert there.recv(10) == b"still"
    heir.close()


def test_a_plain_name_is_a_port_of_this_computer() -> None:
    with pytest.raises(DeviceError, match="does not exist"):
        open_line("stage", "/dev/does-not-exist", 115_200)
    assert open_line.__annotations__["return"] == "SerialLink | DeviceServerLink" and SerialLink


# -- telnet ----------------------------------------------------------------------------------------------------------


def feed_in_pieces(data: bytes, size: int) -> tuple[bytes, bytes, Telnet]:
    telnet = Telnet({})
    line, answer = b"", b""
    for i in range(0, len(data), size):
        one, other = telnet.feed(data[i : i + size])
        line, answer = line + one, answer + other
    return line, answer, telnet


@pytest.mark.parametrize("size", [1, 2, 3, 5, 1000])
def test_telnet_gives_back_every_byte_however_it_is_cut(size: int) -> None:
    talk = bytes((IAC, WILL, 44, IAC, DO, 44, IAC, DO, 1, IAC, DO, 1, IAC, WONT, 5))
    rate = bytes((IAC, SB, 44, 101)) + encode((0x0001FF80).to_bytes(4, "big")) + bytes((IAC, SE))
    line, answer, telnet = feed_in_pieces(encode(EVERY_BYTE) + talk + rate + b"end", size)
    assert line == EVERY_BYTE + b"end"
    assert answer == bytes((IAC, DO, 44, IAC, WONT, 1))  # once each: two ends that answer answers never stop
    assert telnet.baud == 0x0001FF80 and telnet.counters == {"telnet_garbage": 0}


def test_telnet_survives_garbage_and_keeps_little_of_it() -> None:
    import random

    source = random.Random(1)
    telnet = Telnet({})
    for _ in range(2000):
        telnet.feed(bytes(source.choice((IAC, SB, SE, DO, DONT, 44, 0, 65)) for _ in range(50)))
        assert len(telnet._command) <= 70


# -- pyserial's server -----------------------------------------------------------------------------------------------


class PyserialServer(Server):
    """As pyserial's example of a server does it, with a line that gives back what it gets."""

    def __init__(self) -> None:
        super().__init__()
        self.line = serial.serial_for_url("loop://", baudrate=9600, timeout=0.02)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        connection = self.accept()
        lock = threading.Lock()

        class Connection:
            def write(self, data: bytes) -> None:
                with lock:
                    connection.sendall(data)

        out = Connection()
        manager = PortManager(self.line, out, logger=logging.getLogger("quiet"))
        connection.settimeout(0.005)
        with contextlib.suppress(OSError):
            while not self._stop.is_set():
                with contextlib.suppress(TimeoutError):
                    if not (data := connection.recv(1024)):
                        return
                    self.line.write(b"".join(manager.filter(data)))
                if waiting := self.line.in_waiting:
                    out.write(b"".join(manager.escape(self.line.read(waiting))))

    def close(self) -> None:
        self._stop.set()
        self._thread.join(5)
        super().close()
        self.line.close()


def test_pyserials_server_sets_the_line_and_carries_every_byte() -> None:
    server = PyserialServer()
    try:
        link = DeviceServerLink("force", f"rfc2217://127.0.0.1:{server.port}", 230_400)
        link.write(EVERY_BYTE)
        assert read_until(link, len(EVERY_BYTE)) == EVERY_BYTE
        line = server.line
        assert (line.baudrate, line.bytesize, line.parity, line.stopbits) == (230_400, 8, "N", 1)
        assert link._telnet is not None and link._telnet.baud == 230_400
        assert link.counters["telnet_garbage"] == 0
        link.close()
    finally:
        server.close()


def test_a_server_that_sets_another_rate_is_refused(server: Server) -> None:
    link = DeviceServerLink("force", f"rfc2217://127.0.0.1:{server.port}", 230_400)
    there = server.accept()
    asked = received(there, 40)
    assert bytes((IAC, SB, 44, 1)) + (230_400).to_bytes(4, "big") + bytes((IAC, SE)) in asked
    there.sendall(bytes((IAC, SB, 44, 101)) + (115_200).to_bytes(4, "big") + bytes((IAC, SE)))
    with pytest.raises(DeviceRefused, match="has set 115200 baud although 230400"):
        read_until(link, 1)
    link.close()


def test_a_server_that_takes_no_settings_is_told(server: Server) -> None:
    link = DeviceServerLink("force", f"rfc2217://127.0.0.1:{server.port}", 230_400)
    there = server.accept()
    there.sendall(bytes((IAC, DONT, 44)) + b"M1")
    assert read_until(link, 2) == b"M1" and "takes no line settings" in link.settings["remark"]
    link.close()
