"""What commands share about files: types of arguments, JSON, and nothing half-made when a run fails to begin."""

from __future__ import annotations

import glob
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

FILE = click.Path(path_type=Path, dir_okay=False)
FILE_OR_STDIN = click.Path(path_type=Path, dir_okay=False, allow_dash=True)
FOLDER = click.Path(path_type=Path, file_okay=False)


def read_ports(path: Path | None) -> dict[str, dict[str, Any]] | None:
    """The ports by role that `dea-rig sim` printed; None for no file."""
    from rig.base.errors import ConfigError

    if path is None:
        return None
    ports = read_json(path, "ports")
    if not isinstance(ports, dict) or not all(isinstance(value, dict) for value in ports.values()):
        raise ConfigError(f"{path}: not the JSON that `dea-rig sim` prints: a table of ports by role is needed.")
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
