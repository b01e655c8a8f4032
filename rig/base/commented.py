"""TOML with every key explained: tables written from their declarations, for files that people go on editing."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping
from datetime import date

from pydantic import BaseModel

from rig.base.reference import keys_of

Value = float | int | bool | str | date | list[float]
WIDTH = 100


def commented(heading: str, table: type[BaseModel], values: Mapping[str, Value]) -> str:
    """One table: each key with its description above it; what is not given is left as a remark with its default.

    ``heading`` is the table's line in the file, "" for keys at its top.
    """
    lines = [heading] if heading else []
    for key in keys_of(table):
        if key.name not in values and (key.needed or key.kind == "table" or key.kind.startswith("list of table")):
            continue
        lines += textwrap.wrap(key.text, WIDTH, initial_indent="# ", subsequent_indent="# ")
        if key.name in values:
            lines.append(f"{key.name} = {written(values[key.name])}")
        else:
            lines.append(f"# {key.name} = {key.default or '...'}")
    return "\n".join(lines) + "\n"


def written(value: Value) -> str:
    """A value as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return f"[{', '.join(written(one) for one in value)}]"
    if isinstance(value, float):
        return f"{value:.6g}" if "e" in f"{value:.6g}" or "." in f"{value:.6g}" else f"{value:.6g}.0"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else str(value)
