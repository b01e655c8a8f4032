"""Serial lines at the other end of a network: device servers, as boxes with serial ports or as ser2net.

``socket://host:port`` carries the bytes as they are; the line's rate is set in the server. ``rfc2217://host:port``
carries them in telnet, and sets the rate too: RFC 2217, "Telnet Com Port Control Option". In telnet a byte FF is
doubled; FF and another byte are commands; ``FF FA 2C 01 <rate, four bytes> FF F0`` sets the rate and is answered with
65 in place of 01.

Nothing here waits once the connection is open: what is asked of the server goes out before the first byte, and servers
keep the order. What it answers is looked at when it comes.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from urllib.parse import urlsplit

from drivers.links.link import DeviceError, DeviceRefused
from drivers.links.port_lock import PortLock
from drivers.links.serial_link import SerialLink
from drivers.links.tcp_link import TcpLink

SCHEMES = ("socket", "rfc2217")

IAC, DONT, DO, WONT, WILL, SB, SE = 0xFF, 0xFE, 0xFD, 0xFC, 0xFB, 0xFA, 0xF0
BINARY, NO_GO_AHEAD, COM_PORT = 0, 3, 44
SET_BAUDRATE, SET_DATASIZE, SET_PARITY, SET_STOPSIZE, SET_CONTROL = 1, 2, 3, 4, 5
FROM_SERVER = 100  # is added to a command in its answer
LONGEST = 64  # bytes of one command of the server that are kept


class Telnet:
    """Bytes from an RFC 2217 server to those of the line, and back. Never raises.

    ``counters``: ``telnet_garbage`` (commands that make no sense). ``baud`` is the rate that the server says it has
    set, None until it does; ``refused`` is True when it does not take line settings.
    """

    def __init__(self, counters: dict[str, int]) -> None:
        self.counters = counters
        counters.setdefault("telnet_garbage", 0)
        self.baud: int | None = None
        self.refused = False
        self._command = bytearray()  # begun and not complete; empty in data
        self._answered: set[tuple[int, int]] = set()

    def opening(self, baud: int) -> bytes:
        """What is asked of the server at first: 8N1 at ``baud``, without flow control."""
        asked = bytearray()
        for option in (BINARY, NO_GO_AHEAD):
            asked += bytes((IAC, WILL, option, IAC, DO, option))
        asked += bytes((IAC, WILL, COM_PORT))
        for command, value in (
            (SET_BAUDRATE, baud.to_bytes(4, "big")),
            (SET_DATASIZE, b"\x08"),
            (SET_PARITY, b"\x01"),
            (SET_STOPSIZE, b"\x01"),
            (SET_CONTROL, b"\x01"),
        ):
            asked += bytes((IAC, SB, COM_PORT, command)) + encode(value) + bytes((IAC, SE))
        return bytes(asked)

    def feed(self, data: bytes) -> tuple[bytes, bytes]:
        """(bytes of the line, what is to be answered to the server)."""
        if not self._command and IAC not in data:
            return data, b""
        line, answer = bytearray(), bytearray()
        command = self._command
        for byte in data:
            if not command:
                (command if byte == IAC else line).append(byte)
                continue
            command.append(byte)
            if command[1] == IAC:  # a doubled one is a byte of the line
                line.append(IAC)
                command.clear()
            elif command[1] == SB:
                if command[-2:] == bytes((IAC, SE)) and len(command) > 3:
                    self._subnegotiation(bytes(command[2:-2]).replace(b"\xff\xff", b"\xff"))
                    command.clear()
                elif len(command) > LONGEST:
                    self.counters["telnet_garbage"] += 1
                    command.clear()
            elif command[1] not in (WILL, WONT, DO, DONT):
                command.clear()  # a command of two bytes, none of which matters here
            elif len(command) == 3:
                answer += self._option(command[1], command[2])
                command.clear()
        return bytes(line), bytes(answer)

    def _option(self, verb: int, option: int) -> bytes:
        if verb == DONT and option == COM_PORT:
            self.refused = True
        asked_by_us = option in (BINARY, NO_GO_AHEAD) or (option == COM_PORT and verb == DO)
        if verb in (WONT, DONT) or asked_by_us or (verb, option) in self._answered:
            return b""
        self._answered.add((verb, option))
        if verb == WILL:
            return bytes((IAC, DO if option == COM_PORT else DONT, option))
        return bytes((IAC, WONT, option))

    def _subnegotiation(self, what: bytes) -> None:
        if what[:2] == bytes((COM_PORT, FROM_SERVER + SET_BAUDRATE)) and len(what) == 6:
            self.baud = int.from_bytes(what[2:], "big")
        elif what[:1] != bytes((COM_PORT,)):
            self.counters["telnet_garbage"] += 1


def encode(data: bytes) -> bytes:
    """Bytes of the line as telnet carries them."""
    return data.replace(b"\xff", b"\xff\xff")


class DeviceServerLink:
    """A `drivers.links.link.ByteLink` over a device server; arguments as `drivers.links.serial_link.SerialLink` has.

    Raises
    ------
    DeviceError
        The address makes no sense, nobody answers there, or another program of this computer has that port.
    """

    def __init__(
        self,
        name: str,
        port: str,
        baud: int,
        *,
        adopt: Sequence[int] = (),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name = port
        self._label = f"{name} ({port})"
        scheme, host, number = _parsed(self._label, port)
        self._baud = baud
        self._lock = None if adopt else PortLock(self._label, port)
        self._held = tuple(adopt[1:])
        try:
            self._tcp = TcpLink(name, host, number, adopt=adopt[:1], clock=clock)
        except BaseException:
            if self._lock is not None:
                self._lock.release()
            raise
        self.counters = self._tcp.counters
        self.settings = {"port": port, "baud": str(baud) if scheme == "rfc2217" else "set in the device server"}
        self._telnet = Telnet(self.counters) if scheme == "rfc2217" else None
        if not adopt:
            self._set_line()

    def _set_line(self) -> None:
        if self._telnet is not None:
            self._telnet = Telnet(self.counters)
            self._tcp.write(self._telnet.opening(self._baud))

    def read(self) -> bytes:
        """Everything of the line that has arrived."""
        data = self._tcp.read()
        if self._telnet is None or not data:
            return data
        line, answer = self._telnet.feed(data)
        if answer:
            self._tcp.write(answer)
        if self._telnet.refused:
            self.settings["remark"] = "the device server takes no line settings; its own hold"
        if self._telnet.baud not in (None, self._baud):
            raise DeviceRefused(
                self._label,
                f"the device server has set {self._telnet.baud} baud although {self._baud} were asked for",
                "Set the line in the server, or another rate in instrument and scene.",
            )
        return line

    def write(self, data: bytes, *, behind: bytes | None = None) -> None:
        """As `drivers.links.serial_link.SerialLink.write`."""
        self._tcp.write(data if self._telnet is None else encode(data), behind=behind)

    @property
    def descriptors(self) -> tuple[int, ...]:
        """As `drivers.links.serial_link.SerialLink.descriptors`."""
        if self._lock is None or os.name != "posix" or not self._tcp.descriptors:
            return ()
        return (*self._tcp.descriptors, self._lock.fd)

    def reopen(self) -> bool:
        """Try to connect again, without waiting; True when it is connected, and the line asked for."""
        if not self._tcp.reopen():
            return False
        self._set_line()
        return True

    def resume(self) -> None:
        """Nothing of a predecessor is left in bytes."""

    def close(self) -> None:
        """Release it. Calling it twice does no harm."""
        self._tcp.close()
        if self._lock is not None:
            self._lock.release()
        held, self._held = self._held, ()
        for descriptor in held:
            os.close(descriptor)


def open_line(
    name: str, port: str, baud: int, *, adopt: Sequence[int] = (), clock: Callable[[], float] = time.monotonic
) -> SerialLink | DeviceServerLink:
    """The link to a serial port of this computer, or of a device server where ``port`` is an address."""
    kind = DeviceServerLink if "://" in port else SerialLink
    return kind(name, port, baud, adopt=adopt, clock=clock)


def _parsed(label: str, port: str) -> tuple[str, str, int]:
    advice = f"Give {' or '.join(f'{scheme}://HOST:PORT' for scheme in SCHEMES)}."
    try:
        url = urlsplit(port)
        host, number = url.hostname, url.port
    except ValueError as error:
        raise DeviceError(label, f"{port} is no address ({error})", advice) from None
    if url.scheme not in SCHEMES or not host or not number or url.path not in ("", "/") or url.query or url.username:
        raise DeviceError(label, f"{port} is no address of a device server", advice)
    return url.scheme, host, number
