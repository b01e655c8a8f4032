"""``dea-rig calibrate`` and ``dea-rig verify``: from a scene or a recorded log to a certificate or a verdict."""

from __future__ import annotations

import glob
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from calibration.sensors.sensor import COVERAGE, SensorError, Standstill
from rig.analysis import sensors as analysis
from rig.analysis.certificate_file import certificate_text
from rig.analysis.film import write_text
from rig.analysis.sensor_protocols import protocol_text, verify_text
from rig.analysis.sensors import ROLE, UNIT, Calibration, Quantity
from rig.base.errors import ConfigError, DataError
from rig.base.outputs import check_new
from rig.experiment import Experiment, prepare
from rig.log.dataset import load_run
from rig.scene.scene import load_scene

Run = Callable[[Experiment, Path], None]


def calibrate(
    quantity: Quantity, source: Path, out: Path, run: Run, protocol: Path | None = None, valid_days: int = 365
) -> tuple[Calibration, list[Path]]:
    """Run the calibration on the bench of a scene, or take a recorded one, and write what follows into ``out``.

    Parameters
    ----------
    source : Path
        A scene (``.toml``) or the log of an earlier calibration (``.mcap``).
    run : callable
        Carries an experiment out into a log.

    Returns
    -------
    What was found, and the files written.

    Raises
    ------
    RigError
        Whatever was in the way. Logs are kept.
    """
    certificate, picture = out / f"{quantity}.toml", out / f"{quantity}.png"
    wanted = [picture] if quantity == "timing" else [certificate, picture]
    log = source
    if source.suffix == ".mcap":
        if protocol is not None:
            raise ConfigError("--protocol goes with a scene; a log holds its own.")
        with _made(out, *wanted):
            found = analysis.calibrate(log, quantity)
    else:
        log, steps = out / f"{quantity}.mcap", protocol or out / f"{quantity}.protocol.toml"
        scene, _ = load_scene(source)
        text = protocol_text(quantity, scene) if protocol is None else ""
        with _made(out, *wanted, log, *([steps] if protocol is None else [])):
            if protocol is None:
                write_text(steps, text)
            with _nothing_without_a_log(log, *([steps] if protocol is None else [])):
                run(prepare(source, steps), log)
        found = analysis.calibrate(log, quantity)
    if quantity != "timing":
        write_text(certificate, certificate_text(found, valid_days))
    from rig.analysis.sensor_picture import draw

    draw(found, picture)
    return found, wanted


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


def verify(quantity: Quantity, scene_path: Path, standard: float, log: Path, run: Run) -> Verdict:
    """Apply one standard (g, mm or V) and hold the sensor's answer against its certificate.

    Raises
    ------
    RigError
        When the check cannot be made; a check that fails is a `Verdict`.
    """
    scene, _ = load_scene(scene_path)
    steps = log.with_suffix(".protocol.toml")
    check_new(log, steps)
    text = verify_text(quantity, scene, standard)
    write_text(steps, text)
    with _nothing_without_a_log(log, steps):
        run(prepare(scene_path, steps), log)
    return judge(log, quantity)


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


@contextmanager
def _made(out: Path, *files: Path) -> Iterator[None]:
    """Make the directory of new ``files``; it goes again when an error comes before anything is in it."""
    new = not out.exists()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{out}: this directory cannot be made: {error.strerror}.") from None
    check_new(*files)
    try:
        yield
    except BaseException:
        if new and not any(out.iterdir()):
            out.rmdir()
        raise


@contextmanager
def _nothing_without_a_log(log: Path, *steps: Path) -> Iterator[None]:
    """Take ``steps`` away when the run of them fails before it has a log, so that it can be tried again."""
    try:
        yield
    except BaseException:
        if not any(log.parent.glob(f"{glob.escape(log.name)}*")):
            for path in steps:
                path.unlink(missing_ok=True)
        raise
