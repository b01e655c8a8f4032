"""Strict JSON: limits before the parser sees it, no key twice, no number that is none."""

from __future__ import annotations

import json
import math
import re
from typing import Any

from rig.base.errors import ConfigError
from rig.base.text import control_in, printable

MAX_DEPTH = 64
MAX_DIGITS = 40  # of one number: a double has 17
_NESTING = re.compile(r'"(?:\\.|[^"\\])*"|[\[{]|[\]}]', re.S)


def parse_json(text: str, kind: str, source: str) -> Any:
    """The value in a JSON text of a ``kind`` ("ports"); ``source`` names it in errors.

    Raises
    ------
    ConfigError
        Not JSON, nested too deeply, a key twice, a number that is too long, too large or not finite.
    """
    depth = 0
    for token in _NESTING.finditer(text):
        depth += {"[": 1, "{": 1, "]": -1, "}": -1}.get(token.group(), 0)
        if depth > MAX_DEPTH:
            raise ConfigError(f"{source}: brackets more than {MAX_DEPTH} deep; this is not a file of {kind}.")
    try:
        return json.loads(
            text,
            object_pairs_hook=_unique,
            parse_float=_number,
            parse_int=_whole,
            parse_constant=_no_constant,
        )
    except json.JSONDecodeError as error:
        line = printable(text.split("\n")[error.lineno - 1].strip()[:72])
        where = f"line {error.lineno} is not understood at column {error.colno}"
        raise ConfigError(f"{source}: not a JSON file of {kind}: {where}.\n  {line}") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{source}: not a usable JSON file of {kind}: {error}.") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f'the key "{printable(key)[:60]}" stands twice in one object')
        if control_in(key) is not None:
            raise ValueError(f'the key "{printable(key)[:60]}" holds a control character')
        found[key] = value
    return found


def _number(text: str) -> float:
    if len(text) > MAX_DIGITS:
        raise ValueError(f"a number of {len(text)} digits")
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is larger than any number here can be")
    return value


def _whole(text: str) -> int:
    if len(text) > MAX_DIGITS:
        raise ValueError(f"a number of {len(text)} digits")
    return int(text)


def _no_constant(text: str) -> float:
    raise ValueError(f"{text} is not a number")
