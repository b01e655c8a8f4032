"""The verdict of a daily one-point check: a sensor's answer to one standard, held against its certificate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from calibration.sensors.sensor import COVERAGE, SensorError, Standstill
from rig.analysis import sensors as analysis
from rig.analysis.sensors import ROLE, UNIT, Quantity
from rig.base.errors import DataError
from rig.log.dataset import load_run


@dataclass(frozen=True)
class Verdict:
    """A one-point check: what was applied and what the calibrated sensor said, with the normalised error E_n.

    ``|E_n| <= 1`` means that both agree within their expanded uncertainties (ISO 13528).
    """

    unit: str
    applied: float
    measured: float
    uncertainty: float

    @property
    def normalised_error(self) -> float:
        """(measured - applied) / U."""
        return (self.measured - self.applied) / self.uncertainty

    @property
    def passed(self) -> bool:
        """Whether the certificate still holds; False for NaN."""
        return abs(self.normalised_error) <= 1


def judge(log: Path, quantity: Quantity) -> Verdict:
    """The verdict that the log of a one-point check supports."""
    run = load_run(log, {})
    certificate = run.certificates.get(ROLE[quantity])
    if certificate is None:
        raise DataError(f"{log}: no certificate of {quantity} was used; there is nothing to hold the check against.")
    try:
        standstills = analysis.standstills(run, quantity)
    except SensorError as error:
        raise DataError(f"{log}: {error}") from None
    # A meter reads some volts without voltage too: what is nearer to nothing than to the standard is its absence.
    middle = 0.5 * max(abs(one.applied) for one in standstills)
    none = [one for one in standstills if abs(one.applied) < middle]
    some = [one for one in standstills if abs(one.applied) >= middle]
    if not (none and some):
        raise DataError(f"{log}: the check needs a standard and its absence.")

    def mean(values: list[float]) -> float:
        return math.fsum(values) / len(values)

    def noise(group: list[Standstill]) -> float:
        """Standard error of the group's mean reading."""
        return math.sqrt(sum(one.scatter**2 / one.count for one in group)) / len(group)

    applied = mean([one.applied for one in some]) - mean([one.applied for one in none])
    reading = mean([one.reading for one in some]) - mean([one.reading for one in none])
    measured = certificate.gain * reading
    common = math.hypot(*analysis.common_uncertainties(run, quantity).values())
    parts = (
        certificate.gain_uncertainty * measured,
        certificate.zero_uncertainty,
        certificate.gain * math.hypot(noise(some), noise(none)),
        math.hypot(some[0].applied_error, none[0].applied_error),
        common * applied,
    )
    return Verdict(UNIT[quantity], applied, measured, COVERAGE * math.hypot(*parts))
