"""A small log of everything that a log can hold."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rig.log.writer import LogWriter

START_NS = 1_577_836_800_000_000_000

# One message of every topic but the raw ones; the values are awkward on purpose.
SAMPLES: dict[str, dict[str, Any]] = {
    "/stage/sample": {
        "position_m": 1.5e-3,
        "moving": True,
        "referenced": False,
        "raw_steps": -31496,
        "warnings": "WR FQ",
    },
    "/force/sample": {"reading": -0.0, "force_N": 0.1, "flags": 4},
    "/displacement/sample": {"reading_m": 0.0, "displacement_m": 5e-324, "flags": 0},
    **{
        f"/{name}/sample": {"voltage_V": 0.5, "temperature_K": 296.1, "relative_humidity": 0.4, "flags": 1}
        for name in ("monitor", "monitor_2", "monitor_3")
    },
    "/hv/sample": {"voltage_V": 1499.75, "current_A": 1e-9, "setpoint_V": 1500.0, "flags": 1023},
    "/target": {"displacement_m": 2e-3, "voltage_V": 1500.0, "speed_m_per_s": 1e-4},
    "/phase": {
        "step": 3,
        "kind": "sweep",
        "label": "up · 1500 V",
        "cycle": 1,
        "direction": -1,
        "voltage_V": 1500.0,
        "record": True,
    },
    "/reference": {"name": "force_zero", "value": 0.0123, "standard_uncertainty": 1e-5, "unit": "mV/V"},
    "/decision": {
        "t_s": 12.0,
        "step": 5,
        "number": 2,
        "outcome": "go",
        "reason": "tells most per second",
        "displacement_m": 3.8e-3,
        "voltage_V": 1710.0,
        "hold_s": 8.0,
        "quantity": "eps_r",
        "value": 1.7,
        "standard_uncertainty": 0.02,
        "unit": "1",
        "relative_uncertainty": 0.012,
        "wanted_uncertainty": 0.005,
        "spent_s": 31.5,
        "expected_s": 40.0,
    },
    "/standing": {
        "t_s": 12.0,
        "step": 5,
        "number": 2,
        "quantity": "stiffness",
        "value": 1.2e5,
        "standard_uncertainty": 900.0,
        "unit": "Pa",
        "relative_uncertainty": 0.0075,
        "wanted_uncertainty": 0.01,
        "outcome": "met",
        "reason": "known well enough by two fits in a row",
    },
    "/result": {
        "step": 4,
        "kind": "breakdown",
        "outcome": "breakdown",
        "name": "voltage",
        "value": 1412.5,
        "standard_uncertainty": 3.0,
        "unit": "V",
    },
    "/cycle": {
        "step": 4,
        "cycle": 1_000_000_000,
        "whole": True,
        "kept": False,
        "begin_s": 12.5,
        "samples": 100,
        "force_valley_N": 1e-3,
        "force_peak_N": 0.2,
        "displacement_valley_m": 0.0,
        "displacement_peak_m": 5e-3,
        "voltage_valley_V": 0.0,
        "voltage_peak_V": 800.0,
        "current_valley_A": -1e-9,
        "current_peak_A": 1e-7,
        "stiffness_N_per_m": 40.0,
        "actuation_N_per_V2": -1e-8,
        "work_J": 1e-6,
        "electric_J": 1e-5,
        "leakage_A": 4e-8,
    },
    "/kept": {"keeping": True, "before_s": 2.0, "cause": "cycle 100"},
    "/command": {"device": "stage", "command": "move_to", "argument": "2.0 mm"},
    "/operator": {"act": "answers", "text": "yes, by Jove: 3", "by": "the keyboard"},
    "/identity": {"device": "hv", "model": "iseg, serial 3", "serial": "484216", "firmware": ""},
    "/setting": {"device": "hv", "name": "ramp_percent_per_s", "value": "10"},
    "/certificate_problem": {"device": "hv", "problem": "valid until 2026-01-01"},
    "/counter": {"device": "hv", "name": "retries", "count": 3},
    "/event": {"severity": "warning", "source": "force", "message": "“over range”"},
    "/raw/hv/rx": {"data": b"\x02\x58\x00\xff"},
}


def write_small(path: Path, n: int = 20) -> None:
    """``n`` rounds of `SAMPLES`, 40 ms apart, with an attachment, metadata and an outcome."""
    with LogWriter(path) as log:
        log.attach("scene.toml", "application/toml", b'title = "small"\n')
        log.metadata("run", {"scene": "small"})
        for k in range(n):
            t = k * 0.04
            ns = START_NS + k * 40_000_000
            for topic, fields in SAMPLES.items():
                log.write(topic, {"t_s": t, **fields}, ns + 7, ns)
            log.tick(t)
        log.finish({"reason": "complete"})


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "small.mcap"
    write_small(path)
    return path


@pytest.fixture
def write_log() -> Callable[[Path, int], None]:
    return write_small


@pytest.fixture
def samples() -> dict[str, dict[str, Any]]:
    return SAMPLES
