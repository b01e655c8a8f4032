"""Several instruments on one LabJack share a connection; the device here takes two, and no more."""

from __future__ import annotations

import select
import socket
import struct
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from drivers.instruments.labjack.analog_input import AnalogDisplacement, AnalogForce
from drivers.instruments.labjack.shared import shared
from drivers.links.link import DeviceLost
from drivers.links.tcp_link import TcpLink

FIXED = {
    60_000: struct.pack(">f", 7.0),
    60_002: struct.pack(">f", 1.3),
    60_004: struct.pack(">f", 1.03),
    60_028: struct.pack(">I", 4711),
    55_100: struct.pack(">I", 0x00112233),
}


class Box:
    """A LabJack's registers on TCP: AIN2 shows 0.5 V, AIN3 1.25 V. A third connection is closed at once."""

    def __init__(self) -> None:
        self.listening = socket.create_server(("127.0.0.1", 0))
        self.port = self.listening.getsockname()[1]
        self.taken = self.refused = 0
        self.numbers: list[int] = []
        self.hosts: dict[socket.socket, bytes] = {}
        self.split = False  # answers come in two pieces
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while not self._stop.is_set():
            for one in select.select([self.listening, *self.hosts], [], [], 0.01)[0]:
                if one is self.listening:
                    host, _ = self.listening.accept()
                    if len(self.hosts) == 2:
                        self.refused += 1
                        host.close()
                    else:
                        self.taken += 1
                        host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                        self.hosts[host] = b""
                elif one in self.hosts:
                    self._read(one)

    def _read(self, host: socket.socket) -> None:
        try:
            data = host.recv(4096)
        except OSError:
            data = b""
        if not data:
            del self.hosts[host]
            host.close()
            return
        data = self.hosts[host] + data
        while len(data) >= 6 and len(data) >= (length := 6 + int.from_bytes(data[4:6], "big")):
            answer = self._answer(data[:length])
            half = len(answer) // 2 if self.split else len(answer)
            host.sendall(answer[:half])
            if self.split:
                time.sleep(0.001)
                host.sendall(answer[half:])
            data = data[length:]
        self.hosts[host] = data

    def _answer(self, frame: bytes) -> bytes:
        number, unit, function = int.from_bytes(frame[:2], "big"), frame[6], frame[7]
        self.numbers.append(number)
        if function == 16:
            pdu = frame[7:12]
        else:
            address, count = struct.unpack(">HH", frame[8:12])
            inputs = {4: struct.pack(">f", 0.5), 6: struct.pack(">f", 1.25)}
            values = b"".join((FIXED | inputs).get(address + k, struct.pack(">f", 10.0)) for k in range(0, count, 2))
            pdu = bytes((function, len(values))) + values
        return struct.pack(">HHHB", number, 0, 1 + len(pdu), unit) + pdu

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        for one in (self.listening, *self.hosts):
            one.close()


@pytest.fixture
def box() -> Iterator[Box]:
    it = Box()
    yield it
    it.close()


def poll(devices: list[Any], samples: int, limit_s: float = 5.0) -> list[list[Any]]:
    got: list[list[Any]] = [[] for _ in devices]
    end = time.monotonic() + limit_s
    while min(map(len, got)) < samples:
        assert time.monotonic() < end, [device.counters for device in devices]
        for device, mine in zip(devices, got, strict=True):
            mine += device.poll(time.monotonic())
        time.sleep(0.001)
    return got


@pytest.mark.parametrize("split", [False, True])
def test_two_sensors_need_one_connection_and_get_each_their_own_answers(box: Box, split: bool) -> None:
    box.split = split
    guard = TcpLink("hv", "127.0.0.1", box.port)  # the guard has the other one
    one, other = shared(TcpLink("force and displacement", "127.0.0.1", box.port), 2)
    force = AnalogForce("force", one, newtons_per_V=0.2, rate_Hz=100)
    laser = AnalogDisplacement("displacement", other, mm_per_V=4.0, rate_Hz=100)
    forces, ways = poll([force, laser], 20)
    assert {round(sample.reading, 6) for sample in forces} == {0.1}
    assert {round(sample.displacement, 9) for sample in ways} == {0.005}
    assert (box.taken, box.refused) == (2, 0)
    assert len(set(box.numbers)) == len(box.numbers)  # no two requests have one number
    for device in (force, laser):
        assert device.counters["unexpected_replies"] == device.counters["retries"] == 0
    force.close()
    laser.poll(time.monotonic())  # the other one goes on
    laser.close()
    laser.close()
    guard.close()


def test_a_connection_that_is_lost_comes_back_for_all(box: Box) -> None:
    one, other = shared(TcpLink("both", "127.0.0.1", box.port), 2)
    force = AnalogForce("force", one, newtons_per_V=0.2, rate_Hz=100)
    laser = AnalogDisplacement("displacement", other, mm_per_V=4.0, rate_Hz=100)
    poll([force, laser], 3)
    for host in list(box.hosts):
        host.shutdown(socket.SHUT_RDWR)
    for device in (force, laser):
        with pytest.raises(DeviceLost):
            for _ in range(1000):
                device.poll(time.monotonic())
                time.sleep(0.001)
    end = time.monotonic() + 5
    while not one.reopen():
        assert time.monotonic() < end
        time.sleep(0.01)
    assert other.reopen() and not other.reopen()
    again = [
        AnalogForce("force", one, newtons_per_V=0.2, rate_Hz=100),
        AnalogDisplacement("displacement", other, mm_per_V=4.0, rate_Hz=100),
    ]
    poll(again, 3)
    assert box.refused == 0
    one.close()
    other.close()
