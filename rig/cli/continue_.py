"""``dea-rig continue``: let a paused run go on, or answer what a run asks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rig.cli.files import FILE

if TYPE_CHECKING:
    from rig.operator.live import LiveRun

ANSWER_S = 3.0  # a run that was told to continue may ask something first


@click.command("continue")
@click.argument("log", required=False, type=FILE)
def command(log: Path | None) -> None:
    """Continue a paused run, or answer what a run asks. LOG names the run if there are several."""
    from rig.cli.talk import speaking_to

    with speaking_to(log) as run:
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
    from rig.base.clock import RealClock
    from rig.cli.talk import LOOK_S

    clock = RealClock()
    while not (state := run.send("status"))["question"] and clock.now() < ANSWER_S:
        clock.sleep_until(clock.now() + LOOK_S)
    return state
