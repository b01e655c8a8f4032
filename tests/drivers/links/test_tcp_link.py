"""A TCP device with two slots that does not notice that a host has gone: whoever was cut off gets in again, later."""

from __future__ import annotations

import select
import socket
import time

import pytest

from drivers.links.link import DeviceError, DeviceLost
from drivers.links.tcp_link import LOOK_AGAIN_S, TAKES_S, TcpLink


class Device:
    """Takes ``slots`` hosts and closes whoever comes beyond; a slot stays taken until `notice`, half open."""

    def __init__(self, slots: int = 2) -> None:
        self.listening = socket.create_server(("127.0.0.1", 0))
        self.port = self.listening.getsockname()[1]
        self.hosts: list[socket.socket] = []
        self.slots, self.refused = slots, 0

    def turn(self) -> None:
        """Take who has come."""
        while select.select([self.listening], [], [], 0.02)[0]:
            host, _ = self.listening.accept()
            if len(self.hosts) < self.slots:
                self.hosts.append(host)
            else:
                self.refused += 1
                host.close()

    def notice(self, number: int) -> None:
        """At last it notices that this host has gone."""
        self.hosts.pop(number).close()

    def close(self) -> None:
        for host in [*self.hosts, self.listening]:
            host.close()


class Clock:
    def __init__(self) -> None:
        self.t = 0.0

    def __call__(self) -> float:
        return self.t


def read(link: TcpLink) -> bytes:
    """What comes, which is waited for."""
    end = time.monotonic() + 10.0
    while time.monotonic() < end:
        if data := link.read():
            return data
        time.sleep(1e-3)
    return b""


def test_a_slot_that_is_half_open_is_waited_for_and_taken_when_it_is_free() -> None:
    device, clock = Device(), Clock()
    first, guard = (TcpLink(name, "127.0.0.1", device.port, clock=clock) for name in ("force", "hv"))
    try:
        device.turn()
        assert len(device.hosts) == 2
        assert first._socket is not None
        first._socket.close()  # the cable was out: the device has not heard of it
        first._shut()
        with pytest.raises(DeviceLost):
            first.read()
        tries = 0
        while tries < 3:  # both slots are taken, one by nobody
            clock.t += LOOK_AGAIN_S
            if first.reopen():
                tries += 1
                device.turn()
                with pytest.raises(DeviceLost, match="the other end closed it"):
                    read(first)
            else:
                time.sleep(1e-3)
        assert device.refused == 3
        device.notice(0)
        clock.t += LOOK_AGAIN_S
        while not first.reopen():
            clock.t += 0.1 * LOOK_AGAIN_S
            time.sleep(1e-3)
        device.turn()
        device.hosts[-1].sendall(b"here")
        assert read(first) == b"here"
        device.hosts[0].sendall(b"undisturbed")
        assert read(guard) == b"undisturbed"
    finally:
        first.close()
        guard.close()
        device.close()


def test_a_connection_that_takes_nothing_is_lost_and_one_that_is_not_there_is_told() -> None:
    device, clock = Device(), Clock()
    link = TcpLink("force", "127.0.0.1", device.port, clock=clock)
    try:
        device.turn()
        with pytest.raises(DeviceLost, match="takes no more data"):
            for _ in range(10_000):  # nobody reads at the other end
                link.write(bytes(4096))
                clock.t += 0.1 * TAKES_S
    finally:
        link.close()
        device.close()
    with pytest.raises(DeviceError, match="no connection"):
        TcpLink("force", "127.0.0.1", device.port)
