"""iseg EDCP: the documented frames, and the driver against a scripted module."""

from __future__ import annotations

import contextlib
import random
import struct
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.instruments.iseg_edcp import codec as edcp
from drivers.instruments.iseg_edcp.codec import ChannelEvents, ChannelStatus, ModuleStatus
from drivers.instruments.iseg_edcp.device import IsegEDCP
from drivers.links.link import CanFrame, DeviceError, DeviceRefused, DeviceSilent
from drivers.roles import HVFlag, HVSample, HVSupply

GOOD = int(
    ModuleStatus.TEMPERATURE_GOOD
    | ModuleStatus.SUPPLY_GOOD
    | ModuleStatus.MODULE_GOOD
    | ModuleStatus.SAFETY_LOOP_GOOD
    | ModuleStatus.NO_RAMP
    | ModuleStatus.NO_SUM_ERROR
)


def frame(text: str) -> CanFrame:
    identifier, _, data = text.partition("#")
    return CanFrame(int(identifier, 16), bytes.fromhex(data))


# -- frames ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("built", "text"),
    [
        (edcp.log_on(0), "200# D8 01"),
        (edcp.log_off(0), "200# D8 00"),
        (edcp.read_request(0, edcp.CHANNEL_COUNT), "201# 12 08"),
        (edcp.read_request(0, edcp.NOMINAL_VOLTAGE, 0), "201# 41 06 00"),
        (edcp.write(0, edcp.SET_VOLTAGE, 1500.0, 0), "200# 41 00 00 44 BB 80 00"),
        (edcp.read_request(0, edcp.SET_VOLTAGE, 0), "201# 41 00 00"),
        (edcp.write(0, edcp.CHANNEL_CONTROL, int(edcp.ChannelControl.ON), 0), "200# 40 01 00 00 08"),
        (edcp.write(0, edcp.CHANNEL_CONTROL, 0, 0), "200# 40 01 00 00 00"),
        (edcp.write(0, edcp.CHANNEL_CONTROL, int(edcp.ChannelControl.EMERGENCY_OFF), 0), "200# 40 01 00 00 20"),
        (edcp.write(0, edcp.MODULE_RAMP, 10.0), "200# 11 00 41 20 00 00"),
        (edcp.write(0, edcp.MODULE_EVENTS, 0x0400), "200# 10 02 04 00"),
        (edcp.read_request(63, edcp.MODULE_STATUS), "3F9# 10 00"),
        (edcp.read_many(0, edcp.CHANNEL_STATUS, range(3)), "201# 60 00 00 07 00"),
        (edcp.read_many(0, edcp.MEASURED_VOLTAGE, [0, 8]), "201# 61 02 01 01 00"),
        (edcp.EMERGENCY_OFF_ALL, "004# E8 00 60 01 00 20"),
    ],
)
def test_frames_sent(built: CanFrame, text: str) -> None:
    assert built == frame(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("200# 12 08 01", edcp.Data(edcp.CHANNEL_COUNT, None, 1)),
        ("200# 41 06 00 45 BB 80 00", edcp.Data(edcp.NOMINAL_VOLTAGE, 0, 6000.0)),
        ("200# 41 00 00 44 BB 80 00", edcp.Data(edcp.SET_VOLTAGE, 0, 1500.0)),
        ("200# 12 03 45 31 36 44", edcp.Data(edcp.FIRMWARE_NAME, None, b"E16D")),
        ("200# 40 00 02 00 88", edcp.Data(edcp.CHANNEL_STATUS, 2, 0x88)),
        ("201# D8 76 05", edcp.LogOn(0x76, 5)),
    ],
)
def test_frames_received(text: str, message: edcp.Message) -> None:
    assert edcp.Decoder(0).feed(frame(text)) == message


@pytest.mark.parametrize(
    ("text", "counter"),
    [
        ("208# 12 08 01", "foreign_frames"),
        ("181# 00", "foreign_frames"),
        ("201# 41 06 00", "foreign_requests"),
        ("200# 41 06 00 45 BB 80", "bad_frames"),
        ("200# 41 06 00 45 BB 80 00 00", "bad_frames"),
        ("200# 7F 7F 00", "bad_frames"),
        ("200#", "bad_frames"),
        ("200# D8 01", "bad_frames"),
    ],
)
def test_frames_that_make_no_sense_are_counted(text: str, counter: str) -> None:
    decoder = edcp.Decoder(0)
    assert decoder.feed(frame(text)) is None
    assert decoder.counters == {"foreign_frames": 0, "foreign_requests": 0, "bad_frames": 0} | {counter: 1}


def test_a_channel_item_needs_a_channel_and_a_module_item_has_none() -> None:
    with pytest.raises(ValueError, match="needs a channel"):
        edcp.read_request(0, edcp.SET_VOLTAGE)
    with pytest.raises(ValueError, match="has no channel"):
        edcp.read_request(0, edcp.SERIAL_NUMBER, 0)
    with pytest.raises(ValueError, match="belongs to the module"):
        edcp.read_many(0, edcp.SERIAL_NUMBER, [0])


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_any_frame_is_a_message_or_counted(identifier: int, data: bytes) -> None:
    decoder = edcp.Decoder(5)
    message = decoder.feed(CanFrame(identifier, data))
    assert (message is None) == (sum(decoder.counters.values()) == 1)


@pytest.mark.parametrize(
    ("status", "events", "module", "flags"),
    [
        (0, 0, GOOD, HVFlag(0)),
        (ChannelStatus.ON | ChannelStatus.RAMPING, 0, GOOD, HVFlag.ON | HVFlag.RAMPING),
        (ChannelStatus.ON | ChannelStatus.CONSTANT_CURRENT, 0, GOOD, HVFlag.ON | HVFlag.CURRENT_LIMIT),
        (0, ChannelEvents.TRIP, GOOD, HVFlag.TRIPPED),
        (0, ChannelEvents.EMERGENCY_OFF, GOOD, HVFlag.EMERGENCY_OFF),
        (ChannelStatus.EXTERNAL_INHIBIT, 0, GOOD, HVFlag.INHIBITED),
        (ChannelStatus.VOLTAGE_BOUNDS, 0, GOOD, HVFlag.VOLTAGE_LIMIT),
        (ChannelStatus.ARC, 0, GOOD, HVFlag.ARC),
        (0, 0, GOOD & ~ModuleStatus.SAFETY_LOOP_GOOD, HVFlag.INTERLOCK_OPEN),
        (0, 0, GOOD & ~ModuleStatus.TEMPERATURE_GOOD, HVFlag.FAULT),
        (0, ChannelEvents.END_OF_RAMP | ChannelEvents.ON_TO_OFF, GOOD, HVFlag(0)),
    ],
)
def test_status_bits_as_flags(status: int, events: int, module: int, flags: HVFlag) -> None:
    assert edcp.hv_flags(ChannelStatus(status), ChannelEvents(events), ModuleStatus(module)) == flags


# -- a scripted module -------------------------------------------------------------------------------------------------


class Module:
    """The least module that can be talked to: a table of values. Faults are lists of things to do wrong."""

    name = "module"

    def __init__(self, module: int = 0, channels: int = 1) -> None:
        self.base = 0x200 | module << 3
        self.sent: list[CanFrame] = []
        self.inbox: list[CanFrame] = []
        self.closed = 0
        self.silent = False
        self.lose_writes = 0
        self.lose_answers = 0
        self.corrupt: Callable[[CanFrame], CanFrame | None] = lambda f: f
        self.values: dict[bytes, bytes] = {
            b"\x10\x00": struct.pack(">H", GOOD),
            b"\x10\x01": b"\0\0",
            b"\x10\x02": b"\0\0",
            b"\x11\x00": struct.pack(">f", 5.0),
            b"\x12\x00": struct.pack(">I", 484216),
            b"\x12\x01": bytes((0, 4, 2, 1)),
            b"\x12\x03": b"E16D",
            b"\x12\x08": bytes((channels,)),
        }
        for c in range(channels):
            ch = bytes((c,))
            self.values |= {
                b"\x40\x00" + ch: b"\0\0",
                b"\x40\x01" + ch: b"\0\0",
                b"\x40\x02" + ch: b"\0\0",
                b"\x40\x05" + ch: b"\0\0",
                b"\x40\x06" + ch: b"\0",
                b"\x41\x00" + ch: struct.pack(">f", 0.0),
                b"\x41\x01" + ch: struct.pack(">f", 1e-3),
                b"\x41\x02" + ch: struct.pack(">f", 0.25),
                b"\x41\x03" + ch: struct.pack(">f", 2e-9),
                b"\x41\x04" + ch: struct.pack(">f", 0.0),
                b"\x41\x05" + ch: struct.pack(">f", 0.0),
                b"\x41\x06" + ch: struct.pack(">f", 6000.0),
                b"\x41\x07" + ch: struct.pack(">f", 1e-3),
            }

    def read(self) -> list[CanFrame]:
        frames, self.inbox = self.inbox, []
        return frames

    def close(self) -> None:
        self.closed += 1

    def set(self, item: edcp.Item, value: float | int, channel: int = 0) -> None:
        key = struct.pack(">H", item.code) + (bytes((channel,)) if item.per_channel else b"")
        self.values[key] = struct.pack(">" + item.format, value)

    def get(self, item: edcp.Item, channel: int = 0) -> float:
        key = struct.pack(">H", item.code) + (bytes((channel,)) if item.per_channel else b"")
        value = struct.unpack(">" + item.format, self.values[key])[0]
        assert isinstance(value, float | int)
        return value

    def write(self, f: CanFrame, *, urgent: bool = False) -> None:
        self.sent.append(f)
        if self.silent:
            return
        if f.id == self.base:
            self.written(f.data)
        elif f.data[0] in (0x60, 0x61):
            mask = int.from_bytes(f.data[2:4], "big")
            for c in range(16):
                if mask >> c & 1:
                    self.answer(bytes((f.data[0] - 0x20, f.data[1], c)))
        else:
            self.answer(f.data)

    def answer(self, key: bytes) -> None:
        if key not in self.values:
            return
        if self.lose_answers:
            self.lose_answers -= 1
            return
        reply = self.corrupt(CanFrame(self.base, key + self.values[key]))
        if reply is not None:
            self.inbox.append(reply)

    def written(self, data: bytes) -> None:
        if data[0] == 0xD8:
            return
        if self.lose_writes:
            self.lose_writes -= 1
            return
        key = data[:3] if data[0] in (0x40, 0x41) else data[:2]
        value = data[len(key) :]
        if key[:2] in (b"\x10\x02", b"\x40\x02"):  # write 1 to clear
            old = int.from_bytes(self.values[key], "big")
            value = (old & ~int.from_bytes(value, "big")).to_bytes(2, "big")
        self.values[key] = value
        if key[:2] == b"\x40\x01":
            self.control(key[2], int.from_bytes(value, "big"))

    def control(self, channel: int, bits: int) -> None:
        status = 0
        if bits & 0x20:
            status = int(ChannelStatus.EMERGENCY_OFF)
            self.set(edcp.CHANNEL_EVENTS, int(self.get(edcp.CHANNEL_EVENTS, channel)) | 0x20, channel)
        elif bits & 0x08 and not int(self.get(edcp.CHANNEL_EVENTS, channel)) & int(edcp.BLOCKING):
            status = int(ChannelStatus.ON)
        self.set(edcp.CHANNEL_STATUS, status, channel)


class Rig:
    """Driver and module, polled every millisecond of made-up time."""

    def __init__(self, wire: Module | None = None, **options: float) -> None:
        self.module = wire or Module()
        self.hv = IsegEDCP("hv", self.module, **options)  # type: ignore[arg-type]
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
        self.module.sent.clear()
        return self

    def settle(self) -> None:
        """Run until all commands are done."""
        for _ in range(5000):
            if not self.hv.busy:
                return
            self.run(0.001)
        raise AssertionError("still busy")

    @property
    def writes(self) -> list[CanFrame]:
        return [f for f in self.module.sent if f.id & 1 == 0]


def test_it_is_an_hv_supply() -> None:
    supply: HVSupply = IsegEDCP("hv", Module())
    assert not supply.ready


def test_set_up_registers_and_reads_and_writes_nothing_else() -> None:
    rig = Rig(Module(module=3), module=3)
    rig.run(0.5)
    assert rig.hv.ready
    assert rig.hv.nominal == (6000.0, pytest.approx(1e-3))
    assert rig.hv.identity.serial == "484216"
    assert rig.hv.identity.firmware == "0.4.2.1"
    assert rig.hv.identity.model == "iseg E16D"
    assert rig.hv.settings["ramp_V_per_s"] == "300"
    assert rig.hv.settings["channel_at_setup"] == "off"
    assert rig.writes == [edcp.log_on(3)]
    assert not rig.hv.busy


def test_a_channel_found_on_is_reported_and_left_alone() -> None:
    rig = Rig()
    rig.module.set(edcp.CHANNEL_STATUS, int(ChannelStatus.ON))
    rig.module.set(edcp.MEASURED_VOLTAGE, 1200.0)
    rig.module.set(edcp.SET_VOLTAGE, 1200.0)
    rig.run(0.5)
    assert rig.writes == [edcp.log_on(0)]
    assert rig.hv.settings["channel_at_setup"] == "on"
    sample = rig.samples[-1]
    assert (sample.voltage, sample.setpoint, sample.flags) == (1200.0, 1200.0, HVFlag.ON)


def test_samples_come_at_the_poll_rate_and_keep_the_registration() -> None:
    rig = Rig(poll_rate_Hz=20.0).until_ready()
    start = rig.now
    rig.run(2.0)
    assert len(rig.samples) == pytest.approx(40, abs=1)
    assert all(b.t - a.t == pytest.approx(0.05, abs=5e-3) for a, b in zip(rig.samples, rig.samples[1:], strict=False))
    assert rig.samples[0].t > start
    assert rig.samples[0].current == pytest.approx(2e-9)
    assert rig.writes == []


def test_set_voltage_on_the_wire() -> None:
    rig = Rig(poll_rate_Hz=0.1).until_ready()
    rig.run(0.05)  # the first cycle
    rig.module.sent.clear()
    rig.hv.set_voltage(1500.0)
    assert rig.hv.busy
    assert rig.hv.next_poll <= rig.now
    rig.settle()
    assert rig.module.sent == [frame("200# 41 00 00 44 BB 80 00"), frame("201# 41 00 00")]


@pytest.mark.parametrize("volts", [-1.0, 6000.1, float("nan"), float("inf")])
def test_a_set_point_outside_the_range_is_refused_before_it_is_sent(volts: float) -> None:
    rig = Rig().until_ready()
    with pytest.raises(DeviceRefused, match="Allowed: 0 to 6000 V"):
        rig.hv.set_voltage(volts)
    rig.run(0.2)
    assert rig.writes == []


def test_ramp_is_converted_and_its_limits_are_stated() -> None:
    rig = Rig().until_ready()
    rig.hv.set_ramp(600.0)
    rig.settle()
    assert rig.writes == [frame("200# 11 00 41 20 00 00")]
    assert rig.hv.settings["ramp_percent_per_s"] == "10"
    for bad in (0.0, -5.0, 1201.0, float("nan")):
        with pytest.raises(DeviceRefused, match="at most 20 %/s: 1200 V/s"):
            rig.hv.set_ramp(bad)


def test_current_limit() -> None:
    rig = Rig().until_ready()
    rig.hv.set_current_limit(2e-5)
    rig.settle()
    assert rig.module.get(edcp.SET_CURRENT) == pytest.approx(2e-5)
    for bad in (0.0, 2e-3, float("nan")):
        with pytest.raises(DeviceRefused, match=r"at most 0\.001 A"):
            rig.hv.set_current_limit(bad)


@pytest.mark.parametrize("command", ["set_voltage", "set_ramp", "set_current_limit"])
def test_commands_before_set_up_are_refused(command: str) -> None:
    rig = Rig()
    with pytest.raises(DeviceRefused, match="before the set-up"):
        getattr(rig.hv, command)(1.0)


def test_switch_on_and_off_on_the_wire() -> None:
    rig = Rig().until_ready()
    rig.hv.switch_on()
    rig.settle()
    rig.run(0.3)
    assert rig.samples[-1].flags == HVFlag.ON
    rig.hv.switch_off()
    rig.settle()
    rig.run(0.3)
    assert rig.samples[-1].flags == HVFlag(0)
    assert rig.writes == [frame("200# 40 01 00 00 08"), frame("200# 40 01 00 00 00")]


def test_a_lost_write_is_noticed_and_repeated() -> None:
    rig = Rig().until_ready()
    rig.module.lose_writes = 2
    rig.hv.set_voltage(1000.0)
    rig.settle()
    assert rig.module.get(edcp.SET_VOLTAGE) == 1000.0
    assert rig.hv.counters["writes_repeated"] == 2


def test_a_set_point_that_does_not_come_back_is_refused_and_takes_what_is_queued_with_it() -> None:
    rig = Rig().until_ready()
    rig.module.lose_writes = 99
    rig.hv.set_voltage(1000.0)
    rig.hv.switch_on()
    with pytest.raises(DeviceRefused, match=r"reads back as 0.0 after 1000.0 was written"):
        rig.settle()
    assert not rig.hv.busy
    rig.module.lose_writes = 0
    rig.run(0.5)
    assert frame("200# 40 01 00 00 08") not in rig.writes


def test_switching_on_is_not_repeated_when_the_channel_trips_at_once() -> None:
    rig = Rig().until_ready()
    plain = rig.module.control

    def trips(channel: int, bits: int) -> None:
        plain(channel, bits)
        if bits & 8:
            rig.module.set(edcp.CHANNEL_STATUS, int(ChannelStatus.TRIP))
            rig.module.set(edcp.CHANNEL_EVENTS, int(ChannelEvents.TRIP))
            rig.module.set(edcp.CHANNEL_CONTROL, 0)

    rig.module.control = trips  # type: ignore[method-assign]
    rig.hv.switch_on()
    with pytest.raises(DeviceRefused, match=r"did not switch on.*TRIP"):
        rig.settle()
    assert rig.writes == [frame("200# 40 01 00 00 08")]


def test_switching_on_is_sent_once_even_if_its_answer_is_lost() -> None:
    rig = Rig().until_ready()
    rig.hv.switch_on()
    plain = rig.module.written

    def lossy(data: bytes) -> None:
        plain(data)
        rig.module.lose_answers = 1

    rig.module.written = lossy  # type: ignore[method-assign]
    rig.settle()
    assert rig.writes == [frame("200# 40 01 00 00 08")]
    assert rig.hv.counters["retries"] == 1


def test_latched_events_keep_it_off_until_cleared() -> None:
    rig = Rig().until_ready()
    rig.module.set(edcp.CHANNEL_EVENTS, int(ChannelEvents.TRIP | ChannelEvents.END_OF_RAMP))
    rig.run(0.3)
    assert rig.samples[-1].flags == HVFlag.TRIPPED
    rig.hv.switch_on()
    with pytest.raises(DeviceRefused, match="while TRIP is latched"):
        rig.settle()
    assert rig.writes == []
    rig.hv.clear()
    rig.settle()
    assert frame("200# 40 02 00 20 10") in rig.writes  # ones are written to what had latched
    rig.hv.switch_on()
    rig.settle()
    rig.run(0.2)
    assert rig.samples[-1].flags == HVFlag.ON


def test_clear_says_when_the_cause_persists() -> None:
    rig = Rig().until_ready()
    plain = rig.module.written

    def inhibited(data: bytes) -> None:
        plain(data)
        rig.module.set(edcp.CHANNEL_EVENTS, int(ChannelEvents.EXTERNAL_INHIBIT))

    rig.module.written = inhibited  # type: ignore[method-assign]
    rig.hv.clear()
    with pytest.raises(DeviceRefused, match="EXTERNAL_INHIBIT comes back"):
        rig.settle()


def test_emergency_off_overtakes_everything() -> None:
    rig = Rig().until_ready()
    rig.hv.switch_on()
    rig.settle()
    rig.module.sent.clear()
    rig.hv.set_voltage(3000.0)
    rig.run(0.002)  # the write is under way
    rig.hv.set_ramp(100.0)
    rig.hv.emergency_off()
    before = len(rig.module.sent)
    rig.run(0.002)
    assert rig.module.sent[before] == frame("200# 40 01 00 00 20")
    rig.settle()
    rig.run(0.3)
    assert rig.samples[-1].flags == HVFlag.EMERGENCY_OFF
    assert frame("200# 11 00 3F D5 55 55") not in rig.module.sent


def test_emergency_off_is_sent_to_a_module_that_never_answers() -> None:
    rig = Rig()
    rig.module.silent = True
    rig.run(0.1)
    rig.hv.emergency_off()
    rig.run(0.002)
    assert rig.module.sent[-2:] == [frame("200# 40 01 00 00 20"), frame("201# 40 01 00")]
    rig.run(0.1)
    assert 8 <= rig.writes.count(frame("200# 40 01 00 00 20")) <= 12  # every 10 ms
    with pytest.raises(DeviceSilent, match="EMERGENCY OFF IS NOT CONFIRMED"):
        rig.run(2.0)
    assert rig.writes.index(edcp.EMERGENCY_OFF_ALL) > 30  # the last resort


FOREIGN = 0x0402


def test_bits_of_the_control_register_that_are_somebody_elses_stay_and_confuse_nobody() -> None:
    rig = Rig().until_ready()
    rig.module.set(edcp.CHANNEL_CONTROL, FOREIGN)
    rig.hv.set_voltage(1000.0)
    rig.hv.switch_on()
    rig.settle()
    assert rig.module.get(edcp.CHANNEL_CONTROL) == FOREIGN | 0x08
    rig.hv.switch_off()
    rig.settle()
    assert rig.module.get(edcp.CHANNEL_CONTROL) == FOREIGN
    rig.hv.emergency_off()
    rig.settle()
    assert rig.module.get(edcp.CHANNEL_CONTROL) == FOREIGN | 0x20
    assert edcp.EMERGENCY_OFF_ALL not in rig.writes
    rig.hv.clear()
    rig.settle()
    assert rig.module.get(edcp.CHANNEL_CONTROL) == FOREIGN


def test_an_emergency_off_goes_out_before_anything_is_read() -> None:
    rig = Rig().until_ready()
    order: list[str] = []
    read, write = rig.module.read, rig.module.write
    rig.module.read = lambda: order.append("read") or read()  # type: ignore[method-assign, func-returns-value]
    rig.module.write = lambda f, urgent=False: order.append(f.data.hex()) or write(f)  # type: ignore[method-assign, func-returns-value, misc]
    rig.hv.emergency_off()
    rig.run(0.001)
    assert order[0] == "4001000020"


@pytest.mark.parametrize(
    ("bit_5", "module", "bad"),
    [
        ("unused", GOOD, False),
        ("unused", GOOD | 1 << 5, False),
        ("limit good", GOOD | 1 << 5, False),
        ("limit good", GOOD, True),
        ("input error", GOOD, False),
        ("input error", GOOD | 1 << 5, True),
    ],
)
def test_bit_5_of_the_module_status_means_what_the_class_of_the_module_says(bit_5: str, module: int, bad: bool) -> None:
    flags = edcp.hv_flags(ChannelStatus(0), ChannelEvents(0), ModuleStatus(module), bit_5)
    assert (HVFlag.FAULT in flags) is bad


@pytest.mark.parametrize("stated", [1.0, -1.0])
def test_a_negative_channel_is_used_by_magnitudes(stated: float) -> None:
    """With which sign it states set-point and measurement is not settled: either is taken."""
    module = Module()
    module.set(edcp.NOMINAL_VOLTAGE, -6000.0)
    module.set(edcp.MEASURED_VOLTAGE, stated * 1000.0)
    rig = Rig(module).until_ready()
    assert rig.hv.nominal[0] == 6000.0 and rig.hv.settings["polarity"] == "negative"
    rig.hv.set_voltage(1500.0)
    rig.settle()
    assert rig.module.get(edcp.SET_VOLTAGE) == -1500.0
    rig.run(0.3)
    assert rig.samples[-1].voltage == 1000.0 and rig.samples[-1].setpoint == 1500.0


def test_a_latched_event_that_keeps_the_channel_off_is_named() -> None:
    rig = Rig().until_ready()
    rig.module.set(edcp.CHANNEL_EVENTS, int(ChannelEvents.VOLTAGE_BOUNDS))
    rig.module.set(edcp.MODULE_EVENTS, 0x0400)
    rig.module.control = lambda channel, bits: None  # type: ignore[method-assign]  # it is refused
    rig.hv.switch_on()
    with pytest.raises(DeviceRefused, match=r"VOLTAGE_BOUNDS, latched events of the module 0400"):
        rig.settle()


def test_emergency_off_that_does_not_take_is_said_loudly() -> None:
    rig = Rig().until_ready()
    rig.module.lose_writes = 99
    rig.hv.emergency_off()
    with pytest.raises(DeviceRefused, match="EMERGENCY OFF IS NOT CONFIRMED"):
        rig.settle()


def test_emergency_off_stays_latched_through_switch_off_until_clear() -> None:
    rig = Rig().until_ready()
    rig.hv.emergency_off()
    rig.settle()
    rig.hv.switch_off()
    rig.settle()
    assert rig.module.get(edcp.CHANNEL_CONTROL) == 0x20
    rig.hv.switch_on()
    with pytest.raises(DeviceRefused, match="EMERGENCY_OFF is latched"):
        rig.settle()
    rig.hv.clear()
    rig.settle()
    assert rig.module.get(edcp.CHANNEL_CONTROL) == 0
    rig.run(0.2)
    assert rig.samples[-1].flags == HVFlag(0)


def test_a_silent_module_is_reported_with_advice_and_asked_again_later() -> None:
    rig = Rig()
    rig.module.silent = True
    with pytest.raises(DeviceSilent, match=r"no answer to 'module status'.*bit rate"):
        rig.run(2.0)
    assert rig.hv.counters["retries"] == 2
    rig.module.silent = False
    rig.run(1.0)
    assert rig.hv.ready


def test_a_module_that_falls_silent_later() -> None:
    rig = Rig().until_ready()
    rig.run(0.2)
    rig.module.silent = True
    with pytest.raises(DeviceSilent):
        rig.run(1.5)


def test_lost_answers_are_asked_for_again() -> None:
    rig = Rig().until_ready()
    rig.module.lose_answers = 2
    rig.run(2.0)
    assert rig.hv.counters["retries"] == 2
    assert len(rig.samples) > 10


def test_values_that_cannot_be_are_dropped_and_counted() -> None:
    rig = Rig().until_ready()
    bad = iter([float("nan"), float("inf")])

    def corrupt(f: CanFrame) -> CanFrame | None:
        if f.data[:2] == b"\x41\x02" and (value := next(bad, None)) is not None:
            return CanFrame(f.id, f.data[:3] + struct.pack(">f", value))
        return f

    rig.module.corrupt = corrupt
    rig.run(1.0)
    assert rig.hv.counters["bad_values"] == 2
    assert {s.voltage for s in rig.samples} == {0.25}


def test_a_value_that_stays_impossible_is_an_error() -> None:
    rig = Rig().until_ready()
    rig.module.set(edcp.MEASURED_VOLTAGE, 1e9)
    with pytest.raises(DeviceRefused, match=r"reports 1e\+09 as measured voltage"):
        rig.run(1.0)


def test_answers_nobody_asked_for_change_nothing() -> None:
    rig = Rig().until_ready()
    rig.run(0.05)
    rig.module.inbox += [frame("200# 41 02 00 44 BB 80 00"), frame("200# 41 02 05 44 BB 80 00"), frame("7FF#")]
    rig.run(0.3)
    assert {s.voltage for s in rig.samples} == {0.25}
    assert rig.hv.counters["unexpected_frames"] == 2
    assert rig.hv.counters["foreign_frames"] == 1


def test_another_channels_answer_is_not_ours() -> None:
    rig = Rig(Module(channels=2), channel=1)
    rig.module.set(edcp.MEASURED_VOLTAGE, 77.0, channel=0)
    rig.module.set(edcp.MEASURED_VOLTAGE, 88.0, channel=1)
    plain = rig.module.answer

    def both(key: bytes) -> None:
        if key == b"\x41\x02\x01":
            plain(b"\x41\x02\x00")
        plain(key)

    rig.module.answer = both  # type: ignore[method-assign]
    rig.run(0.5)
    assert {s.voltage for s in rig.samples} == {88.0}


def test_a_bus_that_returns_own_frames_is_refused() -> None:
    rig = Rig()
    plain = rig.module.write

    def echo(f: CanFrame) -> None:
        rig.module.inbox.append(f)
        plain(f)

    rig.module.write = echo  # type: ignore[method-assign]
    with pytest.raises(DeviceRefused, match="returns its own frames"):
        rig.run(0.5)


def test_a_module_that_lost_its_registration_is_registered_again() -> None:
    rig = Rig().until_ready()
    rig.module.set(edcp.SET_CURRENT, 2e-4)  # and what it had been set to
    rig.module.inbox.append(frame("201# D8 76 05"))
    rig.run(0.1)
    assert float(rig.hv.settings["current_limit_A"]) == pytest.approx(2e-4)
    assert rig.writes == [edcp.log_on(0)]
    assert rig.hv.counters["log_ons"] == 1


def test_a_channel_that_does_not_exist_is_refused() -> None:
    with pytest.raises(DeviceRefused, match=r"has 1 channel\(s\), but channel 2"):
        Rig(channel=2).run(0.5)
    with pytest.raises(DeviceRefused, match="0 to 63"):
        IsegEDCP("hv", Module(), module=64)


def test_a_module_without_identity_items_is_still_usable() -> None:
    rig = Rig()
    for key in (b"\x12\x00", b"\x12\x01", b"\x12\x03", b"\x12\x08"):
        del rig.module.values[key]
    rig.run(3.0)
    assert rig.hv.ready
    assert rig.hv.identity.serial == ""


def test_the_other_channels_of_the_module_are_watched() -> None:
    rig = Rig(Module(channels=3))
    rig.module.set(edcp.CHANNEL_STATUS, int(ChannelStatus.ON), channel=2)
    rig.run(0.5)
    assert rig.hv.channel_status == {0: ChannelStatus(0), 1: ChannelStatus(0), 2: ChannelStatus.ON}
    assert rig.hv.counters["unexpected_frames"] == 0
    assert frame("201# 60 00 00 07 00") in rig.module.sent


class TripsBetween(Module):
    """Its channel has an error just after status and events were asked for; the module's status tells of it."""

    events = 0

    def answer(self, key: bytes) -> None:
        super().answer(key)
        if key == b"\x40\x02\x00" and self.events:
            self.set(edcp.CHANNEL_EVENTS, self.events)
            self.set(edcp.MODULE_STATUS, GOOD & ~int(ModuleStatus.NO_SUM_ERROR | ModuleStatus.MODULE_GOOD))


def test_a_trip_between_two_reads_is_told_as_one_and_not_as_a_fault_of_the_module() -> None:
    module = TripsBetween()
    rig = Rig(module).until_ready()
    rig.run(0.5)
    module.events = int(edcp.ChannelEvents.TRIP)
    rig.run(0.5)
    told = [sample.flags for sample in rig.samples if sample.flags]
    assert told and all(flags & HVFlag.TRIPPED for flags in told), told


def test_an_error_of_another_channel_stays_a_fault_and_one_of_the_module_needs_no_second_look() -> None:
    rig = Rig(Module(channels=2)).until_ready()
    rig.module.set(edcp.MODULE_STATUS, GOOD & ~int(ModuleStatus.NO_SUM_ERROR | ModuleStatus.MODULE_GOOD))
    rig.run(0.5)
    assert rig.samples[-1].flags == HVFlag.FAULT
    rig.module.set(edcp.MODULE_STATUS, GOOD & ~int(ModuleStatus.TEMPERATURE_GOOD | ModuleStatus.MODULE_GOOD))
    rig.run(0.5)
    rig.module.sent.clear()
    rig.run(1.0)
    asked = [f.data for f in rig.module.sent]
    assert rig.samples[-1].flags == HVFlag.FAULT
    assert asked.count(b"\x40\x02\x00") <= asked.count(b"\x10\x00") + 1


def found_again(module: Module) -> dict[bytes, bytes]:
    return {key: value for key, value in module.values.items() if key[0] in (0x10, 0x11, 0x40, 0x41)}


def test_arming_its_own_trip_and_giving_everything_back() -> None:
    rig = Rig().until_ready()
    rig.module.set(edcp.MODULE_CONTROL, 0x1001)  # somebody's own bits
    rig.module.set(edcp.TRIP_DELAY, 100)
    at_first = found_again(rig.module)
    rig.hv.set_ramp(300.0)
    rig.hv.set_current_limit(5e-5)
    rig.hv.arm_trip(50.0, 5e-5)
    rig.settle()
    assert rig.writes[2:] == [
        edcp.write(0, edcp.VOLTAGE_BOUNDS, 50.0, 0),
        edcp.write(0, edcp.CURRENT_BOUNDS, 5e-5, 0),
        frame("200# 40 05 00 00 14"),
        frame("200# 40 06 00 02"),
        frame("200# 10 01 50 01"),
    ]
    assert rig.hv.settings["kill"] == "1" and rig.hv.settings["trip_action"] == "2"
    assert not rig.hv.given_back
    rig.hv.give_back()
    rig.settle()
    assert rig.hv.given_back and found_again(rig.module) == at_first


def test_kill_is_left_alone_on_a_module_whose_other_channels_are_somebody_elses() -> None:
    rig = Rig(Module(channels=2)).until_ready()
    rig.hv.arm_trip(50.0, 5e-5)
    rig.settle()
    assert rig.module.get(edcp.MODULE_CONTROL) == 0 and rig.module.get(edcp.TRIP_ACTION) == 2
    assert rig.module.get(edcp.TRIP_ACTION, 1) == 0 and "kill" not in rig.hv.found


def test_a_module_without_a_trip_of_its_own_is_armed_without_it() -> None:
    module = Module()
    for key in (b"\x40\x05\0", b"\x40\x06\0", b"\x10\x01"):
        del module.values[key]
    rig = Rig(module).until_ready()
    rig.hv.arm_trip(50.0, 5e-5)
    rig.settle()
    assert rig.hv.settings["kill"] == rig.hv.settings["trip_action"] == "the module does not have it"
    rig.hv.give_back()
    rig.settle()
    assert rig.hv.given_back and module.get(edcp.VOLTAGE_BOUNDS) == 0.0


def test_what_another_program_had_found_is_given_back() -> None:
    rig = Rig().until_ready()
    rig.hv.resume_found({"current_limit_A": 2e-4, "kill": 0.0, "no such thing": 1.0})
    rig.module.set(edcp.MODULE_CONTROL, 0x4001)
    rig.hv.give_back()
    rig.settle()
    assert rig.hv.given_back and rig.module.get(edcp.SET_CURRENT) == pytest.approx(2e-4)
    assert rig.module.get(edcp.MODULE_CONTROL) == 0x0001


def test_closing_sends_nothing() -> None:
    rig = Rig().until_ready()
    rig.hv.close()
    rig.hv.close()
    assert rig.module.sent == []
    assert rig.module.closed == 2


ACCOUNTS = ("round_trips", "foreign_frames", "foreign_requests", "bad_frames", "unexpected_frames", "log_ons")


def survive(mutations: int, seed: int) -> None:
    """Random faults on the bus: the error family, never a value that was not sent, and every frame accounted for."""
    rng = random.Random(seed)
    done = samples = 0
    while done < mutations:
        rig = Rig(timeout_s=0.01)
        rig.module.set(edcp.MEASURED_VOLTAGE, 123.0)
        delivered = 0
        plain = rig.module.read

        def read() -> list[CanFrame]:
            nonlocal delivered
            frames = plain()  # noqa: B023
            delivered += len(frames)
            return frames

        def corrupt(f: CanFrame) -> CanFrame | None:
            nonlocal done
            kind = rng.random()
            if kind < 0.5:
                return f
            done += 1
            if kind < 0.6:
                return None
            if kind < 0.7:  # wrong identifier
                return CanFrame(rng.randrange(0x800), f.data)
            if kind < 0.8:  # wrong length
                return CanFrame(f.id, f.data[: rng.randrange(len(f.data))])
            if kind < 0.9:  # wrong item or channel
                i = rng.randrange(min(3, len(f.data)))
                data = bytearray(f.data)
                data[i] ^= 1 << rng.randrange(8)
                return CanFrame(f.id, bytes(data))
            for _ in range(rng.randint(1, 20)):  # a storm
                done += 1
                rig.module.inbox.append(CanFrame(f.id, rng.randbytes(rng.randrange(9))))  # noqa: B023
            return f

        rig.module.corrupt = corrupt
        rig.module.read = read  # type: ignore[method-assign]
        for _ in range(300):
            if rng.random() < 0.01 and rig.hv.ready:
                rng.choice([rig.hv.emergency_off, rig.hv.clear, rig.hv.switch_off])()
            try:
                rig.run(0.001)
            except DeviceError:
                continue
        for sample in rig.samples:
            assert sample.voltage == 123.0
            assert sample.current == struct.unpack(">f", struct.pack(">f", 2e-9))[0]
        assert all(s.setpoint == 0.0 for s in rig.samples)
        # A damaged answer is given to nobody, and counted: each frame is an answer that was asked for, or a count.
        # (A module that seems to have several channels answers one request with several frames.)
        accounted = sum(rig.hv.counters[key] for key in ACCOUNTS) + len(rig.hv._inbox)
        assert delivered == accounted or rig.hv._channels > 1
        samples += len(rig.samples)
    assert samples > mutations / 2000  # it was not merely deaf


def test_faults_on_the_bus_never_become_values() -> None:
    survive(20_000, seed=1)


def test_statuses_of_many_channels_are_never_mixed_up_by_faults() -> None:
    """One request, sixteen answers: lost, doubled, foreign and torn ones among them."""
    rng = random.Random(3)
    surveys = 0
    for _ in range(40):
        rig = Rig(Module(channels=16), timeout_s=0.02)
        for channel in range(16):
            rig.module.set(edcp.CHANNEL_STATUS, channel << 4, channel)
        rig.until_ready()

        def corrupt(f: CanFrame) -> CanFrame | None:
            match rng.randrange(12):
                case 0:
                    return None
                case 1:
                    rig.module.inbox.append(f)  # noqa: B023
                case 2:  # another item's value, and a channel that is not there
                    rig.module.inbox.append(CanFrame(f.id, b"\x40\x01" + f.data[2:]))  # noqa: B023
                    rig.module.inbox.append(CanFrame(f.id, b"\x40\x00" + bytes((rng.randrange(16, 256), 0, 9))))  # noqa: B023
                case 3:
                    return CanFrame(f.id, f.data[:-1])
            return f

        rig.module.corrupt = corrupt
        for _ in range(60):
            with contextlib.suppress(DeviceError):
                rig.run(0.05)
        seen = rig.hv.channel_status
        assert all(int(status) == channel << 4 for channel, status in seen.items()), seen
        surveys += len(seen) == 16
    assert surveys > 10


@pytest.mark.parametrize(
    "faults",
    [
        pytest.param(100_000, marks=pytest.mark.slow),
        pytest.param(1_000_000, marks=[pytest.mark.long, pytest.mark.timeout(900)]),
    ],
)
def test_very_many_faults_on_the_bus_never_become_values(faults: int) -> None:
    survive(faults, seed=2)
