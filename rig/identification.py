"""From logs to parameters: curves out of logs, one identification over all of them, results as JSON and HTML."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.certificate import Certificate, CertificateError, parse_certificate
from calibration.curve import Curve, CurveError
from calibration.homogeneous import TestsError, TestsFit, fit_tests, load_test
from calibration.identify import IdentificationError, identify
from calibration.result import Identification
from model.materials import Material
from rig.errors import ConfigError, DataError
from rig.experiment import IN_MEMORY
from rig.log.dataset import CurveErrors, Run, load_run
from rig.scene import Scene
from rig.toml_file import parse_table

# A sample belongs to its curve while the measured voltage is this near to the nominal one.
VOLTAGE_V, VOLTAGE_PART = 50.0, 0.05


@dataclass(frozen=True)
class Found:
    """An identification with what it came from.

    ``truth`` is the hidden film of the simulation, when all logs are of one and the same simulated film.
    """

    identification: Identification
    curves: list[Curve]
    runs: list[Run]
    provenance: dict[str, object]
    truth: Material | None
    notes: list[str]


def identify_logs(paths: Sequence[Path], *, terms: int = 2, profiles: bool = False) -> Found:
    """Identify the film from all recorded curves of all logs at once.

    ``profiles`` adds 95 % intervals from profile likelihood, which take a few seconds more.

    Raises
    ------
    LogError, DataError
        When a log cannot be read, lacks what is needed, or the curves cannot be fitted.
    """
    runs = [load_run(path) for path in paths]
    scenes = [parse_table(run.scene, Scene, "scene", f"{run.log.path} (scene.toml inside)") for run in runs]
    hashes = {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
    provenance: dict[str, object] = {
        "logs": hashes,
        "outcomes": {str(run.log.path): (run.log.outcome or {}).get("status", "cut off") for run in runs},
    }
    if len(set(hashes.values())) < len(paths):
        raise DataError("The same log is given twice; it would count as if it had been measured twice.")
    curves: list[Curve] = []
    try:
        for run, scene in zip(runs, scenes, strict=True):
            certificates = _certificates(run)
            found = run.curves(scene.specimen.specimen(), **_errors(run, scene, certificates))
            curves += [_with_drift(_at_its_voltage(curve), certificates) for curve in found]
        if not curves:
            raise DataError("None of these logs holds a recorded curve: did the runs end before the first sweep?")
        identification = identify(curves, terms=terms, profiles=profiles, provenance=provenance)
    except (CurveError, IdentificationError, CertificateError) as error:
        raise DataError(f"{error}.") from None
    return Found(identification, curves, runs, provenance, _truth(runs, scenes), _notes(runs))


def _at_its_voltage(curve: Curve) -> Curve:
    """The curve with those samples flagged at which the measured voltage was not the nominal one."""
    allowed = max(VOLTAGE_V, VOLTAGE_PART * abs(curve.nominal_voltage))
    elsewhere = ~(np.abs(curve.voltage - curve.nominal_voltage) <= allowed) & np.isfinite(curve.voltage)
    return replace(curve, flagged=elsewhere if curve.flagged is None else curve.flagged | elsewhere)


def _notes(runs: Sequence[Run]) -> list[str]:
    """What a reader of the result must know of the logs."""
    notes = []
    for run in runs:
        log = run.log
        if not log.whole:
            notes.append(f"{log.path} is cut short or damaged; `dea-rig info {log.path}` tells what is missing")
        status = (log.outcome or {}).get("status", "unknown")
        if status != "complete":
            notes.append(f"{log.path} is of a run that did not come to its end: {status}")
    return notes


def write_results(found: Found, fit: Path | None, report: Path | None) -> None:
    """Write the result as JSON and as an HTML report; each appears whole or not at all.

    Raises
    ------
    ConfigError
        When a file cannot be written.
    """
    try:
        if fit is not None:
            write_text(fit, found.identification.to_json())
        if report is not None:
            from calibration.report import write_report

            write_report(
                report,
                found.identification,
                found.curves,
                scene_texts={str(run.log.path): run.scene for run in found.runs},
                provenance=found.provenance,
                truth=found.truth,
            )
    except OSError as error:
        raise ConfigError(f"{error.filename}: cannot be written: {error.strerror}.") from None


def write_text(path: Path, text: str) -> None:
    """Write a text file that appears whole or not at all.

    Raises
    ------
    ConfigError
        When it cannot be written.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}.") from None


def identify_tests(tests: Sequence[Path], predict: Sequence[Path], terms: int) -> TestsFit:
    """Identify Ogden terms from homogeneous tests in CSV files; ``predict`` are held against the result.

    Raises
    ------
    DataError
        When a file cannot be read as a test, or the tests cannot be fitted.
    """
    try:
        return fit_tests(
            [load_test(path) for path in tests], terms=terms, predict=[load_test(path) for path in predict]
        )
    except TestsError as error:
        raise DataError(f"{error}.") from None


def _with_drift(curve: Curve, certificates: Mapping[str, Certificate]) -> Curve:
    """The curve with what its sensors' zeros may drift during a run, besides the error with which they were taken."""
    drift = {role: certificate.zero_uncertainty for role, certificate in certificates.items()}
    return replace(
        curve,
        force_zero=math.hypot(curve.force_zero, drift.get("force", 0.0)),
        displacement_zero=math.hypot(curve.displacement_zero, drift.get("displacement", 0.0)),
    )


def _errors(run: Run, scene: Scene, certificates: Mapping[str, Certificate]) -> CurveErrors:
    """Noise and uncertainties of a run's curves, from the certificates in its log and from the scene."""
    force = certificates.get("force")
    if force is None:
        raise DataError(f"{run.log.path}: the log holds no certificate of the force sensor; its noise is not known.")
    dimensions = scene.specimen
    errors = CurveErrors(
        force_noise=force.noise,
        force_gain=force.gain_uncertainty,
        thickness_uncertainty=dimensions.thickness_uncertainty_um / dimensions.thickness_um,
        prestretch_uncertainty=dimensions.prestretch_uncertainty / dimensions.prestretch,
        disk_radius_uncertainty=dimensions.disk_radius_uncertainty_mm / dimensions.disk_radius_mm,
    )
    laser, hv = certificates.get("displacement"), certificates.get("hv")
    if laser is not None:
        errors["displacement_noise"] = laser.noise
        errors["displacement_gain"] = laser.gain_uncertainty
    if hv is not None:
        errors["voltage_gain"] = hv.gain_uncertainty
    return errors


def _certificates(run: Run) -> dict[str, Certificate]:
    found: dict[str, Certificate] = {}
    for name, attachment in run.log.attachments.items():
        if name.startswith("certificate."):
            certificate = parse_certificate(attachment.data, f"{run.log.path} ({name} inside)")
            found[certificate.role] = certificate
    return found


def _truth(runs: Sequence[Run], scenes: Sequence[Scene]) -> Material | None:
    if any(run.log.metadata.get("run", {}).get("bench") != IN_MEMORY for run in runs):
        return None
    truths = set()
    for scene in scenes:
        if scene.simulation is None:
            return None
        film, believed = scene.simulation.film, scene.specimen.specimen().material
        truths.add(
            (
                tuple(film.mu_Pa) if film.mu_Pa is not None else believed.mu,
                tuple(film.alpha) if film.alpha is not None else believed.alpha,
                film.eps_r if film.eps_r is not None else believed.eps_r,
            )
        )
    if len(truths) != 1:
        return None
    mu, alpha, eps_r = truths.pop()
    return Material(name="the simulation's truth", mu=mu, alpha=alpha, eps_r=eps_r)
