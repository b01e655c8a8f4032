"""LabJack: frames by the manual's examples, and the amplifier on the simulated device: proof, ramp, watchdog, off."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest
from pydantic import ValidationError

from drivers.instruments.labjack import PRESETS, AmplifierSettings
from drivers.instruments.labjack.amplifier import Amplifier, LabJackAmplifier
from drivers.instruments.labjack.analog_input import AnalogForce
from drivers.instruments.labjack.codec import (
    LONGEST,
    Decoder,
    Refused,
    Words,
    Written,
    f32,
    read_request,
    u16,
    write_request,
)
from drivers.links.link import DeviceError, DeviceRefused, DeviceSilent
from drivers.roles import HVFlag, HVSample, HVSupply
from model.material.materials import NAMED
from model.specimen import Specimen
from rig.base.clock import VirtualClock
from rig.bench.memory_link import MemoryByteLink
from rig.sim.bench import SimulatedBench
from rig.sim.settings import SimulationSettings
from rig.sim.truth import Fault

FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"])
TREK = PRESETS["trek-610e"]

# -- frames ------------------------------------------------------------------------------------------------------------


def test_requests_as_in_the_manual() -> None:
    assert read_request(1, 0, 2).hex() == "000100000006010300000002"
    assert write_request(2, 1000, f32(2.5)).hex() == "00020000000b011003e800020440200000"
    assert write_request(3, 2000, u16(1)).hex() == "000300000009011007d00001020001"
    for wrong in (b"", b"\0", bytes(248)):
        with pytest.raises(ValueError, match="registers"):
            write_request(1, 0, wrong)


ANSWERS = {
    "00010000000701030440200000": Words(1, bytes.fromhex("40200000")),
    "000200000006011003e80002": Written(2, 1000, 2),
    "000400000003018302": Refused(4, 3, 2),
    "000500000003019004": Refused(5, 16, 4),
}


@pytest.mark.parametrize(("data", "message"), [(bytes.fromhex(k), v) for k, v in ANSWERS.items()])
def test_answers_cut_at_every_place(data: bytes, message: Any) -> None:
    for cut in range(len(data) + 1):
        decoder = Decoder()
        assert decoder.feed(data[:cut]) + decoder.feed(data[cut:] + data) == [message, message]
        assert decoder.counters == {"dropped_bytes": 0}


def test_a_frame_longer_than_any_is_not_waited_for() -> None:
    """Both bytes of the length, one at a time and together."""
    good = bytes.fromhex("00010000000701030440200000")
    for length in (LONGEST + 1, 0x0107, 0xFF07, 0x00FF, 0xFFFF, 0, 1, 2):
        decoder = Decoder()
        damaged = good[:4] + struct.pack(">H", length) + good[6:]
        found = decoder.feed(damaged + good)
        assert found[-1:] == [Words(1, bytes.fromhex("40200000"))], hex(length)
        assert decoder.counters["dropped_bytes"] > 0
    decoder = Decoder()
    assert decoder.feed(struct.pack(">HHH", 1, 0, LONGEST) + bytes(LONGEST - 1)) == []
    assert decoder.counters["dropped_bytes"] == 0  # the longest one is waited for


# -- settings ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_is_whole_and_can_be_corrected(preset: str) -> None:
    table = {"driver": "labjack-amplifier", "preset": preset}
    assert AmplifierSettings.model_validate(table).amplifier == PRESETS[preset]
    changed = AmplifierSettings.model_validate({**table, "gain_V_per_V": 750.0, "polarity": -1}).amplifier
    assert changed.gain_V_per_V == 750.0 and changed.polarity == -1
    assert changed.full_scale_V == PRESETS[preset].full_scale_V


def test_without_a_preset_everything_must_be_said() -> None:
    whole = {
        "driver": "labjack-amplifier",
        "gain_V_per_V": 1000.0,
        "voltage_monitor_V_per_V": 1000.0,
        "current_monitor_uA_per_V": 200.0,
        "full_scale_V": 1e4,
        "current_limit_uA": 2000.0,
        "slew_V_per_us": 35.0,
    }
    assert AmplifierSettings.model_validate(whole).amplifier == TREK
    for key in set(whole) - {"driver"}:
        with pytest.raises(ValidationError, match=f"{key} must be given, or a preset"):
            AmplifierSettings.model_validate({name: value for name, value in whole.items() if name != key})
    with pytest.raises(ValidationError, match="same input"):
        AmplifierSettings.model_validate({**whole, "voltage_ain": 1})


# -- the amplifier -----------------------------------------------------------------------------------------------------


class Rig:
    """The simulated amplifier and its driver, polled as the engine does; the guard renews while ``guarded``."""

    def __init__(self, truth: dict[str, Any] | None = None, **keys: Any) -> None:
        settings = {"seed": 3, "hv": {"driver": "labjack-amplifier", **(truth or {})}}
        self.bench = SimulatedBench(SimulationSettings.model_validate(settings), FILM, {"hv"})
        self.clock = VirtualClock(self.bench.advance)
        self.link = MemoryByteLink("hv", self.bench.wire("hv"), self.clock)  # type: ignore[arg-type]
        keys = {"amplifier": TREK, "enable_line": 0, "ramp_V_per_s": 1000.0, **keys}
        self.supply = LabJackAmplifier("hv", self.link, **keys)
        self.samples: list[HVSample] = []
        self.guarded = True
        self.box: Any = self.bench.instruments["hv"].box  # type: ignore[attr-defined]

    def run(self, seconds: float) -> None:
        end = self.clock.now() + seconds
        while self.clock.now() < end:
            if self.guarded:
                self.supply.renew()
            self.samples += self.supply.poll(self.clock.now())
            self.clock.sleep_until(min(end, max(self.clock.now() + 1e-3, min(self.supply.next_poll, end))))

    @property
    def output(self) -> float:
        return self.bench.world.output.at(self.clock.now())[0]

    def up(self, volts: float = 1000.0) -> None:
        self.run(0.5)
        self.supply.set_voltage(volts)
        self.supply.switch_on()
        self.run(2.0 + volts / 1000.0)


def test_is_a_supply() -> None:
    supply: HVSupply = Rig().supply
    assert supply.measures_current and not supply.ready


def test_set_up_changes_no_output() -> None:
    rig = Rig()
    rig.run(1.0)
    assert rig.supply.ready
    assert rig.supply.identity.model == "LabJack T7" and rig.supply.identity.serial == "470010000"
    assert rig.supply.nominal == pytest.approx((5000.0, 2e-3))  # what the DAC of a T7 can ask for
    assert rig.box.dac == [0.0, 0.0] and rig.box.direction == 0 and rig.box.flash_writes == 0
    assert not any(sample.flags for sample in rig.samples) and len(rig.samples) > 10


@pytest.mark.parametrize("line", [0, 3])
@pytest.mark.parametrize("high", [False, True], ids=["enabled low", "enabled high"])
@pytest.mark.parametrize("level", [0, 1])
def test_whether_it_is_enabled_is_the_level_of_its_own_line(line: int, high: bool, level: int) -> None:
    """Either level, the other lines at the other one; read at set-up, and an output that is up is then live."""
    rig = Rig(enable_line=line, enable_high=high)
    rig.box.direction = 0xFF
    rig.box.state = 1 << line if level else 0xFF & ~(1 << line)
    rig.box.write(1000, f32(0.5), rig.clock.now())
    rig.run(0.5)
    enabled = bool(level) is high
    assert rig.supply.settings["enabled_at_setup"] == ("yes" if enabled else "no")
    assert (HVFlag.ON in rig.samples[-1].flags) is enabled


def test_the_output_ramps_at_the_rate_and_is_measured() -> None:
    rig = Rig()
    rig.up(1000.0)
    assert rig.output == pytest.approx(1000.0, abs=2.0)
    last = rig.samples[-1]
    assert last.voltage == pytest.approx(rig.output, abs=5.0) and last.setpoint == 1000.0
    assert last.flags == HVFlag.ON
    ramp = [s for s in rig.samples if 150 < s.voltage < 850]
    rate = (ramp[-1].voltage - ramp[0].voltage) / (ramp[-1].t - ramp[0].t)
    assert rate == pytest.approx(1000.0, rel=0.05)
    assert all(HVFlag.RAMPING in s.flags for s in ramp)
    rig.supply.switch_off()
    rig.run(2.0)
    assert rig.output == 0.0 and rig.box.level(0) and rig.box.dac[0] == 0.0
    assert not rig.samples[-1].flags


def test_the_step_that_proves_stays_below_what_is_dangerous() -> None:
    rig = Rig({"monitor_unplugged": True})
    rig.run(0.5)
    rig.supply.set_voltage(1000.0)
    rig.supply.switch_on()
    highest = 0.0
    with pytest.raises(DeviceRefused):
        for _ in range(400):
            rig.run(0.01)
            highest = max(highest, rig.output)
    assert 40.0 < highest < 60.0


WRONG = {
    "dead or unplugged": {"monitor_unplugged": True},
    "wrong sign": {"gain_V_per_V": -1000.0},
    "gain_V_per_V or voltage_monitor_V_per_V is wrong": {"gain_V_per_V": 500.0},
    "is wrong, or the output is loaded": {"monitor_V_per_V": 2000.0},
}


@pytest.mark.parametrize(("words", "truth"), WRONG.items(), ids=list(WRONG))
def test_an_amplifier_that_is_not_as_typed_in_is_refused_and_left_off(words: str, truth: dict[str, Any]) -> None:
    rig = Rig(truth)
    rig.run(0.5)
    rig.supply.set_voltage(1000.0)
    rig.supply.switch_on()
    with pytest.raises(DeviceRefused, match=words):
        rig.run(3.0)
    rig.run(0.5)
    assert rig.output == 0.0 and rig.box.dac[0] == 0.0 and rig.box.level(0)


def test_a_gain_within_the_tolerance_is_taken() -> None:
    rig = Rig({"gain_error": 0.1})
    rig.up(500.0)
    assert rig.output == pytest.approx(550.0, abs=3.0)


def test_a_negative_amplifier_is_stated_positive() -> None:
    inverted = Amplifier(**{**{f: getattr(TREK, f) for f in TREK.__dataclass_fields__}, "polarity": -1})
    rig = Rig({"gain_V_per_V": -1000.0}, amplifier=inverted)
    rig.up(500.0)
    assert rig.samples[-1].voltage == pytest.approx(500.0, abs=5.0)


def test_the_watchdog_is_armed_before_the_first_volt_and_takes_the_output_off_without_the_guard() -> None:
    rig = Rig()
    rig.up(1000.0)
    assert rig.box._setting(61_600) == 1 and rig.box._setting(61_610) == 1 and rig.box._setting(61_604) == 3
    writes = rig.box.flash_writes
    assert 0 < writes <= 14
    rig.run(10.0)
    assert rig.box.watchdog_acted == 0  # it is kept from acting
    rig.guarded = False  # polled on, but nobody decides any more
    began = rig.clock.now()
    while rig.box.dac[0] > 0:
        assert rig.clock.now() - began < 3.3
        rig.run(0.01)
    assert rig.clock.now() - began > 2.5
    rig.run(0.2)
    assert rig.output == 0.0 and rig.box.level(0)
    assert rig.samples[-1].setpoint == 0.0  # what the DAC holds, not what was asked for


def test_its_settings_are_written_only_when_they_differ() -> None:
    rig = Rig()
    rig.up(500.0)
    writes = rig.box.flash_writes
    rig.supply.switch_off()
    rig.run(1.0)
    again = LabJackAmplifier("hv", rig.link, amplifier=TREK, enable_line=0, ramp_V_per_s=1000.0)
    rig.supply = again
    rig.up(500.0)
    assert rig.output == pytest.approx(500.0, abs=3.0)
    assert rig.box.flash_writes == writes


def test_after_the_watchdog_has_acted_the_output_is_not_raised() -> None:
    rig = Rig()
    rig.up(500.0)
    rig.guarded = False
    rig.run(4.0)
    rig.guarded = True
    rig.supply.set_voltage(800.0)
    with pytest.raises(DeviceRefused, match="Its watchdog has acted, or another program"):
        rig.run(1.0)
    assert rig.output == 0.0


def test_a_ramp_down_that_was_decided_comes_to_its_end() -> None:
    """Longer than the watchdog's time, with nobody renewing."""
    rig = Rig()
    rig.up(1000.0)
    rig.supply.set_ramp(200.0)
    rig.guarded = False
    rig.supply.switch_off()
    rig.run(4.5)
    assert 50.0 < rig.output < 150.0 and rig.box.watchdog_acted == 0
    rig.run(1.5)
    assert rig.output == 0.0 and rig.box.dac[0] == 0.0 and not rig.supply.busy


def test_a_ramp_down_goes_on_from_where_the_output_is() -> None:
    rig = Rig()
    rig.up(1000.0)
    rig.box.write(1000, f32(0.3), rig.clock.now())  # somebody else has taken it down
    rig.supply.switch_off()
    rig.run(1.0)
    assert rig.output == 0.0 and not rig.supply.busy


def test_emergency_off_is_at_once_and_latches() -> None:
    rig = Rig()
    rig.up(1000.0)
    rig.supply.emergency_off()
    rig.run(0.1)
    assert rig.output < 60.0 and rig.box.dac[0] == 0.0 and rig.box.level(0)
    assert HVFlag.EMERGENCY_OFF in rig.samples[-1].flags
    with pytest.raises(DeviceRefused, match="after a trip"):
        rig.supply.switch_on()
    rig.supply.clear()
    rig.run(0.1)
    assert not rig.samples[-1].flags


def test_an_emergency_off_that_is_not_answered_says_so() -> None:
    rig = Rig()
    rig.up(500.0)
    rig.bench.inject(Fault(role="hv", kind="silent", at_s=rig.clock.now()))
    rig.supply.emergency_off()
    with pytest.raises(DeviceSilent, match=r"EMERGENCY OFF IS NOT CONFIRMED.*by hand"):
        rig.run(3.0)
    assert rig.box.dac[0] == 0.0  # and was carried out all the same


@pytest.mark.parametrize("kind", ["silent", "line"])
def test_after_an_emergency_off_that_is_not_confirmed_nothing_but_0_is_written(kind: str) -> None:
    """The ramp at rest, the output at 800 V: no step of a way down may raise the DAC again."""
    rig = Rig()
    rig.up(800.0)
    written: list[float] = []
    write = rig.box.write

    def spy(address: int, data: bytes, t: float) -> Any:
        if address == 1000:
            written.append(struct.unpack(">f", data)[0])
        elif kind == "line" and address == 2000:
            return None  # something else holds the line at "enabled"
        return write(address, data, t)

    rig.box.write = spy
    if kind == "silent":
        rig.bench.inject(Fault(role="hv", kind="silent", at_s=rig.clock.now(), duration_s=1.0))
    rig.supply.emergency_off()
    with pytest.raises(DeviceError, match="EMERGENCY OFF IS NOT CONFIRMED"):
        rig.run(3.0)
    rig.run(2.0)
    assert set(written) == {0.0} and rig.output < 60.0


def test_an_output_that_reads_back_as_no_number_is_not_called_off() -> None:
    rig = Rig()
    rig.up(500.0)
    read = rig.box.read
    rig.box.read = lambda address, *rest: f32(math.nan) if address == 1000 else read(address, *rest)
    rig.supply.emergency_off()
    with pytest.raises(DeviceRefused, match="the DAC stays at nan"):
        rig.run(1.0)
    rig.run(0.2)
    assert HVFlag.ON in rig.samples[-1].flags


def test_a_ramp_slower_than_one_step_of_the_dac_goes_on_all_the_same() -> None:
    """A T4 has steps of 4.9 V of the output: at 10 V/s one every half second."""
    rig = Rig({"product": 4}, ramp_V_per_s=10.0)
    rig.up(100.0)
    rig.run(12.0)
    assert rig.output == pytest.approx(100.0, abs=6.0)
    rig.supply.switch_off()
    rig.run(13.0)
    assert rig.output == 0.0 and not rig.supply.busy


def test_a_set_point_beyond_the_dac_is_refused_before_it_is_cut_silently() -> None:
    rig = Rig()
    rig.run(0.5)
    for volts in (5001.0, -1.0, math.nan):
        with pytest.raises(DeviceRefused, match="outside its range"):
            rig.supply.set_voltage(volts)
    rig = Rig({"product": 8})
    rig.run(0.5)
    assert rig.supply.nominal[0] == pytest.approx(10_000.0)


def test_an_output_that_lags_makes_the_ramp_wait_and_is_said() -> None:
    rig = Rig({"film_capacitance_nF": 1000.0, "current_limit_uA": 100.0}, settle_s=1.0)  # 100 V/s is all that it can
    rig.run(0.5)
    rig.supply.set_voltage(1000.0)
    rig.supply.switch_on()
    rig.run(7.0)
    assert rig.supply.counters["lagging"] > 10
    assert any(HVFlag.CURRENT_LIMIT in sample.flags for sample in rig.samples)
    ahead = [sample.setpoint - sample.voltage for sample in rig.samples if HVFlag.ON in sample.flags]
    assert max(ahead) < 250.0
    rig.run(10.0)
    assert rig.output == pytest.approx(1000.0, abs=5.0)  # it comes there all the same


def test_an_output_that_does_not_come_at_all_ends_it() -> None:
    rig = Rig()
    rig.run(0.5)
    rig.supply.set_voltage(1000.0)
    rig.supply.switch_on()
    rig.run(1.2)
    rig.bench.inject(Fault(role="hv", kind="sag", value=0.2, at_s=rig.clock.now()))
    with pytest.raises(DeviceRefused, match="at its current limit, or off"):
        rig.run(5.0)


def test_a_saturated_monitor_is_a_trip() -> None:
    rig = Rig()
    rig.up(500.0)
    rig.bench.inject(Fault(role="hv", kind="saturate", at_s=rig.clock.now(), duration_s=0.3))
    rig.run(1.0)
    assert HVFlag.TRIPPED in rig.samples[-1].flags
    assert rig.supply.counters["over_range"] > 0


def test_more_current_than_the_limit_is_a_trip() -> None:
    rig = Rig()
    rig.run(0.5)
    rig.supply.set_current_limit(50e-6)
    rig.up(500.0)
    assert HVFlag.TRIPPED not in rig.samples[-1].flags
    rig.bench.inject(Fault(role="hv", kind="over_current", value=80e-6, at_s=rig.clock.now()))
    rig.run(0.5)
    assert HVFlag.TRIPPED in rig.samples[-1].flags


def test_a_line_that_floats_high_after_a_power_cycle_leaves_a_low_active_amplifier_off() -> None:
    rig = Rig()
    rig.up(500.0)
    rig.bench.inject(Fault(role="hv", kind="reset", at_s=rig.clock.now()))
    with pytest.raises(DeviceSilent):
        rig.run(1.5)
    rig.run(1.5)
    assert rig.output == 0.0 and rig.box.level(0)
    assert rig.box._setting(61_600) == 1  # the watchdog is armed again


@pytest.mark.parametrize(
    ("register", "data", "words"),
    [
        (55_100, b"\x22\x33\x00\x11", "This is no LabJack"),
        (60_000, struct.pack(">f", 200.0), "product 200 is not known"),
    ],
)
def test_something_else_at_that_address_is_refused(register: int, data: bytes, words: str) -> None:
    rig = Rig()
    value = rig.box._value
    rig.box._value = lambda address, t: data if address == register else value(address, t)
    with pytest.raises(DeviceRefused, match=words):
        rig.run(1.0)
    assert not rig.supply.ready


def test_an_input_at_its_end_gives_no_force() -> None:
    settings = SimulationSettings.model_validate({"seed": 1, "force": {"driver": "labjack-force"}})
    bench = SimulatedBench(settings, FILM, {"force"})
    clock = VirtualClock(bench.advance)
    link = MemoryByteLink("force", bench.wire("force"), clock)  # type: ignore[arg-type]
    force = AnalogForce("force", link, newtons_per_V=0.1)
    samples = []
    bench.inject(Fault(role="force", kind="saturate", at_s=1.0))
    while clock.now() < 2.0:
        samples += force.poll(clock.now())
        clock.sleep_until(clock.now() + 2e-3)
    before = [sample for sample in samples if sample.t < 1.0]
    after = [sample for sample in samples if sample.t > 1.05]
    assert not any(sample.flags for sample in before) and len(before) > 30
    assert all(math.isnan(sample.reading) and sample.flags for sample in after) and len(after) > 30
