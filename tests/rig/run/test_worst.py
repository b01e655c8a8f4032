"""The worse of two outcomes is told: an output that was not measured off is never hidden behind a stop."""

from __future__ import annotations

import itertools
import math

import pytest

from drivers.links.link import DeviceLost, DeviceSilent
from rig.base.errors import (
    ConfigError,
    DataError,
    FaultError,
    LimitError,
    NotSafe,
    RigError,
    StaleData,
    Stopped,
    from_fields,
)
from rig.engine.engine import _lets_ramp_down
from rig.engine.outcome import Outcome
from rig.run.run import worst
from rig.safety.process import pack_error
from rig.safety.remote import unpack_error

CODES = {None: 0, Stopped: 130, LimitError: 3, FaultError: 4, StaleData: 4, ConfigError: 2, RigError: 1, DataError: 1}


def outcome(*, safe: bool, standing: bool) -> Outcome:
    return Outcome("stopped", "stopped by a test", safe, standing, 800.0, 0.1, 1e-3, 5.0)


@pytest.mark.parametrize(("kind", "safe", "standing"), [*itertools.product(CODES, (True, False), (True, False))])
def test_exit_code_4_and_not_safe_whenever_the_output_was_not_measured_off_and_never_otherwise(
    kind: type[RigError] | None, safe: bool, standing: bool
) -> None:
    if kind is None and safe and standing:
        return  # nothing is told
    error = None if kind is None else kind("It ended so.")
    told = worst(outcome(safe=safe, standing=standing), error)
    assert isinstance(told, RigError)
    assert isinstance(told, NotSafe) is (not safe)
    assert ("NOT SAFE" in str(told)) is (not safe)
    if not safe:
        assert told.exit_code == 4 and told.device == "hv" and told.cause == "stopped by a test"
    elif not standing and kind in (None, Stopped, LimitError):
        assert told.exit_code == 4 and told.device == "stage" and "may be moving" in str(told)
    else:
        assert told is error and told.exit_code == CODES[kind]


@pytest.mark.parametrize("safe", [True, False])
def test_a_devices_error_and_a_mistake_of_ours_are_not_worse_than_not_safe(safe: bool) -> None:
    for error in (DeviceLost("hv (can0)", "gone"), TypeError("oops")):
        told = worst(outcome(safe=safe, standing=True), error)
        assert (told is error) is safe


@pytest.mark.parametrize("kind", [ConfigError, LimitError, FaultError, StaleData, Stopped, DataError, NotSafe])
def test_an_error_comes_through_a_process_with_all_its_fields(kind: type[RigError]) -> None:
    error = kind("hv, 3: it's off; or not", device="hv", cause="a, b: c")
    error.exit_code = 77
    for came in (from_fields(error.fields()), unpack_error(pack_error(error))):
        assert type(came) is kind and str(came) == str(error)
        assert (came.device, came.cause, came.exit_code) == ("hv", "a, b: c", 77)  # type: ignore[attr-defined]


def test_an_error_of_an_unknown_kind_keeps_its_exit_code() -> None:
    class Special(FaultError):
        def __init__(self, number: int) -> None:
            super().__init__(f"number {number}", device="stage")

    came = from_fields(Special(3).fields())
    assert type(came) is RigError and (str(came), came.device, came.exit_code) == ("number 3", "stage", 4)


def test_a_mistake_in_the_guard_is_a_fault_of_hv() -> None:
    came = unpack_error(pack_error(ValueError("oops")))
    assert isinstance(came, FaultError) and came.device == "hv" and "internal error of the guard" in str(came)


@pytest.mark.parametrize(
    ("name", "role", "ramps"),
    [
        ("force (/dev/ttyUSB0)", "force", True),
        ("hv (can0)", "hv", False),
        ("HVPS 7, serial 3", "hv", False),  # whatever its board is called
        ("hvac sensor", "force", True),
        ("stage", "stage", True),
        ("anything", "", False),  # nobody knows which: off at once
    ],
)
def test_whether_the_voltage_may_ramp_down_goes_by_the_role_and_not_by_a_name(
    name: str, role: str, ramps: bool
) -> None:
    error = DeviceSilent(name, "no answer")
    error.role = role
    assert _lets_ramp_down(error) is ramps
    lost = DeviceLost(name, "gone")
    lost.role = role
    assert not _lets_ramp_down(lost)


def test_the_outcome_says_not_safe_of_itself() -> None:
    ended = Outcome("NOT SAFE", "stopped by a test", False, True, math.nan, 0.0, 0.0, 1.0)
    assert "NOT SAFE" in ended.state and ended.as_text()["status"] == "NOT SAFE"
