"""Options that all fits share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import click

fix_option = click.option(
    "--fix",
    "fixed",
    multiple=True,
    metavar="NAME=VALUE",
    help="Hold a parameter that is known: alpha1=2, Jm=40, of a cone eps_r=2.8. May be repeated.",
)


def fixed_values(words: Sequence[str]) -> dict[str, float]:
    """Parameters to be held, from ``name=value``."""
    found = {}
    for word in words:
        name, _, value = word.partition("=")
        try:
            found[name.strip()] = float(value)
        except ValueError:
            raise click.BadParameter(f"{word!r}: write name=value, as in alpha1=2", param_hint="--fix") from None
        if not math.isfinite(found[name.strip()]):
            raise click.BadParameter(f"{word!r}: the value is not a number", param_hint="--fix")
    return found


def branches_wanted(words: str | None, elastic: str) -> int | Literal["auto"]:
    """How many branches; 0 without the option. Options of an ``elastic`` law, which are named, do not go with it.

    Raises
    ------
    click.UsageError
        When ``elastic`` names such options, or the number is none.
    """
    if words is None:
        return 0
    if elastic:
        raise click.UsageError(f"--branches goes without {elastic}: that is of an elastic law.")
    if words.strip().lower() == "auto":
        return "auto"
    if words.strip() not in ("1", "2", "3"):
        raise click.BadParameter(f"{words!r}: give 1, 2, 3, or auto", param_hint="--branches")
    return int(words)
