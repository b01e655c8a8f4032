"""One experiment: scene and protocol in, a finished log out, whatever happens in between."""

from __future__ import annotations

import gc
import os
import platform
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path

from calibration.sensors.certificate import Certificate
from drivers.instrument import MONITORS
from rig.base.clock import Clock, calendar_now
from rig.base.errors import ConfigError, FaultError, LimitError, NotSafe, Stopped
from rig.engine.engine import Engine
from rig.engine.outcome import Outcome
from rig.log import space
from rig.log.contents import IN_MEMORY, bench_word, is_real
from rig.log.process import LogProcess
from rig.log.recorder import Gains
from rig.log.writer import LogWriter
from rig.operator.awake import kept_awake
from rig.operator.control import Control, Keyboard, Source
from rig.operator.signals import stop_on_signals
from rig.operator.status import Status
from rig.protocol.experiment import Experiment, gains_of
from rig.run.backend import Backend
from rig.safety.guard import ADVICE, NOT_SAFE
from rig.scene.scene import Scene
from rig.steps.advisor import Advisor

RECORDED_PACKAGES = ("dea-rig", "numpy", "scipy", "mcap", "protobuf", "pydantic", "pyserial", "python-can")


@dataclass(frozen=True)
class Consent:
    """What the operator chose when he started the run, each in words for the log; empty where he did not.

    ``arm``: high voltage is meant. ``answers``: questions are answered as expected, nobody is there. ``take_down``: an
    output found live is to be ramped down. ``clear``: the cause of what the supply has latched is removed.
    """

    arm: str = ""
    answers: str = ""
    take_down: str = ""
    clear: str = ""


def run(
    experiment: Experiment,
    out: Path,
    progress: Callable[[float, float, str], None],
    consent: Consent | None = None,
    say: Callable[[str], None] = lambda text: None,
    origin: Mapping[str, Mapping[str, str]] | None = None,
    show: Callable[[Status], None] | None = None,
    advisor: Advisor | None = None,
) -> Outcome:
    """Carry the experiment out and leave a finished log at ``out``.

    ``show`` is told about five times a second where the run stands, in numbers; it returns at once.
    ``advisor`` fits for a closed loop; a protocol without one needs none.
    ``origin`` is what the log says of the versions and the host that made it, by default the true ones. On the
    simulated bench in memory nobody is asked anything: every question is answered as expected, and the log says so.
    Returns the outcome of a run that ended as planned.

    Raises
    ------
    RigError, drivers.links.link.DeviceError
        What ended the run early; the rig has been made safe and the log finished by then, and the error carries the
        outcome as a note.
    """
    bench_kind = experiment.bench
    in_memory = not experiment.scene.on_real_ports
    if consent is None:
        consent = Consent(IN_MEMORY, IN_MEMORY) if in_memory else Consent()
    if is_real(bench_kind) and consent.answers and experiment.highest_voltage > 0:
        raise ConfigError(
            f"{bench_word(bench_kind)}: the highest voltage is typed by somebody who is there; {consent.answers} "
            "cannot do that. It is for simulated benches: ports count as simulated when they come from the file that "
            "`dea-rig sim` printed, by --ports. Nothing was touched."
        )
    space.check(out, experiment.kept_s, experiment.scene.rates, experiment.summaries)
    backend = Backend(experiment.scene)
    bench = backend.bench
    engine: Engine | None = None
    outcome: Outcome | None = None
    log: LogWriter | LogProcess | None = None
    try:
        problems = _check_dates(experiment.certificates, bench.clock)
        with (
            closing(Control([] if in_memory else _sources(out), consent.answers, say)) as control,
            stop_on_signals(control, control.ask_pause),
            _log(out, experiment.scene) as log,
            _awake(experiment, bench_kind) as awake,
        ):
            _attach(log, experiment, problems, _this_origin() if origin is None else origin)
            if backend.guard is not None and isinstance(log, LogProcess):
                backend.guard.log_to(out, log.second)
                log.second.close()
            engine = Engine(
                bench,
                experiment.actions,
                log,
                _gains(experiment),
                control,
                progress,
                experiment.certificates,
                requested=consent.arm,
                take_down=consent.take_down,
                clear=consent.clear,
                guard_process=backend.guard,
                show=show,
                advisor=advisor,
            )
            if awake:
                engine.recorder.event("info", "host", awake)
            with _undisturbed(experiment.scene):
                outcome, error = engine.run()
            bench.close()  # before the log ends: closing a device may say a last word on its wire
            if not engine.recorder.log_failed:
                log.finish(outcome.as_text())
        if error is not None:
            raise error
        if not (outcome.safe and outcome.standing):
            raise worst(outcome, None)
    except Exception as error:
        told = worst(outcome, error) if outcome is not None else _unended(error, engine)
        if log is not None and (found := next((file for file in (out, log.part) if file.exists()), None)) is not None:
            told.add_note(f"The log so far: {found}")
        if outcome is not None:  # the last line: whatever else is said, this is seen
            told.add_note(f"State of the rig: {outcome.state}.{'' if outcome.safe else ' ' + ADVICE}")
        if told is error:
            raise
        raise told from error
    finally:
        bench.close()
    return outcome


@contextmanager
def _undisturbed(scene: Scene) -> Iterator[None]:
    """On real ports: what was made before the run is left out of Python's search for garbage.

    A search through all of it holds the loop up for longer than the guard allows.
    """
    if not scene.on_real_ports:
        yield
        return
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def worst(outcome: Outcome, error: Exception | None) -> Exception:
    """What is told of a run that ended with ``error``, or without one in a state that is none: the worse of the two.

    An output that was not measured off is worse than anything else, and a stage that may move than a stop or a limit.
    """
    if isinstance(error, NotSafe):
        return error
    ended = "The protocol had ended." if error is None else f"What ended the run: {outcome.reason}"
    if not outcome.safe:
        second = f"{outcome.second[:1].upper()}{outcome.second[1:]}. " if outcome.second else ""
        return NotSafe(f"{NOT_SAFE} {second}{ADVICE} {ended}", device="hv", cause=outcome.reason)
    if not outcome.standing and (error is None or isinstance(error, Stopped | LimitError)):
        words = "The stage did not say that it stands; it may be moving. Cut its power."
        return FaultError(f"{words} {ended}", device="stage", cause=outcome.reason)
    assert error is not None
    return error


def _unended(error: Exception, engine: Engine | None) -> Exception:
    """What is told when not even the way to the safe state came to its end: by what the guard knows."""
    guard = engine.guard if engine is not None else None
    if guard is None or not guard.commanded or guard.output_is_safe:
        return error
    return NotSafe(f"{NOT_SAFE} {ADVICE} What ended the run: {error!r}", device="hv", cause=repr(error))


def _awake(experiment: Experiment, bench_kind: str) -> AbstractContextManager[str]:
    """Keeps the computer from sleeping while there may be voltage on real ports."""
    if is_real(bench_kind) and experiment.highest_voltage > 0:
        return kept_awake(f"high voltage on {experiment.scene.specimen.name}")
    return nullcontext("")


def _sources(out: Path) -> list[Source]:
    from rig.operator.remote import Remote

    keyboard = Keyboard.here()
    return [Remote(out.resolve()), *([keyboard] if keyboard is not None else [])]


def _check_dates(certificates: dict[str, Certificate], clock: Clock) -> list[str]:
    """Problems with the certificates' dates; the engine checks serial numbers once the instruments have answered."""
    today = datetime.fromtimestamp(clock.epoch_ns(clock.now()) * 1e-9, UTC).date()
    return [problem for certificate in certificates.values() for problem in certificate.check("", today)]


def _gains(experiment: Experiment) -> Gains:
    """The gains; where no certificate has a stored zero of the force sensor, that of the run gone on with serves."""
    gains = gains_of(experiment.certificates)
    return gains if gains.stored_zero is not None else replace(gains, stored_zero=experiment.stored_zero)


def _log(out: Path, scene: Scene) -> LogWriter | LogProcess:
    """On real ports a process of its own writes the log; in memory, the same run gives the same bytes."""
    if scene.on_real_ports and os.name == "posix":
        return LogProcess(out)
    return LogWriter(out)


@cache
def _version(package: str) -> str:
    return metadata.version(package)


def _this_origin() -> dict[str, dict[str, str]]:
    return {
        "versions": {name: _version(name) for name in RECORDED_PACKAGES},
        "host": {
            "python": sys.version.split()[0],
            "system": platform.system(),
            "machine": platform.machine(),
            "started": calendar_now().isoformat(timespec="seconds"),
        },
    }


def _attach(
    log: LogWriter | LogProcess, experiment: Experiment, problems: list[str], origin: Mapping[str, Mapping[str, str]]
) -> None:
    """What a reader needs to understand the run; first in the file, so that it survives whatever comes."""
    log.attach("scene.toml", "application/toml", experiment.scene_text.encode())
    log.attach("protocol.toml", "application/toml", experiment.protocol_text.encode())
    for role, certificate in experiment.certificates.items():
        log.attach(f"certificate.{role}.toml", "application/toml", certificate.raw)
    uncalibrated = [role for role in experiment.scene.instruments if role not in experiment.certificates]
    log.metadata(
        "run",
        {
            "scene": experiment.scene.title,
            "protocol": experiment.protocol.title,
            "specimen": experiment.scene.specimen.name,
            "bench": experiment.bench,
            "without_certificate": " ".join(role for role in uncalibrated if role != "stage" and role not in MONITORS),
            "certificate_problems": "; ".join(problems),
        },
    )
    if experiment.resumed is not None:
        log.metadata("resumed", experiment.resumed)
    if experiment.campaign is not None:
        log.metadata("campaign", experiment.campaign)
    for name, table in origin.items():
        log.metadata(name, table)
