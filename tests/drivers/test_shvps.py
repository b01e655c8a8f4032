"""shvps: the documented lines, any split of any stream, and the driver against a scripted supply."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.link import DeviceError, DeviceRefused, DeviceSilent
from drivers.roles import HVFlag, HVSample, HVSupply
from drivers.shvps import MAX_LINE, SHVPS, Decoder, encode

# -- lines -------------------------------------------------------------------------------------------------------------


def test_commands() -> None:
    assert encode("QVnow") == b"QVnow\r"
    assert encode("SVset", 3500) == b"SVset 3500\r"
    assert encode("SSwMode", 1) == b"SSwMode 1\r"


@pytest.mark.parametrize("end", [b"\r\n", b"\r", b"\n"])
def test_lines(end: bytes) -> None:
    decoder = Decoder()
    assert decoder.feed(b"slave 8" + end + b"3500" + end + b"Err" + end) == [b"slave 8", b"3500", b"Err"]
    assert decoder.counters == {"dropped_bytes": 0}


def test_lines_that_are_none_are_dropped_and_counted() -> None:
    decoder = Decoder()
    assert decoder.feed(b"12\xff4\r\n" + b"7" * 200) == []
    assert decoder.feed(b"7\r\n" + b"5\r\n") == [b"5"]
    assert decoder.counters["dropped_bytes"] == 4 + 201


LINES = st.sampled_from([b"0\r\n", b"4999\r\n", b"Err\r\n", b"\r", b"slave 8\r"])


@given(st.lists(LINES | st.binary(max_size=100)), st.data())
def test_any_split_decodes_to_the_same_lines(pieces: list[bytes], data: st.DataObject) -> None:
    stream = b"".join(pieces)
    whole = Decoder()
    expected = whole.feed(stream)
    cuts = sorted(data.draw(st.sets(st.integers(0, len(stream)), max_size=20)))
    parts = Decoder()
    got = [line for a, b in itertools.pairwise([0, *cuts, len(stream)]) for line in parts.feed(stream[a:b])]
    assert got == expected
    assert len(parts._buffer) <= MAX_LINE


# -- a scripted supply -------------------------------------------------------------------------------------------------


class Supply:
    """The least supply that can be talked to; its output follows the set-point at once."""

    name = "supply"

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.out = b""
        self.values = {"Vmax": 5000, "Vset": 0, "SwMode": 0, "SwSrc": 0, "VMode": 0, "PowJack": 1, "Jack": 1}
        self.version = b"slave 8"
        self.silent = False
        self.stuck_on = False
        self.line: Callable[[bytes], bytes] = lambda data: data
        self.closed = 0

    def read(self) -> bytes:
        data, self.out = self.out, b""
        return data

    def close(self) -> None:
        self.closed += 1

    def write(self, data: bytes) -> None:
        assert data.endswith(b"\r")
        for command in data[:-1].split(b"\r"):
            self.sent.append(command)
            if not self.silent:
                self.out += self.line(self.answer(command.decode()) + b"\r\n")

    def answer(self, command: str) -> bytes:
        head, _, argument = command.partition(" ")
        kind, key = head[0], head[1:]
        if command == "QVer":
            return self.version
        if command == "QName":
            return b"HV-17"
        if command == "QVnow":
            return str(self.values["Vset"] if self.values["SwMode"] else 2).encode()
        if kind == "S" and argument.isdigit() and key in self.values:
            if not (self.stuck_on and key == "SwMode"):
                self.values[key] = int(argument)
        elif kind != "Q" or key not in self.values:
            return b"Err"
        return str(self.values[key]).encode()


class Rig:
    def __init__(self, **options: float) -> None:
        self.supply = Supply()
        self.hv = SHVPS("hv", self.supply, **options)  # type: ignore[arg-type]
        self.now = 0.0
        self.samples: list[HVSample] = []

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end:
            self.now += 0.001
            if self.now >= self.hv.next_poll:
                self.samples += self.hv.poll(self.now)

    def until_ready(self) -> Rig:
        for _ in range(1000):
            if self.hv.ready:
                break
            self.run(0.001)
        assert self.hv.ready
        self.supply.sent.clear()
        return self

    def settle(self) -> None:
        for _ in range(5000):
            if not self.hv.busy:
                return
            self.run(0.001)
        raise AssertionError("still busy")

    @property
    def settings(self) -> list[bytes]:
        return [c for c in self.supply.sent if c.startswith(b"S")]


def test_it_is_an_hv_supply() -> None:
    supply: HVSupply = SHVPS("hv", Supply())
    assert not supply.ready


def test_set_up_only_asks() -> None:
    rig = Rig()
    rig.run(0.5)
    assert rig.hv.ready
    assert rig.supply.sent[:8] == [
        b"QVer", b"QName", b"QVmax", b"QVset", b"QSwMode", b"QSwSrc", b"QVMode", b"QPowJack",
    ]  # fmt: skip
    assert rig.settings == []
    assert rig.hv.identity.serial == "HV-17"
    assert rig.hv.identity.firmware == "8"
    assert rig.hv.nominal[0] == 5000.0
    sample = rig.samples[-1]
    assert (sample.voltage, sample.setpoint, sample.flags) == (2.0, 0.0, HVFlag(0))
    assert math.isnan(sample.current)


def test_a_channel_found_on_is_reported_and_left_alone() -> None:
    rig = Rig()
    rig.supply.values |= {"SwMode": 1, "Vset": 1200}
    rig.run(2.0)
    assert rig.settings == []
    assert rig.samples[-1].flags == HVFlag.ON
    assert rig.samples[-1].voltage == 1200.0
    assert rig.hv.settings["channel_at_setup"] == "on"


def test_switch_on_starts_from_nothing_and_ramps() -> None:
    rig = Rig(ramp_V_per_s=500.0, poll_rate_Hz=20.0).until_ready()
    rig.supply.values["Vset"] = 4000  # left over; must not jump to the output
    rig.hv.set_voltage(1000.0)
    rig.hv.switch_on()
    rig.settle()
    assert rig.settings[:4] == [b"SVset 0", b"SSwSrc 0", b"SVMode 0", b"SSwMode 1"]
    start = rig.now
    rig.run(4.0)
    steps = [int(c.split()[1]) for c in rig.settings[4:]]
    assert steps == sorted(steps)
    assert steps[-1] == 1000
    assert max(b - a for a, b in itertools.pairwise([0, *steps])) <= 51
    arrived = next(s.t for s in rig.samples if s.setpoint == 1000.0)
    assert arrived - start == pytest.approx(2.0, abs=0.2)
    assert rig.samples[-1].flags == HVFlag.ON
    assert all(HVFlag.RAMPING in s.flags for s in rig.samples if start + 0.1 < s.t < arrived)


def test_slow_ramps_step_by_single_volts() -> None:
    rig = Rig(ramp_V_per_s=4.0, poll_rate_Hz=20.0).until_ready()
    rig.hv.set_voltage(100.0)
    rig.hv.switch_on()
    rig.settle()
    rig.run(5.0)
    assert rig.samples[-1].setpoint == pytest.approx(20, abs=2)


def test_switch_off_ramps_down_and_then_switches_off() -> None:
    rig = Rig(ramp_V_per_s=1000.0).until_ready()
    rig.hv.set_voltage(500.0)
    rig.hv.switch_on()
    rig.run(2.0)
    rig.supply.sent.clear()
    rig.hv.switch_off()
    rig.run(2.0)
    assert rig.settings[-1] == b"SSwMode 0"
    steps = [int(c.split()[1]) for c in rig.settings[:-1]]
    assert steps == sorted(steps, reverse=True)
    assert steps[-1] == 0
    assert rig.samples[-1].flags == HVFlag(0)


def test_switch_off_of_a_channel_that_others_switched_on() -> None:
    rig = Rig(ramp_V_per_s=1000.0)
    rig.supply.values |= {"SwMode": 1, "Vset": 300}
    rig.until_ready()
    rig.hv.switch_off()
    rig.run(2.0)
    assert rig.supply.values["SwMode"] == 0


@pytest.mark.parametrize("volts", [-1.0, 5001.0, math.nan, math.inf, 10.5])
def test_set_points_outside_the_range_are_refused_before_they_are_sent(volts: float) -> None:
    rig = Rig().until_ready()
    with pytest.raises(DeviceRefused):
        rig.hv.set_voltage(volts)
    rig.run(0.5)
    assert rig.settings == []


@pytest.mark.parametrize("ramp", [0.0, -1.0, math.nan, math.inf])
def test_ramps_that_are_none(ramp: float) -> None:
    with pytest.raises(DeviceRefused, match="a ramp of"):
        Rig().hv.set_ramp(ramp)


def test_a_current_limit_it_cannot_keep_is_refused() -> None:
    with pytest.raises(DeviceRefused, match="cannot limit its current"):
        Rig().hv.set_current_limit(1e-4)
    rig = Rig(max_current_A=2e-4)
    rig.hv.set_current_limit(2e-4)
    for amperes in (1e-4, math.nan):
        with pytest.raises(DeviceRefused, match=r"is 0\.0002 A"):
            rig.hv.set_current_limit(amperes)


def test_commands_before_set_up_are_refused() -> None:
    rig = Rig()
    with pytest.raises(DeviceRefused, match="before the set-up"):
        rig.hv.set_voltage(1.0)
    with pytest.raises(DeviceRefused, match="before the set-up"):
        rig.hv.switch_on()


def on_at(volts: float, **options: float) -> Rig:
    rig = Rig(ramp_V_per_s=10_000.0, **options).until_ready()
    rig.hv.set_voltage(volts)
    rig.hv.switch_on()
    rig.run(2.0)
    assert rig.samples[-1].voltage == volts
    rig.supply.sent.clear()
    return rig


def test_emergency_off_goes_out_at_once_and_stays_until_cleared() -> None:
    rig = on_at(2000.0)
    rig.hv.set_voltage(3000.0)
    rig.run(0.002)
    rig.hv.emergency_off()
    before = len(rig.supply.sent)
    rig.run(0.002)
    assert rig.supply.sent[before : before + 2] == [b"SSwMode 0", b"SVset 0"]
    rig.settle()
    rig.run(0.5)
    assert rig.samples[-1].flags == HVFlag.EMERGENCY_OFF
    assert b"SVset 3000" not in rig.supply.sent
    with pytest.raises(DeviceRefused, match="EMERGENCY_OFF is latched"):
        rig.hv.switch_on()
    rig.hv.clear()
    rig.settle()
    rig.run(0.3)
    assert rig.samples[-1].flags == HVFlag(0)


def test_an_answer_on_its_way_does_not_confirm_an_emergency_off() -> None:
    rig = on_at(0.0)
    rig.supply.stuck_on = True
    rig.supply.out += b"0\r\n"
    rig.hv.emergency_off()
    with pytest.raises(DeviceRefused, match=r"EMERGENCY OFF IS NOT CONFIRMED.*still says that it is on"):
        rig.settle()


def test_emergency_off_is_sent_to_a_supply_that_never_answers() -> None:
    rig = Rig()
    rig.supply.silent = True
    rig.run(0.05)
    rig.hv.emergency_off()
    rig.run(0.002)
    assert rig.supply.sent[-2:] == [b"SSwMode 0", b"SVset 0"]
    with pytest.raises(DeviceRefused, match="EMERGENCY OFF IS NOT CONFIRMED"):
        rig.run(5.0)


def test_a_supply_that_went_off_by_itself_is_not_switched_on_again() -> None:
    rig = on_at(1000.0)
    rig.supply.values |= {"SwMode": 0, "Vset": 0}
    rig.run(1.0)
    assert rig.samples[-1].flags == HVFlag.TRIPPED
    assert rig.settings == []
    with pytest.raises(DeviceRefused, match="TRIPPED is latched"):
        rig.hv.switch_on()


def test_a_missing_plug_is_a_fault() -> None:
    rig = Rig().until_ready()
    rig.supply.values["Jack"] = 0
    rig.run(0.3)
    assert rig.samples[-1].flags == HVFlag.FAULT


def test_a_setting_that_is_not_taken_is_an_error_and_takes_the_queue_with_it() -> None:
    rig = Rig().until_ready()
    rig.supply.stuck_on = True  # it keeps its mode: here, off
    rig.hv.switch_on()
    rig.hv.set_voltage(100.0)
    with pytest.raises(DeviceRefused, match="answers 0 to 'SSwMode 1'"):
        rig.settle()
    assert not rig.hv.busy


def test_values_beyond_the_rating_are_dropped_and_an_error_if_they_stay() -> None:
    rig = Rig().until_ready()
    rig.supply.values |= {"SwMode": 1, "Vset": 9000}
    rig.samples.clear()
    with pytest.raises(DeviceRefused, match="beyond its rating"):
        rig.run(0.5)
    assert rig.samples == []
    assert rig.hv.counters["bad_values"] == 3


def test_what_set_up_refuses() -> None:
    rig = Rig()
    rig.supply.version = b"master 3"
    with pytest.raises(DeviceRefused, match="calls itself 'master'"):
        rig.run(1.0)
    rig = Rig()
    del rig.supply.values["VMode"]
    with pytest.raises(DeviceRefused, match="does not understand 'QVMode'"):
        rig.run(1.0)
    with pytest.raises(DeviceRefused, match="poll rate"):
        Rig(poll_rate_Hz=math.nan)


def test_a_silent_supply() -> None:
    rig = Rig()
    rig.supply.silent = True
    with pytest.raises(DeviceSilent, match="no answer to 'QVer'"):
        rig.run(2.0)


def test_a_late_answer_is_not_given_to_the_next_question() -> None:
    """Each answer may come one timeout late; the repetition's answer must not be taken for the next one's."""
    rig = Rig(timeout_s=0.05)
    rig.supply.values |= {"Vset": 7, "SwMode": 1}
    late: list[tuple[float, bytes]] = []
    rng = random.Random(1)

    def line(data: bytes) -> bytes:
        if rng.random() < 0.1:
            late.append((rig.now + 0.06, data))
            return b""
        return data

    rig.supply.line = line
    for _ in range(20_000):
        for item in [x for x in late if x[0] <= rig.now]:
            late.remove(item)
            rig.supply.out += item[1]
        try:
            rig.run(0.001)
        except DeviceError:
            continue
    assert len(rig.samples) > 50
    assert {(s.voltage, s.setpoint) for s in rig.samples} == {(7.0, 7.0)}
    assert {s.flags for s in rig.samples} == {HVFlag.ON}
    assert rig.hv.counters["unexpected_answers"] > 10


def survive(count: int, seed: int) -> None:
    """Damaged lines: the error family or the right value. A digit that became another digit cannot be told."""
    rng = random.Random(seed)
    done = samples = 0
    while done < count:
        rig = Rig(timeout_s=0.01)
        rig.supply.values["Vset"] = 1234

        def line(data: bytes) -> bytes:
            nonlocal done
            if rng.random() < 0.5:
                return data
            done += 1
            kind = rng.randrange(3)
            if kind == 0:
                return b""
            at = rng.randrange(len(data))
            if kind == 1:
                return data[:at] + bytes((rng.choice(b"\x00\xff~ -+.eE_Nan"),)) + data[at:]
            return data + b"\xb2\xb3\r\n"  # digits only to Unicode

        rig.supply.line = line
        for _ in range(500):
            try:
                rig.run(0.001)
            except DeviceError:
                continue
        assert all(s.setpoint == 1234.0 and s.voltage == 2.0 for s in rig.samples)
        samples += len(rig.samples)
    assert samples > count / 100


def test_damaged_lines_never_become_values() -> None:
    survive(20_000, seed=1)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_million_damaged_lines_never_become_values() -> None:
    survive(1_000_000, seed=2)
