"""The log is told once that a link is gone, and once that it works again."""

from __future__ import annotations

import pytest

from drivers.links.link import CanFrame, DeviceLost
from rig.base.clock import VirtualClock
from rig.bench.memory_link import MemoryByteLink, MemoryFrameLink
from rig.bench.tap import TappedByteLink, TappedFrameLink
from rig.sim.wire import ByteWire, FrameWire


@pytest.mark.parametrize("kind", ["bytes", "frames"])
@pytest.mark.parametrize("by", ["read", "write"])
def test_what_a_tap_is_told_of_a_link_that_goes_and_comes(kind: str, by: str) -> None:
    told: list[tuple[str, str, bytes, float]] = []
    clock = VirtualClock(lambda t: None)

    def tap(role: str, way: str, data: bytes, t: float) -> None:
        told.append((role, way, data, t))

    if kind == "bytes":
        wire: ByteWire | FrameWire = (serial := ByteWire())
        line = TappedByteLink("stage", MemoryByteLink("stage", serial, clock), tap, clock.now)
        read, write, data = line.read, lambda: line.write(b"ab"), b"ab"
    else:
        wire = bus = FrameWire()
        can = TappedFrameLink("stage", MemoryFrameLink("stage", bus, clock), tap, clock.now)
        read, write, data = can.read, lambda: can.write(CanFrame(2, b"ab")), b"\x00\x02ab"
    read()
    assert told == []
    wire.gone = True
    for _ in range(3):
        with pytest.raises(DeviceLost):
            read() if by == "read" else write()
    sent = [("stage", "tx", data, 0.0)] if by == "write" else []
    assert told == [*sent, ("stage", "gone", b"", 0.0), *sent, *sent]
    wire.gone = False
    told.clear()
    read()
    read()
    assert told == [("stage", "back", b"", 0.0)]
