"""Every fault switch does what it says, from the scene's table or at run time, by the seed."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from pydantic import ValidationError

from rig.sim.settings import SimulationSettings
from rig.sim.truth import SWITCHES, Fault
from rig.sim.twins import registered
from rig.sim.wire import WireGone

POLL = b"/1 1 07\n"
REPLY = b"@01 1 07 OK IDLE WR 0\r\n"


def fault(role: str, kind: str, **keys) -> Fault:
    return Fault.model_validate({"role": role, "kind": kind, **keys})


@pytest.fixture
def stage(make_host):
    return make_host("stage")


# Wires


def test_delay_makes_a_reply_late_and_keeps_the_order(stage):
    stage.bench.inject(fault("stage", "delay", duration_s=0.1, value=0.3))
    assert stage.ask("stage", POLL, 0.15) == b""
    assert stage.ask("stage", b"/1 1 08\n", 0.1) == b""
    assert stage.ask("stage", b"", 0.2) == REPLY + b"@01 1 08 OK IDLE WR 0\r\n"


def test_drop_loses_replies_but_the_command_was_done(stage):
    stage.bench.inject(fault("stage", "drop", duration_s=0.1))
    assert stage.ask("stage", b"/1 1 01 home\n", 0.15) == b""
    assert stage.ask("stage", POLL) == b"@01 1 07 OK BUSY WR 0\r\n"


def test_drop_to_the_device_loses_the_command(stage):
    stage.bench.inject(fault("stage", "drop", duration_s=0.1, direction="to_device"))
    assert stage.ask("stage", b"/1 1 01 home\n", 0.15) == b""
    assert stage.ask("stage", POLL) == REPLY


def test_split_tears_a_reply_in_two(stage):
    stage.bench.inject(fault("stage", "split", value=0.05))
    first = stage.ask("stage", POLL)
    assert 0 < len(first) < len(REPLY)
    assert first + stage.ask("stage", b"", 0.1) == REPLY


def test_merge_glues_two_replies_into_one_piece(stage):
    stage.bench.inject(fault("stage", "merge"))
    assert stage.ask("stage", POLL, 0.2) == b""
    assert stage.ask("stage", POLL) == REPLY * 2


def test_duplicate(stage):
    stage.bench.inject(fault("stage", "duplicate"))
    assert stage.ask("stage", POLL) == REPLY * 2


def test_corrupt_turns_one_bit(stage):
    stage.bench.inject(fault("stage", "corrupt"))
    for _ in range(20):
        damaged = stage.ask("stage", POLL)
        assert len(damaged) == len(REPLY)
        assert sum((a ^ b).bit_count() for a, b in zip(damaged, REPLY, strict=True)) == 1


def test_corruption_on_the_way_to_the_device_is_caught_by_its_checksum(stage):
    stage.bench.inject(fault("stage", "corrupt", direction="to_device"))
    command = b"/1 1 07 home:" + b"%02X" % (-sum(b"1 1 07 home") & 0xFF) + b"\n"
    for _ in range(50):
        stage.ask("stage", command)
        stage.ask("stage", b"\n")
        assert stage.bench.world.stage.at(stage.t)[1] == 0


def test_silent_hears_but_says_nothing(stage):
    stage.bench.inject(fault("stage", "silent", duration_s=1.0))
    assert stage.ask("stage", b"/1 1 01 home\n", 0.9) == b""
    assert stage.ask("stage", b"", 0.3) == b""
    assert stage.ask("stage", POLL).startswith(b"@01 1 07 OK BUSY")


@pytest.mark.parametrize("role", ["stage", "force", "displacement", "hv"])
def test_vanish_and_come_back(make_host, role):
    host = make_host("stage", "force", "displacement", "hv")
    host.wait(0.2)
    host.bench.inject(fault(role, "vanish", at_s=0.3, duration_s=1.0))
    host.bench.advance(0.35)
    message = (0x201, b"\x12\x08") if role == "hv" else b"x"
    with pytest.raises(WireGone):
        host.bench.wire(role).host_read(0.35)
    with pytest.raises(WireGone):
        host.bench.wire(role).host_write(message, 0.35)
    host.bench.advance(1.35)
    host.bench.wire(role).host_write(message, 1.35)


def test_probability_is_kept_and_seeded(make_host):
    def run(seed: int) -> list[bool]:
        host = make_host("stage", seed=seed, fault=[{"role": "stage", "kind": "drop", "probability": 0.3}])
        return [host.ask("stage", POLL, 0.01) == b"" for _ in range(400)]

    assert run(5) == run(5) != run(6)
    assert sum(run(5)) == pytest.approx(120, abs=30)


def test_can_frames_can_be_lost_doubled_and_damaged(make_host):
    host = make_host("hv")
    host.can("200#D801")
    host.bench.inject(fault("hv", "duplicate", duration_s=0.1))
    assert host.can("201#1208", 0.2) == ["200#120801"] * 2
    host.bench.inject(fault("hv", "drop", at_s=host.t, duration_s=0.1))
    assert host.can("201#1208", 0.2) == []
    host.bench.inject(fault("hv", "corrupt", at_s=host.t, duration_s=0.1))
    [answer] = host.can("201#1208", 0.2)
    assert answer != "200#120801" and len(answer) == len("200#120801")
    assert host.can("201#1208") == ["200#120801"]


# Stage


def test_alerts_come_in_between(stage):
    stage.bench.inject(fault("stage", "alert", at_s=0.5, duration_s=0.1, value=0.02))
    assert stage.ask("stage", b"", 0.7) == b"!01 1 IDLE WR\r\n" * 5


def test_alerts_between_a_command_and_its_reply(make_host):
    host = make_host("stage", "displacement")
    host.bench.inject(fault("stage", "alert", value=0.0, duration_s=1.0))
    host.bench.inject(fault("displacement", "alert", value=0.0, probability=0.5))
    assert host.ask("stage", POLL) == b"!01 1 IDLE WR\r\n" + REPLY
    pushed = [host.ask("displacement", b"M1\r").startswith(b"TG,1,") for _ in range(100)]
    assert 30 < sum(pushed) < 70
    assert host.ask("stage", POLL) == REPLY


def test_reset_in_the_middle_of_a_move(make_host):
    host = make_host("stage", stage={"referenced_at_start": True})
    host.ask("stage", b"/1 1 move abs 100000\n")
    host.bench.inject(fault("stage", "reset", at_s=1.0))
    host.wait(2.0)
    assert host.ask("stage", POLL) == REPLY
    stood = host.bench.world.stage.at(host.t)
    assert 12e-3 < stood[0] < 49e-3 and stood[1] == 0
    assert b"RJ" in host.ask("stage", b"/1 1 move abs 100000\n")


def test_frozen_position_and_wrong_status(make_host):
    host = make_host("stage", stage={"referenced_at_start": True})
    before = host.ask("stage", b"/1 1 get pos\n").split()[-1]
    host.bench.inject(fault("stage", "freeze"))
    host.ask("stage", b"/1 1 move abs 100000\n")
    host.wait(1.0)
    assert host.ask("stage", b"/1 1 get pos\n").split()[-1] == before
    host.bench.inject(fault("stage", "wrong_status", duration_s=0.5))
    host.wait(0.1)
    assert host.ask("stage", POLL) == b"@01 1 07 OK BUSY FS 0\r\n"


# Sensors


def frames(host) -> list[tuple[int, float]]:
    data = host.ask("force", b"", 0.1)
    rows = [data[k : k + 36] for k in range(0, len(data), 36)]
    return [(row[2], struct.unpack(">f", row[3:7])[0]) for row in rows]


@pytest.mark.parametrize(("value", "rail"), [(None, 3.675), (-1.0, -3.675)])
def test_saturated_cell_sits_at_the_rail_with_the_overload_bit(make_host, value, rail):
    host = make_host("force")
    host.bench.inject(fault("force", "saturate", value=value))
    host.wait(0.1)
    assert len(frames(host)) >= 9
    assert all(status == 0xB1 and reading == pytest.approx(rail, rel=1e-6) for status, reading in frames(host))


def test_frozen_cell_repeats_one_value(make_host):
    host = make_host("force")
    host.bench.inject(fault("force", "freeze", duration_s=1.0))
    host.wait(0.1)
    assert len({reading for _, reading in frames(host)}) == 1
    host.wait(1.0)
    assert len({reading for _, reading in frames(host)}) > 5


def test_wrong_status_of_the_cell(make_host):
    host = make_host("force")
    host.bench.inject(fault("force", "wrong_status", value=2))
    host.wait(0.1)
    assert {status for status, _ in frames(host)} == {0xB2}


@pytest.mark.parametrize(
    ("kind", "value", "answer"),
    [
        ("saturate", None, b"M1,+FFFFFFF\r"),
        ("saturate", -1.0, b"M1,-FFFFFFF\r"),
        ("no_value", None, b"M1,XXXXXXXX\r"),
        ("wrong_status", None, b"ER,M1,99\r"),
    ],
)
def test_laser_faults(make_host, kind, value, answer):
    host = make_host("displacement")
    host.wait(0.5)
    host.bench.inject(fault("displacement", kind, duration_s=1.0, value=value))
    host.wait(0.1)
    assert host.ask("displacement", b"M1\r") == answer
    host.wait(1.0)
    assert host.ask("displacement", b"M1\r").startswith(b"M1,+01.2")


def test_frozen_laser_and_pushed_lines(make_host):
    host = make_host("stage", "displacement", stage={"referenced_at_start": True})
    host.wait(0.5)
    host.bench.inject(fault("displacement", "freeze"))
    host.wait(0.1)
    before = host.ask("displacement", b"M1\r")
    host.ask("stage", b"/1 1 move abs 100000\n")
    host.wait(5.0)
    assert host.ask("displacement", b"M1\r") == before
    assert host.bench.world.displacement(np.array([host.t]))[0] > 9e-3
    host.bench.inject(fault("displacement", "alert"))
    assert host.ask("displacement", b"M1\r") == b"TG,1" + before[2:] + before


# Supply


@pytest.fixture
def supply(make_host):
    """A supply that stands at 1200 V."""
    host = make_host("hv", hv={"voltage_noise_V": 0.0, "current_noise_nA": 0.0})
    host.can("200#D801")
    host.can("200#41000044960000")
    host.can("200#4001000008")
    host.wait(3.0)
    assert output(host) == 1200.0
    return host


def output(host) -> float:
    return host.bench.world.output.at(host.t)[0]


def status(host) -> int:
    return int(host.can("201#400000")[0][-4:], 16)


def reading(host, opcode: str) -> float:
    return struct.unpack(">f", bytes.fromhex(host.can(f"201#{opcode}00")[0][-8:]))[0]


@pytest.mark.parametrize("way", ["200#4001000000", "200#4001000020", "004#E80060010020", "200#41000000000000"])
def test_stuck_on_says_off_but_is_not(supply, way):
    supply.bench.inject(fault("hv", "stuck_on"))
    supply.wait(0.1)
    supply.can(way)
    supply.wait(3.0)
    if way.startswith("200#4001"):
        assert not status(supply) & 1 << 3
    assert output(supply) == 1200.0
    assert reading(supply, "4102") == pytest.approx(1200.0)


def test_breakdown_draws_all_the_current_there_is(supply):
    supply.bench.inject(fault("hv", "breakdown"))
    supply.wait(0.3)
    assert reading(supply, "4103") == pytest.approx(1e-3, rel=0.02)
    assert output(supply) < 20
    assert status(supply) & 1 << 6


def test_over_current_trips_with_kill(supply):
    supply.can("200#10014000")
    supply.bench.inject(fault("hv", "over_current", value=2e-3, duration_s=1.0))
    supply.wait(0.3)
    assert output(supply) == 0 and status(supply) & 1 << 13
    supply.wait(2.0)
    assert output(supply) == 0


def test_leakage_below_the_limit_is_only_seen(supply):
    supply.bench.inject(fault("hv", "over_current", value=2e-4))
    supply.wait(0.3)
    assert reading(supply, "4103") == pytest.approx(2e-4, rel=1e-3)
    assert output(supply) == 1200.0


def test_sag(supply):
    supply.bench.inject(fault("hv", "sag", value=0.8, duration_s=5.0))
    supply.wait(1.0)
    assert reading(supply, "4102") == pytest.approx(960.0)
    assert reading(supply, "4100") == 1200.0
    supply.wait(6.0)
    assert reading(supply, "4102") == pytest.approx(1200.0)


def test_interlock_and_inhibit(supply):
    for kind in ("interlock", "inhibit"):
        supply.bench.inject(fault("hv", kind, at_s=supply.t, duration_s=0.5))
        supply.wait(0.2)
        assert output(supply) == 0 and not status(supply) & 1 << 3
        supply.wait(1.0)
        supply.can("200#4001000008")
        assert not status(supply) & 1 << 3  # blocked by the event
        supply.can("200#400200FFFF")
        supply.can("200#10020400")
        supply.can("200#4001000008")
        supply.wait(3.0)
        assert output(supply) == 1200.0


def test_reset_of_the_supply_takes_the_output_off_and_forgets(supply):
    supply.bench.inject(fault("hv", "reset"))
    supply.wait(0.5)
    assert output(supply) == 0
    assert supply.can("201#1208") == []
    supply.wait(1.0)
    assert status(supply) == 0 and reading(supply, "4100") == 0


def test_frozen_and_wrong_readings(supply):
    supply.bench.inject(fault("hv", "freeze"))
    supply.wait(0.1)
    supply.can("200#4001000020")
    supply.wait(0.5)
    assert output(supply) == 0 and reading(supply, "4102") == pytest.approx(1200.0)
    supply.bench.inject(fault("hv", "wrong_status", value=1 << 13, duration_s=1.0))
    supply.wait(0.1)
    assert status(supply) & 1 << 13


# The table


def test_faults_of_the_scene_begin_by_themselves(make_host):
    host = make_host("stage", fault=[{"role": "stage", "kind": "silent", "at_s": 1.0, "duration_s": 1.0}])
    assert host.ask("stage", POLL) == REPLY
    host.wait(1.2)
    assert host.ask("stage", POLL) == b""
    host.wait(1.0)
    assert host.ask("stage", POLL) == REPLY


def test_faults_of_roles_that_are_not_there_are_left_out_of_a_scene_and_refused_at_run_time(make_host):
    host = make_host("stage", fault=[{"role": "hv", "kind": "silent"}])
    with pytest.raises(ValueError, match="there is no hv"):
        host.bench.inject(fault("hv", "silent"))


PROBE = {
    "zaber": b"/1 1\n",
    "keyence-lkg": b"M1\r",
    "shvps": b"QVer\r",
    "iseg-edcp": "201#1208",
    "cia404": "605#4000100000000000",
    "gsv8": b"",
    "ascii-stream": b"",
    "optoncdt-1420": b"",
    "scpi": b"*IDN?\n",
    **dict.fromkeys(
        ("labjack-amplifier", "labjack-force", "labjack-displacement", "labjack-monitor"),
        bytes.fromhex("000100000006010300000002"),
    ),
}
TWINS_BY_DRIVER = {one.driver: (one.role, one.truth) for one in registered().twins.values()}


@pytest.mark.parametrize("driver", TWINS_BY_DRIVER)
def test_every_fault_of_every_instrument_can_be_switched_on_and_off(make_host, driver):
    role, twin = TWINS_BY_DRIVER[driver]
    host = make_host(role, **{role: {"driver": driver}})
    host.wait(2.5)
    for kind in twin.faults():
        host.bench.inject(fault(role, kind, at_s=host.t + 0.1, duration_s=0.2, direction="both"))
        host.t += 3.0
        host.bench.advance(host.t)
    host.wait(0.5)
    answer = host.can(PROBE[driver], role=role) if isinstance(PROBE[driver], str) else host.ask(role, PROBE[driver])
    assert answer


@pytest.mark.parametrize("driver", TWINS_BY_DRIVER)
def test_every_switch_means_something_for_an_instrument_or_it_says_why_not(make_host, driver):
    role, twin = TWINS_BY_DRIVER[driver]
    assert set(twin.means_nothing) <= set(SWITCHES) and not set(twin.means_nothing) & set(twin.more_faults)
    for kind in SWITCHES:
        if kind in twin.means_nothing:
            with pytest.raises(ValueError, match="has no fault") as refused:
                make_host(role, **{role: {"driver": driver}}, fault=[{"role": role, "kind": kind}])
            assert twin.means_nothing[kind] in str(refused.value)


@pytest.mark.parametrize(("driver", "message"), [("iseg-edcp", "201#d8"), ("cia404", "085#1081")])
def test_what_a_node_on_can_says_unasked(make_host, driver, message):
    role, _ = TWINS_BY_DRIVER[driver]
    host = make_host(role, **{role: {"driver": driver}})
    host.wait(0.5)
    host.can("200#D801", role=role)  # the supply is registered, and quiet
    host.bench.inject(fault(role, "alert", at_s=host.t, value=0.0, duration_s=1.0))
    answers = host.can(PROBE[driver], role=role)
    assert answers[0].startswith(message) and len(answers) > 1
    host.wait(1.0)
    assert not host.can(PROBE[driver], role=role)[0].startswith(message)


@pytest.mark.parametrize(
    "bad",
    [
        {"role": "stage", "kind": "stuck_on"},
        {"role": "hv", "kind": "split"},
        {"role": "laser", "kind": "drop"},
        {"role": "stage", "kind": "drop", "probability": 1.5},
        {"role": "stage", "kind": "drop", "at_s": -1.0},
        {"role": "stage", "kind": "drop", "colour": "red"},
    ],
)
def test_impossible_faults_are_refused(bad):
    with pytest.raises(ValidationError):
        SimulationSettings.model_validate({"seed": 1, "fault": [bad]})
