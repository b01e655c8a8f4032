"""TOML files into strict tables, with errors that an operator can act on."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from rig.base.errors import ConfigError
from rig.base.problems import explain
from rig.base.table import Table
from rig.base.text_file import read_text
from rig.base.toml_text import parse_toml
from rig.base.unusual import check_usual

T = TypeVar("T", bound=Table)


def load_table(path: Path, table: type[T], kind: str) -> tuple[T, str]:
    """Parse ``path`` as ``table``; also return the exact text, for the log.

    Raises
    ------
    ConfigError
        Naming the file, and for each problem the key, the value found and what is allowed; also for values that are
        possible but hardly meant.
    """
    text = read_text(path, kind)
    found = parse_table(text, table, kind, str(path))
    check_usual(found, kind, str(path))
    return found, text


def parse_table(text: str, table: type[T], kind: str, source: str) -> T:
    """Parse TOML ``text`` as ``table``; ``source`` names it in errors. Unusual values pass."""
    return validate(parse_toml(text, kind, source), table, kind, source)


def validate(raw: dict[str, Any], table: type[T], kind: str, source: str) -> T:
    """Hold a parsed file against ``table``; ``source`` names it in errors."""
    try:
        return table.model_validate(raw)
    except ValidationError as error:
        raise ConfigError(explain(error, raw, table, kind, source)) from None
