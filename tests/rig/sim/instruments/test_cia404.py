"""The simulated CiA 404 load cell against exchanges from CiA 301, CiA 404 and a manufacturer's manual."""

from __future__ import annotations

import struct

import pytest
from pydantic import ValidationError

from rig.sim.settings import SimulationSettings
from rig.sim.truth import Fault

QUIET = {"driver": "cia404", "noise_fraction": 0.0, "zero_offset_N": 0.01}


def make(make_host, *roles, **force):
    host = make_host("force", *roles, force=QUIET | force)
    assert host.can("", 0.1, "force") == ["705#00"]  # boot-up
    return host


@pytest.fixture
def host(make_host):
    return make(make_host)


def single(value: float) -> str:
    return struct.pack("<f", value).hex()


def streaming(host) -> list[tuple[float, int]]:
    """What the process data of 0.1 s at 10 ms say: value and status."""
    host.can("605#2B0018050A000000", role="force")
    host.can("000#0105", role="force")
    frames = [f for f in host.can("", 0.1, "force") if f.startswith("185#")]
    return [(struct.unpack("<f", bytes.fromhex(f[4:12]))[0], int(f[12:], 16)) for f in frames]


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("4000100000000000", "4300100094010200"),  # device type: profile 404, analogue input
        ("4018100400000000", "43181004402d0100"),  # serial number 77120
        ("4031610100000000", "4331610100002100"),  # unit: newton
        ("4032610100000000", "4f32610104000000"),  # four decimals
        ("4030610000000000", "4f30610001000000"),  # one input
        ("4030610100000000", "43306101" + single(0.01)),
        ("4030710100000000", "4b30710164000000"),  # 100 in units of 1e-4 N
        ("4030810100000000", "4730810164000000"),
        ("4030910100000000", "4330910164000000"),
        ("4050610100000000", "4f50610100000000"),
        ("4000180100000000", "4300180185010000"),  # process data on identifier 185h
        # Refusals: no such object, no such sub-index, read only, write only, wrong length, bad value, unknown command
        ("4000200000000000", "8000200000000206"),
        ("4030610200000000", "8030610211000906"),
        ("2331610100002100", "8031610102000106"),
        ("4025610100000000", "8025610101000106"),
        ("2F25610100000000", "8025610110000706"),
        ("2325610100000000", "8025610130000906"),
        ("E000000000000000", "8000000001000405"),
        ("6000000000000000", "8000000001000405"),  # a segment that belongs to nothing
    ],
)
def test_sdo_exchange(host, request_, answer):
    assert host.can(f"605#{request_}", role="force") == [f"585#{answer}"]


def test_text_comes_in_segments(host):
    name = b"simulated load cell"
    assert host.can("605#4008100000000000", role="force") == [f"585#41081000{len(name):02x}000000"]
    text = b""
    for toggle, last in ((0x60, False), (0x70, False), (0x60, True)):
        (answer,) = host.can(f"605#{toggle:02X}00000000000000", role="force")
        data = bytes.fromhex(answer[4:])
        assert data[0] & 0x10 == toggle & 0x10 and bool(data[0] & 1) == last
        text += data[1 : 8 - (data[0] >> 1 & 7)]
    assert text == name


def test_a_wrong_toggle_bit_is_refused(host):
    host.can("605#4008100000000000", role="force")
    assert host.can("605#7000000000000000", role="force") == ["585#8000000000000305"]


def test_process_data_flow_only_when_operational(host):
    assert host.can("", 0.5, "force") == []
    host.can("000#0105", role="force")
    assert host.can("", 0.5, "force") == [f"185#{single(0.01)}00"] * 5
    host.can("000#8000", role="force")  # all nodes pre-operational
    assert host.can("", 0.5, "force") == []
    host.can("000#0107", role="force")  # another node
    assert host.can("", 0.5, "force") == []
    host.can("000#0205", role="force")
    assert host.can("605#4000100000000000", role="force") == []  # no SDO when stopped


def test_the_mapping_changes_only_while_the_pdo_is_off_and_empty(host):
    assert host.can("605#2F001A0000000000", role="force") == ["585#80001a0000000106"]
    assert host.can("605#2300180185010080", role="force") == ["585#6000180100000000"]  # off
    assert host.can("605#23001A0120013091", role="force") == ["585#80001a0100000106"]
    assert host.can("605#2F001A0000000000", role="force") == ["585#60001a0000000000"]  # empty
    assert host.can("605#23001A0120013091", role="force") == ["585#60001a0100000000"]


def test_another_mapping_and_rate(host):
    for request in (
        "2300180185010080",  # off
        "2F001A0000000000",
        "23001A0120013091",  # 9130h:1, 32 bits
        "2F001A0001000000",
        "2B00180532000000",  # 50 ms
        "2300180185010000",  # on
    ):
        (answer,) = host.can(f"605#{request}", role="force")
        assert answer.startswith("585#60"), (request, answer)
    host.can("000#0105", role="force")
    assert host.can("", 0.5, "force") == ["185#64000000"] * 10


def test_what_does_not_fit_is_not_mapped(host):
    for request in ("2300180185010080", "2F001A0000000000"):
        host.can(f"605#{request}", role="force")
    (not_mappable,) = host.can("605#23001A0120013161", role="force")
    assert not_mappable == "585#80001a0141000406"
    (wrong_length,) = host.can("605#23001A0110013091", role="force")
    assert wrong_length == "585#80001a0141000406"
    for number in (1, 2, 3):
        host.can(f"605#23001A{number:02X}20013091", role="force")
    assert host.can("605#2F001A0003000000", role="force") == ["585#80001a0042000406"]


def test_autozero_takes_the_value_of_now_and_has_a_range(make_host):
    host = make(make_host)
    assert host.can("605#222561017A65726F", role="force") == ["585#6025610100000000"]
    assert streaming(host)[0] == (0.0, 0)
    far = make(make_host, zero_offset_N=0.3)  # of 0.5 N full scale
    assert far.can("605#222561017A65726F", role="force") == ["585#8025610100000405"]


def test_it_measures_the_film(make_host):
    host = make(make_host, "stage", full_scale_N=1.0)
    host.bench.world.stage.rest(host.t, 45e-3)
    host.wait(0.1)
    values = streaming(host)
    assert [v for v, _ in values] == pytest.approx([host.bench.world.force_at(host.t) + 0.01] * len(values), rel=1e-6)
    assert values[0][0] > 0.1


def test_noise_is_a_part_of_full_scale(make_host):
    host = make(make_host, noise_fraction=0.01, full_scale_N=2.0)
    readings = []
    for _ in range(40):
        readings += [v for v, _ in streaming(host)]
    assert len(readings) > 300
    mean = sum(readings) / len(readings)
    assert (sum((r - mean) ** 2 for r in readings) / len(readings)) ** 0.5 == pytest.approx(0.02, rel=0.15)


def test_millinewtons(make_host):
    host = make(make_host, unit="mN")
    assert host.can("605#4031610100000000", role="force") == ["585#43316101000021fd"]
    assert streaming(host)[0] == (10.0, 0)


def test_heartbeat_says_the_state(host):
    host.can("605#2B171000C8000000", role="force")
    assert host.can("", 0.5, "force") == ["705#7f"] * 2
    host.can("000#0205", role="force")
    assert host.can("", 0.2, "force") == ["705#04"]


def test_faults(make_host):
    host = make(make_host)
    inject = lambda kind, **keys: host.bench.inject(Fault(role="force", kind=kind, duration_s=0.5, **keys))  # noqa: E731
    inject("saturate", value=-1.0)
    assert streaming(host)[0] == (pytest.approx(-0.6), 4)  # 1.2 of 0.5 N full scale
    host.can("", 0.6, "force")
    inject("wrong_status")
    assert streaming(host)[0] == (pytest.approx(0.01), 1)
    host.can("", 0.6, "force")
    inject("reset")
    frames = host.can("", 1.5, "force")
    assert frames == ["705#00"]  # and no process data: it is pre-operational again


@pytest.mark.parametrize("kind", ["split", "merge", "stuck_on"])
def test_impossible_faults_are_refused(make_host, kind):
    with pytest.raises(ValidationError, match=f"no fault '{kind}'"):
        SimulationSettings.model_validate(
            {"seed": 1, "force": {"driver": "cia404"}, "fault": [{"role": "force", "kind": kind}]}
        )


def test_a_fault_that_only_another_load_cell_can_have_is_refused_at_run_time(make_host):
    host = make(make_host)
    with pytest.raises(ValueError, match=r"force \(cia404\) has no fault 'merge'"):
        host.bench.inject(Fault(role="force", kind="merge"))


def test_an_input_that_is_not_there_is_refused():
    with pytest.raises(ValidationError, match="only 1 inputs"):
        SimulationSettings.model_validate({"seed": 1, "force": {"driver": "cia404", "channel": 2}})
