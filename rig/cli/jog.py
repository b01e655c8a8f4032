"""``dea-rig jog``: move the stage by hand and read the instruments; the voltage stays off."""

from __future__ import annotations

import re
from pathlib import Path

import click

from rig.cli.files import FILE, PORTS, POSITIVE, read_ports

NEGATIVE_NUMBERS = {"ignore_unknown_options": True}  # -0.5 is a way, not an option


@click.command("jog", context_settings=NEGATIVE_NUMBERS)
@click.argument("scene", type=FILE)
@click.argument("moves", nargs=-1)
@PORTS
@click.option("--step-mm", type=POSITIVE, default=0.1, show_default=True, help="How far + and - go.")
@click.option("--speed-mm-per-s", type=POSITIVE, default=1.0, show_default=True, help="Of the stage.")
@click.option("-o", "--out", type=FILE, help="Log to write; default: jog-DATE-TIME.mcap here.")
def command(
    scene: Path, moves: tuple[str, ...], ports: Path | None, step_mm: float, speed_mm_per_s: float, out: Path | None
) -> None:
    """Move the stage of SCENE by hand; after each move every instrument says a line.

    MOVES, in turn: home; read; a position of the stage in mm (20); a way in mm (+0.5, -2). Without MOVES they are typed
    one after another. High voltage stays off and must be measured off; limits, guard and log are those of a run. Stop:
    s, Ctrl-C, `dea-rig stop`.
    """
    from rig.base.clock import calendar_now
    from rig.base.errors import ConfigError
    from rig.base.outputs import check_new
    from rig.cli.running import prepare_step, run_and_tell
    from rig.steps.jog import PATTERN, WORDS

    if bad := next((move for move in moves if not re.fullmatch(PATTERN, move)), None):
        raise click.BadParameter(f"{bad!r} is none of: {WORDS}.", param_hint="MOVES")
    log = out or Path(f"jog-{calendar_now():%Y%m%d-%H%M%S}.mcap")
    check_new(log)
    step = {"do": "jog", "moves": list(moves), "step_mm": step_mm, "speed_mm_per_s": speed_mm_per_s}
    experiment = prepare_step(scene, "The stage by hand", step, read_ports(ports))
    if not moves and not experiment.scene.on_real_ports:
        raise ConfigError(
            f"{scene}: this bench is simulated in memory, where nobody can type. Name the moves (home 20 +0.5), or "
            "serve it: dea-rig sim SCENE > ports.json, and --ports ports.json here."
        )
    run_and_tell(experiment, log, arm=False, yes=False, take_down=False)
