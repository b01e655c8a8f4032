"""Reading certificate files, and those inside logs."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError

from calibration.sensors.certificate import Certificate, CertificateFile, DisplacementFile, ForceFile, HVFile, StageFile
from rig.base.errors import ConfigError
from rig.base.problems import explain, kind_of_table
from rig.base.text_file import MAX_BYTES, decode, read_bytes
from rig.base.toml_text import parse_toml

FILES: dict[str, type[CertificateFile]] = {
    "force": ForceFile,
    "displacement": DisplacementFile,
    "hv": HVFile,
    "stage": StageFile,
}


def load_certificate(path: Path) -> Certificate:
    """Read one certificate. Raises `ConfigError` that names file, key, value and what is allowed."""
    return parse_certificate(read_bytes(path, "certificate"), str(path))


def parse_certificate(raw: bytes, name: str) -> Certificate:
    """A certificate from its bytes, as found in a file or attached to a log. Raises `ConfigError`."""
    if len(raw) > MAX_BYTES:
        raise ConfigError(f"{name}: larger than {MAX_BYTES // 1024} kB; this is not a certificate file.")
    table = parse_toml(decode(raw, name, "certificate"), "certificate", name)
    file = kind_of_table(table, "role", FILES, "certificate", name)
    try:
        return file.model_validate(table).certificate(name, raw)
    except ValidationError as error:
        raise ConfigError(explain(error, table, file, "certificate", name)) from None
