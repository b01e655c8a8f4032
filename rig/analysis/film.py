"""From logs to parameters: curves out of logs, one identification over all of them, results as JSON and HTML."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from calibration.electrical.charge import ByCharge, charge_as_json
from calibration.film.between import Spread, between, by_specimen, identify_each
from calibration.film.cards import CardError, material_cards
from calibration.film.curve import Curve, CurveError
from calibration.film.identify import IdentificationError, compare, identify
from calibration.film.problem import UnknownParameter
from calibration.film.result import Identification
from calibration.film.summary import looks_viscous
from calibration.sensors.certificate import Certificate
from model.material.law import Law
from model.material.laws import find_law, known_laws
from model.material.materials import Material
from rig.base.errors import ConfigError, DataError
from rig.base.outputs import write_text
from rig.base.toml_file import parse_table
from rig.log.contents import IN_MEMORY, air_in, bench_of, bench_word, session_in
from rig.log.dataset import CurveErrors, Run, SpecimenErrors, load_run
from rig.log.notes import notes_on
from rig.log.reader import Log
from rig.scene.scene import Scene
from rig.scene.specimen import SpecimenTable
from rig.steps import registry

if TYPE_CHECKING:
    from calibration.film.branches.record import Record

# Of a rig that nobody pressed on (m/N): load cells for a newton give way by some 0.3 mm at full scale.
UNKNOWN_COMPLIANCE = 3e-4
# Of the force behind the displacement where nobody measured it (s): filters of amplifiers and buffers of adapters.
UNKNOWN_LAG = 5e-3
NOISE_SIGMAS = 5.0  # by this much of its noise a sensor may read beyond its calibrated range
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
    comparison: list[Identification] = field(default_factory=list)
    spreads: dict[str, Spread] = field(default_factory=dict)
    charge: ByCharge | None = None  # where the charge was asked for
    scene_texts: dict[str, str] = field(default_factory=dict)  # beside those of the runs: scenes given with tables


def identify_logs(
    paths: Sequence[Path],
    *,
    law: str | None = None,
    terms: int = 2,
    comparing: bool = False,
    profiles: bool = False,
    wrinkled: str = "left-out",
    posterior: bool = False,
    branches: int | Literal["auto"] = 0,
    progress: Callable[[float, float, str], None] = lambda done, total, label: None,
    **settings: Any,
) -> Found:
    """Identify the film from all recorded curves of all logs at once.

    ``law`` is the name of the law to fit, the scene's when not given. ``comparing`` judges 1, 2 and 3 Ogden terms
    beside each other, ``profiles`` adds 95 % intervals from profile likelihood; each takes a few seconds more.
    ``posterior`` adds Markov chains, which take a minute or more and tell ``progress``. ``branches`` fits so many
    Maxwell branches along, or as many as pay, from the whole histories of the runs. ``wrinkled`` is "left-out" or
    "tension-field". Other ``settings`` are those of `calibration.film.identify.identify`: ``fixed``,
    ``negative_exponents``, ``along``, ``fixed_stretch``, ``currents``.

    Raises
    ------
    LogError, DataError
        When a log cannot be read, lacks what is needed, or the curves cannot be fitted; when there is no such law.
    """
    runs = [load_run(path) for path in paths]
    scenes = [parse_table(run.scene, Scene, "scene", f"{run.log.path} (scene.toml inside)") for run in runs]
    benches = {str(path): bench_of(run.log) for path, run in zip(paths, runs, strict=True)}
    _check_one_kind(benches)
    hashes = {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
    provenance: dict[str, object] = {
        "logs": hashes,
        "bench": bench_word(next(iter(benches.values()))),
        "benches": benches,
        "outcomes": {str(run.log.path): (run.log.outcome or {}).get("status", "cut off") for run in runs},
    }
    provenance |= said_in([run.log for run in runs])
    if len(set(hashes.values())) < len(paths):
        raise ConfigError("The same log is given twice; it would count as if it had been measured twice.")
    curves: list[Curve] = []
    records: list[Record] = []
    try:
        for run, scene in zip(runs, scenes, strict=True):
            mine = curves_in(run, scene)
            curves += mine
            if branches and mine:
                records.append(_record(run, mine[0], run.certificates))
        if not curves:
            raise DataError("None of these logs holds a recorded curve: did the runs end before the first sweep?")
    except CurveError as error:
        raise DataError(f"{error}.") from None
    identified = identify_curves(
        curves,
        provenance,
        terms=terms,
        comparing=comparing,
        profiles=profiles,
        wrinkled=wrinkled,
        posterior=posterior,
        branches=branches,
        records=records,
        progress=progress,
        law=scenes[0].specimen.specimen().material.law if law is None else law_called(law),
        reach=min(scene.limits.displacement_mm for scene in scenes) * 1e-3,
        **settings,
    )
    return replace(identified, runs=runs, truth=_truth(runs, scenes), notes=[*_notes(runs), *identified.notes])


def curves_in(run: Run, scene: Scene) -> list[Curve]:
    """The curves of a run as a fit takes them. Raises `CurveError` for one that cannot be used."""
    certificates = run.certificates
    joining = registry.joining({phase.kind for phase in run.phases})
    found = run.curves(scene.specimen.specimen(), joining, **_errors(run, scene, certificates))
    corrected = [_without_compliance(curve, run, certificates) for curve in found]
    inside = [_in_calibrated_range(_at_its_voltage(curve), certificates) for curve in corrected]
    return [_with_drift(curve, certificates) for curve in inside]


def read_records(paths: Sequence[Path]) -> list[Record]:
    """The whole histories of logs.

    Raises
    ------
    LogError, DataError
        When a log cannot be read, or holds no recorded curve.
    """
    records = []
    for path in paths:
        run = load_run(path)
        scene = parse_table(run.scene, Scene, "scene", f"{run.log.path} (scene.toml inside)")
        try:
            curves = curves_in(run, scene)
            if not curves:
                raise DataError(f"{path}: the log holds no recorded curve: did the run end before the first sweep?")
            records.append(_record(run, curves[0], run.certificates))
        except CurveError as error:
            raise DataError(f"{error}.") from None
    return records


def identify_curves(
    curves: list[Curve],
    provenance: dict[str, object],
    *,
    terms: int = 2,
    comparing: bool = False,
    profiles: bool = False,
    wrinkled: str = "left-out",
    posterior: bool = False,
    branches: int | Literal["auto"] = 0,
    records: Sequence[Record] = (),
    progress: Callable[[float, float, str], None] = lambda done, total, label: None,
    law: type[Law] | None = None,
    reach: float = math.inf,
    each: bool = False,
    **settings: Any,
) -> Found:
    """Identify the film from curves, wherever they come from; options as in `identify_logs`.

    ``law`` is that of the specimens' material when not given. ``records`` are the whole runs, where they are known
    beyond their curves. With ``each`` every specimen is fitted alone as well, and what scatters between them is told.

    Raises
    ------
    DataError
        When the curves cannot be fitted.
    """
    options: dict[str, Any] = {
        "profiles": profiles,
        "provenance": provenance,
        "wrinkling": "tension_field" if wrinkled == "tension-field" else "plain",
        "reach": reach,
        "law": law or curves[0].specimen.material.law,
        **settings,
    }
    counts = (1, 2, 3) if options["law"].series else (1,)
    terms = min(terms, counts[-1])
    try:
        comparison = compare(curves, terms=counts, **options) if comparing else []
        same = [one for one in comparison if one.terms == terms]
        if branches:
            identification, curves = _with_branches(curves, records, branches, terms, options)
        else:
            identification = same[0] if same else identify(curves, terms=terms, **options)
            if looks_viscous(identification.suspects):
                from calibration.film.branches.estimate import with_elastic_error

                identification = with_elastic_error(identification, curves)
        if posterior:
            from calibration.film.posterior import posterior as sample

            chains = sample(curves, identification, progress=progress, currents=options.get("currents"))
            identification = replace(identification, posterior=chains)
    except UnknownParameter as error:
        raise ConfigError(f"--fix: {error}.") from None
    except (CurveError, IdentificationError) as error:
        raise DataError(f"{error}.") from None
    found = Found(identification, curves, [], provenance, None, [], comparison)
    return replace(found, **_between(curves, terms, options)) if each else found


def _with_branches(
    curves: list[Curve],
    records: Sequence[Record],
    branches: int | Literal["auto"],
    terms: int,
    options: Mapping[str, Any],
) -> tuple[Identification, list[Curve]]:
    """The film with its branches, and the curves less what those add to the forces."""
    from calibration.film.branches.identify import identify_branches
    from calibration.film.branches.record import records_of_curves

    number = None if branches == "auto" else branches
    return identify_branches(records or records_of_curves(curves), curves, branches=number, terms=terms, **options)


def _record(run: Run, like: Curve, certificates: Mapping[str, Certificate]) -> Record:
    """The whole history of a run: measured from the beginning of the first recorded part to the end of the last."""
    from calibration.film.branches.record import record_of

    whole = replace(
        like,
        label=run.log.path.name,
        h=run.h,
        force=run.force,
        voltage=run.voltage,
        direction=np.zeros(run.t.size, dtype=np.int8),
        time=run.t,
        flagged=run.flagged,
    )
    whole = _in_calibrated_range(_without_compliance(whole, run, certificates), certificates)
    recorded = np.flatnonzero(np.array([phase.record for phase in run.phases]))
    first, last = run.phases[recorded[0]].t, recorded[-1] + 1
    return record_of(whole, first, run.phases[last].t if last < len(run.phases) else math.inf)


def _between(curves: list[Curve], terms: int, options: Mapping[str, Any]) -> dict[str, Any]:
    """Statistics between specimens, where there are several, and notes on those that could not be fitted alone."""
    if len(by_specimen(curves)) < 2:
        return {}
    each, failed = identify_each(curves, terms=terms, starts=2, **(dict(options) | {"profiles": False}))
    one_batch = len({curve.batch for curve in curves}) == 1 and curves[0].batch != ""
    notes = [f"not fitted alone: {why}" for why in failed]
    return {"spreads": between(each, one_batch), "notes": notes}


def law_called(name: str) -> type[Law]:
    """The law of that name, with dashes or blanks for its underscores. Raises `ConfigError` when there is none."""
    plain = name.strip().casefold().replace("-", "_").replace(" ", "_")
    try:
        return find_law(plain)
    except ValueError as error:
        near = get_close_matches(plain, known_laws(), n=1, cutoff=0.5)
        raise ConfigError(f"--law {name!r}: {error}." + (f" Did you mean {near[0]}?" if near else "")) from None


def _check_one_kind(benches: Mapping[str, str]) -> None:
    """A film on hardware and a simulated one are two films; a log that does not say counts as hardware."""
    kinds = {path: bench_word(bench) for path, bench in benches.items()}
    if len(set(kinds.values())) > 1:
        listed = ", ".join(f"{path}: {kind}" for path, kind in kinds.items())
        raise DataError(f"These logs are of different benches and are not fitted together ({listed}).")


def _without_compliance(curve: Curve, run: Run, certificates: Mapping[str, Certificate]) -> Curve:
    """Where the stage's way stands for the disk's: the part of it that the rig gives way is taken off."""
    stage = certificates.get("stage")
    if run.has_laser or stage is None:
        return curve
    return curve.without_compliance(stage.compliance)


def _in_calibrated_range(curve: Curve, certificates: Mapping[str, Certificate]) -> Curve:
    """The curve with those samples flagged at which a sensor was beyond what it is calibrated for.

    Beyond by more than its noise: a calibration that begins at zero covers an unloaded sensor.
    """
    beyond = np.zeros(curve.h.shape, dtype=np.bool_)
    for role, values in (("force", curve.force), ("hv", curve.voltage)):
        used = certificates.get(role)
        if used is not None:
            margin = NOISE_SIGMAS * used.noise + used.zero_uncertainty
            beyond |= ~((values >= used.low - margin) & (values <= used.high + margin)) & np.isfinite(values)
    return replace(curve, flagged=beyond if curve.flagged is None else curve.flagged | beyond)


def _at_its_voltage(curve: Curve) -> Curve:
    """The curve with those samples flagged at which the measured voltage was not the nominal one."""
    allowed = max(  # A sample belongs to its curve while the measured voltage is this near to the nominal one.
        VOLTAGE_V, VOLTAGE_PART * abs(curve.nominal_voltage)
    )
    elsewhere = ~(np.abs(curve.voltage - curve.nominal_voltage) <= allowed) & np.isfinite(curve.voltage)
    return replace(curve, flagged=elsewhere if curve.flagged is None else curve.flagged | elsewhere)


def _notes(runs: Sequence[Run]) -> list[str]:
    """What a reader of the result must know of the logs."""
    notes = []
    for run in runs:
        log = run.log
        notes += [f"{log.path}: {problem}" for problem in _certificate_problems(run)]
        if not run.has_laser and "stage" not in run.certificates:
            notes.append(
                f"{log.path}: the stage's way stands for the disk's, and how far the rig gives way is not known; it "
                f"is fitted along (within {1e6 * UNKNOWN_COMPLIANCE:.0f} um/N), which makes the results less certain. "
                "`dea-rig calibrate compliance` tells"
            )
        for there, role, device in (
            (run.has_laser, "displacement", "displacement sensor"),
            (run.has_hv, "hv", "HV supply"),
        ):
            if there and role not in run.certificates:
                notes.append(
                    f"{log.path}: the {device} has no certificate; its readings are taken as they are, and the "
                    f"error of its gain is an assumption. `dea-rig calibrate {role}` makes one"
                )
        if not log.whole:
            notes.append(f"{log.path} is cut short or damaged; `dea-rig info {log.path}` tells what is missing")
        status = (log.outcome or {}).get("status", "unknown")
        if status != "complete":
            notes.append(f"{log.path} is of a run that did not come to its end: {status}")
    return notes


def _certificate_problems(run: Run) -> list[str]:
    """What the run itself noted against the certificates that it used: their dates, another serial number."""
    problems = [message.fields["problem"] for message in run.log.messages("/certificate_problem")]
    if "/identity" in run.log.topics:
        return list(dict.fromkeys(problems))
    # Older logs say it in sentences.
    noted = run.log.metadata.get("run", {}).get("certificate_problems", "")
    problems = [problem for problem in noted.split("; ") if problem]
    for message in run.log.messages("/event"):
        text = message.fields["message"]
        if message.fields["severity"] == "warning" and " certificate " in text and text not in problems:
            problems.append(text)
    return problems


def said_in(logs: Sequence[Log]) -> dict[str, dict[str, object]]:
    """What people said of ``logs``, by path: ``session`` of their scenes and ``notes`` beside them, if there are any.

    What was measured of the air stands with the session.

    Raises
    ------
    ConfigError
        When the notes of a log cannot be read.
    """
    found: dict[str, dict[str, object]] = {"session": {}, "notes": {}}
    for log in logs:
        notes = [f"{note.written} {note.by}: {note.text}" for note in notes_on(log.path)]
        for kind, said in (("session", session_in(log) | air_in(log)), ("notes", notes)):
            if said:
                found[kind][str(log.path)] = said
    return {kind: said for kind, said in found.items() if said}


def write_results(found: Found, fit: Path | None, report: Path | None) -> None:
    """Write the result as JSON and as an HTML report; each appears whole or not at all.

    Raises
    ------
    ConfigError
        When a file cannot be written.
    """
    try:
        if fit is not None:
            write_text(fit, _as_json(found))
        if report is not None:
            from calibration.report.report import write_report

            write_report(
                report,
                found.identification,
                found.curves,
                scene_texts={str(run.log.path): run.scene for run in found.runs} | found.scene_texts,
                provenance=found.provenance,
                truth=found.truth,
                comparison=found.comparison,
                charge=found.charge,
            )
    except OSError as error:
        raise ConfigError(f"{error.filename}: cannot be written: {error.strerror}.") from None


def _as_json(found: Found) -> str:
    """The result with its comparison of terms and its statistics between specimens, where they were asked for."""
    values = found.identification.to_dict()
    if found.comparison:
        values["comparison"] = [
            {name: one.to_dict()[name] for name in ("terms", "aicc", "bic", "held_out")} for one in found.comparison
        ]
    if found.charge is not None:
        values["by_charge_alone"] = charge_as_json(found.charge)
    if found.spreads:
        values["between_specimens"] = {name: one.to_dict() for name, one in found.spreads.items()}
    return json.dumps(values, indent=2, allow_nan=False) + "\n"


def write_cards(material: Material, folder: Path, *, electric: bool = True) -> list[Path]:
    """Write the material cards of every program that knows the law into ``folder``, which is made if need be.

    Raises
    ------
    ConfigError
        When a file cannot be written, or is there already.
    DataError
        When no program has the law.
    """
    try:
        cards = material_cards(material, electric=electric)
    except CardError as error:
        raise DataError(f"{error}.") from None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made: {error.strerror}.") from None
    paths = [folder / name for name in cards]
    there = [str(path) for path in paths if path.exists()]
    if there:
        raise ConfigError(f"{', '.join(there)}: there already; nothing was overwritten. Name another folder.")
    for path, text in zip(paths, cards.values(), strict=True):
        write_text(path, text)
    return paths


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
    return errors_of(scene, certificates)


def errors_of(scene: Scene, certificates: Mapping[str, Certificate]) -> CurveErrors:
    """Noise and uncertainties of the curves of a scene with these certificates; that of the force must be there."""
    force = certificates["force"]
    errors = CurveErrors(force_noise=force.noise, force_gain=force.gain_uncertainty)
    errors.update(dimension_errors(scene.specimen))  # type: ignore[typeddict-item] # a part of its keys
    laser, hv = certificates.get("displacement"), certificates.get("hv")
    if laser is not None:
        errors["displacement_noise"] = laser.noise
        errors["displacement_gain"] = laser.gain_uncertainty
    elif scene.displacement is None:
        stage = certificates.get("stage")
        errors["compliance_uncertainty"] = UNKNOWN_COMPLIANCE if stage is None else stage.compliance_uncertainty
    timed = [certificate for certificate in (force, laser) if certificate is not None]
    known = [certificate.lag_uncertainty for certificate in timed]
    complete = all(known) and (laser is not None or scene.displacement is None)
    errors["lag_uncertainty"] = math.hypot(*known) if complete else UNKNOWN_LAG
    if hv is not None:
        errors["voltage_gain"] = hv.gain_uncertainty
    return errors


def dimension_errors(dimensions: SpecimenTable) -> SpecimenErrors:
    """The uncertainties that the table of a specimen states; what it leaves out, the curve assumes."""
    errors = SpecimenErrors(eccentricity=dimensions.eccentricity_mm * 1e-3, batch=dimensions.batch)
    if dimensions.thickness_uncertainty_um is not None:
        errors["thickness_uncertainty"] = dimensions.thickness_uncertainty_um / dimensions.thickness_um
    if dimensions.prestretch_uncertainty is not None:
        errors["prestretch_uncertainty"] = dimensions.prestretch_uncertainty / dimensions.prestretch
    if dimensions.disk_radius_uncertainty_mm is not None:
        errors["disk_radius_uncertainty"] = dimensions.disk_radius_uncertainty_mm / dimensions.disk_radius_mm
    if dimensions.ring_radius_uncertainty_mm is not None:
        errors["ring_radius_uncertainty"] = dimensions.ring_radius_uncertainty_mm / dimensions.ring_radius_mm
    if dimensions.displacement_axis_uncertainty_percent is not None:
        errors["displacement_axis"] = dimensions.displacement_axis_uncertainty_percent / 100.0
    if dimensions.voltage_at_film_uncertainty_percent is not None:
        errors["voltage_at_film"] = dimensions.voltage_at_film_uncertainty_percent / 100.0
    return errors


def _truth(runs: Sequence[Run], scenes: Sequence[Scene]) -> Material | None:
    if any(bench_of(run.log) != IN_MEMORY for run in runs):
        return None
    truths = set()
    for scene in scenes:
        if scene.simulation is None:
            return None
        film = scene.simulation.film.material(scene.specimen.specimen().material)
        truths.add(Material("the simulation's truth", film.mu, film.alpha, film.eps_r, law=film.law))
    return truths.pop() if len(truths) == 1 else None
