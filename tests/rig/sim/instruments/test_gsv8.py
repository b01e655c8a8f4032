"""The simulated GSV-8 against the documented exchanges of its binary protocol."""

from __future__ import annotations

import struct

import numpy as np
import pytest


def h(text: str) -> bytes:
    return bytes.fromhex(text)


QUIET = {"noise_fraction": 0.0, "zero_offset_mV_per_V": 0.25}


@pytest.fixture
def host(make_host):
    """A load cell that has been stopped and drained."""
    host = make_host("force", force=QUIET)
    host.ask("force", h("AA 90 23 85"))
    host.wait(0.1)
    return host


def values(frames: bytes) -> np.ndarray:
    """Channel 1 of a run of whole float frames."""
    assert len(frames) % 36 == 0
    rows = np.frombuffer(frames, dtype=np.uint8).reshape(-1, 36)
    assert (rows[:, :3] == [0xAA, 0x17, 0xB0]).all() and (rows[:, -1] == 0x85).all()
    return rows[:, 3:7].copy().view(">f4").ravel()


def test_it_streams_by_itself_after_power_up(make_host):
    host = make_host("force", force=QUIET)
    stream = host.ask("force", b"", 1.0015)
    assert len(values(stream)) == 100
    assert values(stream) == pytest.approx(0.25, abs=1e-6)


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("AA 90 23 85", "AA 50 00 85"),
        ("AA 91 0C 01 85", "AA 50 00 85"),
        ("AA 91 0C 00 85", "AA 50 00 85"),
        ("AA 94 8B 42 C8 00 00 85", "AA 50 00 85"),
        ("AA 90 8A 85", "AA 54 00 42 C8 00 00 85"),
        ("AA 93 81 01 00 10 85", "AA 50 00 85"),
        ("AA 91 14 01 85", "AA 54 00 40 60 00 00 85"),  # 3.5 mV/V
        ("AA 92 A2 01 FF 85", "AA 55 00 01 00 00 01 5E 85"),  # 5 V bridge, 350 = 3.5 mV/V
        ("AA 91 0F 01 85", "AA 51 00 00 85"),
        ("AA 90 1F 85", "AA 54 00 00 D8 D3 54 85"),
        ("AA 90 77 85", "AA 50 40 85"),  # unknown
        ("AA 91 59 01 85", "AA 51 00 01 85"),  # digital lines 1.1 to 1.4 are inputs
        ("AA 90 06 85", "AA 50 41 85"),  # not implemented
        ("AA 91 8A 01 85", "AA 50 5B 85"),  # wrong number of parameters
        ("AA 91 0C 09 85", "AA 50 51 85"),  # no such channel
        ("AA 91 14 00 85", "AA 50 51 85"),
        ("AA 93 81 01 00 07 85", "AA 50 52 85"),
        ("AA 94 8B 7F C0 00 00 85", "AA 50 52 85"),  # NaN
        ("AA 94 8B 48 00 00 00 85", "AA 50 54 85"),  # 131 kHz
        ("AA 94 8B 00 00 00 00 85", "AA 50 55 85"),
        ("AA 92 A3 01 04 85", "AA 50 59 85"),  # no Pt1000 in this one
        ("AA 90 23 86", "AA 50 42 85"),  # no end where the length says
        ("00 FF AA 50 00 AA 90 23 85", "AA 50 00 85"),  # rubbish before
    ],
)
def test_exchange(host, request_, answer):
    assert host.ask("force", h(request_)) == h(answer)


def test_parameters_that_do_not_come_are_given_up(host):
    assert host.ask("force", h("AA 91 0C"), 0.15) == b""
    assert host.ask("force", b"", 0.15) == h("AA 50 5A 85")
    assert host.ask("force", h("AA 90 23 85")) == h("AA 50 00 85")


def test_one_value_on_request_is_a_frame_and_no_answer(host):
    assert values(host.ask("force", h("AA 90 3B 85"))) == pytest.approx([0.25], abs=1e-6)


def test_rate_and_clock_drift(make_host):
    host = make_host("force", force=QUIET | {"clock_drift_ppm": 1000.0})
    host.ask("force", h("AA 90 23 85"))
    host.ask("force", h("AA 94 8B 44 7A 00 00 85"))  # 1000 Hz
    assert host.ask("force", h("AA 90 24 85"), 0.1)[:4] == h("AA 50 00 85")
    stream = b"".join(host.ask("force", b"", 0.1) for _ in range(100))
    assert len(values(stream)) == 10_010


def test_float_is_scale_times_share_of_the_input_range(host):
    host.ask("force", h("AA 95 15 01") + struct.pack(">f", 350.0) + b"\x85")
    host.ask("force", h("AA 95 9B 01") + struct.pack(">f", 1000.0) + b"\x85")
    assert values(host.ask("force", h("AA 90 3B 85"))) == pytest.approx([1000 + 350 * 0.25 / 3.5], abs=1e-3)


def test_zero_takes_the_present_value_off(host):
    host.ask("force", h("AA 91 0C 01 85"))
    assert values(host.ask("force", h("AA 90 3B 85"))) == pytest.approx([0], abs=1e-6)
    assert struct.unpack(">f", host.ask("force", h("AA 91 02 01 85"))[3:7])[0] == pytest.approx(0.25)


@pytest.mark.parametrize(("word", "status", "width"), [(1, 0x90, 2), (2, 0xA0, 3)])
def test_integers_are_raw_with_a_binary_offset(host, word, status, width):
    host.ask("force", h("AA 93 81 01 00") + bytes([word, 0x85]))
    frame = host.ask("force", h("AA 90 3B 85"))
    assert len(frame) == 4 + 8 * width and frame[:3] == bytes([0xAA, 0x17, status]) and frame[-1] == 0x85
    share = int.from_bytes(frame[3 : 3 + width], "big") / 2 ** (8 * width - 1) - 1
    assert share == pytest.approx(0.25 / 3.5 / 1.05, abs=2.0 ** (1 - 8 * width))
    assert frame[3 + width : -1] == (b"\x80" + bytes(width - 1)) * 7


def test_overload_is_flagged_and_clipped(make_host):
    host = make_host("force", force=QUIET | {"zero_offset_mV_per_V": 5.0})
    frame = host.ask("force", b"", 0.0115)
    assert frame[2] == 0xB1
    assert struct.unpack(">f", frame[3:7])[0] == pytest.approx(3.5 * 1.05, rel=1e-6)


def test_frames_that_nobody_reads_are_lost_whole(make_host):
    host = make_host("force", force=QUIET | {"stored_rate_Hz": 1000.0})
    stream = host.ask("force", b"", 10.0)
    assert len(values(stream)) == 20_480 // 36
    assert host.bench.wire("force").lost_bytes > 9000 * 36
    assert len(values(host.ask("force", b"", 0.1))) == 99  # the frame of this very moment found no room


def test_reset_reboots_and_streams_again(host):
    assert host.ask("force", h("AA 90 78 85")) == h("AA 50 00 85")
    assert host.ask("force", h("AA 90 23 85"), 0.9) == b""
    assert len(values(host.ask("force", b"", 0.2))) > 5


def test_noise_is_a_fraction_of_full_scale(make_host):
    host = make_host("force", force={"noise_fraction": 0.01, "stored_rate_Hz": 1000.0})
    sample = np.concatenate([values(host.ask("force", b"", 0.1)) for _ in range(100)])
    assert sample.std() == pytest.approx(0.01 * 2.0, rel=0.05)
    assert sample.mean() == pytest.approx(0.013, abs=4 * 0.02 / 100)


def test_force_comes_through_the_sensitivity(make_host):
    host = make_host("stage", "force", force=QUIET | {"gain_error": 0.01}, stage={"referenced_at_start": True})
    host.ask("force", h("AA 90 23 85"))
    host.ask("stage", b"/1 1 move abs 100788\n")  # 50 mm: 10 mm beyond contact
    host.wait(5.0)
    force = host.bench.world.force(np.array([host.t]))[0]
    assert force == pytest.approx(0.24, abs=0.001)
    expected = 0.25 + force / 0.5 * 2.0 * 1.01
    assert values(host.ask("force", h("AA 90 3B 85"))) == pytest.approx([expected], rel=1e-6)
