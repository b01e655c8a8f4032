"""What the commands that run something share: consent, progress, and how it ended."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from drivers.links.link import DeviceError
from rig.base.errors import ConfigError, FaultError, RigError
from rig.base.terminal import tell
from rig.cli.swapped import others_on_its_ports
from rig.log.contents import IN_MEMORY, bench_word
from rig.operator.display import Display
from rig.operator.notice import tell_end
from rig.operator.status import Status
from rig.protocol.experiment import Experiment, prepare
from rig.run.run import Consent
from rig.run.run import run as run_experiment
from rig.safety.arming import undetectable
from rig.scene.scene import Scene
from rig.steps.advisor import Advisor
from rig.steps.learn import Learn
from rig.steps.output import CLEARED


def prepare_step(scene: Path, title: str, step: Mapping[str, Any], ports: dict[str, Any] | None) -> Experiment:
    """The experiment that is a single step of these keys."""
    with TemporaryDirectory(prefix="dea-rig-") as folder:
        steps = Path(folder) / f"{step['do']}.toml"
        lines = [f'title = "{title}"', "", "[[step]]", *(f"{key} = {json.dumps(value)}" for key, value in step.items())]
        steps.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return prepare(scene, steps, ports)


def run_and_tell(
    experiment: Experiment, out: Path, *, arm: bool, yes: bool, take_down: bool, clear: bool = False
) -> None:
    """Carry out a prepared experiment with progress on the terminal, and say how it ended.

    Raises
    ------
    ConfigError
        When high voltage is planned on real ports and was not asked for.
    """
    scene, highest = experiment.scene, experiment.highest_voltage
    kind = experiment.bench
    word = bench_word(kind)
    if scene.on_real_ports and highest > 0 and not arm:
        raise ConfigError(f"{word}: this run goes up to {highest:g} V. If that is meant, add --arm.")
    in_memory = "" if scene.on_real_ports else IN_MEMORY  # there nobody is asked
    consent = Consent(
        in_memory or ("--arm on the command line" if arm else ""),
        in_memory or ("--yes on the command line" if yes else ""),
        "--take-down on the command line" if take_down else "",
        CLEARED if clear else "",
    )
    begun = False

    def show(status: Status) -> None:
        nonlocal begun
        begun = True
        display.show(status)

    try:
        with Display(f"{word}: {kind}. {scene.specimen.name}: {experiment.protocol.title}", word) as display:
            if arm and highest > 0 and scene.on_real_ports:
                display.say(undetectable(_second(scene)))
            with _advisor(experiment, out) as advisor:
                outcome = run_experiment(
                    experiment,
                    out,
                    lambda done, total, label: None,
                    consent,
                    display.say,
                    show=show,
                    advisor=advisor,
                )
    except (RigError, DeviceError) as error:
        if not begun and scene.on_real_ports and isinstance(error, FaultError | DeviceError):
            for line in others_on_its_ports(scene):
                error.add_note(line)
        _tell_elsewhere(experiment, out, getattr(error, "exit_code", 4), f"{word}: {out}: {error}")
        raise
    said = f"{word}: {out}: {outcome.reason} after {outcome.duration:.0f} s; {outcome.state}."
    tell(said, "stdout")
    _tell_elsewhere(experiment, out, 0, said)


def _advisor(experiment: Experiment, out: Path) -> AbstractContextManager[Advisor | None]:
    """Who fits for a closed loop, where the protocol has one."""
    if not any(isinstance(step, Learn) for step in experiment.protocol.step):
        return nullcontext()
    from rig.analysis.refitting import RefitProcess

    return RefitProcess(experiment, out)


def _second(scene: Scene) -> str:
    """The second reading of the voltage, in words; empty: there is none."""
    role = scene.second_reading
    return f"{role}: {scene.monitors[role].driver}" if role else ""


def _tell_elsewhere(experiment: Experiment, out: Path, exit_code: int, text: str) -> None:
    """By the scene's ``on_end``: of a run that goes on with a log it is that log's, which others may have written."""
    command = experiment.scene.on_end if experiment.resumed is None else []
    if problem := tell_end(command, str(out.resolve()), exit_code, text):
        tell(f"on_end: {problem}.", colour="red")
