"""Links that tell a tap what passes on them: the log's raw bytes and frames, and when a link was gone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from drivers.links.link import ByteLink, CanFrame, DeviceLost, FrameLink
from rig.log.schema import Way


class Tap(Protocol):
    """Is told every byte and frame, before it is sent and as soon as it has been read, with the time of that poll."""

    def __call__(self, role: str, way: Way, data: bytes, t: float) -> None: ...


class _Tapped:
    """Tells a tap what passes, and once when the link is lost and when it works again."""

    def __init__(self, role: str, tap: Tap, when: Callable[[], float]) -> None:
        self._role = role
        self._tap = tap
        self._when = when
        self._gone = False

    def _tell(self, way: Way, data: bytes = b"") -> None:
        self._tap(self._role, way, data, self._when())

    def _lost(self) -> None:
        if not self._gone:
            self._gone = True
            self._tell("gone")

    def _works(self) -> None:
        if self._gone:
            self._gone = False
            self._tell("back")


class TappedByteLink(_Tapped):
    """A serial link whose traffic is told to a tap."""

    def __init__(self, role: str, link: ByteLink, tap: Tap, when: Callable[[], float]) -> None:
        super().__init__(role, tap, when)
        self.name = link.name
        self._link = link

    def read(self) -> bytes:
        try:
            data = self._link.read()
        except DeviceLost:
            self._lost()
            raise
        self._works()
        if data:
            self._tell("rx", data)
        return data

    def write(self, data: bytes) -> None:
        self._tell("tx", data)
        try:
            self._link.write(data)
        except DeviceLost:
            self._lost()
            raise

    def reopen(self) -> bool:
        return self._link.reopen()

    def close(self) -> None:
        self._link.close()


class TappedFrameLink(_Tapped):
    """A CAN link whose frames are told to a tap as identifier (two bytes, big-endian) and data."""

    def __init__(self, role: str, link: FrameLink, tap: Tap, when: Callable[[], float]) -> None:
        super().__init__(role, tap, when)
        self.name = link.name
        self._link = link

    def read(self) -> list[CanFrame]:
        try:
            frames = self._link.read()
        except DeviceLost:
            self._lost()
            raise
        self._works()
        for frame in frames:
            self._tell("rx", frame.id.to_bytes(2, "big") + frame.data)
        return frames

    def write(self, frame: CanFrame, *, urgent: bool = False) -> None:
        self._tell("tx", frame.id.to_bytes(2, "big") + frame.data)
        try:
            self._link.write(frame, urgent=urgent)
        except DeviceLost:
            self._lost()
            raise

    def reopen(self) -> bool:
        return self._link.reopen()

    def close(self) -> None:
        self._link.close()
