"""CiA 404: the documented frames, and the driver against a scripted node."""

from __future__ import annotations

import itertools
import math
import random
import struct
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.instruments.cia404 import codec as cia404
from drivers.instruments.cia404.codec import Decoder, Entry, Layout
from drivers.instruments.cia404.device import CiA404
from drivers.links.link import CanFrame, DeviceError, DeviceRefused, DeviceSilent
from drivers.roles import ForceSample, ForceSensor, SampleFlag


def frame(text: str) -> CanFrame:
    identifier, _, data = text.partition("#")
    return CanFrame(int(identifier, 16), bytes.fromhex(data))


# -- frames ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("built", "text"),
    [
        (cia404.nmt(5, "start"), "000# 01 05"),
        (cia404.nmt(5, "stop"), "000# 02 05"),
        (cia404.nmt(5, "pre-operational"), "000# 80 05"),
        (cia404.upload_request(5, 0x1000, 0), "605# 40 00 10 00 00 00 00 00"),
        (cia404.download_request(5, 0x1A00, 0, b"\x02"), "605# 2F 00 1A 00 02 00 00 00"),
        (cia404.download_request(5, 0x1800, 5, b"\x0a\x00"), "605# 2B 00 18 05 0A 00 00 00"),
        (cia404.download_request(5, 0x1800, 1, b"\x85\x01\0\0"), "605# 23 00 18 01 85 01 00 00"),
        (cia404.autozero_request(5, 1), "605# 22 25 61 01 7A 65 72 6F"),
    ],
)
def test_frames_sent(built: CanFrame, text: str) -> None:
    assert built == frame(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("585# 60 25 61 01 00 00 00 00", cia404.Downloaded(0x6125, 1)),
        ("585# 43 00 10 00 94 01 02 00", cia404.Uploaded(0x1000, 0, b"\x94\x01\x02\x00")),
        ("585# 4F 00 1A 00 02 00 00 00", cia404.Uploaded(0x1A00, 0, b"\x02")),
        ("585# 4B 00 18 05 0A 00 00 00", cia404.Uploaded(0x1800, 5, b"\x0a\x00")),
        ("585# 42 00 10 00 94 01 02 00", cia404.Uploaded(0x1000, 0, b"\x94\x01\x02\x00")),
        ("585# 80 25 61 01 00 00 04 05", cia404.Aborted(0x6125, 1, 0x05040000)),
        ("185# 00 00 80 3F 00", cia404.ProcessData(b"\x00\x00\x80\x3f\x00")),
        ("085# 30 81 11 00 00 00 00 00", cia404.Emergency(0x8130, 0x11)),
        ("705# 00", cia404.NodeState(0)),
        ("705# 05", cia404.NodeState(5)),
    ],
)
def test_frames_received(text: str, message: cia404.Message) -> None:
    assert Decoder(5).feed(frame(text)) == message


@pytest.mark.parametrize(
    ("text", "counter"),
    [
        ("586# 60 25 61 01 00 00 00 00", "foreign_frames"),
        ("285# 00", "foreign_frames"),
        ("585# 60 25 61 01", "bad_frames"),
        ("585# 41 08 10 00 10 00 00 00", "bad_frames"),  # a segmented transfer
        ("085# 30", "bad_frames"),
        ("705#", "bad_frames"),
    ],
)
def test_frames_that_make_no_sense_are_counted(text: str, counter: str) -> None:
    decoder = Decoder(5)
    assert decoder.feed(frame(text)) is None
    assert decoder.counters == {"foreign_frames": 0, "bad_frames": 0} | {counter: 1}


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_any_frame_is_a_message_or_counted(identifier: int, data: bytes) -> None:
    decoder = Decoder(5)
    message = decoder.feed(CanFrame(identifier, data))
    assert (message is None) == (sum(decoder.counters.values()) == 1)


def test_the_reason_of_an_abort() -> None:
    assert cia404.Aborted(0x6125, 1, 0x05040000).meaning == "time out (abort 05040000)"
    assert "reason unknown" in cia404.Aborted(0x6125, 1, 0x12345678).meaning


@pytest.mark.parametrize(
    ("entries", "data", "value", "status"),
    [
        ([(0x6130, 1, 32), (0x6150, 1, 8)], struct.pack("<fB", -1.5, 2), -1.5, 2),
        ([(0x6150, 1, 8), (0x6130, 1, 32)], struct.pack("<Bf", 4, 2.5), 2.5, 4),
        ([(0x6130, 2, 32), (0x6130, 1, 32)], struct.pack("<ff", 9.0, 2.5), 2.5, 0),
        ([(0x7130, 1, 16)], struct.pack("<h", -321), -321, 0),
        ([(0x8130, 1, 24), (0x6150, 1, 8)], b"\xff\xff\xff\x01", -1, 1),
        ([(0x9130, 1, 32)], struct.pack("<i", -70000), -70000, 0),
    ],
)
def test_what_a_pdo_carries(entries: list[tuple[int, int, int]], data: bytes, value: float, status: int) -> None:
    layout = Layout([Entry(*e) for e in entries], 1)
    assert layout.usable
    assert layout.length == len(data)
    assert layout.take(data) == (value, status)


def test_a_pdo_without_the_channel_is_of_no_use() -> None:
    assert not Layout([], 1).usable
    assert not Layout([Entry(0x6130, 2, 32)], 1).usable
    assert not Layout([Entry(0x6130, 1, 16)], 1).usable


@pytest.mark.parametrize(
    ("code", "unit"),
    [
        (0x0021_0000, ("N", 1.0)),
        (0x0321_0000, ("N", 1000.0)),
        (0xFD21_0000, ("N", pytest.approx(1e-3))),
        (0xFD26_2600, ("mV/V", 1.0)),
        (0x0026_2600, ("mV/V", 1000.0)),
        (0x0022_0000, None),  # pascal
        (0x0000_0000, None),
        (0x8021_0000, None),  # no such prefix
    ],
)
def test_units(code: int, unit: tuple[str, float] | None) -> None:
    assert cia404.unit_of(code) == unit


# -- a scripted node ---------------------------------------------------------------------------------------------------


class Node:
    """The least CiA 404 node that can be talked to: an object dictionary and a timer."""

    name = "node"

    def __init__(self, node: int = 5) -> None:
        self.node = node
        self.sent: list[CanFrame] = []
        self.inbox: list[CanFrame] = []
        self.now = 0.0
        self.running = False
        self.started = 0.0
        self.k = 0
        self.value: Callable[[int], float] = lambda k: 1e-3 * k
        self.status = 0
        self.silent = False
        self.read_only: set[int] = set()
        self.zeroable = True
        self.closed = 0
        self.objects: dict[tuple[int, int], bytes] = {
            (0x1000, 0): struct.pack("<I", 0x00020194),
            (0x1018, 1): struct.pack("<I", 0x15F),
            (0x1018, 2): struct.pack("<I", 0x2A),
            (0x1018, 3): struct.pack("<I", 0x0001_0004),
            (0x1018, 4): struct.pack("<I", 700123),
            (0x1800, 1): struct.pack("<I", 0x180 + node),
            (0x1800, 2): b"\xff",
            (0x1800, 5): struct.pack("<H", 100),
            (0x1A00, 0): b"\x00",
            (0x1A00, 1): bytes(4),
            (0x1A00, 2): bytes(4),
            (0x6131, 1): struct.pack("<I", 0x0021_0000),
            (0x6132, 1): b"\x03",
        }

    @property
    def period(self) -> float:
        return float(struct.unpack("<H", self.objects[0x1800, 5])[0]) / 1000

    def advance(self, now: float) -> None:
        self.now = now
        while self.running and self.started + (self.k + 1) * self.period <= now:
            self.k += 1
            self.inbox += self.pdo(self.k)

    def pdo(self, k: int) -> list[CanFrame]:
        data = b""
        for sub in range(1, 1 + self.objects[0x1A00, 0][0]):
            entry = Entry.unpack(*struct.unpack("<I", self.objects[0x1A00, sub]))
            if entry.index == 0x6130:
                data += struct.pack("<f", self.value(k))
            elif entry.index == 0x7130:
                data += struct.pack("<h", round(self.value(k) * 1000))
            else:
                data += bytes((self.status,))
        return [CanFrame(0x180 + self.node, data)]

    def read(self) -> list[CanFrame]:
        frames, self.inbox = self.inbox, []
        return frames

    def close(self) -> None:
        self.closed += 1

    def write(self, f: CanFrame, *, urgent: bool = False) -> None:
        self.sent.append(f)
        if self.silent:
            return
        if f.id == 0:
            self.running = f.data == bytes((1, self.node))
            self.started, self.k = self.now, 0
            return
        assert f.id == 0x600 + self.node
        assert len(f.data) == 8
        command, index, sub = struct.unpack("<BHB", f.data[:4])
        if command == 0x40:
            if (value := self.objects.get((index, sub))) is None:
                self.abort(index, sub, 0x06020000)
            else:
                head = 0x43 | (4 - len(value)) << 2
                self.inbox.append(CanFrame(0x580 + self.node, struct.pack("<BHB4s", head, index, sub, value)))
            return
        if index == 0x6125:
            if self.zeroable:
                self.inbox.append(CanFrame(0x580 + self.node, struct.pack("<BHB4x", 0x60, index, sub)))
            else:
                self.abort(index, sub, 0x05040000)
        elif index in self.read_only:
            self.abort(index, sub, 0x06010002)
        else:
            self.objects[index, sub] = f.data[4 : 8 - (command >> 2 & 3)]
            self.inbox.append(CanFrame(0x580 + self.node, struct.pack("<BHB4x", 0x60, index, sub)))

    def abort(self, index: int, sub: int, code: int) -> None:
        self.inbox.append(CanFrame(0x580 + self.node, struct.pack("<BHBI", 0x80, index, sub, code)))

    def map(self, *entries: Entry) -> None:
        self.objects[0x1A00, 0] = bytes((len(entries),))
        for sub, entry in enumerate(entries, 1):
            self.objects[0x1A00, sub] = entry.pack()


class Rig:
    def __init__(self, wire: Node | None = None, **options: object) -> None:
        self.node = wire or Node()
        self.force = CiA404("force", self.node, node=5, **options)  # type: ignore[arg-type]
        self.now = 0.0
        self.samples: list[ForceSample] = []

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end:
            self.now = min(end, max(self.now + 1e-4, self.force.next_poll))
            self.node.advance(self.now)
            self.samples += self.force.poll(self.now)

    def until_ready(self) -> Rig:
        while not self.force.ready:
            self.run(0.001)
            assert self.now < 5
        self.node.sent.clear()
        return self


def test_it_is_a_force_sensor() -> None:
    sensor: ForceSensor = CiA404("force", Node())
    assert sensor.rate == 100.0
    assert sensor.reading_unit == "N"


def test_set_up_on_the_wire() -> None:
    rig = Rig()
    rig.run(0.3)
    assert rig.force.ready
    assert rig.node.sent == [
        frame(text)
        for text in (
            "000# 80 05",
            "605# 40 00 10 00 00 00 00 00",
            "605# 40 18 10 01 00 00 00 00",
            "605# 40 18 10 02 00 00 00 00",
            "605# 40 18 10 03 00 00 00 00",
            "605# 40 18 10 04 00 00 00 00",
            "605# 40 00 1A 00 00 00 00 00",
            "605# 23 00 18 01 85 01 00 80",
            "605# 2F 00 1A 00 00 00 00 00",
            "605# 23 00 1A 01 20 01 30 61",
            "605# 23 00 1A 02 08 01 50 61",
            "605# 2F 00 1A 00 02 00 00 00",
            "605# 40 31 61 01 00 00 00 00",
            "605# 2F 00 18 02 FE 00 00 00",
            "605# 2B 00 18 05 0A 00 00 00",
            "605# 23 00 18 01 85 01 00 00",
            "605# 40 00 18 05 00 00 00 00",
            "000# 01 05",
        )
    ]
    assert rig.force.identity.serial == "700123"
    assert rig.force.identity.firmware == "1.4"
    assert rig.force.identity.model == "CiA 404 vendor 15F product 2A"
    assert rig.force.settings == {
        "tpdo1": "6130h set",
        "unit_code": "00210000",
        "reading_unit": "N",
        "event_timer_ms": "10",
    }


def test_samples_with_times_from_the_event_timer() -> None:
    rig = Rig().until_ready()
    start = rig.node.started
    rig.run(5.0)
    assert len(rig.samples) == pytest.approx(500, abs=2)
    for k, sample in enumerate(rig.samples, 1):
        assert sample.reading == pytest.approx(1e-3 * k)
        assert sample.flags == SampleFlag(0)
        assert -1e-4 < sample.t - (start + k * 0.01) < 0.01
    assert all(b.t > a.t for a, b in itertools.pairwise(rig.samples))


def test_lost_frames_are_noticed_by_rate() -> None:
    rig = Rig().until_ready()
    plain = rig.node.pdo
    rig.node.pdo = lambda k: [] if 200 <= k < 205 else plain(k)  # type: ignore[method-assign]
    rig.run(4.0)
    assert rig.force.counters["lost_samples"] == 5


def test_process_data_of_another_length_are_counted_and_never_a_value() -> None:
    rig = Rig().until_ready()
    rig.run(0.105)
    assert len(rig.samples) == 10 and rig.force.counters["ignored_frames"] == 0
    for data in (b"", bytes(4), bytes(6)):
        rig.node.inbox.append(CanFrame(0x185, data))
    rig.run(0.1)
    assert rig.force.counters["ignored_frames"] == 3 and len(rig.samples) == 20


@pytest.mark.parametrize(
    ("status", "flags"),
    [
        (1, SampleFlag.NO_VALUE),
        (2, SampleFlag.OVER_RANGE),
        (4, SampleFlag.UNDER_RANGE),
        (3, SampleFlag.NO_VALUE | SampleFlag.OVER_RANGE),
    ],
)
def test_status_as_flags(status: int, flags: SampleFlag) -> None:
    rig = Rig().until_ready()
    rig.node.status = status
    rig.run(0.2)
    assert rig.samples[-1].flags == flags
    assert math.isnan(rig.samples[-1].reading) == bool(status & 1)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 3.0, -3.0, 1e30])
def test_a_value_that_cannot_be_is_counted_and_shows_as_no_value(value: float) -> None:
    rig = Rig(limit_N=2.5).until_ready()
    rig.node.value = lambda k: value if k == 20 else 2.375
    rig.run(0.5)
    assert rig.force.counters["bad_values"] == 1
    assert {s.reading for s in rig.samples if not s.flags} == {2.375}
    (flagged,) = [s for s in rig.samples if s.flags]
    assert flagged.flags == SampleFlag.NO_VALUE and math.isnan(flagged.reading)
    assert rig.force.counters["lost_samples"] == 0


def test_a_bridge_signal_has_a_limit_of_its_own() -> None:
    node = Node()
    node.objects[0x6131, 1] = struct.pack("<I", 0x0026_2600)
    node.value = lambda k: 0.2 if k == 20 else 2**-9  # V/V
    rig = Rig(node, limit_N=1e-3).until_ready()
    rig.run(0.5)
    assert rig.force.counters["bad_values"] == 1
    assert {s.reading for s in rig.samples if not s.flags} == {1e3 * 2**-9}


def test_an_emergency_marks_the_samples_until_it_is_over() -> None:
    rig = Rig().until_ready()
    rig.node.inbox.append(frame("085# 30 81 11 00 00 00 00 00"))
    rig.run(0.1)
    assert rig.samples[-1].flags == SampleFlag.SENSOR_ERROR
    assert rig.force.settings["last_emergency"] == "8130"
    rig.node.inbox.append(frame("085# 00 00 00 00 00 00 00 00"))
    rig.run(0.1)
    assert rig.samples[-1].flags == SampleFlag(0)
    assert rig.force.counters["emergencies"] == 1


def test_a_restart_is_an_error_at_once() -> None:
    rig = Rig().until_ready()
    rig.run(0.1)
    rig.node.inbox.append(frame("705# 00"))
    with pytest.raises(DeviceRefused, match="restarted by itself"):
        rig.run(0.1)
    assert not rig.force.ready


def test_silence_is_an_error() -> None:
    rig = Rig().until_ready()
    rig.run(0.3)
    rig.node.running = False
    with pytest.raises(DeviceSilent, match="no valid value"):
        rig.run(1.0)


def test_tare() -> None:
    rig = Rig().until_ready()
    rig.force.set_zero()
    assert rig.force.busy
    rig.run(0.05)
    assert rig.node.sent == [frame("605# 22 25 61 01 7A 65 72 6F")]
    assert not rig.force.busy
    rig.node.zeroable = False
    rig.force.set_zero()
    with pytest.raises(DeviceRefused, match=r"tare refused: time out \(abort 05040000\)"):
        rig.run(0.05)


def test_a_mapping_that_carries_the_value_is_kept() -> None:
    node = Node()
    node.map(Entry(0x6150, 1, 8), Entry(0x6130, 1, 32))
    node.value = lambda k: 2.5
    rig = Rig(node)
    rig.run(0.5)
    assert rig.force.settings["tpdo1"] == "6130h as found"
    assert rig.samples[-1].reading == 2.5


def test_an_integer_mapping_that_cannot_be_changed_is_used_with_its_decimals() -> None:
    node = Node()
    node.map(Entry(0x7130, 1, 16), Entry(0x6150, 1, 8))
    node.read_only = {0x1A00}
    node.value = lambda k: -0.25
    rig = Rig(node)
    rig.run(0.5)
    assert rig.force.settings["tpdo1"] == "7130h as found"
    assert rig.samples[-1].reading == pytest.approx(-0.25)


@pytest.mark.parametrize(
    ("options", "unit_code", "reading", "unit"),
    [
        ({}, 0x0321_0000, 2000.0, "N"),
        ({}, 0xFD26_2600, 2.0, "mV/V"),
        ({"unit": "N", "factor": 9.80665e-3}, 0x0000_0000, 2 * 9.80665e-3, "N"),
    ],
)
def test_the_unit_of_the_device(options: dict[str, object], unit_code: int, reading: float, unit: str) -> None:
    node = Node()
    node.objects[0x6131, 1] = struct.pack("<I", unit_code)
    node.value = lambda k: 2.0
    rig = Rig(node, **options)
    rig.run(0.5)
    assert rig.force.reading_unit == unit
    assert rig.samples[-1].reading == pytest.approx(reading)


def refusal(change: Callable[[Node], object]) -> str:
    node = Node()
    change(node)
    with pytest.raises(DeviceRefused) as caught:
        Rig(node).run(1.0)
    return str(caught.value)


def test_what_set_up_refuses() -> None:
    assert "no CiA 404 device (profile 401)" in refusal(lambda n: n.objects.update({(0x1000, 0): b"\x91\x01\0\0"}))
    assert "neither newtons nor mV/V (code 00220000)" in refusal(
        lambda n: n.objects.update({(0x6131, 1): struct.pack("<I", 0x220000)})
    )
    assert "TPDO1 cannot be made to carry" in refusal(lambda n: n.read_only.add(0x1A00))
    assert "read-only object" in refusal(lambda n: n.read_only.add(0x1800))


@pytest.mark.parametrize(
    "options", [{"node": 0}, {"channel": 0}, {"rate_Hz": math.nan}, {"rate_Hz": 2000.0}, {"rate_Hz": 70.0}]
)
def test_what_construction_refuses(options: dict[str, object]) -> None:
    with pytest.raises(DeviceRefused):
        CiA404("force", Node(), **options)  # type: ignore[arg-type]


def test_a_silent_node() -> None:
    node = Node()
    node.silent = True
    with pytest.raises(DeviceSilent, match=r"no answer to 'object 1000h:0'.*node 5"):
        Rig(node).run(2.0)


def survive(count: int, seed: int) -> None:
    """Damaged, lost, repeated and foreign frames: the error family or the right value, every frame accounted for."""
    rng = random.Random(seed)
    done = samples = 0
    accounts = ("round_trips", "foreign_frames", "bad_frames", "ignored_frames", "unexpected_answers", "emergencies")
    while done < count:
        node = Node()
        node.value = lambda k: 1.25
        rig = Rig(node, timeout_s=0.02)
        plain = node.read
        delivered = uncounted = 0

        def read() -> list[CanFrame]:
            nonlocal done, delivered, uncounted
            out: list[CanFrame] = []
            for f in plain():  # noqa: B023
                kind = rng.random()
                done += kind < 0.3
                if kind < 0.05:
                    continue
                if kind < 0.1:
                    out.append(CanFrame(f.id, f.data[: rng.randrange(len(f.data))]))
                elif kind < 0.15:
                    out.append(CanFrame(rng.choice([0x80, 0x581, 0x186, 0x705, rng.randrange(0x200, 0x800)]), f.data))
                elif kind < 0.2 and f.id == 0x585:
                    data = bytearray(f.data)
                    data[rng.randrange(4)] ^= 1 << rng.randrange(8)
                    out.append(CanFrame(f.id, bytes(data)))
                elif kind < 0.3:
                    # A second node that used our PDO's identifier could not be told from ours.
                    foreign = rng.choice([0x184, 0x186, rng.randrange(0x200, 0x800)])
                    out += [f, CanFrame(foreign, rng.randbytes(rng.randrange(9)))]
                    for _ in range(rng.randrange(40)):  # a storm
                        done += 1
                        out.append(CanFrame(rng.randrange(0x200, 0x580), rng.randbytes(rng.randrange(9))))
                else:
                    out.append(f)
            delivered += len(out)
            # A heartbeat and the end of an emergency are messages that nobody needs to count.
            uncounted += sum(f.id == 0x705 and len(f.data) == 1 for f in out)
            uncounted += sum(f.id == 0x85 and len(f.data) == 8 and f.data[:2] == b"\0\0" for f in out)
            return out

        node.read = read  # type: ignore[method-assign]
        for _ in range(300):
            try:
                rig.run(0.005)
            except DeviceError:
                continue
        assert all(s.reading == 1.25 or math.isnan(s.reading) for s in rig.samples)
        # A damaged answer is given to nobody, and counted: each frame is a sample, an asked-for answer, or a count.
        counted = sum(rig.force.counters[key] for key in accounts) + len(rig.force._inbox)
        assert 0 <= delivered - uncounted - counted - len(rig.samples) < 50  # samples whose time is not settled yet
        samples += len(rig.samples)
    assert samples > count / 300


def test_faults_on_the_bus_never_become_values() -> None:
    survive(10_000, seed=1)


MANY = [
    pytest.param(100_000, marks=pytest.mark.slow),
    pytest.param(1_000_000, marks=[pytest.mark.long, pytest.mark.timeout(900)]),
]


@pytest.mark.parametrize("count", MANY)
def test_very_many_faults_on_the_bus_never_become_values(count: int) -> None:
    survive(count, seed=2)
