"""The Zaber driver against transcripts of bytes and against a small scripted stage written here."""

from __future__ import annotations

import itertools
import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers import roles
from drivers.instruments.zaber import NumberedLines
from drivers.instruments.zaber.codec import WARNINGS, Alert, Codec, Info, Message, Reply, checksum, encode
from drivers.instruments.zaber.device import ZaberStage
from drivers.links.link import DeviceLost, DeviceRefused, DeviceSilent
from drivers.recorded import Exchange, Passed

STEP = 0.49609375e-6  # 6.35 mm / 200 / 64


def lrc(text: str) -> str:
    """The checksum as the manual words it: the two's complement of the sum."""
    return f"{(0x100 - sum(text.encode()) % 0x100) % 0x100:02X}"


def line(text: str) -> bytes:
    return f"{text}:{lrc(text[1:])}\r\n".encode()


# Codec ----------------------------------------------------------------------------------------------------------------

# Exchanges recorded between zaber-motion and an emulator.
VECTORS = [b"1 0 00 get pos:2D", b"1 1 32 move abs 20000:BA", b"01 1 29 OK BUSY -- 0:DC", b"01 0 00 OK IDLE WR 0:BE"]


@pytest.mark.parametrize("vector", [*VECTORS, b"01 1 44 RJ IDLE -- BADCOMMAND:6C"])
def test_checksum_vectors(vector: bytes) -> None:
    text, _, digits = vector.rpartition(b":")
    assert checksum(text) == int(digits, 16)


def test_encode() -> None:
    assert encode(1, 0, 0, "get pos") == b"/1 0 00 get pos:2D\n"
    assert encode(1, 1, 32, "move abs 20000") == b"/1 1 32 move abs 20000:BA\n"
    assert encode(1, 1, 7, "") == b"/1 1 07:" + lrc("1 1 07").encode() + b"\n"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"@01 1 29 OK BUSY -- 0:DC\r\n", Reply(1, 1, 29, True, True, "--", "0")),
        (b"@01 0 00 OK IDLE WR 0:BE\r\n", Reply(1, 0, 0, True, False, "WR", "0")),
        (b"@01 1 44 RJ IDLE -- BADCOMMAND:6C\r\n", Reply(1, 1, 44, False, False, "--", "BADCOMMAND")),
        (b"@01 0 OK IDLE -- 5 NA 7\r\n", Reply(1, 0, None, True, False, "--", "5 NA 7")),
        (line("@01 1 03 OK IDLE FS 02 FS NI"), Reply(1, 1, 3, True, False, "FS", "02 FS NI")),
        (line("!01 1 IDLE --"), Alert(1, 1, False, "--", "")),
        (line("!01 1 BUSY NC 12"), Alert(1, 1, True, "NC", "12")),
        (line("#01 0 07 help text"), Info(1, 0, 7, "help text")),
        (line("#01 0 help text"), Info(1, 0, None, "help text")),
        (b"@01 0 OK IDLE -- 0\n", Reply(1, 0, None, True, False, "--", "0")),
    ],
)
def test_decode(data: bytes, message: Message) -> None:
    assert Codec().feed(data) == [message]


def test_continued_packets_are_joined_also_with_others_between() -> None:
    codec = Codec()
    wire = b"".join(
        line(text)
        for text in (
            "@01 0 04 OK IDLE -- part1\\",
            "#01 0 04 cont part2a part2b\\",
            "!02 1 IDLE --",
            "@01 1 05 OK IDLE -- 7",
            "#01 0 04 cont part3",
        )
    )
    assert codec.feed(wire) == [
        Alert(2, 1, False, "--", ""),
        Reply(1, 1, 5, True, False, "--", "7"),
        Reply(1, 0, 4, True, False, "--", "part1 part2a part2b part3"),
    ]
    assert codec.feed(line("#01 0 04 cont again")) == []
    assert codec.counters["lost_continuation"] == 1


@pytest.mark.parametrize(
    ("data", "counter"),
    [
        (b"@01 1 29 OK BUSY -- 1:DC\r\n", "bad_checksum"),
        (b"@01 1 29 OK BUSY -- 0\r\n", "without_checksum"),
        (line("@01 1 29 OK MAYBE -- 0"), "bad_grammar"),
        (line("@1 1 29 OK IDLE -- 0"), "bad_grammar"),
        (line("/1 1 29 get pos"), "bad_grammar"),  # our own command, echoed
        (b"\xff\xfe@01 1 29 OK BUSY -- 0:DC\r\n", "bad_grammar"),
        (b"@" + b"0" * 600 + b"\r\n", "too_long"),
    ],
)
def test_what_is_wrong_is_dropped_and_counted_and_the_next_line_is_read(data: bytes, counter: str) -> None:
    codec = Codec()
    good = b"@01 1 29 OK BUSY -- 0:DC\r\n"
    assert len(codec.feed(good)) == 1
    assert len(codec.feed(data + good)) == 1
    assert {key: n for key, n in codec.counters.items() if n} == {counter: 1}


def test_alerts_without_checksum_are_taken_until_one_had_it() -> None:
    codec = Codec()
    codec.feed(line("@01 1 29 OK BUSY -- 0"))
    assert codec.feed(b"!01 1 IDLE --\r\n") == [Alert(1, 1, False, "--", "")]
    assert codec.feed(line("!01 1 IDLE --") + b"!01 1 IDLE --\r\n") == [Alert(1, 1, False, "--", "")]
    assert codec.counters["without_checksum"] == 1


def test_line_without_end_does_not_fill_the_memory() -> None:
    codec = Codec()
    for _ in range(1000):
        assert codec.feed(b"x" * 1000) == []
    assert codec._lines.held <= 512
    assert codec.counters["too_long"] == 1
    assert codec.feed(b"\n@01 1 29 OK BUSY -- 0:DC\r\n") == [Reply(1, 1, 29, True, True, "--", "0")]


replies = st.builds(
    "@{:02d} {} {:02d} {} {} {} {}".format,
    st.integers(0, 99),
    st.integers(0, 9),
    st.integers(0, 99),
    st.sampled_from(["OK", "RJ"]),
    st.sampled_from(["BUSY", "IDLE"]),
    st.sampled_from(["--", *WARNINGS]),
    st.from_regex(r"-?[0-9]{1,9}|[A-Z]{3,14}|[0-9]{2}( [A-Z]{2}){0,3}|0 a\\\Z", fullmatch=True),
)
alerts = st.builds("!{:02d} {} {} {}".format, st.integers(1, 9), st.integers(1, 9), st.just("IDLE"), st.just("--"))
infos = st.builds(
    "#{:02d} {} {:02d} {}".format, st.integers(1, 9), st.integers(0, 9), st.integers(0, 99), st.text("ab \\")
)
streams = st.lists(st.one_of(replies, alerts, infos, st.text(st.characters(max_codepoint=255), max_size=9)), max_size=8)


@settings(max_examples=25)  # each with a dozen cuts
@given(streams, st.data())
def test_any_split_decodes_to_the_same_messages(texts: list[str], data: st.DataObject) -> None:
    wire = b"".join(f"{text}:{sum(map(ord, text[1:])) * 255 % 256:02X}\r\n".encode("latin-1") for text in texts)
    whole = Codec()
    expected = whole.feed(wire)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(wire)), max_size=12)))
    pieces = Codec()
    got = [m for a, b in zip([0, *cuts], [*cuts, len(wire)], strict=True) for m in pieces.feed(wire[a:b])]
    assert got == expected
    assert pieces.counters == whole.counters


# A scripted stage -----------------------------------------------------------------------------------------------------


class FakeStage:
    """Answers like an X-LSQ150B; time passes by `tick`. A ByteLink whose other end is the stage."""

    name = "fake"

    def __init__(self) -> None:
        self.position, self.target, self.speed = 1000, 1000, 500
        self.flags = ["WR"]
        self.homing = False
        self.checksums = True
        self.settings = {
            "deviceid": "50081",
            "system.serial": "12345",
            "version": "7.14",
            "resolution": "64",
            "limit.min": "0",
            "limit.max": "305381",
            "maxspeed": "153600",
            "accel": "205",
            "knob.enable": "1",
            "comm.checksum": "0",
        }
        self.rejects: dict[str, str] = {}
        self.log: list[str] = []
        self.out = b""
        self.lose_commands = 0
        self.lose_replies = 0
        self.closed = False

    @property
    def busy(self) -> bool:
        return self.homing or self.position != self.target

    def tick(self) -> None:
        if self.homing:
            self.homing, self.position, self.target = False, 0, 0
            self.flags = [f for f in self.flags if f not in ("WR", "WH")]
        step = max(-self.speed, min(self.speed, self.target - self.position))
        self.position += step

    def reset(self) -> None:
        self.position = self.target = 0
        self.homing, self.flags = False, ["WR"]

    def read(self) -> bytes:
        out, self.out = self.out, b""
        return out

    def write(self, data: bytes) -> None:
        text = data.decode().removesuffix("\n")
        assert text.startswith("/") and text[-3:] == ":" + lrc(text[1:-3])
        device, axis, message_id, *words = text[1:-3].split()
        command = " ".join(words)
        self.log.append(command)
        if self.lose_commands and command:
            self.lose_commands -= 1
            return
        data_words = self.rejects.get(command) or self.do(words)
        verdict = "RJ" if data_words.isupper() and data_words[0].isalpha() else "OK"
        shown = self.flags[0] if self.flags else "--"
        state = "BUSY" if self.busy else "IDLE"
        reply = f"@{int(device):02d} {axis} {message_id} {verdict} {state} {shown} {data_words}"
        if self.lose_replies and command:
            self.lose_replies -= 1
            return
        self.out += line(reply) if self.checksums else f"{reply}\r\n".encode()

    def do(self, words: list[str]) -> str:
        match words:
            case ["get", "pos"]:
                return str(self.position)
            case ["get", key]:
                return self.settings.get(key, "BADCOMMAND")
            case ["set", "comm.checksum", value]:
                self.checksums, self.settings["comm.checksum"] = value == "1", value
            case ["set", key, value]:
                self.settings[key] = value
            case ["warnings"]:
                return " ".join([f"{len(self.flags):02d}", *self.flags])
            case ["warnings", "clear"]:
                said = " ".join([f"{len(self.flags):02d}", *self.flags])
                self.flags = [f for f in self.flags if f in ("WR", "WH")]
                return said
            case ["home"]:
                self.homing = True
            case ["move", "abs", n]:
                if not 0 <= int(n) <= 305381:
                    return "BADDATA"
                self.target = int(n)
            case ["move", "vel", v]:
                self.target = 305381 if int(v) > 0 else 0
            case ["stop"] | ["estop"]:
                self.target = self.position
                self.homing = False
        return "0"

    def close(self) -> None:
        self.closed = True


class Bench:
    """Polls the stage when it asks to be polled, in steps of at most a millisecond."""

    def __init__(self, stage: ZaberStage, fake: FakeStage) -> None:
        self.stage, self.fake, self.t = stage, fake, 0.0
        self.samples: list[roles.StageSample] = []

    def run(self, seconds: float) -> None:
        end = self.t + seconds
        while self.t < end:
            self.t = min(end, max(self.t + 1e-4, min(self.stage.next_poll, self.t + 1e-3)))
            self.samples += self.stage.poll(self.t)

    def until_still(self) -> None:
        for _ in range(1000):
            if not self.stage.moving:
                return
            self.run(0.05)
            self.fake.tick()
        raise AssertionError("never stood still")


@pytest.fixture
def fake() -> FakeStage:
    return FakeStage()


@pytest.fixture
def bench(fake: FakeStage) -> Bench:
    return Bench(ZaberStage("stage", fake), fake)


@pytest.fixture
def homed(bench: Bench) -> Bench:
    bench.run(0.1)
    bench.stage.home()
    bench.until_still()
    assert bench.stage.referenced
    bench.fake.log.clear()
    bench.samples.clear()
    return bench


def test_is_a_stage(fake: FakeStage) -> None:
    stage: roles.Stage = ZaberStage("stage", fake)
    assert not stage.ready and not stage.moving and not stage.referenced


def test_set_up_reads_everything_and_moves_nothing(bench: Bench) -> None:
    bench.run(0.1)
    stage = bench.stage
    assert stage.ready
    assert stage.identity == roles.Identity("Zaber device 50081", "12345", "7.14")
    assert stage.travel == pytest.approx((0.0, 151.4976e-3), abs=1e-7)  # 151.50 mm in the data sheet
    acceleration = 205 / 1.6384 * 1e4 * STEP  # 0.62 m/s^2
    assert stage.braking_distance(10e-3) == pytest.approx((10e-3) ** 2 / (2 * acceleration), rel=1e-9)
    assert stage.settings["resolution"] == "64" and stage.settings["microstep_um"] == "0.49609375"
    assert stage.settings["warnings_at_start"] == "WR"
    assert stage.settings["knob"] == "enabled" and bench.fake.settings["knob.enable"] == "1"
    assert not any(command.startswith("set ") for command in bench.fake.log)
    assert not any(command.split()[0] in ("move", "home", "stop", "estop") for command in bench.fake.log if command)


def test_set_up_transcript() -> None:
    fake = FakeStage()
    fake.flags = []
    bench = Bench(ZaberStage("stage", fake), fake)
    bench.run(0.1)
    assert fake.log[:13] == [
        "",
        "get deviceid",
        "get system.serial",
        "get version",
        "get resolution",
        "get limit.min",
        "get limit.max",
        "get accel",
        "get maxspeed",
        "get knob.enable",
        "get comm.checksum",
        "warnings",
        "get pos",
    ]


def test_resolution_of_the_device_is_used(fake: FakeStage) -> None:
    fake.settings["resolution"] = "128"
    bench = Bench(ZaberStage("stage", fake), fake)
    bench.run(0.1)
    assert bench.samples[0].position == pytest.approx(1000 * 0.248046875e-6)


@pytest.mark.parametrize(
    ("key", "value", "allowed"),
    [
        ("resolution", "0", "1"),
        ("limit.min", "305381", "305380"),  # no travel at all
        ("limit.max", "0", "1"),
        ("maxspeed", "0", "1"),
        ("accel", "-1", "0"),  # 0: it has no ramp
    ],
)
def test_one_senseless_setting_is_enough_to_refuse_the_stage(
    fake: FakeStage, key: str, value: str, allowed: str
) -> None:
    fake.settings[key] = value
    bench = Bench(ZaberStage("stage", fake), fake)
    with pytest.raises(DeviceRefused, match=rf"its settings make no sense: .*{key} {value}\b"):
        bench.run(0.2)
    assert not bench.stage.ready
    sensible = FakeStage()
    sensible.settings[key] = allowed
    bench = Bench(ZaberStage("stage", sensible), sensible)
    bench.run(0.2)
    assert bench.stage.ready


def test_stage_without_reply_checksums_is_told_to_send_them(fake: FakeStage) -> None:
    fake.checksums = False
    bench = Bench(ZaberStage("stage", fake), fake)
    bench.run(0.1)
    assert bench.stage.settings["reply_checksums"] == "no" and fake.settings["comm.checksum"] == "0"
    bench.stage.home()
    bench.until_still()
    assert bench.stage.settings["reply_checksums"] == "yes"
    again = [command for command in fake.log if command == "get resolution"]
    assert len(again) == 2  # what was read without checksums is read again with them
    bench.stage.give_back()
    bench.run(0.1)
    assert bench.stage.given_back and not fake.checksums


def test_stage_that_cannot_send_checksums_still_works(fake: FakeStage) -> None:
    fake.checksums = False
    fake.rejects["set comm.checksum 1"] = "BADCOMMAND"
    del fake.settings["comm.checksum"]
    bench = Bench(ZaberStage("stage", fake), fake)
    bench.run(0.1)
    bench.stage.home()
    bench.until_still()
    assert bench.stage.referenced and bench.stage.settings["reply_checksums"] == "no"


def test_settings_read_wrongly_without_checksums_keep_the_stage_where_it_is(fake: FakeStage) -> None:
    fake.checksums = False
    bench = Bench(ZaberStage("stage", fake), fake)
    bench.run(0.1)
    fake.settings["limit.max"] = "315381"  # as a damaged digit looks
    bench.stage.home()
    with pytest.raises(DeviceRefused, match="without checksums"):
        bench.run(0.2)
    assert "home" not in fake.log


def test_silent_stage(fake: FakeStage) -> None:
    fake.write = lambda data: None  # type: ignore[method-assign]
    bench = Bench(ZaberStage("stage", fake), fake)
    with pytest.raises(DeviceSilent, match=r"stage \(fake\): no answer to 'status'. Check that it is switched on"):
        bench.run(1.0)
    assert bench.t == pytest.approx(0.75, abs=0.01)


def test_position_is_streamed_at_the_rate_with_midpoint_times(homed: Bench) -> None:
    homed.run(1.0)
    assert 49 <= len(homed.samples) <= 51
    assert {s.position for s in homed.samples} == {0.0}
    assert all(s.referenced and not s.moving for s in homed.samples)
    stage = homed.stage
    assert stage.counters["round_trips"] > 50
    # asked and answered within one millisecond by the bench
    gaps = [b.t - a.t for a, b in zip(homed.samples, homed.samples[1:], strict=False)]
    assert gaps == pytest.approx([0.02] * len(gaps), abs=2e-3)


def test_unreferenced_stage_refuses_to_move_and_says_what_to_do(bench: Bench) -> None:
    with pytest.raises(DeviceRefused, match="not set up yet"):
        bench.stage.home()
    bench.run(0.1)
    with pytest.raises(DeviceRefused, match=r"WR: no reference position\). Home it first"):
        bench.stage.move_to(0.01, 0.001)
    with pytest.raises(DeviceRefused, match="Home it first"):
        bench.stage.move_velocity(0.001)
    bench.run(0.1)
    assert not any(command.startswith("move") for command in bench.fake.log)


def test_home_then_move(bench: Bench) -> None:
    bench.run(0.1)
    stage = bench.stage
    stage.home()
    assert stage.moving
    bench.run(0.1)
    assert stage.moving and not stage.referenced
    bench.fake.tick()
    bench.until_still()
    assert stage.referenced
    stage.move_to(1e-3, 2e-3)
    assert stage.moving
    bench.until_still()
    assert bench.fake.position == 2016  # 1 mm / 0.49609375 um = 2015.75
    assert bench.samples[-1].position == pytest.approx(1e-3, abs=0.5 * STEP)
    # 2 mm/s = 2 * 3302.60 velocity units at resolution 64
    order = [command for command in bench.fake.log if command.startswith(("set maxspeed", "move"))]
    assert order == ["set maxspeed 6605", "move abs 2016"]


def test_speed_is_set_only_when_it_changes(homed: Bench) -> None:
    for position in (1e-3, 2e-3):
        homed.stage.move_to(position, 2e-3)
        homed.until_still()
    assert sum(command.startswith("set maxspeed") for command in homed.fake.log) == 1


@pytest.mark.parametrize("position", [math.nan, math.inf, -math.inf, -1e-6, 0.1516])
def test_positions_outside_the_travel_are_refused(homed: Bench, position: float) -> None:
    with pytest.raises(DeviceRefused, match=r"outside the travel. Allowed: 0 to 151.4976 mm"):
        homed.stage.move_to(position, 1e-3)
    assert not homed.stage.moving


@pytest.mark.parametrize("speed", [math.nan, math.inf, 0.0, -1e-3])
def test_speeds_that_are_none_are_refused(homed: Bench, speed: float) -> None:
    with pytest.raises(DeviceRefused, match="is not a speed"):
        homed.stage.move_to(1e-3, speed)


def test_ends_of_the_travel_can_be_reached(homed: Bench) -> None:
    homed.fake.speed = 400_000
    for position, steps in zip(reversed(homed.stage.travel), (305381, 0), strict=True):
        homed.stage.move_to(position, 1e-3)
        homed.until_still()
        assert homed.fake.position == steps


def test_moving_is_true_from_the_command_on(homed: Bench) -> None:
    """Whatever replies are under way, no moment looks as if the motion had ended before it began."""
    for delay in (0.0, 0.0005, 0.01, 0.0195, 0.02):
        homed.run(delay)
        homed.samples.clear()
        target = 2e-3 if homed.fake.position < 3000 else 1e-3
        homed.stage.move_to(target, 1e-3)
        for _ in range(60):
            assert homed.stage.moving
            homed.run(0.0005)
        assert all(s.moving for s in homed.samples if s.t > homed.t - 0.025)
        homed.until_still()


def test_stop_overtakes_everything_queued(homed: Bench) -> None:
    homed.stage.move_to(50e-3, 1e-3)
    homed.run(0.1)
    homed.stage.move_to(100e-3, 1e-3)
    homed.stage.stop()
    assert homed.stage.moving
    homed.fake.log.clear()
    homed.run(0.0011)
    assert homed.fake.log[0] == "stop"
    homed.until_still()
    assert homed.fake.position < 10000
    assert not any(command.startswith("move") for command in homed.fake.log)


def test_stop_does_not_wait_for_an_answer_that_never_comes(homed: Bench) -> None:
    homed.fake.lose_replies = 1
    homed.run(0.03)  # a position is outstanding now
    homed.stage.estop()
    homed.run(0.002)
    assert "estop" in homed.fake.log


def test_stop_is_repeated_until_answered_and_says_so_if_not(homed: Bench) -> None:
    homed.stage.move_to(50e-3, 1e-3)
    homed.run(0.1)
    homed.fake.lose_commands = 3
    homed.stage.stop()
    homed.run(1.0)
    assert homed.fake.target == homed.fake.position
    homed.fake.write = lambda data: None  # type: ignore[method-assign]
    homed.stage.stop()
    with pytest.raises(DeviceSilent, match="cut its power"):
        for _ in range(30):
            try:
                homed.run(0.1)
            except DeviceSilent as silent:
                if "stop" in str(silent):
                    raise


def test_move_velocity(homed: Bench) -> None:
    homed.stage.move_velocity(1e-3)
    homed.run(0.05)
    assert "move vel 3303" in homed.fake.log  # 3302.60
    homed.stage.stop()
    homed.until_still()


def test_move_by(homed: Bench) -> None:
    for expected in (2016, 4031):  # 2015.75 and twice that, each from where it stands
        homed.stage.move_by(1e-3, 1e-3)
        with pytest.raises(DeviceRefused, match="still moving"):
            homed.stage.move_by(1e-3, 1e-3)
        homed.until_still()
        homed.run(0.05)
        assert homed.fake.position == pytest.approx(expected, abs=1)
    with pytest.raises(DeviceRefused, match="outside the travel"):
        homed.stage.move_by(-3e-3, 1e-3)
    with pytest.raises(DeviceRefused, match="outside the travel"):
        homed.stage.move_by(math.nan, 1e-3)


def test_lost_command_is_given_again_after_the_state_was_asked(homed: Bench) -> None:
    homed.run(0.02)
    homed.stage.move_to(1e-3, 1e-3)
    while "move abs 2016" not in homed.fake.log:
        homed.fake.lose_commands = 1 if homed.fake.log and homed.fake.log[-1].startswith("set maxspeed") else 0
        homed.run(0.0005)
    assert homed.fake.target == 0
    homed.until_still()
    assert homed.fake.position == 2016
    after = homed.fake.log[homed.fake.log.index("move abs 2016") + 1 :]
    assert after[0] == "warnings" and "move abs 2016" in after


def test_lost_reply_to_a_move_under_way_does_not_repeat_it(homed: Bench) -> None:
    homed.stage.move_to(1e-3, 1e-3)
    homed.until_still()
    homed.fake.log.clear()
    homed.stage.move_to(5e-3, 1e-3)
    while "move abs 10079" not in homed.fake.log:
        homed.fake.lose_replies = 1 if homed.fake.log and homed.fake.log[-1] == "warnings" else 0
        homed.run(0.0005)
    homed.until_still()
    assert homed.fake.position == 10079
    assert homed.fake.log.count("move abs 10079") == 1


def test_rejected_move_is_told_with_its_meaning(homed: Bench) -> None:
    homed.fake.rejects["move abs 2016"] = "DRIVERDISABLED"
    homed.stage.move_to(1e-3, 1e-3)
    with pytest.raises(DeviceRefused, match=r"rejected 'move abs 2016': the motor driver is disabled .*power-cycle"):
        homed.run(0.1)
    homed.run(0.1)
    assert not homed.stage.moving


def test_restart_in_the_middle_of_a_move(homed: Bench) -> None:
    homed.stage.move_to(50e-3, 1e-3)
    for _ in range(5):
        homed.run(0.05)
        homed.fake.tick()
    homed.fake.reset()
    with pytest.raises(DeviceRefused, match="lost its reference position"):
        homed.run(0.05)
    assert not homed.stage.referenced
    homed.run(0.2)  # told once
    assert not homed.samples[-1].referenced
    with pytest.raises(DeviceRefused, match="Home it first"):
        homed.stage.move_to(1e-3, 1e-3)
    homed.stage.stop()
    homed.until_still()


def test_restart_just_before_a_move_keeps_it_from_going_out(homed: Bench) -> None:
    homed.fake.reset()
    homed.stage.move_to(1e-3, 1e-3)
    with pytest.raises(DeviceRefused, match="lost its reference position"):
        homed.run(0.1)
    assert not any(command.startswith("move") for command in homed.fake.log)


def test_homing_that_fails(bench: Bench) -> None:
    bench.run(0.1)
    bench.stage.home()
    bench.run(0.05)
    bench.fake.homing = False
    with pytest.raises(DeviceRefused, match="homing ended without a reference position"):
        bench.run(0.1)


def test_stall_is_told_once_with_all_flags_in_the_samples(homed: Bench) -> None:
    homed.stage.move_to(50e-3, 1e-3)
    homed.run(0.05)
    homed.fake.target = homed.fake.position
    homed.fake.flags = ["FS", "NI"]
    with pytest.raises(DeviceRefused, match="FS: stalled and stopped"):
        homed.run(0.1)
    homed.run(0.1)
    assert homed.samples[-1].warnings == ("FS", "NI")
    homed.stage.move_to(1e-3, 1e-3)  # the next command clears what is history
    homed.until_still()
    assert not homed.samples[-1].warnings


def test_alerts_and_infos_between_command_and_reply(homed: Bench) -> None:
    original = homed.fake.write

    def chatty(data: bytes) -> None:
        homed.fake.out += line("!01 1 IDLE --") + line("#01 0 note")
        original(data)

    homed.fake.write = chatty  # type: ignore[method-assign]
    homed.stage.move_to(1e-3, 1e-3)
    assert homed.stage.moving
    homed.until_still()
    assert homed.fake.position == 2016
    assert homed.stage.counters["alerts"] > 5 and homed.stage.counters["unexpected_replies"] == 0


def test_duplicate_and_foreign_replies_are_never_taken(homed: Bench) -> None:
    original = homed.fake.write

    def doubled(data: bytes) -> None:
        original(data)
        homed.fake.out = homed.fake.out * 2 + line("@02 1 00 OK IDLE -- 99999")

    homed.fake.write = doubled  # type: ignore[method-assign]
    homed.run(0.5)
    assert {s.raw for s in homed.samples} == {0}
    assert homed.stage.counters["unexpected_replies"] > 40


def test_reply_of_the_question_before_is_never_taken(homed: Bench) -> None:
    """Every reply comes one question late: nothing may be believed."""
    original, held = homed.fake.write, [b""]

    def late(data: bytes) -> None:
        original(data)
        held.append(homed.fake.out)
        homed.fake.out = held.pop(0)

    homed.fake.write = late  # type: ignore[method-assign]
    homed.fake.position = homed.fake.target = 4242
    homed.samples.clear()
    with pytest.raises(DeviceSilent):
        homed.run(2.0)
    assert homed.samples == []


def test_nonsense_with_a_good_checksum_is_no_number(homed: Bench) -> None:
    homed.fake.rejects["get pos"] = "1_000"
    with pytest.raises(DeviceRefused, match="'1_000' to 'get pos', which is no number"):
        homed.run(0.1)


def test_close_gives_the_knob_and_the_speed_back_and_stops(homed: Bench) -> None:
    homed.stage.move_to(50e-3, 1e-3)
    homed.run(0.1)
    homed.stage.close()
    homed.stage.close()
    assert homed.fake.settings["knob.enable"] == "1"
    assert homed.fake.settings["maxspeed"] == "153600"
    assert homed.fake.position == homed.fake.target
    assert homed.fake.closed


def test_close_of_a_lost_stage_is_quiet(homed: Bench) -> None:
    def gone(data: bytes) -> None:
        raise DeviceLost("fake", "gone")

    homed.fake.write = gone  # type: ignore[method-assign]
    homed.stage.close()
    assert homed.fake.closed


def test_lost_port_leaves_poll(homed: Bench) -> None:
    def gone() -> bytes:
        raise DeviceLost("fake", "gone")

    homed.fake.read = gone  # type: ignore[method-assign]
    for _ in range(3):
        with pytest.raises(DeviceLost):
            homed.run(0.01)


def test_noise_on_the_line_costs_retries_and_nothing_else(homed: Bench) -> None:
    noise = random.Random(1)
    original = homed.fake.read

    def noisy() -> bytes:
        data = bytearray(original())
        if data and noise.random() < 0.03:
            data[noise.randrange(len(data))] ^= 1 << noise.randrange(8)
        return bytes(data)

    homed.fake.read = noisy  # type: ignore[method-assign]
    homed.fake.position = homed.fake.target = 4242
    homed.run(20.0)
    assert {s.raw for s in homed.samples} == {4242}
    assert len(homed.samples) > 200
    counters = homed.stage.counters
    assert counters["bad_checksum"] > 10 and counters["retries"] > 10


@pytest.mark.parametrize(
    ("earlier", "later", "replaces"),
    [
        (b"1 0 move abs 100", b"1 0 stop", True),
        (b"1 0 move abs 100", b"1 0 move abs 90", True),
        (b"1 0 move abs 100", b"1 0 get pos", False),
        (b"1 0 stop", b"1 0 stop", False),
        (b"1 0 get pos", b"1 0 move abs 90", False),
    ],
)
def test_in_a_served_log_a_halt_may_stand_for_a_motion_and_for_nothing_else(
    earlier: bytes, later: bytes, replaces: bool
) -> None:
    assert NumberedLines(b"\n").replaces(earlier, later) is replaces


@pytest.mark.parametrize(("steps", "alike"), [(0, True), (20, True), (-20, True), (21, False), (-21, False)])
def test_in_a_served_log_a_motion_is_alike_within_twenty_steps(steps: int, alike: bool) -> None:
    dialect = NumberedLines(b"\n")
    assert dialect.alike(b"1 0 move abs 1000", b"1 0 move abs %d" % (1000 + steps)) is alike
    assert not dialect.alike(b"1 0 move abs 1000", b"2 0 move abs 1000")
    assert dialect.alike(b"1 0 get pos", b"1 0 get pos") and not dialect.alike(b"1 0 get pos", b"1 0 stop")


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_in_a_served_log_an_answer_bears_the_number_of_the_request_that_asks_now(count: int) -> None:
    """And of several pieces comes what they make together, when the last one came."""
    whole = b"@01 0 07 OK IDLE WR 1000\r\n"
    cuts = [len(whole) * k // count for k in range(count + 1)] if count else []
    answers = tuple((0.1 * k, whole[a:b]) for k, (a, b) in enumerate(itertools.pairwise(cuts)))
    exchange = Exchange(Passed(0.0, True, b"/1 0 07 get pos\n"), b"1 0 get pos", answers)
    dialect = NumberedLines(b"\n")
    expected = ((0.1 * (count - 1), b"@01 0 42 OK IDLE WR 1000\r\n"),) if count else ()
    assert dialect.anew(exchange, b"/1 0 42 get pos\n") == expected
    assert dialect.anew(exchange, b"nonsense\n") == answers
