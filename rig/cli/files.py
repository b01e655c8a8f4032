"""What commands share about files: types of arguments, JSON, and nothing half-made when a run fails to begin."""

from __future__ import annotations

import glob
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click


class Number(click.FloatRange):
    """A finite number in the unit that the option's name says, within a range."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        text = str(value).strip()
        try:
            finite = abs(float(text)) < float("inf")
        except ValueError:
            finite = False
        if not finite:
            self.fail(f"'{text}': {_number_said(text)}", param, ctx)
        return super().convert(float(text), param, ctx)


def _number_said(text: str) -> str:
    """What is wrong with a text that should be a number."""
    found = re.fullmatch(r"([-+]?\d+)(?:([.,])(\d+))?\s*([^\d.,]*)", text)
    if found is None or not (found[4] or found[2] == ","):
        return "a finite number is needed here, for example 4.5."
    why = "Decimals take a point, not a comma" if found[2] == "," else "The option's name says the unit"
    return f"a number is needed here. {why}: {found[1]}{f'.{found[3]}' if found[3] else ''}."


POSITIVE = Number(min=0, min_open=True)
FILE = click.Path(path_type=Path, dir_okay=False)
FILE_OR_STDIN = click.Path(path_type=Path, dir_okay=False, allow_dash=True)
FOLDER = click.Path(path_type=Path, file_okay=False)


PORTS = click.option(
    "--ports", type=FILE_OR_STDIN, help="Ports by role as `dea-rig sim` prints them, in place of the scene's."
)
CLEAR = click.option(
    "--clear", is_flag=True, help="Clear what the supply has latched: its cause is removed; default: ask."
)


def read_ports(path: Path | None) -> dict[str, dict[str, Any]] | None:
    """The ports by role that `dea-rig sim` printed; None for no file."""
    from rig.base.errors import ConfigError
    from rig.sim.truth import ROLES

    if path is None:
        return None
    ports = read_json(path, "ports")
    if not isinstance(ports, dict) or not all(isinstance(value, dict) for value in ports.values()):
        raise ConfigError(f"{path}: not the JSON that `dea-rig sim` prints: a table of ports by role is needed.")
    known = ROLES
    if unknown := sorted(ports.keys() - {*known, "served_by"}):
        from difflib import get_close_matches

        near = get_close_matches(unknown[0], known, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise ConfigError(f"{path}: {unknown[0]!r} is no role; roles are {', '.join(known)}.{hint}")
    return ports


def read_json(path: Path, kind: str, most: int = 256 * 1024) -> Any:
    """What is in a JSON file, or in standard input for ``-``."""
    from rig.base.errors import ConfigError
    from rig.base.json_text import parse_json
    from rig.base.text_file import decode, read_text

    if str(path) != "-":
        return parse_json(read_text(path, kind, most), kind, str(path))
    data = sys.stdin.buffer.read(most + 1)
    if len(data) > most:
        raise ConfigError(f"standard input: larger than {most // 1024} kB; this is not a file of {kind}.")
    return parse_json(decode(data, "standard input", kind), kind, "standard input")


def tell_written(*paths: Path | None) -> None:
    """One line for each file that was written."""
    for path in paths:
        if path is not None:
            click.echo(f"written: {path}")


@contextmanager
def nothing_without_a_log(log: Path, *steps: Path) -> Iterator[None]:
    """Take ``steps`` away when the run of them fails before it has a log, so that it can be tried again."""
    try:
        yield
    except BaseException:
        if not any(log.parent.glob(f"{glob.escape(log.name)}*")):
            for path in steps:
                path.unlink(missing_ok=True)
        raise
