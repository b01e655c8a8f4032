"""What the commands that run something share: consent, progress, and how it ended."""

from __future__ import annotations

from pathlib import Path

import click

from rig.base.errors import ConfigError
from rig.base.progress import progress
from rig.protocol.experiment import Experiment
from rig.run.run import Consent
from rig.run.run import run as run_experiment


def run_and_tell(experiment: Experiment, out: Path, *, arm: bool, yes: bool, take_down: bool) -> None:
    """Carry out a prepared experiment with progress on the terminal, and say how it ended.

    Raises
    ------
    ConfigError
        When high voltage is planned on real ports and was not asked for.
    """
    scene = experiment.scene
    consent = None
    if scene.on_real_ports:
        highest = max(max(action.voltage) for action in experiment.actions)
        if highest > 0 and not arm:
            raise ConfigError(f"This run goes up to {highest:g} V on a real port. If that is meant, add --arm.")
        if highest > 0 and yes and scene.simulation is None:
            raise ConfigError("--yes is for simulated benches: on a real one the highest voltage is typed by somebody.")
        consent = Consent(
            "--arm on the command line" if arm else "",
            "--yes on the command line" if yes else "",
            "--take-down on the command line" if take_down else "",
        )
    with progress(f"{scene.specimen.name}: {experiment.protocol.title}") as update:
        outcome = run_experiment(experiment, out, update, consent, lambda text: click.echo(text, err=True))
    click.echo(f"{out}: {outcome.reason} after {outcome.duration:.0f} s; {outcome.state}.")
