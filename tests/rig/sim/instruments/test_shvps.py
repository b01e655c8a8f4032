"""The simulated shvps supply against what its host library expects."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from rig.sim.settings import SimulationSettings
from rig.sim.truth import Fault

QUIET = {"driver": "shvps", "voltage_noise_V": 0.0}


def make(make_host, **hv):
    host = make_host("stage", "hv", hv=QUIET | hv)
    host.bench.world.stage.rest(0.0, 0.0)
    return host


@pytest.fixture
def host(make_host):
    return make(make_host)


def say(host, text: str, seconds: float = 0.03) -> str:
    return host.ask("hv", text.encode() + b"\r", seconds).decode()


def output(host) -> float:
    """The true voltage on the electrodes."""
    return host.bench.world.output.at(host.t)[0]


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        ("QName", "HVPS 7"),
        ("QVer", "slave 8"),
        ("QVmax", "5000"),
        ("QVset", "0"),
        ("QVnow", "0"),
        ("QSwMode", "0"),
        ("QSwSrc", "0"),
        ("QVMode", "0"),
        ("QJack", "1"),
        ("QPowJack", "1"),
        ("QCycle", "0/0"),
        ("QF", "1.000"),
        ("SVset 1500", "1500"),
        ("SVset 9000", "5000"),
        ("SF 0.5", "0.500"),
        ("SF 20000", "5000.000"),
        ("SCycle 70000", "65535"),
        ("SPWM 512", "512"),
        ("Save", "0"),
        ("SName 7", "Err"),
        ("SVset", "Err"),
        ("QVset 3", "Err"),
        ("hello", "Err"),
    ],
)
def test_exchange(host, command, answer):
    assert say(host, command) == answer + "\r\n"


def test_two_commands_in_one_piece_are_answered_in_order(host):
    assert say(host, "SVset 700\rQVset\rQVer") == "700\r\n700\r\nslave 8\r\n"


def test_the_set_point_does_nothing_while_it_is_off(host):
    say(host, "SVset 1000", 0.5)
    assert output(host) == 0.0
    assert say(host, "SSwMode 1", 0.5) == "1\r\n"
    assert output(host) == 1000.0 and say(host, "QVnow") == "1000\r\n"
    assert say(host, "SSwMode 0", 0.1) == "0\r\n"
    assert output(host) == 0.0 and say(host, "QVset") == "1000\r\n"


def test_it_jumps_there_is_no_ramp(host):
    say(host, "SSwMode 1")
    say(host, "SVset 2000", 0.03)
    assert 300 < output(host) < 1000
    host.wait(0.1)
    assert output(host) == 2000.0
    say(host, "SVset 1000", 0.2)
    assert output(host) == 1000.0


@pytest.mark.parametrize("command", ["SSwSrc 1", "SVMode 1"])
def test_other_sources_take_the_voltage_off(host, command):
    say(host, "SVset 1000\rSSwMode 1", 0.5)
    say(host, command, 0.2)
    assert output(host) == 0.0


def test_open_loop_follows_the_duty_cycle(host):
    say(host, "SVMode 2\rSPWM 205\rSSwMode 1", 0.5)
    assert output(host) == pytest.approx(205 / 1023 * 5000)


def test_modes_that_are_not_simulated_are_not_entered(host):
    assert say(host, "SSwMode 2") == "0\r\n"


def test_set_point_and_monitor_are_off_together(make_host):
    host = make(make_host, gain_error=0.02)
    say(host, "SVset 1000\rSSwMode 1", 0.5)
    assert output(host) == pytest.approx(1020) and say(host, "QVnow") == "1000\r\n"


def test_without_its_power_jack_the_output_decays_and_the_board_still_says_that_it_is_on(make_host):
    host = make(make_host)
    say(host, "SVset 1000\rSSwMode 1", 0.5)
    host.bench.instruments["hv"].pull_jack(host.t)
    host.wait(0.2)
    assert output(host) == 0.0 and say(host, "QSwMode\rQJack\rQVset") == "1\r\n0\r\n1000\r\n"


def test_found_live(make_host):
    host = make(make_host, start_live_V=500)
    assert say(host, "QVset\rQSwMode\rQVnow") == "500\r\n1\r\n500\r\n"
    assert output(host) == 500.0


def test_a_film_that_conducts_takes_the_voltage_down(host):
    say(host, "SVset 1000\rSSwMode 1", 0.5)
    host.bench.inject(Fault(role="hv", kind="breakdown"))
    host.wait(0.1)
    assert output(host) == pytest.approx(200e-6 * 10e3)  # largest current times the arc's resistance
    assert say(host, "QSwMode") == "1\r\n"  # it tells of nothing


def test_a_leak_takes_the_voltage_down_and_it_comes_back(host):
    say(host, "SVset 1000\rSSwMode 1", 0.5)
    host.bench.inject(Fault(role="hv", kind="over_current", duration_s=0.5))
    host.wait(0.3)
    assert output(host) == 0.0
    host.wait(0.6)
    assert output(host) == 1000.0


def test_faults(host):
    say(host, "SVset 1000\rSSwMode 1", 0.5)
    inject = lambda kind, **keys: host.bench.inject(Fault(role="hv", kind=kind, duration_s=0.5, **keys))  # noqa: E731
    inject("sag", value=0.4)
    host.wait(0.3)
    assert output(host) == pytest.approx(400)
    host.wait(0.5)
    inject("wrong_status")
    assert say(host, "QSwMode") == "0\r\n" and output(host) == 1000.0
    host.wait(0.6)
    inject("freeze")
    say(host, "SVset 200", 0.2)
    assert say(host, "QVnow") == "1000\r\n" and output(host) == 200.0
    host.wait(0.6)
    inject("stuck_on")
    assert say(host, "SSwMode 0", 0.2) == "0\r\n" and output(host) == 200.0
    host.wait(0.6)
    say(host, "SVset 900\rSSwMode 1", 0.2)
    inject("reset")
    assert say(host, "QVnow", 0.3) == "" and output(host) == 0.0
    host.wait(2.0)
    assert say(host, "QVset\rQSwMode") == "0\r\n0\r\n"


@pytest.mark.parametrize("kind", ["interlock", "inhibit"])
def test_impossible_faults_are_refused(make_host, host, kind):
    table = {"seed": 1, "hv": {"driver": "shvps"}, "fault": [{"role": "hv", "kind": kind}]}
    with pytest.raises(ValidationError, match=f"no fault '{kind}'"):
        SimulationSettings.model_validate(table)
    with pytest.raises(ValueError, match=r"hv \(shvps\) has no fault"):
        host.bench.inject(Fault(role="hv", kind=kind))


def test_a_serial_supply_can_have_split_lines():
    SimulationSettings.model_validate(
        {"seed": 1, "hv": {"driver": "shvps"}, "fault": [{"role": "hv", "kind": "split"}]}
    )


def test_an_unknown_twin_is_refused():
    with pytest.raises(ValidationError):
        SimulationSettings.model_validate({"seed": 1, "hv": {"driver": "van-de-graaff"}})
