"""The simulated Zaber stage against the documented exchanges of its ASCII protocol."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture
def host(make_host):
    return make_host("stage")


def homed(host):
    assert host.ask("stage", b"/1 1 home\n") == b"@01 1 OK BUSY WR 0\r\n"
    host.wait(3.0)
    assert host.ask("stage", b"/1 1\n") == b"@01 1 OK IDLE -- 0\r\n"
    return host


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        (b"/1 0 00 get pos:2D\n", b"@01 0 00 OK IDLE WR 0:BE\r\n"),
        (b"/1 1 32 move abs 20000:BA\n", b"@01 1 32 RJ IDLE WR BADDATA:"),
        (b"/\n", b"@01 0 OK IDLE WR 0\r\n"),
        (b"/0 0 05\r", b"@01 0 05 OK IDLE WR 0\r\n"),
        (b"/1 1 44 sing\r\n", b"@01 1 44 RJ IDLE WR BADCOMMAND\r\n"),
        (b"/1 2 get pos\n", b"@01 2 RJ IDLE WR BADAXIS\r\n"),
        (b"/1 1 get deviceid\n", b"@01 1 RJ IDLE WR DEVICEONLY\r\n"),
        (b"/1 0 get deviceid\n", b"@01 0 OK IDLE WR 50081\r\n"),
        (b"/1 1 get resolution\n", b"@01 1 OK IDLE WR 64\r\n"),
        (b"/1 1 get limit.max\n", b"@01 1 OK IDLE WR 305381\r\n"),
        (b"/1 1 warnings\n", b"@01 1 OK IDLE WR 02 WR WH\r\n"),
        (b"/1 1 set maxspeed -3\n", b"@01 1 RJ IDLE WR BADDATA\r\n"),
        (b"/1 1 set maxspeed nan\n", b"@01 1 RJ IDLE WR BADDATA\r\n"),
        (b"/1 1 set resolution 3\n", b"@01 1 RJ IDLE WR NOACCESS\r\n"),
        (b"/1 1 set knob.enable 0\n", b"@01 1 OK IDLE WR 0\r\n"),
        (b"/1 0 01 get pos:00\n", b""),  # wrong checksum: ignored
        (b"/2 0 get pos\n", b""),  # another device
        (b"/1 0 -- get pos\n", b""),  # no reply wanted
        (b"get pos\n", b""),
        (b"/1 1 get poz\x08s\n", b"@01 1 OK IDLE WR 0\r\n"),
        (b"/1 1 get po\x7fs\n", b""),
        (b"/1 1 get p\xf8os\n", b""),
    ],
)
def test_exchange(host, command, reply):
    answer = host.ask("stage", command)
    assert answer.startswith(reply) and (answer == b"") == (reply == b"")


def test_checksum_of_a_reject_is_the_sum_of_its_bytes(host):
    line = host.ask("stage", b"/1 1 44 sing:" + b"%02X" % (-sum(b"1 1 44 sing") & 0xFF) + b"\n")
    body, check = line[1:].rstrip().split(b":")
    assert (sum(body) + int(check, 16)) & 0xFF == 0


def test_commands_may_come_in_any_pieces(host):
    for byte in b"/1 1 07 get po":
        assert host.ask("stage", bytes([byte])) == b""
    assert host.ask("stage", b"s\n/1 1 08\n") == b"@01 1 07 OK IDLE WR 0\r\n@01 1 08 OK IDLE WR 0\r\n"


def test_homing_gives_a_reference(host):
    assert host.ask("stage", b"/1 1 move rel 10\n") == b"@01 1 RJ IDLE WR BADDATA\r\n"
    homed(host)
    assert host.bench.world.stage.at(host.t)[0] == pytest.approx(0, abs=1e-15)
    assert host.ask("stage", b"/1 1 move rel 10\n") == b"@01 1 OK BUSY -- 0\r\n"


def test_move_takes_the_time_it_must(host):
    homed(host)
    step = 0.49609375e-6
    # 1 mm/s is 3302.60 in data units at resolution 64
    assert host.ask("stage", b"/1 1 set maxspeed 33026\n") == b"@01 1 OK IDLE -- 0\r\n"  # 10 mm/s
    accel = int(host.ask("stage", b"/1 1 get accel\n").split()[-1]) / 1.6384 * 1e4 * step
    assert accel == pytest.approx(0.2, rel=0.01)
    start = host.t
    host.ask("stage", b"/1 1 move abs 40315\n")  # 20 mm
    expected = 20e-3 / 10e-3 + 10e-3 / accel
    while b"BUSY" in host.ask("stage", b"/1 1\n", 0.005):
        pass
    assert host.t - start == pytest.approx(expected, abs=0.02)
    assert host.ask("stage", b"/1 1 get pos\n") == b"@01 1 OK IDLE -- 40315\r\n"
    assert host.bench.world.stage.at(host.t)[0] == pytest.approx(40315 * step, abs=1e-12)


@pytest.mark.parametrize("target", [b"abs 305382", b"abs -1", b"rel -1", b"vel 999999999", b"abs 1e3", b"abs"])
def test_impossible_moves_are_rejected(host, target):
    homed(host)
    assert b" RJ IDLE -- BAD" in host.ask("stage", b"/1 1 move " + target + b"\n")


def test_soft_limit_bounds_moves_and_velocity_moves_stop_at_it(host):
    homed(host)
    host.ask("stage", b"/1 1 set limit.max 20000\n")
    assert b"BADDATA" in host.ask("stage", b"/1 1 move abs 20001\n")
    host.ask("stage", b"/1 1 move vel 66052\n")
    host.wait(2.0)
    assert host.ask("stage", b"/1 1 get pos\n") == b"@01 1 OK IDLE -- 20000\r\n"


def test_stop_decelerates_and_estop_does_not(host):
    homed(host)
    host.ask("stage", b"/1 1 move abs 200000\n")
    host.wait(1.0)
    assert host.ask("stage", b"/1 1 stop\n") == b"@01 1 OK BUSY -- 0\r\n"
    host.wait(0.2)
    assert b"IDLE" in host.ask("stage", b"/1 1\n")
    host.ask("stage", b"/1 1 move abs 200000\n")
    host.wait(1.0)
    assert host.ask("stage", b"/1 1 estop\n", 0.01) == b"@01 1 OK IDLE -- 0\r\n"


def test_a_new_motion_pre_empts_the_old_one_and_says_so(host):
    homed(host)
    host.ask("stage", b"/1 1 move abs 200000\n")
    host.wait(0.5)
    assert host.ask("stage", b"/1 1 move abs 0\n") == b"@01 1 OK BUSY NI 0\r\n"
    assert host.ask("stage", b"/1 1 warnings clear\n") == b"@01 1 OK BUSY -- 01 NI\r\n"
    assert host.ask("stage", b"/1 1 warnings\n") == b"@01 1 OK BUSY -- 00\r\n"


def test_velocity_is_continuous_through_a_pre_emption(host):
    homed(host)
    host.ask("stage", b"/1 1 move abs 200000\n")
    host.wait(0.5)
    before = host.bench.world.stage.at(host.t)[1]
    host.ask("stage", b"/1 1 move abs 0\n", 0.0)
    t = host.t + np.arange(1, 3001) * 1e-3
    host.bench.advance(t[-1])
    x = np.array([host.bench.world.stage.at(time)[0] for time in t])
    assert before > 0.019
    assert np.abs(np.diff(x)).max() <= 0.0201e-3
    assert np.abs(np.diff(x, 2)).max() <= 0.2005e-6  # 200 mm/s^2
    assert x[-1] < x[0]


def test_alert_when_motion_ends_if_wanted(host):
    homed(host)
    host.ask("stage", b"/1 0 set comm.alert 1\n")
    assert host.ask("stage", b"/1 1 move abs 1000\n", 1.0) == b"@01 1 OK BUSY -- 0\r\n!01 1 IDLE --\r\n"


def test_reset_loses_the_reference_but_not_the_place(host):
    homed(host)
    host.ask("stage", b"/1 1 move abs 100000\n")
    host.wait(0.5)
    host.bench.instruments["stage"].reset(host.t)
    place = host.bench.world.stage.at(host.t)[0]
    assert host.ask("stage", b"/1 1\n") == b""  # it boots
    host.wait(0.5)
    assert host.ask("stage", b"/1 1 get pos\n") == b"@01 1 OK IDLE WR 0\r\n"
    assert host.bench.world.stage.at(host.t)[0] == place > 0


def test_long_replies_continue(host):
    host.bench.instruments["stage"]._flags |= {
        *("FF", "FN", "FZ", "FH", "FV", "FO", "FC", "FM", "FD", "FQ", "FI", "FA", "FR", "FS", "FB", "FP", "FE"),
        *("WL", "WV", "WT", "WS", "WM", "WP", "NC", "NI"),
    }
    lines = host.ask("stage", b"/1 1 09 warnings\n").decode().splitlines()
    assert len(lines) == 2 and all(len(line) <= 80 for line in lines)
    assert lines[0].startswith("@01 1 09 OK IDLE FF 27 FF FN") and lines[0].endswith("\\")
    assert lines[1].startswith("#01 1 09 cont ") and lines[1].endswith("NC NI")


def test_encoder_sees_the_screw_error_that_the_step_count_does_not(make_host):
    host = homed(make_host("stage", stage={"screw_error_um": 20.0}))
    host.ask("stage", b"/1 1 move abs 3200\n")  # a quarter turn
    host.wait(1.0)
    position = int(host.ask("stage", b"/1 1 get pos\n").split()[-1])
    encoder = int(host.ask("stage", b"/1 1 get encoder.pos\n").split()[-1])
    assert position == 3200
    assert encoder - position == pytest.approx(20 / 0.49609375, abs=1)
