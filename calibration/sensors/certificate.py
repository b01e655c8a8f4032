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
import tomllib
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

FORMAT = "dea-rig certificate 1"
LARGEST_BYTES = 256 * 1024  # a certificate is a page; a larger file is a mistake or an attack on the parser

Role = Literal["force", "displacement", "hv", "stage"]


class CertificateError(ValueError):
    """A certificate that cannot be used; the message names file, key and value, and what is allowed."""


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


def load_certificate(path: Path) -> Certificate:
    """Read one certificate. Raises `CertificateError`."""
    try:
        with path.open("rb") as file:
            raw = file.read(LARGEST_BYTES + 1)
    except OSError as error:
        raise CertificateError(f"{path}: cannot read the certificate: {error.strerror}") from error
    return parse_certificate(raw, str(path))


def parse_certificate(raw: bytes, name: str) -> Certificate:
    """A certificate from its bytes, as found in a file or attached to a log. Raises `CertificateError`."""
    if len(raw) > LARGEST_BYTES:
        raise CertificateError(f"{name}: larger than {LARGEST_BYTES // 1024} kB; this is no certificate")
    try:
        table = tomllib.loads(raw.decode("utf-8"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise CertificateError(f"{name}: not a TOML file: {str(error) or 'nested too deeply'}") from error
    if table.get("format") != FORMAT:
        raise CertificateError(f"{name}: format is {table.get('format')!r}; this program reads {FORMAT!r}")
    try:
        return _FILE.validate_python(table).certificate(name, raw)
    except ValidationError as error:
        lines = []
        for item in error.errors(include_url=False, include_context=False):
            where = [str(part) for part in item["loc"] if part not in ("force", "displacement", "hv", "stage")]
            value = "" if item["type"] in ("missing", "extra_forbidden") else f" (it is {item['input']!r})"
            lines.append(f"{name}: {'.'.join(where) or 'certificate'}: {item['msg']}{value}")
        raise CertificateError("\n".join(lines)) from error


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Relative = Annotated[float, Field(ge=0, lt=1)]
Range = Annotated[list[float], Field(min_length=2, max_length=2)]
Text = Annotated[str, Field(min_length=1, max_length=200)]


class _Line(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    component: Text
    type: Literal["A", "B"]
    relative: NotNegative
    note: Annotated[str, Field(max_length=200)] = ""


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    format: Literal["dea-rig certificate 1"]
    instrument: Text
    serial: Annotated[str, Field(max_length=64)]
    valid_from: date
    valid_until: date
    method: Text | None = None
    lag_s: Annotated[float, Field(ge=-1, le=1)] = 0.0
    lag_uncertainty_s: NotNegative = 0.0
    data_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = None
    findings: dict[str, float] = Field(default_factory=dict)
    budget: list[_Line] = Field(default_factory=list, max_length=100)
    standstill: list[dict[str, float | str]] = Field(default_factory=list, max_length=2000)

    @model_validator(mode="after")
    def _in_order(self) -> _File:
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
        if not low < high:
            raise CertificateError(f"{name}: the range must run from the lower to the higher end, it is {ends}")
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


class _ForceFile(_File):
    role: Literal["force"]
    gain_N_per_mV_per_V: Positive | None = None
    gain_N_per_N: Positive | None = None
    gain_relative_uncertainty: Relative
    zero_reading_mV_per_V: float | None = None
    zero_reading_N: float | None = None
    noise_N: Positive
    zero_uncertainty_N: NotNegative
    range_N: Range

    @model_validator(mode="after")
    def _one_gain(self) -> _ForceFile:
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


class _DisplacementFile(_File):
    role: Literal["displacement"]
    gain_m_per_m: Positive
    gain_relative_uncertainty: Relative
    noise_m: NotNegative
    zero_uncertainty_m: NotNegative
    range_m: Range

    def certificate(self, name: str, raw: bytes) -> Certificate:
        gain = self.gain_m_per_m, "m", self.gain_relative_uncertainty
        return self._certificate("displacement", gain, self.noise_m, self.zero_uncertainty_m, self.range_m, name, raw)


class _HVFile(_File):
    role: Literal["hv"]
    gain_V_per_V: Positive
    gain_relative_uncertainty: Relative
    noise_V: NotNegative
    zero_uncertainty_V: NotNegative
    range_V: Range

    def certificate(self, name: str, raw: bytes) -> Certificate:
        gain = self.gain_V_per_V, "V", self.gain_relative_uncertainty
        return self._certificate("hv", gain, self.noise_V, self.zero_uncertainty_V, self.range_V, name, raw)


class _StageFile(_File):
    role: Literal["stage"]
    compliance_m_per_N: NotNegative
    compliance_uncertainty_m_per_N: NotNegative
    range_N: Range

    def certificate(self, name: str, raw: bytes) -> Certificate:
        compliance = self.compliance_m_per_N, self.compliance_uncertainty_m_per_N
        return self._certificate("stage", (1.0, "m", 0.0), 0.0, 0.0, self.range_N, name, raw, compliance=compliance)


_FILE: TypeAdapter[_ForceFile | _DisplacementFile | _HVFile | _StageFile] = TypeAdapter(
    Annotated[_ForceFile | _DisplacementFile | _HVFile | _StageFile, Field(discriminator="role")]
)
