"""Wires: nothing early, nothing out of order, what does not fit is lost whole and counted."""

from __future__ import annotations

import pytest

from rig.sim.wire import ByteWire, FrameWire, WireGone


def test_bytes_arrive_one_after_the_other():
    wire = ByteWire(latency=1e-3, baud=10_000)  # 1 ms a byte
    wire.send(b"abcd", 0.0)
    assert wire.host_read(1.9e-3) == b""
    assert wire.next_arrival == pytest.approx(2e-3)
    assert wire.host_read(2.0e-3) == b"a"
    assert wire.host_read(4.5e-3) == b"bc"
    assert wire.host_read(1.0) == b"d"


def test_messages_queue_behind_each_other():
    wire = ByteWire(baud=10_000)
    wire.send(b"abcd", 0.0)
    wire.send(b"ef", 1e-3)
    assert wire.host_read(4.5e-3) == b"abcd"
    assert wire.host_read(6.1e-3) == b"ef"


def test_host_messages_arrive_whole_with_the_time_of_the_last_bit():
    wire = ByteWire(latency=1e-3, baud=10_000)
    wire.host_write(b"ab", 0.0)
    assert wire.next_delivery == pytest.approx(3e-3)
    assert wire.deliveries(2.9e-3) == []
    [(t, data)] = wire.deliveries(1.0)
    assert data == b"ab" and t == pytest.approx(3e-3)


def test_overflow_loses_whole_messages_and_counts_them():
    wire = ByteWire(capacity=10)
    assert wire.send(b"12345678", 0.0) and not wire.send(b"abc", 0.0) and wire.send(b"90", 0.0)
    assert wire.host_read(0.0) == b"1234567890" and wire.lost_bytes == 3
    assert wire.send(b"abc", 0.0)


def test_a_cut_wire_says_so_at_both_calls_and_forgets():
    for wire, message in ((ByteWire(), b"x"), (FrameWire(), (1, b"x"))):
        wire.send(message, 0.0)
        wire.cut()
        with pytest.raises(WireGone):
            wire.host_read(1.0)
        with pytest.raises(WireGone):
            wire.host_write(message, 1.0)
        wire.restore()
        assert not wire.host_read(1.0)


def test_frames_share_the_bus():
    bus = FrameWire(bitrate=125_000)
    bus.host_write((0x201, bytes(2)), 0.0)
    bus.send((0x200, bytes(8)), 0.0)
    [(t, frame)] = bus.deliveries(1.0)
    assert frame == (0x201, bytes(2)) and t == pytest.approx(63 / 125_000)
    assert bus.host_read(173 / 125_000) == []
    assert bus.host_read(174 / 125_000 + 1e-9) == [(0x200, bytes(8))]
