"""The certificate of one instrument: what turns its readings into quantities, how well, from when until when.

A certificate is a small TOML file, kept beside the scenes that use it and attached byte for byte to every log::

    format = "dea-rig certificate 1"
    role = "force"                       # force | displacement | hv
    instrument = "GSV-8 with 1 N cell"
    serial = "12345678"                  # as the instrument states it; "" if it states none
    valid_from = 2025-01-01
    valid_until = 2026-01-01
    gain_N_per_mV_per_V = 0.5            # quantity = gain * (reading - reading at zero)
    gain_relative_uncertainty = 1e-3     # standard uncertainty (k = 1), as are all others
    noise_N = 5e-3                       # standard deviation of one sample
    zero_uncertainty_N = 2e-4            # of a zero taken before the run, drift until its end included
    zero_reading_mV_per_V = 0.013        # optional: the unloaded sensor when it was calibrated, its stored zero
    range_N = [-1.0, 1.0]                # calibrated range; no extrapolation

A force sensor that states newtons itself has ``gain_N_per_N`` and ``zero_reading_N`` instead. The keys of a
displacement certificate end in ``_m`` with ``gain_m_per_m``, those of an HV certificate in ``_V`` with
``gain_V_per_V``. A stage's certificate has the rig's ``compliance_m_per_N`` and ``compliance_uncertainty_m_per_N`` in
place of gain, noise and zero.

``lag_s`` and ``lag_uncertainty_s`` say by how much a sample's time stamp is later than what it shows. A certificate
that `dea-rig calibrate` wrote also holds its evidence: ``data_sha256`` of the log, ``[findings]``, ``[[budget]]`` and
``[[standstill]]``; they are for people and change nothing in how it is used.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from datetime import date
from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

FORMAT = "dea-rig certificate 1"

Role = Literal["force", "displacement", "hv", "stage"]


@dataclass(frozen=True)
class Certificate:
    """A certificate as read, in SI units.

    Attributes
    ----------
    role, instrument, serial, valid_from, valid_until
        As in the file.
    gain : float
        Quantity (N, m, V) per unit of the reading.
    reading_unit : str
        Unit of the reading that the gain is for: "mV/V" or "N", "m", "V".
    gain_uncertainty : float
        Relative standard uncertainty of the gain.
    noise, zero_uncertainty : float
        Standard deviation of one sample; standard uncertainty of a zero (N, m, V).
    stored_zero : float or None
        Reading of the unloaded force sensor when it was calibrated, with which the sensor's serial number and the date
        stand in this file: the force limit holds against it, whatever zero a run takes.
    low, high : float
        Ends of the calibrated range (N, m, V).
    name : str
        File name, for messages.
    raw : bytes
        The file itself, byte for byte.
    lag, lag_uncertainty : float
        By how much a sample's time stamp is later than what it shows (s), and the standard uncertainty of that.
    compliance, compliance_uncertainty : float
        Of the rig (m/N); a stage's certificate only.
    """

    role: Role
    instrument: str
    serial: str
    valid_from: date
    valid_until: date
    gain: float
    reading_unit: str
    gain_uncertainty: float
    noise: float
    zero_uncertainty: float
    stored_zero: float | None
    low: float
    high: float
    name: str
    raw: bytes
    lag: float = 0.0
    lag_uncertainty: float = 0.0
    compliance: float = 0.0
    compliance_uncertainty: float = 0.0

    @property
    def sha256(self) -> str:
        """SHA-256 of the exact bytes, in hexadecimal."""
        return hashlib.sha256(self.raw).hexdigest()

    def check(self, serial: str, today: date) -> list[str]:
        """What speaks against using this certificate today for the instrument that states ``serial``.

        An instrument that states no serial number (``""``) cannot be told from another one; only the dates are
        checked then. An empty list means: nothing speaks against it.
        """
        problems = []
        if not self.valid_from <= today:
            problems.append(
                f"{self.name}: the {self.role} certificate is valid from {self.valid_from}, not yet {today}"
            )
        if not today <= self.valid_until:
            problems.append(f"{self.name}: the {self.role} certificate expired on {self.valid_until}; today is {today}")
        if serial and serial != self.serial:
            problems.append(
                f"{self.name}: the {self.role} certificate is for serial number {self.serial or '(none)'}, "
                f"the instrument says {serial}"
            )
        return problems

    def covers(self, quantity: float) -> bool:
        """Whether ``quantity`` (N, m, V) lies in the calibrated range; nan does not."""
        return self.low <= quantity <= self.high


def _rising(ends: list[float]) -> list[float]:
    if not ends[0] < ends[1]:
        raise ValueError("the range must run from the lower to the higher end")
    return ends


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Relative = Annotated[float, Field(ge=0, lt=1)]
Range = Annotated[list[float], Field(min_length=2, max_length=2), AfterValidator(_rising)]
Text = Annotated[str, Field(min_length=1, max_length=200)]

GAIN_UNCERTAINTY = "Relative standard uncertainty of the gain (k = 1). Typical: 0.0005 to 0.01."
RANGE = "Calibrated range, lower and higher end; nothing is measured beyond it."


class BudgetLine(BaseModel):
    """One component of the gain's uncertainty; for people, it changes nothing."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    component: Text = Field(description="Name of the component of uncertainty.")
    type: Literal["A", "B"] = Field(description="A: evaluated from repeated readings. B: from other knowledge (GUM).")
    relative: NotNegative = Field(description="Its standard uncertainty over the gain (k = 1).")
    note: Annotated[str, Field(max_length=200)] = Field(default="", description="Where it comes from.")


class AnyFile(BaseModel):
    """What every certificate file has."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    format: Literal["dea-rig certificate 1"] = Field(description="Which format the file has.")
    instrument: Text = Field(description="Make and model of the instrument that was calibrated.")
    serial: Annotated[str, Field(max_length=64)] = Field(
        description='Serial number as the instrument states it; "" if it states none.'
    )
    valid_from: date = Field(description="First day on which the certificate is valid, without quotes: 2026-01-31.")
    valid_until: date = Field(description="Last day on which it is valid; a later run notes it in its log.")
    method: Text | None = Field(default=None, description="How the values were found, in words.")
    lag_s: Annotated[float, Field(ge=-1, le=1)] = Field(
        default=0.0,
        description="By how much a sample's time stamp is later than what it shows (s). Typical: 0 to 0.02.",
    )
    lag_uncertainty_s: NotNegative = Field(default=0.0, description="Standard uncertainty of lag_s (s, k = 1).")
    data_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = Field(
        default=None, description="SHA-256 of the log that the values came from; `dea-rig calibrate` writes it."
    )
    findings: dict[str, float] = Field(
        default_factory=dict, description="What the calibration found beside the gain; for people."
    )
    budget: list[BudgetLine] = Field(
        default_factory=list, max_length=100, description="Components of the gain's uncertainty; for people."
    )
    standstill: list[dict[str, float | str]] = Field(
        default_factory=list, max_length=2000, description="The calibration's readings, one by one; for people."
    )

    @model_validator(mode="after")
    def _in_order(self) -> AnyFile:
        if not self.valid_from <= self.valid_until:
            raise ValueError(f"valid_from {self.valid_from} comes after valid_until {self.valid_until}")
        return self

    def _certificate(
        self,
        role: Role,
        gain: tuple[float, str, float],
        noise: float,
        zero: float,
        ends: list[float],
        name: str,
        raw: bytes,
        stored_zero: float | None = None,
        compliance: tuple[float, float] = (0.0, 0.0),
    ) -> Certificate:
        """``gain`` is the gain itself, the unit of the reading, and its relative uncertainty."""
        low, high = ends
        return Certificate(
            role=role,
            instrument=self.instrument,
            serial=self.serial,
            valid_from=self.valid_from,
            valid_until=self.valid_until,
            gain=gain[0],
            reading_unit=gain[1],
            gain_uncertainty=gain[2],
            noise=noise,
            zero_uncertainty=zero,
            stored_zero=stored_zero,
            low=low,
            high=high,
            name=name,
            raw=raw,
            lag=self.lag_s,
            lag_uncertainty=self.lag_uncertainty_s,
            compliance=compliance[0],
            compliance_uncertainty=compliance[1],
        )


class ForceFile(AnyFile):
    """Certificate of a load cell: force = gain * (reading - reading at zero)."""

    role: Literal["force"] = Field(description="Which role of a scene the certificate is for.")
    gain_N_per_mV_per_V: Positive | None = Field(
        default=None, description="Force per reading of an amplifier (N per mV/V). Typical: rated force over 2 mV/V."
    )
    gain_N_per_N: Positive | None = Field(
        default=None, description="Force per reading of a cell that states newtons itself. Typical: 0.98 to 1.02."
    )
    gain_relative_uncertainty: Relative = Field(description=GAIN_UNCERTAINTY)
    zero_reading_mV_per_V: float | None = Field(
        default=None,
        description="Reading of the unloaded cell when it was calibrated (mV/V); the force limit holds against it.",
    )
    zero_reading_N: float | None = Field(
        default=None,
        description="The same of a cell that states newtons (N).",
    )
    noise_N: Positive = Field(description="Standard deviation of one sample (N). Typical: 0.0002 to 0.02.")
    zero_uncertainty_N: NotNegative = Field(
        description="Standard uncertainty of a zero taken before the run, drift until its end included (N)."
    )
    range_N: Range = Field(description=f"{RANGE} In N.")

    @model_validator(mode="after")
    def _one_gain(self) -> ForceFile:
        if (self.gain_N_per_mV_per_V is None) == (self.gain_N_per_N is None):
            raise ValueError("give either gain_N_per_mV_per_V or gain_N_per_N, as the sensor's readings are")
        if (self.zero_reading_N if self.gain_N_per_N is None else self.zero_reading_mV_per_V) is not None:
            raise ValueError("the stored zero must be in the unit of the sensor's readings, as the gain is")
        return self

    def certificate(self, name: str, raw: bytes) -> Certificate:
        gain, unit = (self.gain_N_per_mV_per_V, "mV/V") if self.gain_N_per_N is None else (self.gain_N_per_N, "N")
        assert gain is not None  # _one_gain
        zero = self.zero_reading_mV_per_V if unit == "mV/V" else self.zero_reading_N
        measures = gain, unit, self.gain_relative_uncertainty
        return self._certificate(
            "force", measures, self.noise_N, self.zero_uncertainty_N, self.range_N, name, raw, stored_zero=zero
        )


class OneUnitFile(AnyFile):
    """Certificate of a sensor that states what it measures; its keys carry the ``unit``."""

    unit: ClassVar[str]

    def certificate(self, name: str, raw: bytes) -> Certificate:
        stems = (
            "gain_{0}_per_{0}",
            "gain_relative_uncertainty",
            "noise_{0}",
            "zero_uncertainty_{0}",
            "range_{0}",
            "role",
        )
        gain, relative, noise, zero, ends, role = (getattr(self, stem.format(self.unit)) for stem in stems)
        return self._certificate(role, (gain, self.unit, relative), noise, zero, ends, name, raw)


class DisplacementFile(OneUnitFile):
    """Certificate of a displacement sensor."""

    unit: ClassVar[str] = "m"
    role: Literal["displacement"] = Field(description="Which role of a scene the certificate is for.")
    gain_m_per_m: Positive = Field(description="Displacement per metre that the sensor states. Typical: 0.99 to 1.01.")
    gain_relative_uncertainty: Relative = Field(description=GAIN_UNCERTAINTY)
    noise_m: NotNegative = Field(description="Standard deviation of one sample (m). Typical: 1e-7 to 1e-5.")
    zero_uncertainty_m: NotNegative = Field(description="Standard uncertainty of a zero taken before the run (m).")
    range_m: Range = Field(description=f"{RANGE} In m.")


class HVFile(OneUnitFile):
    """Certificate of a supply's voltage monitor."""

    unit: ClassVar[str] = "V"
    role: Literal["hv"] = Field(description="Which role of a scene the certificate is for.")
    gain_V_per_V: Positive = Field(description="Voltage per volt that the supply states. Typical: 0.99 to 1.01.")
    gain_relative_uncertainty: Relative = Field(description=GAIN_UNCERTAINTY)
    noise_V: NotNegative = Field(description="Standard deviation of one sample (V). Typical: 0.1 to 5.")
    zero_uncertainty_V: NotNegative = Field(description="Standard uncertainty of the reading at 0 V (V).")
    range_V: Range = Field(description=f"{RANGE} In V.")


class StageFile(AnyFile):
    """Certificate of the rig's compliance: by how much the disk moves less than the stage."""

    role: Literal["stage"] = Field(description="Which role of a scene the certificate is for.")
    compliance_m_per_N: NotNegative = Field(
        description="By how much the rig gives way to the force on the disk (m/N). Typical: 1e-6 to 5e-4."
    )
    compliance_uncertainty_m_per_N: NotNegative = Field(description="Its standard uncertainty (m/N, k = 1).")
    range_N: Range = Field(description=f"{RANGE} In N.")

    def certificate(self, name: str, raw: bytes) -> Certificate:
        compliance = self.compliance_m_per_N, self.compliance_uncertainty_m_per_N
        return self._certificate("stage", (1.0, "m", 0.0), 0.0, 0.0, self.range_N, name, raw, compliance=compliance)


CertificateFile = ForceFile | DisplacementFile | HVFile | StageFile
