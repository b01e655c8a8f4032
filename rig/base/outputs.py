"""Files that a command is going to write: looked at before the work begins, never over anything that exists."""

from __future__ import annotations

from pathlib import Path

from rig.base.errors import ConfigError


def check_new(*paths: Path | None) -> None:
    """Refuse outputs that exist, have no folder, or are the same file twice; None stands for no output.

    Raises
    ------
    ConfigError
        Naming the file and what to do.
    """
    wanted = [path for path in paths if path is not None]
    for path in wanted:
        if path.is_dir() or not path.name:
            raise ConfigError(f"{path}: this is a directory; name a file in it.")
        if path.exists():
            raise ConfigError(f"{path}: exists already; nothing is overwritten. Name another file, or move it away.")
        if not path.parent.is_dir():
            raise ConfigError(f"{path}: its folder {path.parent} does not exist.")
    if len({path.resolve() for path in wanted}) < len(wanted):
        raise ConfigError(f"{', '.join(map(str, wanted))}: each output needs a file of its own.")


def write_text(path: Path, text: str) -> None:
    """Write a text file that appears whole or not at all.

    Raises
    ------
    ConfigError
        When it cannot be written.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}.") from None
