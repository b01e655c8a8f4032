"""Writes a certificate with its evidence: a plain TOML file that `calibration.sensors.certificate` reads."""

from __future__ import annotations

import json
import os
import re
from datetime import timedelta
from pathlib import Path
from typing import Any

from rig.analysis.sensors import ROLE, UNIT, Calibration, Quantity

VALID_DAYS = 365
_TABLE, _CERTIFICATE = re.compile(r"\s*\[([^\[\]]+)\]"), re.compile(r"\s*certificate\s*=")


def certificate_place(scene: Path | None, quantity: Quantity, certificate: Path | None = None) -> str:
    """Which line of which scene names the certificate of a quantity, and what belongs there; for people."""
    role = ROLE[quantity]
    if scene is None:
        return f'For the scene: [{role}], certificate = "{certificate}", as seen from the scene.'
    table, number, now = "", 0, ""
    for at, line in enumerate(scene.read_text(encoding="utf-8").splitlines(), 1):
        if heading := _TABLE.match(line):
            table = heading[1].strip()
        elif table == role and _CERTIFICATE.match(line):
            number, now = at, line.split("=", 1)[1].strip()
    if certificate is None:
        return f"and name the new one in {scene}, line {number}, [{role}] (now {now})."
    new = f"certificate = {json.dumps(os.path.relpath(certificate, scene.parent), ensure_ascii=False)}"
    if not number:
        return f"For the scene {scene}: add to [{role}]: {new}"
    return f"For the scene {scene}, line {number}, [{role}]: {new}  (now {now})"


def certificate_text(calibration: Calibration, valid_days: int = VALID_DAYS) -> str:
    """The certificate of what `rig.analysis.sensors.calibrate` found; not for timing, which no certificate is of."""
    found = calibration.characteristic
    assert found is not None
    role, unit = ROLE[calibration.quantity], UNIT[calibration.quantity]
    lines = [
        f"# {role} calibrated by `dea-rig calibrate {calibration.quantity}` from {calibration.path.name}.",
        _row("format", "dea-rig certificate 1"),
        _row("role", role),
        _row("instrument", calibration.instrument or role),
        _row("serial", calibration.serial),
        f"valid_from = {calibration.made.isoformat()}",
        f"valid_until = {(calibration.made + timedelta(days=valid_days)).isoformat()}",
        _row("method", f"dea-rig calibrate {calibration.quantity}: {len(found.standstills)} standstills"),
        _row("data_sha256", calibration.data_sha256),
    ]
    if calibration.quantity == "compliance":
        compliance = abs(1 / found.gain)
        lines += [
            _row("compliance_m_per_N", compliance),
            _row("compliance_uncertainty_m_per_N", compliance * found.gain_uncertainty),
            f"range_N = [{_number(found.low)}, {_number(found.high)}]",
        ]
    else:
        per = calibration.reading_unit.replace("/", "_per_")
        ends = sorted(abs(found.gain) * one.reading for one in found.standstills)
        low, high = (ends[0], ends[-1]) if calibration.quantity == "displacement" else (min(found.low, 0.0), found.high)
        lines += [
            _row(f"gain_{unit}_per_{per}", found.gain),
            _row("gain_relative_uncertainty", found.gain_uncertainty),
            _row(f"noise_{unit}", found.noise),
            _row(f"zero_uncertainty_{unit}", found.zero_uncertainty),
            f"range_{unit} = [{_number(low)}, {_number(high)}]",
            *([_row(f"zero_reading_{per}", found.zero)] if calibration.quantity == "force" else []),
        ]
    lag = calibration.lags.get(role)
    if lag is not None:
        lines += [_row("lag_s", lag.lag), _row("lag_uncertainty_s", lag.uncertainty)]
    lines += ["", "[findings]", *(_row(key, value) for key, value in findings(calibration).items())]
    for part in found.budget:
        lines += ["", "[[budget]]", _row("component", part.name), _row("type", part.type)]
        lines += [_row("relative", part.relative), _row("note", part.note)]
    for one, residual in zip(found.standstills, found.residuals.tolist(), strict=True):
        row = {"standard": one.standard, "applied": one.applied, "reading": one.reading, "residual": residual,
               "t_s": one.t, "cycle": one.cycle, "direction": one.direction}  # fmt: skip
        lines += ["", "[[standstill]]", *(_row(key, value) for key, value in row.items())]
    return "\n".join(lines) + "\n"


def findings(calibration: Calibration) -> dict[str, float]:
    """What else was found, with units in the names."""
    found, unit = calibration.characteristic, UNIT[calibration.quantity]
    assert found is not None
    values: dict[str, float] = {
        "polynomial_order": found.order,
        f"expanded_uncertainty_at_upper_end_{unit}": found.expanded_uncertainty(found.high),  # k = 2
        f"hysteresis_{unit}": found.hysteresis,
        f"repeatability_{unit}": found.repeatability,
        f"linearity_{unit}": found.linearity,
        "zero_in_readings": found.zero,
        "drift_in_readings_per_hour": found.drift * 3600,
    }
    if calibration.quantity == "compliance":
        return {key: value for key, value in values.items() if key == "polynomial_order"}
    if calibration.creep is not None:
        values["creep_N"] = calibration.creep
    return values


def _row(key: str, value: Any) -> str:
    if isinstance(value, str):
        return f"{key} = {json.dumps(value, ensure_ascii=False)}"
    return f"{key} = {_number(value)}"


def _number(value: float) -> str:
    return repr(int(value)) if isinstance(value, int) else f"{float(value):.8g}"
