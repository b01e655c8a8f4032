"""The guard starts safe, arms only a dead supply, checks the pair (displacement, voltage), and latches on faults."""

from __future__ import annotations

import math
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import pytest

from drivers.roles import HVFlag, HVSample
from rig.base.errors import FaultError, LimitError
from rig.safety.guard import Guard, GuardState
from rig.safety.heartbeat import Heartbeat
from rig.safety.limits import FilmLimits, Limits
from rig.scene.scene import load_scene

SCENE, _ = load_scene(Path(str(files("sim_fixtures"))) / "scenes" / "cone-4mm.toml")
OFF = HVFlag(0)


class Supply:
    """Writes down what it is told."""

    measures_current = True
    busy = False

    def __init__(self) -> None:
        self.told: list[tuple[str, float | None]] = []

    def set_ramp(self, volts_per_second: float) -> None:
        self.told.append(("set_ramp", volts_per_second))

    def set_current_limit(self, amperes: float) -> None:
        self.told.append(("set_current_limit", amperes))

    def set_voltage(self, volts: float) -> None:
        self.told.append(("set_voltage", volts))

    def switch_on(self) -> None:
        self.told.append(("switch_on", None))

    def switch_off(self) -> None:
        self.told.append(("switch_off", None))

    def emergency_off(self) -> None:
        self.told.append(("emergency_off", None))

    @property
    def words(self) -> list[str]:
        return [word for word, _ in self.told]


def make() -> tuple[Guard, Supply, list[str]]:
    supply, log = Supply(), []
    limits = Limits.of(SCENE)
    film = FilmLimits(SCENE.specimen.specimen(), limits)
    # Only the commands of the role are needed here.
    guard = Guard(supply, limits, film, 300.0, lambda word, argument: log.append(word))  # type: ignore[arg-type]
    return guard, supply, log


def sample(voltage: float, flags: HVFlag = OFF, current: float = 0.0, setpoint: float = 1000.0) -> HVSample:
    return HVSample(0.0, voltage, current, setpoint, flags)


def live() -> tuple[Guard, Supply, list[str]]:
    """Sent to 1000 V long ago."""
    guard, supply, log = make()
    for _ in range(2):
        guard.on_sample(replace(sample(0.0), t=-100.0))
    guard.arm()
    guard.request(1000.0, 0.0)
    return guard, supply, log


def test_watching_changes_nothing() -> None:
    guard, supply, log = make()
    for voltage in (0.0, 1500.0, math.nan):
        guard.on_sample(sample(voltage, HVFlag.ON | HVFlag.TRIPPED))
    assert guard.state is GuardState.SAFE
    guard.ramp_off("end")
    guard.kill("end")
    assert supply.told == [] and log == []


@pytest.mark.parametrize(
    ("samples", "words"),
    [
        ([], "not measured"),
        ([sample(0.0)], "0 V"),
        ([sample(0.0), sample(math.nan)], "nan"),
        ([sample(0.0), sample(1500.0)], "1500 V"),
        ([sample(0.0, HVFlag.ON)] * 2, "on already"),
        ([sample(0.0, HVFlag.INTERLOCK_OPEN)] * 2, "interlock open"),
    ],
)
def test_a_supply_that_is_not_measurably_off_is_not_armed_and_left_alone(samples: list[HVSample], words: str) -> None:
    guard, supply, _ = make()
    for one in samples:
        guard.on_sample(one)
    with pytest.raises(FaultError, match=words):
        guard.arm()
    assert supply.told == []
    with pytest.raises(FaultError, match="latched"):
        guard.request(100.0, 0.0)
    assert supply.told == []


def test_the_set_point_is_written_before_the_output_is_switched_on_and_logged_before_either() -> None:
    _, supply, log = live()
    assert supply.words == ["set_ramp", "set_current_limit", "set_voltage", "switch_on"]
    assert log == ["arm", "set_voltage", "switch_on"]


@pytest.mark.parametrize("volts", [-1.0, 1801.0, math.nan, math.inf])
def test_a_voltage_outside_its_limit_is_refused(volts: float) -> None:
    guard, supply, _ = live()
    before = list(supply.told)
    with pytest.raises(LimitError, match="voltage"):
        guard.request(volts, 0.0)
    assert supply.told == before


def test_a_voltage_that_the_flat_film_bears_is_refused_on_the_stretched_one() -> None:
    guard, supply, _ = live()
    guard.request(1500.0, 0.0)
    before = list(supply.told)
    with pytest.raises(LimitError, match="field"):
        guard.request(1500.0, 0.0125)
    with pytest.raises(LimitError):
        guard.request(1500.0, math.nan)
    assert supply.told == before


def test_a_path_is_checked_along_its_way() -> None:
    limits = Limits.of(SCENE)
    film = FilmLimits(SCENE.specimen.specimen(), limits)
    film.check_path(0.0, 0.011, 1500.0)
    with pytest.raises(LimitError, match="field"):
        film.check_path(0.0, 0.0125, 1500.0)
    with pytest.raises(LimitError, match="not a number"):
        film.check_path(0.0, math.nan, 0.0)


@pytest.mark.parametrize(
    "bad",
    [
        sample(2000.0),
        sample(math.nan),
        sample(1000.0, current=60e-6),
        sample(1000.0, current=math.nan),
        sample(1000.0, HVFlag.ON | HVFlag.TRIPPED),
        sample(1000.0, HVFlag.ARC),
    ],
)
def test_a_bad_measurement_while_live_is_an_error_and_the_latch_holds(bad: HVSample) -> None:
    guard, supply, _ = live()
    with pytest.raises((LimitError, FaultError)):
        guard.on_sample(bad)
    guard.kill("test")
    assert supply.words[-1] == "emergency_off"
    with pytest.raises(FaultError, match="latched safe"):
        guard.request(0.0, 0.0)
    assert supply.words[-1] == "emergency_off"


def test_a_supply_that_does_not_measure_current_is_held_to_its_voltage_only() -> None:
    guard, supply, _ = make()
    supply.measures_current = False
    guard.on_sample(sample(0.0, current=math.nan))
    guard.on_sample(sample(0.0, current=math.nan))
    guard.arm()
    guard.request(1000.0, 0.0)
    assert supply.words == ["set_ramp", "set_voltage", "switch_on"]
    guard.on_sample(sample(1000.0, HVFlag.ON, current=math.nan))
    with pytest.raises(LimitError, match="voltage"):
        guard.on_sample(sample(2000.0, HVFlag.ON, current=math.nan))


def test_a_channel_that_goes_off_by_itself_is_a_fault() -> None:
    guard, _, _ = live()
    guard.on_sample(sample(0.0))  # on its way
    guard.on_sample(sample(0.0))
    guard.on_sample(sample(1000.0, HVFlag.ON))
    guard.on_sample(sample(600.0))
    with pytest.raises(FaultError, match="says that it is off"):
        guard.on_sample(sample(100.0))


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (sample(900.0, HVFlag.ON), "sagged"),
        (sample(1100.0, HVFlag.ON), "risen"),
        (sample(1000.0, HVFlag.ON, setpoint=1200.0), "were asked for from here"),
    ],
)
def test_an_output_that_is_not_where_it_was_sent_is_a_fault_at_the_second_sample(bad: HVSample, words: str) -> None:
    guard, _, _ = live()
    guard.on_sample(sample(1000.0, HVFlag.ON))
    guard.on_sample(bad)
    guard.on_sample(sample(1000.0, HVFlag.ON))
    guard.on_sample(sample(998.0, HVFlag.ON | HVFlag.RAMPING))  # on its way
    guard.on_sample(bad)
    with pytest.raises(FaultError, match=words) as told:
        guard.on_sample(bad)
    assert not told.value.breakdown  # this supply measures the current of a breakdown


def test_an_output_that_ramps_away_from_its_set_point_is_a_fault_at_the_second_sample() -> None:
    guard, _, _ = live()
    for voltage in (0.0, 500.0, 1000.0):
        guard.on_sample(sample(voltage, HVFlag.ON | HVFlag.RAMPING))
    guard.on_sample(sample(940.0, HVFlag.ON | HVFlag.RAMPING))
    with pytest.raises(FaultError, match="sagged to 880 V") as told:
        guard.on_sample(sample(880.0, HVFlag.ON | HVFlag.RAMPING))
    assert not told.value.breakdown


@pytest.mark.parametrize("measures_current", [True, False])
@pytest.mark.parametrize("rose", [True, False])
def test_only_an_output_that_was_up_and_sags_without_a_current_is_a_breakdown(
    measures_current: bool, rose: bool
) -> None:
    guard, supply, _ = live()
    supply.measures_current = measures_current
    if rose:
        guard.on_sample(at(0.0, 999.0))
    with pytest.raises(FaultError, match=r"sagged to [234] V") as told:
        for number in range(1, 8):  # a few volts of noise
            guard.on_sample(at(0.1 * number, 2.0 + number % 3))
    assert told.value.breakdown is (rose and not measures_current)


def test_an_output_that_was_up_in_an_earlier_arming_only_is_no_breakdown() -> None:
    guard, supply, _ = live()
    supply.measures_current = False
    guard.on_sample(at(0.0, 999.0))
    guard.ramp_off("end")
    for t in (10.0, 10.1, 10.2):
        guard.on_sample(at(t, 0.0, OFF, math.nan, 0.0))
    guard.arm()
    guard.request(1000.0, 0.0)
    with pytest.raises(FaultError, match="sagged to") as told:
        for number in range(200):
            guard.on_sample(at(10.3 + 0.1 * number, 2.0 + number % 3, RAMPING, math.nan))
    assert not told.value.breakdown


def test_off_counts_anew_after_every_command() -> None:
    guard, _, _ = live()
    assert not guard.output_is_safe  # though it was measured off twice before it was armed
    guard.on_sample(sample(10.0))
    guard.on_sample(sample(10.0))
    guard.kill("test")
    assert not guard.output_is_safe


def test_off_is_believed_only_when_measured_twice() -> None:
    guard, _, _ = live()
    guard.ramp_off("end")
    for voltage, safe in [(900.0, False), (30.0, False), (math.nan, False), (30.0, False), (10.0, True), (70.0, False)]:
        guard.on_sample(sample(voltage))
        assert guard.output_is_safe is safe


def test_a_low_voltage_is_not_off_while_the_channel_is_on_a_ramp_is_under_way_or_the_voltage_rises() -> None:
    guard, _, _ = live()
    guard.ramp_off("end")
    ramping = HVFlag.RAMPING
    story = [(5.0, HVFlag.ON), (5.0, HVFlag.ON), (9.0, HVFlag.ON | ramping), (50.0, ramping), (20.0, ramping)]
    for voltage, flags in [*story, (0.0, OFF), (10.0, OFF), (20.0, OFF), (20.0, OFF)]:
        guard.on_sample(sample(voltage, flags))
        assert not guard.output_is_safe
    guard.on_sample(sample(20.0))
    assert guard.output_is_safe


def at(
    t: float, voltage: float, flags: HVFlag = HVFlag.ON, current: float = 5e-8, setpoint: float = 1000.0
) -> HVSample:
    return HVSample(t, voltage, current, setpoint, flags)


def test_a_monitor_that_shows_the_very_same_for_too_long_is_frozen() -> None:
    guard, _, _ = live()
    for number in range(24):
        guard.on_sample(at(0.1 * number, 999.5))
    guard.on_sample(at(2.4, 999.625))  # one that differs, and it counts anew
    for number in range(25, 48):
        guard.on_sample(at(0.1 * number, 999.5))
    for number in range(48, 72):
        guard.on_sample(at(0.1 * number, 999.5, current=1e-9 * number))  # the current shows that it measures
    with pytest.raises(FaultError, match=r"same 999\.5 V for 2\.40 s; it is frozen"):
        for number in range(72, 98):
            guard.on_sample(at(0.1 * number, 999.5, current=3e-8))


def test_a_voltage_in_whole_volts_without_a_current_may_rightly_stand_still() -> None:
    guard, supply, _ = live()
    supply.measures_current = False
    for number in range(200):
        guard.on_sample(at(0.1 * number, 1000.0, current=math.nan))
    # ... for long, and then a ramp begins
    guard.request(100.0, 0.0)
    guard.on_sample(at(20.0, 1000.0, HVFlag.ON | HVFlag.RAMPING, math.nan, 900.0))
    guard.on_sample(at(20.1, 1000.0, HVFlag.ON | HVFlag.RAMPING, math.nan, 870.0))
    guard.on_sample(at(20.2, 930.0, HVFlag.ON | HVFlag.RAMPING, math.nan, 840.0))


@pytest.mark.parametrize("orderly", [False, True])
def test_a_monitor_that_does_not_move_with_the_ramp_is_frozen(orderly: bool) -> None:
    guard, _, _ = live()
    guard.on_sample(at(0.0, 1000.0))
    if orderly:
        guard.ramp_off("end")  # the latch is SAFE, and the voltage is still there
    else:
        guard.request(100.0, 0.0)
    ramping = HVFlag.ON | HVFlag.RAMPING
    with pytest.raises(FaultError, match=r"same 1000 V for 0\.\d\d s of a ramp; it is frozen"):
        for number in range(1, 8):
            guard.on_sample(at(0.1 * number, 1000.0, ramping, 1e-8 * number))


def test_a_ramp_that_moves_however_slowly_is_none_that_is_frozen_but_one_that_lags() -> None:
    guard, _, _ = live()
    with pytest.raises(FaultError, match="sagged to 5") as told:
        for number in range(100):
            guard.on_sample(at(0.1 * number, 500.0 + number // 2, HVFlag.ON | HVFlag.RAMPING))
    assert not told.value.breakdown


# The measured voltage against the commanded ramp -----------------------------------------------------------------

RAMPING = HVFlag.ON | HVFlag.RAMPING


def settled_guard() -> Guard:
    """At 1000 V, since long."""
    guard, supply, _ = live()
    supply.measures_current = False  # what the film takes is not what is tried here
    for t in (-50.0, -0.2, -0.1, 0.0, 0.1, 0.2):
        guard.on_sample(at(t, 999.5 + 0.1 * t))
    return guard


@pytest.mark.parametrize("flags", [HVFlag.ON, RAMPING])
@pytest.mark.parametrize("rate", [5.0, 20.0, 100.0, -20.0])
def test_an_output_that_creeps_is_a_fault_whatever_the_supply_says_of_itself(rate: float, flags: HVFlag) -> None:
    guard = settled_guard()
    with pytest.raises(FaultError, match="risen to 10[5-9]" if rate > 0 else "sagged to 9[2-5]") as told:
        for number in range(3, 500):
            voltage = 1000.0 + rate * 0.1 * (number - 3)
            assert abs(voltage - 1000.0) < 90.0
            guard.on_sample(at(0.1 * number, voltage, flags))
    assert told.value.breakdown is (rate < 0)  # no current is measured


def test_an_output_that_jumps_past_its_ramp_is_a_fault_though_it_is_below_its_set_point() -> None:
    guard = settled_guard()
    guard.request(1400.0, 0.0)
    guard.on_sample(at(0.3, 1030.0, RAMPING, setpoint=1400.0))
    guard.on_sample(at(0.4, 1300.0, RAMPING, setpoint=1400.0))
    with pytest.raises(FaultError, match="run ahead of its ramp to 1330 V with 1400 V set") as told:
        guard.on_sample(at(0.5, 1330.0, RAMPING, setpoint=1400.0))
    assert not told.value.breakdown


def test_an_output_that_says_ramping_and_stays_is_a_fault_in_about_the_ramps_own_time() -> None:
    guard = settled_guard()
    guard.request(1300.0, 0.0)  # 1 s
    end = 0.0
    with pytest.raises(FaultError, match="sagged to 10") as told:
        for number in range(3, 100):
            end = 0.1 * number
            guard.on_sample(at(end, 1000.0 + number % 7, RAMPING, setpoint=1300.0))
    assert 1.0 < end < 2.0 and told.value.breakdown  # it was up before


@pytest.mark.parametrize("start", [1000.0, 400.0])
def test_a_ramp_down_that_does_not_come_down_is_not_waited_for(start: float) -> None:
    guard, _, _ = live()
    guard.on_sample(at(0.0, start, RAMPING))
    guard.ramp_off("end")
    end = 0.0
    with pytest.raises(FaultError, match="its ramp down has it below"):
        for number in range(1, 200):
            end = 0.1 * number
            guard.on_sample(at(end, start - number % 5, RAMPING, setpoint=0.0))
    assert end < 3.0  # one that was on its way up may go on until the command has arrived


def test_a_film_beyond_its_limits_is_cut_off_once_not_at_every_look() -> None:
    """An emergency off overtakes the supply's measuring: given every 50 ms it would never be measured."""
    guard, supply, _ = live()
    guard.on_sample(sample(1000.0, HVFlag.ON))
    guard.heartbeat(Heartbeat(1, 0.0, 60e-3, {}).encode(), 0.0)
    with pytest.raises(LimitError):
        guard.turn(0.01)
    for k in range(20):
        guard.turn(0.1 + 0.1 * k)
    assert supply.words.count("emergency_off") == 1


def test_an_output_that_is_called_off_and_drives_a_current_is_not_off() -> None:
    guard, _, _ = live()
    guard.kill("a test")
    for _ in range(5):
        guard.on_sample(sample(0.0, current=25e-6))
    assert not guard.output_is_safe
    for current in (0.0, -1e-7):
        guard.on_sample(sample(0.0, current=current))
    assert guard.output_is_safe


def test_a_supply_that_is_found_so_is_not_armed() -> None:
    guard, supply, _ = make()
    for _ in range(5):
        guard.on_sample(sample(0.0, current=25e-6))
    with pytest.raises(FaultError, match="0 V and drives 25 uA"):
        guard.arm()
    assert supply.words == []
