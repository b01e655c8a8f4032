"""From the log of a calibration to the characteristic of one instrument. A log of last year does as well as today's."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime
from hashlib import sha256
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.sensors.sensor import Characteristic, SensorError, Standstill, characterise
from drivers.roles import Identity
from rig.base.errors import DataError
from rig.base.toml_file import parse_table
from rig.log.contents import identities_in
from rig.log.dataset import Phase, Run, load_run
from rig.protocol.protocol import Protocol
from rig.steps.meter import Meter
from rig.steps.weigh import Weigh

Quantity = Literal["force", "displacement", "hv", "compliance", "timing"]
QUANTITIES: tuple[Quantity, ...] = ("force", "displacement", "compliance", "hv", "timing")
ROLE = {"force": "force", "displacement": "displacement", "hv": "hv", "compliance": "stage"}
UNIT = {"force": "N", "displacement": "m", "hv": "V", "compliance": "m"}
_STEP = {"force": "weigh", "displacement": "visit", "hv": "meter", "compliance": "press"}
_COLUMN = {"force": "reading", "displacement": "reading_m", "hv": "voltage_V"}

Floats = NDArray[np.float64]

# Standard uncertainty of the time stamps themselves: request and reply on the stage's line differ in length, and
# nobody can tell when between them the position was taken.
STAMP_S = 1e-3
SEEN = 3.0  # a reading that changes by fewer standard deviations of its noise did not follow the stage
EDGE = 0.15  # this part of a way at either end is left out: the stage accelerates there


@dataclass(frozen=True)
class Lag:
    """By how much one sensor's samples lag behind the stage's (s), with standard uncertainty.

    ``standing`` is the part of the difference between the two ways that does not depend on speed, in metres of the
    stage: hysteresis.
    """

    role: str
    lag: float
    uncertainty: float
    standing: float


@dataclass(frozen=True)
class Calibration:
    """What one log says of one quantity.

    Attributes
    ----------
    quantity
        force, displacement, compliance, hv or timing.
    characteristic : Characteristic or None
        None for timing. For compliance its ``gain`` is the rig's stiffness (N/m).
    creep : float or None
        Change of the reading under the heaviest weight (N), where the log holds such a hold.
    lags : dict of str to Lag
        By role, where the log holds ways to and fro.
    instrument, serial : str
        As the instrument stated them.
    made : date
    data_sha256 : str
        Of the log.
    reading_unit : str
    """

    quantity: Quantity
    characteristic: Characteristic | None
    creep: float | None
    lags: dict[str, Lag]
    instrument: str
    serial: str
    made: date
    data_sha256: str
    reading_unit: str
    path: Path


def calibrate(path: Path, quantity: Quantity) -> Calibration:
    """Work out ``quantity`` from the log at ``path``.

    Raises
    ------
    DataError, LogError
        When the log does not hold what is needed.
    """
    run = load_run(path, latency={})  # the lags of the sensors are what may be asked for
    role = ROLE.get(quantity, "")
    lags = _lags(run)
    characteristic, creep = None, None
    if quantity == "timing":
        if not lags:
            raise DataError(f"{path}: the log holds no glide step in which laser or force followed the stage.")
    else:
        try:
            characteristic = characterise(standstills(run, quantity), common_uncertainties(run, quantity))
        except SensorError as error:
            raise DataError(f"{path}: {quantity} cannot be calibrated from this log. {error}") from None
        creep = _creep(run) if quantity == "force" else None
    stated = identities_in(run.log).get(role, Identity())
    return Calibration(
        quantity=quantity,
        characteristic=characteristic,
        creep=None if creep is None or characteristic is None else creep * characteristic.gain,
        lags=lags,
        instrument=stated.model,
        serial=stated.serial,
        made=datetime.fromtimestamp(run.log.start_ns * 1e-9, UTC).date(),
        data_sha256=sha256(path.read_bytes()).hexdigest(),
        reading_unit=run.log.metadata.get("units", {}).get("/force/sample reading", "mV/V")
        if quantity == "force"
        else UNIT.get(quantity, ""),
        path=path,
    )


def standstills(run: Run, quantity: Quantity) -> list[Standstill]:
    """Every standstill of the run; cycle 0 is preloading and is left out.

    Raises
    ------
    SensorError
        When there is none.
    """
    t, readings = _readings(run, quantity)
    mine_are = {number for number, step in enumerate(_protocol(run).step, start=1) if step.kind == _STEP[quantity]}
    applied = [one for one in run.references if one.name == "applied" and one.unit == UNIT[quantity]]
    found = []
    for phase, end in _phases(run, "standstill"):
        if phase.cycle == 0 or phase.step not in mine_are:
            continue
        inside = (t >= phase.t) & (t < end)
        standards = [one for one in applied if phase.t <= one.t <= end]
        if not standards or np.count_nonzero(inside) < 2:
            continue
        standard, mine = standards[-1], readings[inside]
        mean, scatter = float(mine.mean()), float(mine.std(ddof=1))
        # What a force costs in the stage's way is the compliance: there the stage stands in the place of the reading.
        pressed = quantity == "compliance"
        found.append(
            Standstill(
                applied=mean if pressed else standard.value,
                applied_error=standard.standard_uncertainty,
                standard=phase.label,
                reading=standard.value if pressed else mean,
                scatter=0.0 if pressed else scatter,
                count=int(mine.size),
                t=float(t[inside].mean()),
                cycle=phase.cycle,
                direction=phase.direction,
            )
        )
    if not found:
        raise SensorError(f"It holds no standstill of a {_STEP[quantity]} step.")
    if quantity == "displacement":  # it is ways that are compared: the stage's own origin means nothing to the laser
        start = min(one.applied for one in found)
        found = [replace(one, applied=one.applied - start) for one in found]
    if quantity == "compliance":
        # The stage's own error, as the force that it is worth.
        per_metre = abs(1 / np.polyfit([one.applied for one in found], [one.reading for one in found], 1)[0])
        found = [replace(one, applied_error=one.applied_error * per_metre) for one in found]
    return found


def _protocol(run: Run) -> Protocol:
    return parse_table(run.protocol, Protocol, "protocol", f"{run.log.path} (protocol inside)")


def _readings(run: Run, quantity: Quantity) -> tuple[Floats, Floats]:
    """Times and readings that the instrument itself calls good."""
    role = "force" if quantity == "compliance" else quantity
    topic = f"/{role}/sample"
    if topic not in run.log.topics:
        raise SensorError(f"It holds no samples of {role}.")
    table = run.log.tables([topic])[topic]
    good = table["flags"] == 0 if role != "hv" else np.ones(len(table["t_s"]), dtype=bool)
    values = table["force_N" if quantity == "compliance" else _COLUMN[role]][good]
    if role == "hv":
        used = run.certificates.get("hv")
        values = values / (used.gain if used is not None else 1.0)
    return table["t_s"][good], values


def _phases(run: Run, kind: str) -> list[tuple[Phase, float]]:
    """The phases of ``kind`` with the time at which the next one begins."""
    pairs = zip(run.phases, run.phases[1:], strict=False)
    return [(phase, after.t) for phase, after in pairs if phase.kind == kind]


def common_uncertainties(run: Run, quantity: Quantity) -> dict[str, float]:
    """Relative standard uncertainties that all standards of ``quantity`` share, from the protocol in the log."""
    if quantity == "compliance":
        force = run.certificates.get("force")
        return {"force certificate": force.gain_uncertainty} if force is not None else {}
    common: dict[str, float] = {}
    for step in _protocol(run).step:
        if isinstance(step, Weigh) and quantity == "force":
            common["local gravity"] = step.gravity_uncertainty_m_per_s2 / step.gravity_m_per_s2
            # A tenth of the buoyancy: air pressure, temperature and humidity as in any laboratory.
            common["air buoyancy"] = 0.1 * step.air_density_kg_per_m3 / step.density_kg_per_m3
        elif isinstance(step, Meter) and quantity == "hv":
            common["reference meter"] = step.meter_relative_uncertainty
    return common


def _creep(run: Run) -> float | None:
    """Change of the reading from the first to the last tenth of the hold under the heaviest weight."""
    found = None
    for phase, end in _phases(run, "creeping"):
        t, readings = _readings(run, "force")
        inside = (t >= phase.t) & (t < end)
        tenth = np.count_nonzero(inside) // 10
        if tenth >= 1:
            mine = readings[inside]
            found = float(mine[-tenth:].mean() - mine[:tenth].mean())
    return found


def _lags(run: Run) -> dict[str, Lag]:
    """Lags behind the stage, from the ways to and fro at several speeds.

    At one position x of the stage a sensor that lags by tau reads y(x - v tau): the ways up and down differ by
    ``-2 v tau y'(x)``, and by a hysteresis that does not depend on the speed. Both come from the pairs of ways by
    least squares; their scatter gives the uncertainty.
    """
    ways = _phases(run, "way")
    found = {}
    stage = run.log.tables(["/stage/sample"])["/stage/sample"] if ways else None
    for role in ("force", "displacement"):
        if stage is None or f"/{role}/sample" not in run.log.topics:
            continue
        t, readings = _readings(run, "force" if role == "force" else "displacement")
        pairs = [
            pair
            for (up, up_end), (down, down_end) in zip(ways[::2], ways[1::2], strict=False)
            if up.direction == 1 and down.direction == -1 and up.cycle == down.cycle
            and (pair := _differ(stage, t, readings, (up.t, up_end), (down.t, down_end))) is not None
        ]  # fmt: skip
        if len(pairs) < 3:
            continue
        speed, difference = np.array(pairs).T
        columns = np.stack([2 * speed, np.ones_like(speed)], axis=1)
        (lag, standing), *_ = np.linalg.lstsq(columns, -difference, rcond=None)
        rest = -difference - columns @ [lag, standing]
        freedom = max(len(pairs) - 2, 1)
        covariance = np.linalg.inv(columns.T @ columns) * float(rest @ rest) / freedom
        statistical = _student(freedom) * math.sqrt(covariance[0, 0])
        found[role] = Lag(role, float(lag), math.hypot(statistical, STAMP_S), float(standing))
    return found


def _differ(
    stage: dict[str, Floats], t: Floats, readings: Floats, up: tuple[float, float], down: tuple[float, float]
) -> tuple[float, float] | None:
    """Speed, and the mean difference of the readings at one position (up minus down) in metres of the stage."""
    both = []
    for begin, end in (up, down):
        when = (stage["t_s"] >= begin) & (stage["t_s"] <= end)
        during = (t >= begin) & (t <= end)
        if np.count_nonzero(when) < 5 or np.count_nonzero(during) < 10:
            return None
        x = np.interp(t[during], stage["t_s"][when], stage["position_m"][when])
        both.append((x, t[during], readings[during]))
    low = max(x.min() for x, _, _ in both)
    high = min(x.max() for x, _, _ in both)
    low, high = low + EDGE * (high - low), high - EDGE * (high - low)
    degree = 5
    fits, speeds = [], []
    for x, times, y in both:
        inner: NDArray[np.bool_] = (x >= low) & (x <= high)
        if np.count_nonzero(inner) < 2 * degree:
            return None
        fit = np.polynomial.Chebyshev.fit(x[inner], y[inner], degree, domain=(low, high))
        if not np.ptp(fit(x[inner])) > SEEN * np.std(fit(x[inner]) - y[inner]):
            return None  # the sensor did not follow the stage, so it says nothing of time
        fits.append(fit)
        speeds.append(abs(np.polyfit(times[inner], x[inner], 1)[0]))
    at = np.linspace(low, high, 50)
    slope = 0.5 * (fits[0].deriv()(at) + fits[1].deriv()(at))
    # Weighed by the slope: where the reading does not change with position a lag does not show.
    difference = float(np.sum((fits[0](at) - fits[1](at)) * slope) / np.sum(slope * slope))
    return float(np.mean(speeds)), difference


def _student(freedom: int) -> float:
    """Widens a standard error from few pairs so that two of it cover 95 % (GUM, table G.2)."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.975)) / 1.96
