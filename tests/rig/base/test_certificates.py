"""Certificates: strict reading, validity, identity, the exact bytes."""

import hashlib
from datetime import date
from pathlib import Path

import pytest

import sim_fixtures
from rig.base.certificates import load_certificate, parse_certificate
from rig.base.errors import ConfigError

EXAMPLES = Path(sim_fixtures.__file__).parent / "calibrations"
FORCE = (EXAMPLES / "force.toml").read_text()


def edited(old: str, new: str) -> bytes:
    assert FORCE.count(old) == 1
    return FORCE.replace(old, new).encode()


@pytest.mark.parametrize(
    ("name", "gain", "gain_uncertainty", "noise"),
    [("force", 0.5, 1e-3, 5e-3), ("displacement", 1.0, 5e-4, 5e-6), ("hv", 1.0, 1e-3, 0.5)],
)
def test_the_simulated_benchs_certificates(name: str, gain: float, gain_uncertainty: float, noise: float) -> None:
    path = EXAMPLES / f"{name}.toml"
    certificate = load_certificate(path)
    assert certificate.role == name
    assert (certificate.gain, certificate.gain_uncertainty, certificate.noise) == (gain, gain_uncertainty, noise)
    assert certificate.raw == path.read_bytes()
    assert certificate.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert certificate.check(certificate.serial, date(2020, 1, 1)) == []


def test_the_hash_is_of_the_exact_bytes() -> None:
    changed = FORCE.replace("# The simulated", "# the simulated").encode()
    assert parse_certificate(changed, "x").sha256 != parse_certificate(FORCE.encode(), "x").sha256


def test_expired_not_yet_valid_and_mismatched() -> None:
    certificate = parse_certificate(edited("valid_until = 2099-12-31", "valid_until = 2025-06-30"), "cell.toml")
    serial = certificate.serial
    assert certificate.check(serial, date(2025, 6, 30)) == []
    (problem,) = certificate.check(serial, date(2025, 7, 1))
    assert "expired on 2025-06-30" in problem
    assert "cell.toml" in problem
    (problem,) = certificate.check(serial, date(2018, 12, 31))
    assert "not yet" in problem
    (problem,) = certificate.check("999", date(2025, 1, 1))
    assert "999" in problem
    assert serial in problem
    assert len(certificate.check("999", date(2030, 1, 1))) == 2


def test_an_instrument_without_a_serial_number_is_checked_by_date_only() -> None:
    assert load_certificate(EXAMPLES / "force.toml").check("", date(2020, 1, 1)) == []


def test_the_range_is_not_extrapolated() -> None:
    certificate = load_certificate(EXAMPLES / "force.toml")
    assert certificate.covers(1.0)
    assert not certificate.covers(1.0001)
    assert not certificate.covers(float("nan"))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("noise_N = 5e-3", "noise_N = -5e-3", ["noise_N", "greater than 0", "-0.005"]),
        ("noise_N = 5e-3", "noise_N = nan", ["noise_N", "finite"]),
        (
            "noise_N = 5e-3",
            'noise_N = "5 mN"',
            ["noise_N", "number without quotes", "5 mN", "deviation of one sample"],
        ),
        ("noise_N = 5e-3", "noise_mN = 5.0", ["noise_mN", "unknown key; did you mean noise_N?"]),
        ("gain_N_per_mV_per_V = 0.5", "gain_N_per_mV_per_V = 0.0", ["gain_N_per_mV_per_V", "greater than 0"]),
        ("gain_N_per_mV_per_V = 0.5\n", "", ["gain_N_per_mV_per_V", "gain_N_per_N"]),
        ("gain_N_per_mV_per_V = 0.5", "gain_N_per_mV_per_V = 0.5\ngain_N_per_N = 1.0", ["either"]),
        ("gain_relative_uncertainty = 1e-3", "gain_relative_uncertainty = inf", ["gain_relative_uncertainty"]),
        ("range_N = [-1.0, 1.0]", "range_N = [1.0, -1.0]", ["range", "lower to the higher"]),
        ('role = "force"', 'role = "hv"', ["gain_N_per_mV_per_V: unknown key; did you mean gain_V_per_V?"]),
        ('role = "force"', 'role = "torque"', ["role", "torque", "force", "stage"]),
        ("valid_until = 2099-12-31", "valid_until = 2001-12-31", ["valid_from", "comes after"]),
        ("valid_until = 2099-12-31", 'valid_until = "2099"', ["valid_until", "date"]),
        ("certificate 1", "certificate 7", ["format", "certificate 7", "certificate 1"]),
        ("noise_N = 5e-3", "noise_N = 5e-3\nnoise_N = 6e-3", ["not valid TOML in line", "given twice"]),
        ("range_N = [-1.0, 1.0]", "range_N = " + "[" * 5000 + "]" * 5000, ["brackets more than 24 deep"]),
    ],
)
def test_a_bad_file_names_itself_its_key_and_what_is_allowed(old: str, new: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_certificate(edited(old, new), "cell.toml")
    for word in ["cell.toml", *words]:
        assert word in str(caught.value)


def test_files_that_are_not_certificates(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such certificate file"):
        load_certificate(tmp_path / "none.toml")
    large = tmp_path / "large.toml"
    large.write_bytes(b"#" * 300_000)
    with pytest.raises(ConfigError, match="larger than 256 kB"):
        load_certificate(large)
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\x89MCAP0\r\n\xff")
    with pytest.raises(ConfigError, match=r"a log .*, not a certificate"):
        load_certificate(binary)


def test_the_examples_are_for_the_instruments_that_the_simulation_has() -> None:
    from rig.sim.instruments.cia404 import CiA404Truth
    from rig.sim.instruments.gsv8 import GSV8Truth
    from rig.sim.instruments.iseg import IsegTruth

    for name, serial in (
        ("force", GSV8Truth().serial_number),
        ("force-can", CiA404Truth(driver="cia404").serial_number),
        ("hv", IsegTruth().serial_number),
    ):
        assert load_certificate(EXAMPLES / f"{name}.toml").check(str(serial), date(2020, 1, 1)) == []


@pytest.mark.parametrize(("name", "unit"), [("force", "mV/V"), ("force-can", "N"), ("displacement", "m"), ("hv", "V")])
def test_a_certificate_says_what_its_readings_are_in(name: str, unit: str) -> None:
    assert load_certificate(EXAMPLES / f"{name}.toml").reading_unit == unit
