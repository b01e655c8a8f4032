"""What instruments declare, one row for each of their keys: described, with the documented default and range."""

from __future__ import annotations

import math
from typing import Any, Literal, get_args, get_origin

import pytest
from pydantic import TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from drivers.instrument import Instrument
from drivers.registry import registered
from drivers.settings import InstrumentSettings

INSTRUMENTS = list(registered().instruments.values())

# driver, key: default, smallest, largest as the documentation has them; "(0" excludes the 0 itself, "-" is none.
DOCUMENTED = """
zaber        timeout_s               0.25      (0     10
zaber        boot_s                  10.0      0      60
zaber        baud                    115200    (0     -
zaber        poll_rate_Hz            50.0      5      200
zaber        approach_from_mm        0.0       0      -
zaber        device                  1         1      99
zaber        axis                    1         1      9
zaber        full_step_um            None      (0     -
zaber        peripheral_id           None      0      -
gsv8         timeout_s               0.25      (0     10
gsv8         boot_s                  10.0      0      60
gsv8         baud                    230400    (0     -
gsv8         channel                 1         1      8
gsv8         rate_Hz                 100.0     (0     2000
gsv8         int_full_scale          1.05      0.5    2
gsv8         input_range_mV_per_V    None      (0     1000
cia404       timeout_s               0.25      (0     10
cia404       boot_s                  10.0      0      60
cia404       bitrate                 125000    (0     -
cia404       node                    1         1      127
cia404       channel                 1         1      199
cia404       rate_Hz                 100.0     (0     1000
cia404       factor                  1.0       -      -
cia404       limit_N                 10000.0   (0     -
keyence-lkg  timeout_s               0.25      (0     10
keyence-lkg  boot_s                  10.0      0      60
keyence-lkg  baud                    115200    (0     -
keyence-lkg  output                  1         1      2
keyence-lkg  poll_rate_Hz            50.0      5      200
keyence-lkg  unit_mm                 1.0       (0     -
keyence-lkg  limit_mm                80.0      (0     -
iseg-edcp    timeout_s               0.25      (0     10
iseg-edcp    boot_s                  10.0      0      60
iseg-edcp    bitrate                 125000    (0     -
iseg-edcp    ramp_V_per_s            100.0     (0     -
iseg-edcp    parallel_capacitance_nF 0.0       0      -
iseg-edcp    parallel_capacitance_uncertainty_nF None 0 -
iseg-edcp    current_uncertainty_percent None 0 -
iseg-edcp    module                  0         0      63
iseg-edcp    channel                 0         0      23
iseg-edcp    max_ramp_percent_per_s  20.0      (0     100
iseg-edcp    poll_rate_Hz            10.0      (0     50
shvps        timeout_s               0.25      (0     10
shvps        boot_s                  10.0      0      60
shvps        baud                    115200    (0     -
shvps        ramp_V_per_s            100.0     (0     -
shvps        parallel_capacitance_nF 0.0       0      -
shvps        parallel_capacitance_uncertainty_nF None 0 -
shvps        current_uncertainty_percent None 0 -
shvps        poll_rate_Hz            10.0      (0     20
labjack-amplifier     timeout_s                0.25  (0  10
labjack-amplifier     boot_s                   10.0  0   60
labjack-amplifier     tcp_port                 502   1   65535
labjack-amplifier     ramp_V_per_s             100.0 (0  -
labjack-amplifier     parallel_capacitance_nF  0.0   0   -
labjack-amplifier     parallel_capacitance_uncertainty_nF None 0 -
labjack-amplifier     current_uncertainty_percent None 0 -
labjack-amplifier     gain_V_per_V             None  (0  -
labjack-amplifier     voltage_monitor_V_per_V  None  (0  -
labjack-amplifier     current_monitor_uA_per_V None  (0  -
labjack-amplifier     full_scale_V             None  (0  -
labjack-amplifier     current_limit_uA         None  (0  -
labjack-amplifier     slew_V_per_us            None  (0  -
labjack-amplifier     dac                      0     0   1
labjack-amplifier     voltage_ain              0     0   13
labjack-amplifier     current_ain              1     0   13
labjack-amplifier     enable_line              None  0   22
labjack-amplifier     watchdog_s               3     1   60
labjack-amplifier     proof_V                  50.0  (0  55
labjack-amplifier     proof_tolerance          0.15  (0  0.5
labjack-amplifier     poll_rate_Hz             20.0  2   100
labjack-force         timeout_s                0.25  (0  10
labjack-force         boot_s                   10.0  0   60
labjack-force         tcp_port                 502   1   65535
labjack-force         ain                      2     0   13
labjack-force         newtons_per_V            needed - -
labjack-force         rate_Hz                  50.0  (0  200
labjack-displacement  timeout_s                0.25  (0  10
labjack-displacement  boot_s                   10.0  0   60
labjack-displacement  tcp_port                 502   1   65535
labjack-displacement  ain                      3     0   13
labjack-displacement  mm_per_V                 needed - -
labjack-displacement  rate_Hz                  50.0  (0  200
labjack-monitor       timeout_s                0.25  (0  10
labjack-monitor       boot_s                   10.0  0   60
labjack-monitor       tcp_port                 502   1   65535
labjack-monitor       ain                      4     0   13
labjack-monitor       rate_Hz                  5.0   0.05 100
labjack-monitor       factor                   1.0   -   -
labjack-monitor       offset                   0.0   -   -
labjack-monitor       agrees_within_V          50.0  (0  -
labjack-monitor       agrees_within_percent    5.0   0   50
labjack-monitor       lag_s                    0.5   0   5
scpi                  timeout_s                1.0   (0  10
scpi                  boot_s                   10.0  0   60
scpi                  tcp_port                 5025  1   65535
scpi                  rate_Hz                  2.0   0.05 100
scpi                  factor                   1.0   -   -
scpi                  offset                   0.0   -   -
scpi                  agrees_within_V          50.0  (0  -
scpi                  agrees_within_percent    5.0   0   50
scpi                  lag_s                    0.5   0   5
ascii-stream:monitor  timeout_s                0.25  (0  10
ascii-stream:monitor  baud                     115200 (0 -
ascii-stream:monitor  rate_Hz                  5.0   0.05 100
ascii-stream:monitor  columns                  1     1   32
ascii-stream:monitor  column                   1     1   32
ascii-stream:monitor  factor                   1.0   -   -
ascii-stream:monitor  limit                    10000.0 (0 -
ascii-stream:monitor  boot_s                   3.0   0   30
ascii-stream:monitor  offset                   0.0   -   -
ascii-stream:monitor  agrees_within_V          50.0  (0  -
ascii-stream:monitor  agrees_within_percent    5.0   0   50
ascii-stream:monitor  lag_s                    0.5   0   5
ascii-stream          timeout_s                0.25  (0  10
ascii-stream          baud                     115200 (0 -
ascii-stream          rate_Hz                  80.0  (0  1000
ascii-stream          columns                  1     1   32
ascii-stream          column                   1     1   32
ascii-stream          factor                   1.0   -   -
ascii-stream          limit                    10000.0 (0 -
ascii-stream          boot_s                   3.0   0   30
optoncdt-1420         timeout_s                0.25  (0  10
optoncdt-1420         boot_s                   10.0  0   60
optoncdt-1420         baud                     921600 (0 -
optoncdt-1420         measuring_range_mm       50.0  (0  -
optoncdt-1420         rate_Hz                  250.0 (0  4000
optoncdt-1420         first_error_word         262073 65521 262143
"""
# What must be said beside.
NEEDED: dict[str, dict[str, Any]] = {
    "labjack-amplifier": {"preset": "trek-610e"},
    "labjack-force": {"newtons_per_V": 1.0},
    "labjack-displacement": {"mm_per_V": 1.0},
    **{key: {"quantity": "humidity"} for key in ("labjack-monitor", "scpi", "ascii-stream:monitor")},
}
ROWS = [line.split() for line in DOCUMENTED.strip().splitlines()]


def name_of(one: Instrument) -> str:
    """Its driver; where a monitor has that of another role, both."""
    shared = one.role == "monitor" and len([other for other in INSTRUMENTS if other.driver == one.driver]) > 1
    return f"{one.driver}:monitor" if shared else one.driver


def settings_of(driver: str) -> type[InstrumentSettings]:
    return next(one.settings for one in INSTRUMENTS if name_of(one) == driver)


def numeric(field: FieldInfo) -> bool:
    return bool(kinds(field.annotation) & {int, float})


def kinds(annotation: Any) -> set[Any]:
    """The types that an annotation is made of; constants are none."""
    if get_origin(annotation) is Literal:
        return set()
    arguments = get_args(annotation)
    return {annotation} | {kind for one in arguments if isinstance(one, type) or get_args(one) for kind in kinds(one)}


def usual(driver: str) -> dict[str, Any]:
    """The keys that must be there."""
    return {"driver": driver.partition(":")[0], "certificate": "c.toml", **NEEDED.get(driver, {})}


def accepts(driver: str, key: str, value: Any) -> bool:
    """Whether a scene may say it, the other keys being as usual."""
    table = {**usual(driver), key: value}
    if key in ("voltage_ain", "current_ain"):
        table["current_ain" if key == "voltage_ain" else "voltage_ain"] = 5
    if driver.startswith("ascii-stream") and key == "column":
        table["columns"] = 32
    if driver == "cia404" and key == "factor":
        table["unit"] = "N"
    try:
        settings_of(driver).model_validate(table)
    except ValidationError:
        return False
    return True


@pytest.mark.parametrize("one", INSTRUMENTS, ids=lambda one: one.driver)
def test_every_key_is_described(one: Instrument) -> None:
    for name, field in one.settings.model_fields.items():
        assert field.description and len(field.description) > 10, f"{one.driver}: {name} has no description"
        assert field.description.endswith("."), name
        for unit in ("_Hz", "_um", "_mm", "_N", "_s", "_nF"):
            if name.endswith(unit) and "per" not in name:
                assert f"({unit[1:]}" in field.description, (
                    f"{one.driver}: the unit of {name} is not in its description"
                )


def test_every_number_is_documented_here() -> None:
    built_in = [one for one in INSTRUMENTS if one.settings.__module__.startswith("drivers.")]
    keys = {(name_of(one), name) for one in built_in for name, f in one.settings.model_fields.items() if numeric(f)}
    assert {(driver, key) for driver, key, *_ in ROWS} == keys


@pytest.mark.parametrize(("driver", "key", "default", "low", "high"), ROWS)
def test_default_and_range_are_the_documented_ones(driver: str, key: str, default: str, low: str, high: str) -> None:
    field = settings_of(driver).model_fields[key]
    assert repr(field.default) == default or (field.is_required() and default == "needed")
    whole = int in kinds(field.annotation)

    def beside(text: str, way: float) -> Any:
        number = float(text)
        return int(number + way) if whole else math.nextafter(number, math.copysign(math.inf, way))

    def at(text: str) -> Any:
        return int(text) if whole else float(text)

    if low.startswith("("):
        assert not accepts(driver, key, at(low[1:])) and accepts(driver, key, beside(low[1:], +1))
    elif low != "-":
        assert accepts(driver, key, at(low)) and not accepts(driver, key, beside(low, -1))
    if high != "-":
        assert accepts(driver, key, at(high)) and not accepts(driver, key, beside(high, +1))
    if not whole:
        assert not accepts(driver, key, math.nan) and not accepts(driver, key, math.inf)


@pytest.mark.parametrize("one", INSTRUMENTS, ids=lambda one: one.driver)
def test_no_key_of_another_instrument_is_taken(one: Instrument) -> None:
    keys = {name for other in INSTRUMENTS for name in other.settings.model_fields} - set(one.settings.model_fields)
    table = usual(name_of(one))
    TypeAdapter(one.settings).validate_python(table)
    for key in (*keys, "no_such_key"):
        with pytest.raises(ValidationError, match="Extra inputs"):
            one.settings.model_validate({**table, key: 1})


@pytest.mark.parametrize("one", INSTRUMENTS, ids=lambda one: one.driver)
def test_what_names_its_port_makes_it_connected(one: Instrument) -> None:
    table = usual(name_of(one))
    assert not one.settings.model_validate(table).connected
    where = {"port": "p", "interface": "virtual", "can_channel": "c", "host": "127.0.0.1"}
    placed = one.settings.model_validate({**table, **{key: where[key] for key in one.settings.place_keys}})
    assert placed.connected
    assert placed.sample_rate == getattr(placed, one.settings.rate_key) > 0


@pytest.mark.parametrize("key", ["interface", "can_channel"])
def test_an_adapter_and_its_channel_come_together(key: str) -> None:
    for driver in ("cia404", "iseg-edcp"):
        assert not accepts(driver, key, "virtual")


def test_a_factor_needs_a_unit_and_is_not_0() -> None:
    table = {"driver": "cia404", "certificate": "c.toml"}
    settings = settings_of("cia404")
    settings.model_validate({**table, "factor": 2.0, "unit": "N"})
    settings.model_validate({**table, "unit": "mV/V"})
    for wrong, word in (({"factor": 2.0}, "unit"), ({"factor": 0.0, "unit": "N"}, "must not be 0")):
        with pytest.raises(ValidationError, match=word):
            settings.model_validate({**table, **wrong})
