"""Links that tell a tap what passes on them: the log's raw bytes and frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, Protocol

from drivers.links.link import ByteLink, CanFrame, FrameLink


class Tap(Protocol):
    """Is told every byte and frame, before it is sent and as soon as it has been read, with the time of that poll."""

    def __call__(self, role: str, way: Literal["rx", "tx"], data: bytes, t: float) -> None: ...


class TappedByteLink:
    """A serial link whose traffic is told to a tap."""

    def __init__(self, role: str, link: ByteLink, tap: Tap, when: Callable[[], float]) -> None:
        self.name = link.name
        self._role = role
        self._link = link
        self._tap = tap
        self._when = when

    def read(self) -> bytes:
        data = self._link.read()
        if data:
            self._tap(self._role, "rx", data, self._when())
        return data

    def write(self, data: bytes) -> None:
        self._tap(self._role, "tx", data, self._when())
        self._link.write(data)

    def reopen(self) -> bool:
        return self._link.reopen()

    def close(self) -> None:
        self._link.close()


class TappedFrameLink:
    """A CAN link whose frames are told to a tap as identifier (two bytes, big-endian) and data."""

    def __init__(self, role: str, link: FrameLink, tap: Tap, when: Callable[[], float]) -> None:
        self.name = link.name
        self._role = role
        self._link = link
        self._tap = tap
        self._when = when

    def read(self) -> list[CanFrame]:
        frames = self._link.read()
        for frame in frames:
            self._tap(self._role, "rx", frame.id.to_bytes(2, "big") + frame.data, self._when())
        return frames

    def write(self, frame: CanFrame, *, urgent: bool = False) -> None:
        self._tap(self._role, "tx", frame.id.to_bytes(2, "big") + frame.data, self._when())
        self._link.write(frame, urgent=urgent)

    def reopen(self) -> bool:
        return self._link.reopen()

    def close(self) -> None:
        self._link.close()
