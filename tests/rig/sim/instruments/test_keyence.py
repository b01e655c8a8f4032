"""The simulated Keyence LK-G against the documented exchanges of its ASCII protocol."""

from __future__ import annotations

import numpy as np
import pytest

from rig.sim.instruments.keyence import display


def make(make_host, *roles, **displacement):
    host = make_host("displacement", *roles, displacement={"noise_um": 0.0, "offset_mm": 1.2345} | displacement)
    host.wait(0.1)
    return host


@pytest.fixture
def host(make_host):
    return make(make_host)


@pytest.mark.parametrize(
    ("millimetres", "text"),
    [(1.2345, "+01.2345"), (-0.012, "-00.0120"), (0.0, "+00.0000"), (-0.00001, "+00.0000"), (-39.99999, "-40.0000")],
)
def test_display_has_eight_characters(millimetres, text):
    assert display(millimetres) == text


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        (b"M1\r", b"M1,+01.2345\r"),
        (b"m1\r", b"M1,+01.2345\r"),
        (b"M0\r", b"M0,+01.2345,+01.2345\r"),
        (b"M2\r\n", b"M2,+01.2345\r"),
        (b"R0\r", b"ER,R0,01\r"),
        (b"SR,HB,1\r", b"ER,SR,01\r"),
        (b"SW,OC,1,0,5\r", b"ER,SW,01\r"),
        (b"VR,1\r", b"VR\r"),
        (b"PR\r", b"PR,0\r"),
        (b"PW,9\r", b"ER,PW,22\r"),
        (b"PW\r", b"ER,PW,21\r"),
        (b"M1,1\r", b"ER,M1,21\r"),
        (b"MA\r", b"ER,MA,00\r"),
        (b"KL,1\r", b"KL\r"),
        (b"M1" + b"," * 40 + b"\r", b"ER,M1,20\r"),
        (b"AN\r", b"AN,0,000000,000000\r"),
    ],
)
def test_exchange_in_measure_mode(host, command, answer):
    assert host.ask("displacement", command) == answer


def test_communication_mode_does_not_measure(host):
    exchange = [
        (b"Q0\r", b"Q0\r"),
        (b"Q0\r", b"ER,Q0,01\r"),
        (b"M1\r", b"ER,M1,01\r"),
        (b"SR,OC,1,0\r", b"SR,OC,1,0,4\r"),
        (b"SW,OC,1,0,6\r", b"SW,OC\r"),
        (b"SR,OC,1,0\r", b"SR,OC,1,0,6\r"),
        (b"SW,OC,1,0,10\r", b"ER,SW,22\r"),
        (b"SW,CA,3\r", b"SW,CA\r"),
        (b"SR,CA\r", b"SR,CA,3\r"),
        (b"SR,HB,1\r", b"SR,HB,1,0\r"),
        (b"SW,HB,1,4\r", b"SW,HB\r"),
        (b"SR,HB,1\r", b"SR,HB,1,4\r"),
        (b"SW,HE,1,1\r", b"SW,HE\r"),
        (b"SW,HA,M,1,1\r", b"SW,HA\r"),
        (b"SW,OF,1,+123450\r", b"SW,OF\r"),
        (b"SR,OF,1\r", b"SR,OF,1,+12.3450\r"),
        (b"SW,OF,1,12\r", b"ER,SW,22\r"),
        (b"SW,ZZ,1\r", b"ER,SW,22\r"),
        (b"SW,OC,1\r", b"ER,SW,21\r"),
        (b"R0\r", b"R0\r"),
    ]
    for command, answer in exchange:
        assert host.ask("displacement", command, 0.02) == answer
    host.wait(1.0)
    assert host.ask("displacement", b"M1\r") == b"M1,+13.5795\r"


def test_no_value_until_the_average_is_full(make_host):
    host = make_host("displacement", displacement={"averaging_code": 6})  # 4096 x 50 us
    assert host.ask("displacement", b"M1\r") == b"M1,XXXXXXXX\r"
    host.wait(0.25)
    assert b"X" not in host.ask("displacement", b"M1\r")
    assert host.ask("displacement", b"VR,1\r") == b"VR\r"
    assert host.ask("displacement", b"M1\r") == b"M1,XXXXXXXX\r"


@pytest.mark.parametrize(("offset", "field"), [(40.2, b"+FFFFFFF"), (-40.2, b"-FFFFFFF")])
def test_out_of_range(make_host, offset, field):
    assert make(make_host, offset_mm=offset).ask("displacement", b"M1\r") == b"M1," + field + b"\r"


def test_auto_zero_and_hold(host):
    assert host.ask("displacement", b"V1\r") == b"V1\r"
    assert host.ask("displacement", b"M1\r") == b"M1,+00.0000\r"
    assert host.ask("displacement", b"M2\r") == b"M2,+01.2345\r"
    assert host.ask("displacement", b"W0\r") == b"W0\r"
    assert host.ask("displacement", b"M1\r") == b"M1,+01.2345\r"


def test_timing_input_pushes_a_line(host):
    host.bench.instruments["displacement"].alert(host.t)
    assert host.ask("displacement", b"M1\r") == b"TG,1,+01.2345\rM1,+01.2345\r"


def test_averaging_delays_by_half_its_length(make_host):
    host = make(make_host, "stage", averaging_code=6, resolution_um=0.001, offset_mm=0.0)
    host.bench.world.stage.ramp(host.t, 60e-3, 0.1)  # 100 mm/s, into the film
    host.bench.world.stage.rest(host.t + 1, 60e-3)
    t = np.array([host.t + 0.45])
    instrument = host.bench.instruments["displacement"]
    host.bench.advance(t[0])
    lag = host.bench.world.displacement(t)[0] * 1e3 - instrument._millimetres(1, t[0])
    assert lag == pytest.approx(100 * 0.5 * 4096 * 50e-6, rel=0.01)


def test_noise_depends_on_time_not_on_polling(make_host):
    one, two = (make(make_host, noise_um=5.0) for _ in range(2))
    for _ in range(50):
        one.ask("displacement", b"M1\r", 0.02)
    two.wait(1.0)
    assert one.ask("displacement", b"M1\r") == two.ask("displacement", b"M1\r")
