"""One connection to a LabJack for several instruments on it: it has two, and the guard of the output needs one.

Each instrument numbers its requests by itself; on the wire they get numbers of their own, and the answers their old
ones back. An instrument sees the bytes that it would see on a connection of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

from drivers.links.link import ByteLink

LONGEST = 260  # bytes of a Modbus frame
MOST_WAITING = 1000  # requests whose answers have not come; more are forgotten, the oldest first


class _Connection:
    """The link, and whose request each number is."""

    def __init__(self, link: ByteLink) -> None:
        self.link = link
        self.generation = 0  # how often it was opened again
        self.parts: list[Part] = []
        self.open = 0
        self._last = 0
        self._asked: dict[int, tuple[Part, bytes]] = {}
        self._arrived = b""

    def send(self, part: Part, data: bytes) -> None:
        whole = bytearray()
        while len(data) >= 6:
            length = 6 + int.from_bytes(data[4:6], "big")
            self._last = self._last % 0xFFFF + 1
            self._asked[self._last] = part, data[:2]
            whole += self._last.to_bytes(2, "big") + data[2:length]
            data = data[length:]
        while len(self._asked) > MOST_WAITING:
            del self._asked[next(iter(self._asked))]
        self.link.write(bytes(whole) + data)

    def take_in(self) -> None:
        """Give what has arrived to those who asked for it; what nobody asked for goes to all."""
        data = self._arrived + self.link.read()
        while len(data) >= 6:
            length = 6 + int.from_bytes(data[4:6], "big")
            if length > LONGEST:  # no frame begins here any more: the drivers count it
                break
            if len(data) < length:
                self._arrived = data
                return
            asked = self._asked.pop(int.from_bytes(data[:2], "big"), None)
            if asked is None:
                for part in self.parts:
                    part.inbox += data[:length]
            else:
                part, number = asked
                part.inbox += number + data[2:length]
            data = data[length:]
        self._arrived = b""
        if len(data) >= 6:
            for part in self.parts:
                part.inbox += data
        else:
            self._arrived = data

    def reopen(self) -> None:
        if self.link.reopen():
            self.generation += 1
            self._asked.clear()
            self._arrived = b""
            for part in self.parts:
                part.inbox.clear()


class Part:
    """A `drivers.links.link.ByteLink`: one instrument's part of a connection."""

    def __init__(self, connection: _Connection) -> None:
        self.name = connection.link.name
        self.settings: dict[str, str] = getattr(connection.link, "settings", {})
        self.inbox = bytearray()
        self._connection = connection
        self._generation = connection.generation
        self._closed = False
        connection.parts.append(self)
        connection.open += 1

    @property
    def descriptors(self) -> tuple[int, ...]:
        """Of the connection, for another process; empty where it cannot be handed over."""
        return tuple(getattr(self._connection.link, "descriptors", ()))

    def read(self) -> bytes:
        self._connection.take_in()
        data = bytes(self.inbox)
        self.inbox.clear()
        return data

    def write(self, data: bytes) -> None:
        self._connection.send(self, data)

    def reopen(self) -> bool:
        """Whoever sees first that it is back opens it for all."""
        if self._generation == self._connection.generation:
            self._connection.reopen()
        new = self._generation != self._connection.generation
        self._generation = self._connection.generation
        return new

    def close(self) -> None:
        """The connection is closed with its last part. Calling it twice does no harm."""
        if not self._closed:
            self._closed = True
            self._connection.open -= 1
            if self._connection.open == 0:
                self._connection.link.close()


def shared(link: ByteLink, count: int) -> Sequence[Part]:
    """``count`` links that share one."""
    connection = _Connection(link)
    return [Part(connection) for _ in range(count)]
