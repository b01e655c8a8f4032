"""The simulated bench in real time, behind one pseudo-terminal per instrument: for drivers on real ports.

The supply's CAN bus is reached through an slcan adapter on its pseudo-terminal. POSIX only.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
from collections.abc import Callable, Mapping
from typing import Protocol

from rig.base.clock import Clock
from rig.base.served import Announcement, tcp_port
from rig.sim.slcan import SlcanAdapter
from rig.sim.wire import ByteWire, FrameWire, TcpWire, WireGone

STEP_S = 0.002  # bytes that arrive by themselves are handed over in bundles of this length, as USB does
IDLE_S = 0.05  # how often `stop` is asked when nothing happens
CHUNK = 4096


class _Line(Protocol):
    """A wire as the pseudo-terminal sees it: bytes both ways."""

    def host_write(self, data: bytes, t: float) -> bytes: ...

    def host_read(self, t: float) -> bytes: ...


class _Serial:
    """A serial wire as a `_Line`: nothing is answered at once."""

    def __init__(self, wire: ByteWire) -> None:
        self._wire = wire

    def host_write(self, data: bytes, t: float) -> bytes:
        self._wire.host_write(data, t)
        return b""

    def host_read(self, t: float) -> bytes:
        return self._wire.host_read(t)


class _Port:
    """One pseudo-terminal. What the host does not read in time is lost, as on a UART, and counted."""

    def __init__(self, line: _Line, wire: ByteWire | FrameWire) -> None:
        self.line = line
        self.wire = wire
        self.lost_bytes = 0
        self.stalled = False  # a fault: an adapter that hangs, takes nothing and gives nothing
        self.master = -1
        self._slave = -1
        self.open()

    def open(self) -> None:
        import tty

        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.name = os.ttyname(self._slave)

    @property
    def is_open(self) -> bool:
        return self.master >= 0

    def read(self) -> bytes:
        try:
            return os.read(self.master, CHUNK)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> None:
        try:
            written = os.write(self.master, data)
        except BlockingIOError:
            written = 0
        self.lost_bytes += len(data) - written

    def close(self) -> None:
        for descriptor in (self.master, self._slave):
            if descriptor >= 0:
                with contextlib.suppress(OSError):
                    os.close(descriptor)
        self.master = self._slave = -1


class _TcpPort:
    """A TCP port on this machine only. One host is served at a time; the next is taken when it has left.

    ``beside`` is the first port of a device that several instruments are on: they have one number, and whichever is
    free takes the next host. One that ``refuses`` closes what comes while the others are taken.
    """

    def __init__(self, line: _Line, wire: TcpWire, beside: _TcpPort | None = None, refuses: bool = False) -> None:
        self.line = line
        self.wire = wire
        self.refuses = refuses
        self.lost_bytes = 0
        self.stalled = False  # as `_Port` has it
        self._listening: socket.socket
        self._listening = socket.create_server(("127.0.0.1", 0), backlog=2) if beside is None else beside._listening
        self._listening.setblocking(False)
        self.number = int(self._listening.getsockname()[1])
        self._host: socket.socket | None = None

    @property
    def is_open(self) -> bool:
        return True

    @property
    def master(self) -> int:
        """Descriptor to wait on."""
        return (self._host or self._listening).fileno()

    def open(self) -> None:
        """It listens always."""

    def read(self) -> bytes:
        if self._host is None:
            with contextlib.suppress(OSError):
                host, _ = self._listening.accept()
                if self.refuses:
                    host.close()
                    return b""
                self._host = host
                self._host.setblocking(False)
                self._host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return b""
        try:
            data = self._host.recv(CHUNK)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._leave()
        return data

    def write(self, data: bytes) -> None:
        written = 0
        if self._host is not None:
            with contextlib.suppress(OSError):
                written = self._host.send(data)
        self.lost_bytes += len(data) - written

    def _leave(self) -> None:
        host, self._host = self._host, None
        if host is not None:
            host.close()

    def close(self) -> None:
        self._leave()
        if self.wire.gone:
            return  # the cable is out; it goes on listening
        self._listening.close()


class Served(Protocol):
    """A bench in memory, simulated or replayed: instruments by role, their wires, and time."""

    now: float

    @property
    def instruments(self) -> Mapping[str, object]: ...

    def prepare(self) -> None: ...

    def wire(self, role: str) -> ByteWire | FrameWire: ...

    def advance(self, t: float) -> None: ...

    def next_time(self) -> float: ...


class Server:
    """Serve ``bench`` on pseudo-terminals from now on.

    Parameters
    ----------
    bench : Served
        Its time starts with the clock's time at the call of `run`.
    clock : Clock
        Real time.
    """

    def __init__(self, bench: Served, clock: Clock) -> None:
        self._bench = bench
        self._clock = clock
        self._ports: dict[str, _Port | _TcpPort] = {}
        self._announcement = Announcement()
        bench.prepare()
        try:
            for role in bench.instruments:
                wire = bench.wire(role)
                line: _Line = SlcanAdapter(wire) if isinstance(wire, FrameWire) else _Serial(wire)
                self._ports[role] = self._tcp_port(role, line, wire) if isinstance(wire, TcpWire) else _Port(line, wire)
        except BaseException:
            self.close()
            raise
        self._announce()

    def _tcp_port(self, role: str, line: _Line, wire: TcpWire) -> _TcpPort:
        box = getattr(self._bench.instruments[role], "box", None)
        beside = [
            port
            for other, port in self._ports.items()
            if box is not None and getattr(self._bench.instruments[other], "box", None) is box
        ]
        first = next((port for port in beside if isinstance(port, _TcpPort)), None)
        return _TcpPort(line, wire, first, refuses=box is not None and len(beside) >= box.connections)

    @property
    def ports(self) -> Mapping[str, dict[str, str | int]]:
        """By role, the keys of a scene that lead to the instrument: ``port``, or ``interface`` and ``can_channel``, or
        ``host`` and ``tcp_port``.

        A wire that vanished and came back has a new name, as a replugged adapter may have.
        """
        return {role: _place(port) for role, port in self._ports.items()}

    @property
    def lost_bytes(self) -> dict[str, int]:
        """By role, how much the host failed to read in time."""
        return {
            role: port.lost_bytes + (port.wire.lost_bytes if isinstance(port.wire, ByteWire) else 0)
            for role, port in self._ports.items()
        }

    def stall(self, role: str, stalled: bool) -> None:
        """Let the adapter of an instrument hang, or work again."""
        self._ports[role].stalled = stalled

    def run(self, stop: Callable[[], bool], look: Callable[[], None] = lambda: None) -> None:
        """Serve until ``stop()`` is true; it is asked at least every 50 ms. ``look`` is called each time too."""
        start = self._clock.now() - self._bench.now
        while not stop():
            now = self._clock.now() - start
            self._bench.advance(now)
            look()
            for port in self._ports.values():
                self._hand_over(port, now)
            ports = sorted(self._ports.values(), key=_comes_last)  # of those on one descriptor the last one takes it
            open_ports = {port.master: port for port in ports if port.is_open and not port.stalled}
            wait = min(max(self._bench.next_time() - now, STEP_S), IDLE_S)
            ready, _, _ = select.select(list(open_ports), [], [], wait)
            if ready:
                now = self._clock.now() - start
                self._bench.advance(now)
            for descriptor in ready:
                self._take(open_ports[descriptor], now)

    def _hand_over(self, port: _Port | _TcpPort, now: float) -> None:
        if port.wire.gone:
            port.close()
            return
        if not port.is_open:
            port.open()
            self._announce()
        data = port.line.host_read(now)
        if data and not port.stalled:
            port.write(data)

    def _take(self, port: _Port | _TcpPort, now: float) -> None:
        data = port.read()
        if not data:
            return
        with contextlib.suppress(WireGone):  # pulled in this very moment
            answer = port.line.host_write(data, now)
            if answer:
                port.write(answer)

    def close(self) -> None:
        """Close all ports; hosts see them vanish."""
        self._announcement.withdraw()
        for port in self._ports.values():
            port.close()

    def _announce(self) -> None:
        self._announcement.say(
            tcp_port(port.number) if isinstance(port, _TcpPort) else port.name for port in self._ports.values()
        )


def _comes_last(port: _Port | _TcpPort) -> bool:
    return not (isinstance(port, _TcpPort) and port.refuses)


def _place(port: _Port | _TcpPort) -> dict[str, str | int]:
    if isinstance(port, _TcpPort):
        return {"host": "127.0.0.1", "tcp_port": port.number}
    if isinstance(port.wire, FrameWire):
        return {"interface": "slcan", "can_channel": port.name}
    return {"port": port.name}
