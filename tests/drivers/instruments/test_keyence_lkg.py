"""The Keyence LK-G driver against transcripts of bytes and against a small scripted controller written here."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import roles
from drivers.instruments.keyence_lkg import (
    Codec,
    KeyenceLKG,
    Measured,
    Message,
    Pushed,
    Refused,
    Response,
    Value,
    encode,
)
from drivers.links.link import DeviceLost, DeviceRefused, DeviceSilent
from drivers.roles import SampleFlag

# Codec ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "message"),
    [
        # display and field as in the manual's table
        (b"M1,+01.2345\r", Measured("M1", {1: Value(1.2345)})),
        (b"M1,-00.0120\r", Measured("M1", {1: Value(-0.0120)})),
        (b"M2,+1234.56\r", Measured("M2", {2: Value(1234.56)})),
        (b"M2,-00001.2\r", Measured("M2", {2: Value(-1.2)})),
        (b"M0,+01.2345,-00.0120\r", Measured("M0", {1: Value(1.2345), 2: Value(-0.0120)})),
        (b"TG,2,+00.0001\r", Pushed(2, Value(0.0001))),
        (b"ER,M1,01\r", Refused("M1", 1)),
        (b"ER,SR,22\r", Refused("SR", 22)),
        (b"Q0\r", Response("Q0")),
        (b"R0\r", Response("R0")),
        (b"SR,HB,1,0\r", Response("SR,HB,1,0")),
        (b"SR,OF,1,+12.3450\r", Response("SR,OF,1,+12.3450")),
        (b"SW,CA\r", Response("SW,CA")),
        (b"PR,3\r", Response("PR,3")),
        (b"V1\r", Response("V1")),
        (b"VR\r", Response("VR")),
        (b"AN,1,100,200\r", Response("AN,1,100,200")),
        (b"\nR0\r\n", Response("R0")),  # converters that add LF
    ],
)
def test_decode(data: bytes, message: Message) -> None:
    assert Codec().feed(data) == [message]


@pytest.mark.parametrize(
    ("field", "flag"),
    [
        ("+FFFFFFF", SampleFlag.OVER_RANGE),
        ("-FFFFFFF", SampleFlag.UNDER_RANGE),
        ("XXXXXXXX", SampleFlag.NO_VALUE),
    ],
)
def test_special_values_are_flags_and_never_numbers(field: str, flag: SampleFlag) -> None:
    for text, output in ((f"M1,{field}", 1), (f"M0,+01.2345,{field}", 2), (f"TG,1,{field}", None)):
        (message,) = Codec().feed(text.encode() + b"\r")
        assert isinstance(message, Measured | Pushed)
        value = message.value if isinstance(message, Pushed) else message.values[output or 1]
        assert math.isnan(value.number) and value.flag is flag


@pytest.mark.parametrize(
    "text",
    [
        "M1,+1.2345",  # too short
        "M1,+001.2345",  # too long
        "M1, 01.2345",
        "M1,+01,2345",
        "M1,+012.345.",
        "M1,+1.2.345",
        "M1,+.123456",
        "M1,+123456.",
        "M1,+0123456",
        "M1,+1e1.000",
        "M1,+1_0.000",
        "M1,+00.00nan",
        "M1,+    inf",
        "M1,+FFFFFF",
        "M1,+FFFF.FF",
        "M1,FFFFFFFF",
        "M1,XXXXXXX",
        "M1",
        "M1,+01.2345,+01.2345",
        "M0,+01.2345",
        "m1,+01.2345",
        "M3,+01.2345",
        "M1,+01.M1,+01.2345",  # torn and merged
        "ER,M1",
        "ER,M1,1",
        "Q1",
        "SR,CA",
    ],
)
def test_what_fits_no_grammar_is_dropped_and_counted_and_the_next_line_is_read(text: str) -> None:
    codec = Codec()
    assert codec.feed(text.encode() + b"\rR0\r") == [Response("R0")]
    assert codec.counters["bad_grammar"] == 1


@pytest.mark.parametrize("text", ["M1,+0١.2345", "M1,+0１.2345", "M1,+01\u00b72345"])
def test_digits_of_other_scripts_are_no_digits(text: str) -> None:
    for coding in ("utf-8", "utf-16-le"):
        assert Codec().feed(text.encode(coding) + b"\r") == []


def test_line_without_end_does_not_fill_the_memory() -> None:
    codec = Codec()
    for _ in range(1000):
        assert codec.feed(b"+" * 1000) == []
    assert codec._lines.held <= 128
    assert codec.counters["too_long"] == 1
    assert codec.feed(b"\rR0\r") == [Response("R0")]


def field(sign: str, digits: str, point: int) -> str:
    return f"{sign}{digits[:point]}.{digits[point:]}"


fields = st.one_of(
    st.builds(field, st.sampled_from("+-"), st.integers(0, 999_999).map("{:06d}".format), st.integers(1, 5)),
    st.sampled_from(["+FFFFFFF", "-FFFFFFF", "XXXXXXXX"]),
)
lines = st.one_of(
    st.builds("M1,{}".format, fields),
    st.builds("M0,{},{}".format, fields, fields),
    st.builds("TG,{},{}".format, st.integers(1, 2), fields),
    st.sampled_from(["Q0", "R0", "ER,M1,01", "SR,CA,3", "SR,OC,1,0,4", "PR,0"]),
)


@given(st.lists(st.tuples(lines, st.sampled_from(["\r", "\r\n"])), max_size=12), st.data())
def test_any_split_decodes_to_the_same_messages(texts: list[tuple[str, str]], data: st.DataObject) -> None:
    wire = "".join(text + end for text, end in texts).encode()
    expected = Codec().feed(wire)
    assert len(expected) == len(texts)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(wire)), max_size=12)))
    codec = Codec()
    got = [m for a, b in zip([0, *cuts], [*cuts, len(wire)], strict=True) for m in codec.feed(wire[a:b])]
    assert list(map(repr, got)) == list(map(repr, expected))  # NaN is not equal to itself
    assert codec.counters == Codec().counters


@given(lines, st.data())
def test_no_change_of_one_byte_makes_another_kind_of_value(text: str, data: st.DataObject) -> None:
    """As the module's docstring promises: only a digit or a sign may turn into another without being seen."""
    (before,) = Codec().feed(text.encode() + b"\r")
    at = data.draw(st.integers(0, len(text) - 1))
    byte = data.draw(st.integers(0, 255).filter(lambda b: b != ord(text[at])))
    damaged = bytearray(text.encode() + b"\r")
    damaged[at] = byte
    for after in Codec().feed(bytes(damaged)):
        if isinstance(before, Measured | Pushed) and isinstance(after, Measured | Pushed):
            both = (text[at], chr(byte))
            assert all(c in "0123456789" for c in both) or all(c in "+-" for c in both)


# A scripted controller ------------------------------------------------------------------------------------------------


class FakeLKG:
    """Answers like an LK-G; a ByteLink whose other end is the controller."""

    name = "fake"

    def __init__(self) -> None:
        self.out1, self.out2 = "+01.2345", "XXXXXXXX"
        self.communicating = False
        self.answers = {"SR,CA": "SR,CA,0", "SR,OC,1": "SR,OC,1,0,0", "SR,OC,2": "SR,OC,2,0,0", "PR": "PR,0"}
        self.log: list[str] = []
        self.out = b""
        self.after: Callable[[bytes], bytes] = lambda data: data
        self.closed = False

    def read(self) -> bytes:
        out, self.out = self.out, b""
        return out

    def write(self, data: bytes) -> None:
        command = data.decode().removesuffix("\r")
        assert "\r" not in command
        self.log.append(command)
        self.out += self.after(self.answer(command).encode() + b"\r")

    def answer(self, command: str) -> str:
        main = command.partition(",")[0]
        if command in ("Q0", "R0"):
            if self.communicating == (command == "Q0"):
                return f"ER,{command},01"
            self.communicating = command == "Q0"
            return command
        if main in ("SR", "SW") and not self.communicating:
            return f"ER,{main},01"
        if main in ("M0", "M1", "M2") and self.communicating:
            return f"ER,{main},01"
        measured = {"M0": f"M0,{self.out1},{self.out2}", "M1": f"M1,{self.out1}", "M2": f"M2,{self.out2}"}
        return (measured | self.answers).get(command, f"ER,{main},00")

    def close(self) -> None:
        self.closed = True


class Bench:
    def __init__(self, sensor: KeyenceLKG, fake: FakeLKG) -> None:
        self.sensor, self.fake, self.t = sensor, fake, 0.0
        self.samples: list[roles.DisplacementSample] = []

    def run(self, seconds: float) -> None:
        end = self.t + seconds
        while self.t < end:
            self.t = min(end, max(self.t + 1e-4, min(self.sensor.next_poll, self.t + 1e-3)))
            self.samples += self.sensor.poll(self.t)


def values(bench: Bench) -> list[float]:
    """The different values among the samples."""
    return sorted({s.displacement for s in bench.samples})


@pytest.fixture
def fake() -> FakeLKG:
    return FakeLKG()


@pytest.fixture
def bench(fake: FakeLKG) -> Bench:
    return Bench(KeyenceLKG("laser", fake), fake)


@pytest.fixture
def measuring(bench: Bench) -> Bench:
    bench.run(0.05)
    assert bench.sensor.ready
    bench.samples.clear()
    bench.fake.log.clear()
    return bench


def test_is_a_displacement_sensor(fake: FakeLKG) -> None:
    sensor: roles.DisplacementSensor = KeyenceLKG("laser", fake, poll_rate_Hz=50)
    assert not sensor.ready and sensor.rate == 50


def test_encode() -> None:
    assert encode("SR,CA") == b"SR,CA\r"


def test_set_up_transcript(bench: Bench) -> None:
    bench.fake.answers |= {"SR,CA": "SR,CA,3", "SR,OC,1": "SR,OC,1,0,4"}
    bench.run(0.05)
    assert bench.fake.log[:8] == ["Q0", "SR,CA", "SR,OC,1", "R0", "PR", "M0", "M1", "M0"]
    assert bench.sensor.settings == {
        "output": "1",
        "sampling_code": "3",
        "sampling_us": "200",
        "averaging_code": "4",
        "averaging_samples": "256",
        "averaging_window_ms": "51.2",
        "program": "0",
    }
    assert bench.sensor.averaging_window_s == pytest.approx(51.2e-3)


@pytest.mark.parametrize("left_in_communication_mode", [False, True])
def test_measures_whatever_mode_the_last_program_left(bench: Bench, left_in_communication_mode: bool) -> None:
    bench.fake.communicating = left_in_communication_mode
    bench.run(0.05)
    assert bench.samples and not bench.fake.communicating


def test_settings_that_cannot_be_read_do_not_keep_it_from_measuring(bench: Bench) -> None:
    bench.fake.answers.clear()
    bench.run(0.05)
    assert bench.samples
    assert bench.sensor.settings["averaging_code"].startswith("refused: the command is unknown")
    assert bench.sensor.settings["averaging_window_ms"] == "nan"


def test_other_form_of_the_question_for_averaging(bench: Bench) -> None:
    del bench.fake.answers["SR,OC,1"]
    bench.fake.answers["SR,OC,1,0"] = "SR,OC,1,0,6"
    bench.run(0.05)
    assert bench.sensor.settings["averaging_samples"] == "4096"


def test_set_up_waits_until_the_average_is_full_again(bench: Bench) -> None:
    bench.fake.out1 = "XXXXXXXX"
    bench.run(0.8)
    assert not bench.sensor.ready
    bench.fake.out1 = "+01.2345"
    bench.run(0.1)
    assert bench.sensor.ready and not any(s.flags for s in bench.samples)


@pytest.mark.parametrize(("shown", "after"), [("XXXXXXXX", 10.1), ("+FFFFFFF", 0.1)])
def test_specimen_that_cannot_be_seen_does_not_hold_up_set_up(bench: Bench, shown: str, after: float) -> None:
    bench.fake.out1 = shown
    bench.run(after)
    assert bench.sensor.ready


def test_values_come_at_the_rate_in_metres_with_midpoint_times(measuring: Bench) -> None:
    measuring.run(1.0)
    assert 99 <= len(measuring.samples) <= 101
    assert values(measuring) == pytest.approx([1.2345e-3], rel=1e-12)
    gaps = [b.t - a.t for a, b in zip(measuring.samples, measuring.samples[1:], strict=False)]
    assert gaps == pytest.approx([0.01] * len(gaps), abs=2e-3)


def test_time_of_a_value_is_the_middle_of_the_averaging_window(fake: FakeLKG) -> None:
    """Asked and answered within a millisecond; 200 us times 256 samples are averaged before."""
    asked: dict[str, list[float]] = {"plain": [], "averaged": []}
    for kind, codes in (("plain", ("0", "0")), ("averaged", ("3", "4"))):
        fake.answers |= {"SR,CA": f"SR,CA,{codes[0]}", "SR,OC,1": f"SR,OC,1,0,{codes[1]}"}
        bench = Bench(KeyenceLKG("laser", fake), fake)
        bench.run(0.1)
        asked[kind] = [sample.t for sample in bench.samples]
    assert asked["averaged"] == pytest.approx([t - 25.6e-3 for t in asked["plain"]], abs=1e-4)


def test_other_output_and_unit(fake: FakeLKG) -> None:
    fake.out1, fake.out2 = "+01.2345", "-0123.40"
    bench = Bench(KeyenceLKG("laser", fake, output=2, unit_mm=1e-3), fake)
    bench.run(0.1)
    assert values(bench) == pytest.approx([-123.4e-6], rel=1e-12)
    assert "M2" in fake.log and "M1" not in fake.log


@pytest.mark.parametrize(
    ("shown", "flag"),
    [
        ("+FFFFFFF", SampleFlag.OVER_RANGE),
        ("-FFFFFFF", SampleFlag.UNDER_RANGE),
        ("XXXXXXXX", SampleFlag.NO_VALUE),
    ],
)
def test_special_values_become_flagged_samples(measuring: Bench, shown: str, flag: SampleFlag) -> None:
    measuring.fake.out1 = shown
    measuring.run(0.1)
    assert all(math.isnan(s.displacement) and s.flags == flag for s in measuring.samples[1:])
    assert len(measuring.samples) >= 9


def test_pushed_values_among_the_answers_are_not_taken_for_them(measuring: Bench) -> None:
    measuring.fake.after = lambda data: b"TG,1,+09.9999\r" + data + b"TG,2,-FFFFFFF\r"
    measuring.run(0.5)
    assert values(measuring) == pytest.approx([1.2345e-3], rel=1e-12)
    assert measuring.sensor.counters["pushed"] > 90


def test_duplicates_never_shift_answers_against_questions(measuring: Bench) -> None:
    measuring.fake.after = lambda data: data * 2
    for shown in ("+00.0001", "+00.0002", "+00.0003", "+00.0004"):
        measuring.fake.out1 = shown
        measuring.run(0.05)
        measuring.samples.clear()
        measuring.run(0.05)
        assert values(measuring) == pytest.approx([float(shown) * 1e-3], rel=1e-12)
    assert measuring.sensor.counters["unexpected_replies"] > 30


def test_answer_to_the_question_before_is_never_taken(measuring: Bench) -> None:
    held = [b""]

    def late(data: bytes) -> bytes:
        held.append(data)
        return held.pop(0)

    measuring.fake.after = late
    measuring.run(0.02)
    measuring.samples.clear()
    with pytest.raises(DeviceSilent):
        measuring.run(1.0)
    assert measuring.samples == []


@pytest.mark.parametrize("late_s", [0.11, 0.15, 0.21, 0.25, 0.31, 0.39])
def test_late_value_is_never_taken_for_a_new_one(measuring: Bench, late_s: float) -> None:
    """One answer is late, and all later ones wait behind it, as they do on a serial line."""
    waiting: list[tuple[float, bytes]] = []
    held_until = measuring.t + late_s
    original = measuring.fake.read

    def read() -> bytes:
        waiting.append((max(measuring.t, held_until), original()))
        out = b"".join(data for t, data in waiting if t <= measuring.t)
        waiting[:] = [(t, data) for t, data in waiting if t > measuring.t]
        return out

    measuring.fake.read = read  # type: ignore[method-assign]
    begin, old = measuring.t, measuring.fake.answer
    # the value is the time at which it was asked for, in milliseconds
    measuring.fake.answer = lambda command: (  # type: ignore[method-assign]
        old(command).replace("01.2345", f"{(measuring.t - begin) * 1e3 / 10:07.4f}")
    )
    measuring.run(1.0)
    assert len(measuring.samples) > 20
    for sample in measuring.samples:
        if sample.t > begin:
            middle = measuring.sensor.averaging_window_s / 2
            assert sample.displacement * 10 == pytest.approx(sample.t - begin + middle, abs=5e-3)


def test_value_beyond_the_head_is_not_believed(measuring: Bench) -> None:
    measuring.fake.out1 = "+91.2345"
    with pytest.raises(DeviceSilent):
        measuring.run(1.0)
    assert all(s.displacement < 0.08 for s in measuring.samples)
    assert measuring.sensor.counters["implausible"] == 3


def test_other_output_may_show_anything(measuring: Bench) -> None:
    measuring.fake.out2 = "+99999.9"
    measuring.run(0.1)
    assert len(measuring.samples) > 8


def test_somebody_entered_communication_mode(measuring: Bench) -> None:
    measuring.fake.communicating = True
    measuring.run(0.1)
    assert len(measuring.samples) > 8
    assert measuring.sensor.counters["mode_restored"] == 1


def test_refusal_to_measure_is_told_with_its_meaning(measuring: Bench) -> None:
    measuring.fake.answer = lambda command: f"ER,{command},22"  # type: ignore[method-assign]
    with pytest.raises(DeviceRefused, match=r"laser \(fake\): the controller refused to measure because a parameter"):
        measuring.run(0.1)


def test_refusal_of_another_command_is_not_taken(measuring: Bench) -> None:
    measuring.fake.after = lambda data: b"ER,SR,01\r" + data
    measuring.run(0.1)
    assert len(measuring.samples) > 8


def test_lost_answers_are_asked_for_again(measuring: Bench) -> None:
    measuring.fake.after = lambda data: b""
    measuring.run(0.12)
    measuring.fake.after = lambda data: data
    measuring.samples.clear()
    measuring.run(0.2)
    assert len(measuring.samples) > 5
    assert measuring.sensor.counters["retries"] >= 1


def test_silence(measuring: Bench) -> None:
    measuring.fake.after = lambda data: b""
    with pytest.raises(DeviceSilent, match=r"laser \(fake\): no answer to 'PR'"):
        measuring.run(1.0)


def test_lost_port_leaves_poll(measuring: Bench) -> None:
    def gone() -> bytes:
        raise DeviceLost("fake", "gone")

    measuring.fake.read = gone  # type: ignore[method-assign]
    with pytest.raises(DeviceLost):
        measuring.run(0.01)


def test_close_in_communication_mode_leaves_it(fake: FakeLKG) -> None:
    sensor = KeyenceLKG("laser", fake)
    sensor.poll(0.0)
    assert fake.communicating
    sensor.close()
    sensor.close()
    assert not fake.communicating and fake.closed


def test_output_that_does_not_exist(fake: FakeLKG) -> None:
    with pytest.raises(ValueError, match="output must be 1 or 2"):
        KeyenceLKG("laser", fake, output=3)
