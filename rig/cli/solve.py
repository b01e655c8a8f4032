"""``dea-rig solve``: single states of a film, from JSON to JSON."""

from __future__ import annotations

import json
from pathlib import Path

import click

from rig.cli.files import FILE_OR_STDIN, read_json

MOST_BYTES = 16 * 1024 * 1024


@click.command("solve")
@click.argument("cases", type=FILE_OR_STDIN)
def command(cases: Path) -> None:
    """Solve the films in CASES.json (- reads standard input) and print the answers as JSON.

    Exit code 1 when not a single case describes a film.

    CASES is a list of objects in SI units with id, a, b, thickness, prestretch, h, voltage, wrinkling ("plain" or
    "tension_field"), material {mu, alpha, eps_r} and optionally tolerance.

    A film that takes time has material {..., branches: [{ratio, time_s}]}, history {t, h, voltage} and times in place
    of h and voltage. Where its disk is free to move, history has weight (N) in place of h, or the case has bias
    {kind, ...} (mass, spring, antagonist, bistable, tabulated): then h is among the answers.
    """
    from rig.analysis.cases import CaseError, solve_cases
    from rig.base.errors import ConfigError

    try:
        answers = solve_cases(read_json(cases, "cases", MOST_BYTES))
    except CaseError as error:
        raise ConfigError(f"{cases}: {error}.") from None
    click.echo(json.dumps(answers, indent=2))
    if answers and all(answer["status"] == "invalid" for answer in answers):
        click.get_current_context().exit(1)
