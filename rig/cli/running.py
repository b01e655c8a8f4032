"""``dea-rig run`` and the commands that talk to a run: stop, pause, continue."""

from __future__ import annotations

from pathlib import Path

import click

from rig.base.clock import RealClock
from rig.base.errors import ConfigError
from rig.base.progress import progress
from rig.experiment import Consent, Experiment
from rig.experiment import run as run_experiment
from rig.operator.remote import LiveRun, live_run

LOOK_S = 0.2
ANSWER_S = 3.0  # a run that was told to continue may ask something first
END_S = 600.0  # a ramp down may be slow


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


def wish(word: str, log: Path | None) -> None:
    """Tell the live run what is wanted of it, and what it says to that.

    Raises
    ------
    ConfigError
        When there is no such run, or it does not answer.
    """
    run = live_run(log)
    try:
        if word == "continue":
            _continue(run)
            return
        click.echo(run.send(word)["said"])
        if word == "stop":
            _wait_for_the_end(run)
    except ConnectionError:
        raise ConfigError(f"The run has ended; its log is {run.log}.") from None


def _continue(run: LiveRun) -> None:
    state = run.send("status")
    if not state["question"]:
        click.echo(run.send("continue")["said"])
        state = _next_question(run)
    while state["question"]:
        click.echo(state["question"])
        wanted = f"type {state['expected']}" if state["expected"] else "Enter, or a remark for the log"
        state = run.send(click.prompt(f"  -> {wanted}", default="", show_default=False) or "yes")
        click.echo(state["said"])


def _next_question(run: LiveRun) -> dict[str, str]:
    """A run that was paused under voltage asks before it gives it again."""
    clock = RealClock()
    while not (state := run.send("status"))["question"] and clock.now() < ANSWER_S:
        clock.sleep_until(clock.now() + LOOK_S)
    return state


def _wait_for_the_end(run: LiveRun) -> None:
    clock = RealClock()
    try:
        while clock.now() < END_S:
            run.send("status")
            clock.sleep_until(clock.now() + LOOK_S)
    except ConnectionError:
        click.echo(f"The run has ended; its log is {run.log}.")
