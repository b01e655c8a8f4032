"""The shvps driver against a small scripted supply written here."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import roles
from drivers.instruments.shvps import Codec, Shvps, ShvpsSettings, encode
from drivers.links.link import DeviceLost, DeviceRefused, DeviceSilent
from drivers.roles import HVFlag


class FakeSupply:
    """Answers as NERDv3's library expects; the output follows at once, 3 V below the set-point.

    A setting that is ``stuck`` is answered as if it were not.
    """

    name = "fake"

    def __init__(self) -> None:
        self.values = {"Vmax": 5000, "Vset": 0, "SwMode": 0, "SwSrc": 0, "VMode": 0, "PowJack": 1, "Jack": 1}
        self.log: list[str] = []
        self.history: list[int] = []
        self.out = b""
        self.after: Callable[[bytes], bytes] = lambda data: data
        self.deaf = False
        self.stuck: dict[str, int] = {}

    @property
    def output(self) -> int:
        return max(0, self.values["Vset"] - 3) if self.values["SwMode"] and self.values["Jack"] else 0

    def read(self) -> bytes:
        out, self.out = self.out, b""
        return out

    def write(self, data: bytes) -> None:
        assert data.endswith(b"\r") and data.count(b"\r") == 1
        command = data.decode()[:-1]
        self.log.append(command)
        if not self.deaf:
            self.out += self.after(self.answer(command).encode() + b"\r\n")
        self.history.append(self.output)

    def answer(self, command: str) -> str:
        word, _, number = command.partition(" ")
        if command == "QVer":
            return "slave 8"
        if command == "QName":
            return "HVPS 7"
        if command == "QVnow":
            return str(self.output)
        if word[0] == "S":
            self.values[word[1:]] = int(number)
            self.values |= self.stuck
            return number
        return str(self.values[word[1:]])

    def close(self) -> None:
        pass


class Bench:
    def __init__(self, supply: Shvps, fake: FakeSupply) -> None:
        self.supply, self.fake, self.t = supply, fake, 0.0
        self.samples: list[roles.HVSample] = []

    def run(self, seconds: float) -> None:
        end = self.t + seconds
        while self.t < end:
            self.t = min(end, max(self.t + 1e-4, min(self.supply.next_poll, self.t + 1e-3)))
            self.samples += self.supply.poll(self.t)


@pytest.fixture
def fake() -> FakeSupply:
    return FakeSupply()


@pytest.fixture
def bench(fake: FakeSupply) -> Bench:
    bench = Bench(Shvps("hv", fake), fake)
    bench.run(0.2)
    assert bench.supply.ready
    return bench


@pytest.fixture
def live(bench: Bench) -> Bench:
    bench.supply.set_ramp(2000.0)
    bench.supply.set_voltage(1000.0)
    bench.supply.switch_on()
    bench.run(1.0)
    assert bench.fake.output == 997
    bench.samples.clear()
    bench.fake.history.clear()
    return bench


def hold(bench: Bench, arrival: Callable[[float], float]) -> None:
    """Bytes that come at t are read at ``arrival(t)`` or later, in order."""
    waiting: list[tuple[float, bytes]] = []
    original = bench.fake.read

    def read() -> bytes:
        waiting.append((arrival(bench.t), original()))
        ready = 0
        while ready < len(waiting) and waiting[ready][0] <= bench.t:
            ready += 1
        out = b"".join(data for _, data in waiting[:ready])
        del waiting[:ready]
        return out

    bench.fake.read = read  # type: ignore[method-assign]


def test_is_an_hv_supply(fake: FakeSupply) -> None:
    supply: roles.HVSupply = Shvps("hv", fake)
    assert not supply.ready and not supply.busy


def test_set_up_only_asks(fake: FakeSupply) -> None:
    fake.values |= {"Vset": 1234, "SwMode": 1}
    bench = Bench(Shvps("hv", fake), fake)
    bench.run(0.5)
    assert all(command.startswith("Q") for command in fake.log)
    assert bench.supply.identity == roles.Identity("shvps HVPS 7", "", "8")
    assert bench.supply.nominal[0] == 5000.0
    assert bench.supply.settings["output_at_setup"] == "mode 1"
    sample = bench.samples[-1]
    assert (sample.voltage, sample.setpoint, sample.flags) == (1231.0, 1234.0, HVFlag.ON)
    assert math.isnan(sample.current)


def test_switching_on_starts_at_zero_and_ramps(bench: Bench) -> None:
    bench.fake.values["Vset"] = 4000  # left by somebody
    bench.supply.set_ramp(1000.0)
    bench.supply.set_voltage(500.0)
    bench.supply.switch_on()
    assert bench.supply.busy
    bench.run(0.3)
    assert not bench.supply.busy
    assert 50 < bench.fake.output < 350 and HVFlag.RAMPING in bench.samples[-1].flags
    bench.run(0.5)
    assert (bench.samples[-1].setpoint, bench.samples[-1].voltage) == (500.0, 497.0)
    assert bench.samples[-1].flags == HVFlag.ON
    rises = [b - a for a, b in zip(bench.fake.history, bench.fake.history[1:], strict=False)]
    assert max(rises) <= 1000 * 0.06 + 1  # no more than the ramp in one polling period
    assert max(bench.fake.history) == 497


def test_ramp_does_not_make_up_for_time_without_polls(live: Bench) -> None:
    live.supply.set_voltage(5000.0)
    live.run(0.05)
    before = live.fake.output
    live.t += 10.0
    live.run(0.05)
    assert live.fake.output - before <= 2000 * (0.25 + 0.1)


def test_switch_off_ramps_down(live: Bench) -> None:
    live.supply.switch_off()
    assert live.supply.busy
    live.run(1.0)
    assert not live.supply.busy and live.fake.values["SwMode"] == 0 and live.samples[-1].flags == HVFlag(0)
    falls = [a - b for a, b in zip(live.fake.history, live.fake.history[1:], strict=False)]
    assert max(falls) <= 2000 * 0.06 + 1


def test_emergency_off_overtakes_everything_and_is_remembered(live: Bench) -> None:
    live.supply.set_voltage(2000.0)
    live.supply.emergency_off()
    live.fake.log.clear()
    live.run(0.0011)
    assert live.fake.log[:2] == ["SSwMode 0", "SVset 0"]
    assert live.fake.output == 0
    live.run(0.5)
    assert not live.supply.busy
    assert live.samples[-1].flags == HVFlag.EMERGENCY_OFF
    with pytest.raises(DeviceRefused, match="Find the cause, then clear"):
        live.supply.switch_on()
    live.supply.clear()
    live.supply.switch_on()
    live.run(0.5)
    assert live.fake.values["SwMode"] == 1 and live.fake.output == 0  # the old target is gone


@pytest.mark.parametrize("steps", range(30))
def test_emergency_off_at_any_moment_is_confirmed_by_its_own_answers(live: Bench, steps: int) -> None:
    """Answers to what was asked before are on the wire; none may be taken for the read-back of the emergency off."""
    hold(live, lambda t: t + 5e-3)
    live.run(0.1 + steps * 0.00173)
    live.fake.stuck = {"SwMode": 1}
    live.supply.emergency_off()
    with pytest.raises(DeviceRefused, match="EMERGENCY OFF IS NOT CONFIRMED"):
        live.run(0.5)


def test_emergency_off_during_set_up(fake: FakeSupply) -> None:
    fake.values |= {"Vset": 1234, "SwMode": 1}
    bench = Bench(Shvps("hv", fake), fake)
    bench.run(0.004)
    bench.supply.emergency_off()
    bench.run(0.3)
    assert fake.output == 0 and bench.supply.ready and HVFlag.EMERGENCY_OFF in bench.samples[-1].flags


def test_emergency_off_of_a_dead_supply_is_not_called_safe(live: Bench) -> None:
    live.fake.deaf = True
    live.supply.emergency_off()
    with pytest.raises(DeviceSilent, match=r"EMERGENCY OFF IS NOT CONFIRMED .*ground the electrodes"):
        live.run(2.0)


@pytest.mark.parametrize("volts", [math.nan, math.inf, -1.0, 5001.0, 0.5])
def test_set_points_that_cannot_be_are_refused(bench: Bench, volts: float) -> None:
    with pytest.raises(DeviceRefused):
        bench.supply.set_voltage(volts)


def test_what_it_cannot_do_is_refused(bench: Bench) -> None:
    with pytest.raises(DeviceRefused, match="no current limit"):
        bench.supply.set_current_limit(1e-3)
    with pytest.raises(DeviceRefused, match="is no ramp"):
        bench.supply.set_ramp(math.nan)


def test_set_point_that_does_not_come_back_is_refused(live: Bench) -> None:
    live.fake.stuck = {"Vset": 1000}
    live.supply.set_voltage(1500.0)
    with pytest.raises(DeviceRefused, match="Vset reads back as 1000"):
        live.run(0.5)


def test_missing_power_jack(fake: FakeSupply) -> None:
    fake.values["Jack"] = 0
    bench = Bench(Shvps("hv", fake), fake)
    bench.run(0.3)
    assert HVFlag.FAULT in bench.samples[-1].flags
    bench.supply.switch_on()
    with pytest.raises(DeviceRefused, match="power jack"):
        bench.run(0.1)


def test_the_power_jack_is_asked_for_where_the_output_is_low_and_only_there(live: Bench) -> None:
    live.fake.log.clear()
    live.supply.set_voltage(2000.0)
    live.run(1.0)
    live.supply.set_voltage(500.0)
    live.run(1.0)
    assert live.samples[-1].setpoint == 500.0 and "QJack" not in live.fake.log
    live.samples.clear()
    live.fake.values["Jack"] = 0
    live.run(0.2)
    low = [sample for sample in live.samples if sample.voltage == 0.0]
    assert low and all(sample.flags == HVFlag.ON | HVFlag.FAULT for sample in low)
    asked = live.fake.log.index("QJack")  # right after what every sample asks
    assert live.fake.log[asked - 6 : asked + 2] == [
        "QVnow",
        "QVer",
        "QVset",
        "QVer",
        "QSwMode",
        "QVer",
        "QJack",
        "QVer",
    ]


def test_a_low_output_with_its_jack_in_is_no_fault_and_a_missing_answer_no_missing_jack(live: Bench) -> None:
    answer = live.fake.answer
    live.fake.answer = lambda command: "400" if command == "QVnow" else answer(command)  # type: ignore[method-assign]
    live.run(0.3)
    assert "QJack" in live.fake.log and {sample.flags for sample in live.samples} == {HVFlag.ON}
    write = live.fake.write
    live.fake.write = lambda data: None if data == b"QJack\r" else write(data)  # type: ignore[method-assign]
    live.samples.clear()
    live.run(1.0)
    assert len(live.samples) > 3 and {sample.flags for sample in live.samples} == {HVFlag.ON}


def test_a_recorded_dialogue_that_never_asked_for_the_jack_again_is_not_asked_for_it() -> None:
    settings = ShvpsSettings(driver="shvps")
    assert settings.looks_at_jack
    settings.as_recorded([b"QVer\r", b"QJack\r", b"QVnow\r"])
    assert not settings.looks_at_jack
    settings.as_recorded([b"QVer\r", b"QJack\r", b"QVnow\r", b"QJack\r"])
    assert settings.looks_at_jack


@pytest.mark.parametrize(
    "after",
    [
        lambda data: data * 2,
        lambda data: data * 3,
        lambda data: b"noise\r\n" + data,
        lambda data: b"\xff" * 3 + b"\r\n" + data,
    ],
)
def test_doubled_answers_and_noise_never_shift_answers_against_questions(
    live: Bench, after: Callable[[bytes], bytes]
) -> None:
    live.fake.after = after
    live.run(1.0)
    assert len(live.samples) > 10
    assert {(s.voltage, s.setpoint, s.flags) for s in live.samples} == {(997.0, 1000.0, HVFlag.ON)}


@pytest.mark.parametrize("every", [3, 4, 5, 7, 11])
def test_lost_answers_never_shift_answers_against_questions(live: Bench, every: int) -> None:
    count = [0]

    def lossy(data: bytes) -> bytes:
        count[0] += 1
        return b"" if count[0] % every == 0 else data

    live.fake.after = lossy
    for _ in range(40):
        try:
            live.run(0.1)
        except DeviceSilent:
            continue
    assert len(live.samples) > 0
    assert {(s.voltage, s.setpoint, s.flags) for s in live.samples} == {(997.0, 1000.0, HVFlag.ON)}


@pytest.mark.parametrize("late_s", [0.11, 0.15, 0.21, 0.25])
def test_late_answers_never_shift_answers_against_questions(live: Bench, late_s: float) -> None:
    for _ in range(20):
        until = live.t + late_s
        hold(live, lambda t, until=until: max(t, until))  # type: ignore[misc]
        live.run(0.3 + 0.0017)
        live.fake.read = type(live.fake).read.__get__(live.fake)  # type: ignore[method-assign]
        live.run(0.1)
    assert len(live.samples) > 20
    assert {(s.voltage, s.setpoint, s.flags) for s in live.samples} == {(997.0, 1000.0, HVFlag.ON)}


@pytest.mark.parametrize("late_s", [0.15, 0.18, 0.21, 0.25])
def test_late_voltage_is_never_taken_for_a_new_one(live: Bench, late_s: float) -> None:
    begin, original = live.t, live.fake.answer
    # the voltage is the time at which it was asked for, in milliseconds
    live.fake.answer = lambda command: (  # type: ignore[method-assign]
        f"{(live.t - begin) * 1e3:.0f}" if command == "QVnow" else original(command)
    )
    hold(live, lambda t: max(t, begin + late_s))
    live.run(1.0)
    assert len(live.samples) > 10
    assert [s.voltage * 1e-3 for s in live.samples] == pytest.approx([s.t - begin for s in live.samples], abs=5e-3)


def test_voltage_beyond_the_maximum_is_not_believed(live: Bench) -> None:
    live.fake.after = lambda data: b"9000\r\n" if data == b"997\r\n" else data
    with pytest.raises((DeviceSilent, DeviceRefused)):
        live.run(2.0)
    assert all(s.voltage <= 6000 for s in live.samples)
    assert live.supply.counters["implausible"] > 0


def test_lost_port(live: Bench) -> None:
    def gone() -> bytes:
        raise DeviceLost("fake", "gone")

    live.fake.read = gone  # type: ignore[method-assign]
    with pytest.raises(DeviceLost):
        live.run(0.1)


def test_encode() -> None:
    assert encode("SVset 1500") == b"SVset 1500\r"


@given(st.lists(st.binary(max_size=70), max_size=8), st.data())
def test_any_split_decodes_to_the_same_lines(lines: list[bytes], data: st.DataObject) -> None:
    wire = b"".join(line + b"\r\n" for line in lines)
    whole, pieces = Codec(), Codec()
    expected = whole.feed(wire)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(wire)), max_size=8)))
    got = [m for a, b in zip([0, *cuts], [*cuts, len(wire)], strict=True) for m in pieces.feed(wire[a:b])]
    assert got == expected and pieces.counters == whole.counters
    assert all(line.isprintable() for line in got)


@pytest.mark.parametrize(("word", "damaged"), [("QVset", b"9000\r\n"), ("QVset", b"3\r\n"), ("QSwMode", b"0\r\n")])
def test_a_damaged_answer_does_not_move_the_set_point(live: Bench, word: str, damaged: bytes) -> None:
    """A ramp goes on from the set-point: an answer that was damaged once must not become that."""
    original = live.fake.write
    spoiled: list[bytes] = []
    watching = False  # in the polling cycle, not while a set-point is read back

    def write(data: bytes) -> None:
        nonlocal watching
        original(data)
        watching = (watching or data == b"QVnow\r") and not data.startswith(b"S")
        if watching and not spoiled and data == word.encode() + b"\r":
            spoiled.append(live.fake.out)
            live.fake.out = damaged

    live.supply.set_voltage(1100.0)
    live.fake.write = write  # type: ignore[method-assign]
    live.run(1.0)
    assert spoiled
    assert live.fake.history == sorted(live.fake.history) and max(live.fake.history) == 1097
    assert {sample.flags & HVFlag.ON for sample in live.samples} == {HVFlag.ON}
