"""A supply that lies in status and reading, and the second reading of the voltage that finds it out.

Runs on the bench in memory; over real processes and ports in `tests/faults/test_second_reading_ports.py`. What is
asserted is what the simulated supply's own output did, and that nothing was called off which was not.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from drivers.roles import OK, HVFlag, HVSample, MonitorSample, SampleFlag
from drivers.settings import MonitorSettings
from rig.base.errors import FaultError, LimitError, StaleData
from rig.log.reader import read_log
from rig.operator.control import Control
from rig.safety.arming import undetectable
from rig.safety.guard import SAFE_VOLTAGE
from rig.safety.second import SecondReading
from rig.sim.bench import SimulatedBench
from rig.sim.truth import Fault

Tell = Callable[..., Any]  # of conftest.Story
METERS = {
    "scpi": '[monitor]\ndriver = "scpi"\nquantity = "voltage"\nfactor = 1000.0\nrate_Hz = 5.0\n',
    "ascii-stream": '[monitor]\ndriver = "ascii-stream"\nquantity = "voltage"\n',
    "labjack-monitor": '[monitor]\ndriver = "labjack-monitor"\nquantity = "voltage"\nfactor = 1000.0\n',
}


@pytest.fixture
def tell(tell: Tell) -> Tell:
    """With the ramp of the scenes: what a second reading may lag behind depends on it."""
    return partial(tell, quick=False)


def with_meter(driver: str = "scpi", more: str = "") -> tuple[str, str]:
    """(old, new) that puts a second reading of the voltage into the scene."""
    return "[simulation]\n", f"{METERS[driver]}{more}\n[simulation]\n"


def inject(kind: str, role: str = "hv", **keys: Any) -> Callable[[SimulatedBench, Control], None]:
    def mischief(bench: SimulatedBench, control: Control) -> None:
        bench.inject(Fault(role=role, kind=kind, **keys))  # type: ignore[arg-type]

    return mischief


@pytest.mark.slow
@pytest.mark.parametrize("driver", METERS)
def test_a_run_with_a_second_reading_ends_as_one_without(tell: Tell, driver: str) -> None:
    story = tell(replace=with_meter(driver))
    assert story.error is None, story.error
    assert story.outcome.safe and story.outcome.status == "complete"
    assert f"(monitor) shows {0:.0f} V" in story.outcome.state.replace("-0 V", "0 V")
    volts = read_log(story.log).columns("/monitor/sample")["voltage_V"]
    assert volts.max() == pytest.approx(1000.0, abs=5.0)


@pytest.mark.slow
def test_a_supply_that_lies_is_called_safe_without_a_second_reading(tell: Tell) -> None:
    """What the second reading is for: nothing else can tell."""
    story = tell(inject("lies"))
    assert story.final_output > 990
    assert story.outcome.safe


@pytest.mark.slow
@pytest.mark.parametrize("driver", ["scpi", "labjack-monitor"])
def test_a_supply_that_lies_is_not_safe_with_one(tell: Tell, driver: str) -> None:
    story = tell(inject("lies"), replace=with_meter(driver))
    assert story.final_output > 990
    assert not story.outcome.safe and story.outcome.status == "NOT SAFE"
    assert "shows 1000 V" in story.outcome.state.replace("999 V", "1000 V").replace("1001 V", "1000 V")
    assert story.control_words[-1] == "emergency_off"


@pytest.mark.slow
def test_a_supply_that_lies_about_its_voltage_only_ends_the_run_by_name(tell: Tell) -> None:
    """It stays at 1000 V on its own reading while the output sags; status and set-point are as they should be."""

    def mischief(bench: SimulatedBench, control: Control) -> None:
        supply: Any = bench.instruments["hv"]
        measured = supply._measured_v
        supply._measured_v = lambda t: measured(t) + 1000.0 - bench.world.output.at(t)[0]
        supply.set_sag(bench.now, 0.7)

    story = tell(mischief, replace=with_meter())
    assert isinstance(story.error, FaultError)
    # The output may still be sagging when it is told.
    assert re.search(
        r"supply and monitor disagree: the supply says (999|1000) V, the second reading 7\d\d V", str(story.error)
    )
    assert story.final_output < SAFE_VOLTAGE


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["silent", "vanish", "wrong_status", "saturate"])
def test_a_second_reading_that_fails_ends_the_run_and_prevents_no_off(tell: Tell, kind: str) -> None:
    story = tell(inject(kind, "monitor"), replace=with_meter())
    assert story.final_output < SAFE_VOLTAGE  # it was switched off all the same
    assert "monitor" in str(story.error)
    assert not story.outcome.safe and story.outcome.status == "NOT SAFE"  # but nobody can prove it
    assert "no value" in story.outcome.state


@pytest.mark.slow
def test_a_second_reading_that_is_back_proves_the_off(tell: Tell) -> None:
    story = tell(inject("silent", "monitor", duration_s=4.0), replace=with_meter())
    assert "monitor" in str(story.error)
    assert story.final_output < SAFE_VOLTAGE and story.outcome.safe


@pytest.mark.slow
def test_a_second_reading_that_is_frozen_disagrees_at_the_next_ramp(tell: Tell) -> None:
    def frozen(now: float, bench: SimulatedBench, control: Control) -> None:
        if not bench.world.output.changes and now > 1.0:
            bench.instruments["monitor"].freeze(bench.now, True)

    story = tell(meanwhile=frozen, replace=with_meter())
    assert "disagree" in str(story.error)
    assert max(volts for _, volts in story.outputs) < 500.0
    assert story.final_output < SAFE_VOLTAGE


@pytest.mark.slow
def test_an_output_that_only_the_second_reading_shows_is_not_armed(tell: Tell) -> None:
    def live(bench: SimulatedBench, control: Control) -> None:
        raise AssertionError

    story = tell(
        replace=with_meter(more="\n"),
        also=("[simulation.hv]", "[simulation.monitor]\nzero_offset = 300.0\n[simulation.hv]"),
    )
    assert isinstance(story.error, FaultError)
    assert "the supply says that its output is off, but the second reading" in str(story.error)
    assert "arm" not in story.control_words and not story.outcome.safe


@pytest.mark.slow
def test_air_is_logged_and_ends_no_run(tell: Tell) -> None:
    air = (
        '[monitor]\ndriver = "scpi"\nquantity = "temperature"\nquery = "MEAS:TEMP?"\n\n[monitor_2]\n'
        'driver = "ascii-stream"\nquantity = "humidity"\n\n[simulation.monitor]\nunits_per_number = 1.0\n\n'
        "[simulation]\n"
    )
    story = tell(inject("silent", "monitor"), replace=("[simulation]\n", air))
    assert story.error is None and story.outcome.safe
    log = read_log(story.log)
    assert log.columns("/monitor/sample")["temperature_K"].mean() == pytest.approx(296.15, abs=0.3)
    assert log.columns("/monitor_2/sample")["relative_humidity"].mean() == pytest.approx(0.45, abs=0.01)
    assert any("the run goes on without" in m.fields["message"] for m in log.messages("/event"))


# The rules themselves ---------------------------------------------------------------------------------------------


class NoMonitor(MonitorSettings):
    """A table whose instrument is never opened: the rules are asked about samples made here."""

    def open(self, role: Any, wire: Any, clock: Any) -> Any:
        raise AssertionError("no test of the rules opens an instrument")


def second(**keys: Any) -> SecondReading:
    table = NoMonitor(driver="any", quantity="voltage", **{"rate_Hz": 5.0, "lag_s": 0.5, **keys})
    return SecondReading("monitor", table, 0.2, 300.0, 1080.0)


def reading(t: float, value: float, flags: SampleFlag = OK) -> MonitorSample:
    return MonitorSample(t, "monitor", "voltage", value, flags)


def said(t: float, volts: float) -> HVSample:
    return HVSample(t, volts, 0.0, volts, HVFlag(0))


def test_off_needs_two_fresh_good_readings_after_the_command() -> None:
    one = second()
    assert not one.shows_off(0.0)
    one.take(reading(1.0, 2.0))
    assert not one.shows_off(1.0)
    one.take(reading(1.2, -3.0))
    assert one.shows_off(1.3)
    assert not one.shows_off(1.2 + one.allowed_age + 0.01)  # stale
    one.expect_off()
    assert not one.shows_off(1.3)
    for bad in (
        reading(1.4, math.nan),
        reading(1.4, 3.0, SampleFlag.NO_VALUE),
        reading(1.4, 60.0),
        reading(1.4, -61.0),
    ):
        one.take(reading(1.35, 2.0))
        one.take(bad)
        one.take(reading(1.45, 2.0))
        assert not one.shows_off(1.5)


def test_disagreement_must_last_and_a_late_meter_is_none() -> None:
    """A meter half a second late on a ramp of 300 V/s, beside a supply that is asked five times a second."""
    one = second()
    for k in range(200):
        t = 0.05 * k
        if k % 4 == 0:
            one.on_supply(said(t, min(300.0 * t, 1000.0)))
        one.take(reading(t, min(max(300.0 * (t - 0.5), 0.0), 1000.0)))
        one.judge()
    for k in range(40):  # 5 % and less is agreement
        t = 10.0 + 0.1 * k
        one.on_supply(said(t, 1000.0))
        one.take(reading(t, 955.0))
        one.judge()
    with pytest.raises(FaultError, match=r"the supply says 1000 V, the second reading 940 V; allowed are 50 V or 5%"):
        for k in range(40):
            t = 14.0 + 0.1 * k
            one.on_supply(said(t, 1000.0))
            one.take(reading(t, 940.0))
            one.judge()
    assert 14.4 <= t <= 14.7


def test_it_holds_the_limit_by_itself_and_its_age() -> None:
    one = second()
    one.on_supply(said(0.0, 1000.0))
    one.take(reading(0.0, 1200.0))
    with pytest.raises(LimitError, match="shows 1200 V"):
        one.judge()
    one.check_age(0.5)
    with pytest.raises(StaleData, match=r"no value for 5\.00 s"):
        one.check_age(5.0)
    with pytest.raises(StaleData, match="has given no value yet"):
        second().check_age(5.0)


def test_what_cannot_be_detected_is_said_at_arming() -> None:
    assert "a supply whose status and reading are wrong at once" in undetectable("")
    assert "monitor: scpi" in undetectable("monitor: scpi")
    assert "wrong at once" not in undetectable("monitor: scpi")
