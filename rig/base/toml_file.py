"""Reading TOML files into strict tables, with errors that an operator can act on."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from rig.base.errors import ConfigError
from rig.base.table import Table

MAX_BYTES = 256 * 1024  # a scene is a page; anything larger is not one, and slow to parse

T = TypeVar("T", bound=Table)


def read_text(path: Path, kind: str) -> str:
    """The text of a small UTF-8 file, or a `ConfigError` that says what is wrong with it."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise ConfigError(f"{path}: there is no such {kind} file.") from None
    except IsADirectoryError:
        raise ConfigError(f"{path}: this is a directory, not a {kind} file.") from None
    except OSError as error:
        raise ConfigError(f"{path}: the {kind} file cannot be read: {error.strerror}.") from None
    if len(data) > MAX_BYTES:
        raise ConfigError(f"{path}: larger than {MAX_BYTES // 1024} kB; this is not a {kind} file.")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text (byte {error.start}); a {kind} file is TOML text.") from None


def load_table(path: Path, table: type[T], kind: str) -> tuple[T, str]:
    """Parse ``path`` as ``table``; also return the exact text, for the log.

    Raises
    ------
    ConfigError
        Naming the file, and for each problem the key, the value found and what is allowed.
    """
    text = read_text(path, kind)
    return parse_table(text, table, kind, str(path)), text


def parse_table(text: str, table: type[T], kind: str, source: str) -> T:
    """Parse TOML ``text`` as ``table``; ``source`` names it in errors."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source}: not valid TOML: {error}.") from None
    except (RecursionError, ValueError) as error:
        raise ConfigError(f"{source}: not a usable {kind} file: {error}.") from None
    return validate(raw, table, kind, source)


def validate(raw: dict[str, Any], table: type[T], kind: str, source: str) -> T:
    """Hold a parsed file against ``table``; ``source`` names it in errors."""
    try:
        return table.model_validate(raw)
    except ValidationError as error:
        raise ConfigError(_explain(error, table, kind, source)) from None


def _explain(error: ValidationError, table: type[Table], kind: str, source: str) -> str:
    """One line a problem: key = value, then what is wrong or allowed."""
    lines = [f"{source}: this {kind} file cannot be used."]
    problems = error.errors(include_url=False)
    for problem in problems[:12]:
        location = problem["loc"]
        key = _key(location)
        message = _in_words(problem)
        if problem["type"] == "extra_forbidden":
            allowed = _allowed_keys(table, location[:-1])
            near = difflib.get_close_matches(str(location[-1]), allowed, n=1, cutoff=0.5)
            hint = f"; did you mean {near[0]}?" if near else ""
            listing = f" Allowed here: {', '.join(allowed)}." if allowed else ""
            lines.append(f"  {key}: unknown key{hint}.{listing}")
        elif problem["type"] == "missing":
            lines.append(f"  {key}: this key is missing.")
        else:
            found = "" if isinstance(problem["input"], dict) else f" = {_short(problem['input'])}"
            lines.append(f"  {key}{found}: {message[:1].lower()}{message[1:]}.")
    if len(problems) > 12:
        lines.append(f"  ... and {len(problems) - 12} more.")
    return "\n".join(lines)


def _in_words(problem: ErrorDetails) -> str:
    """What is wrong, in words of the file rather than of the program that reads it."""
    context = problem.get("ctx", {})
    match problem["type"]:
        case "union_tag_invalid":
            return f"{context['discriminator']} is '{context['tag']}'; allowed are {context['expected_tags']}"
        case "union_tag_not_found":
            return f"the key {context['discriminator']} is missing, which says what kind of table this is"
        case "model_type" | "dict_type" | "model_attributes_type":
            return "a table of keys is needed here"
        case "list_type":
            return "a list in square brackets is needed here"
        case "string_type":
            return "a text in quotes is needed here"
    return problem["msg"].removeprefix("Value error, ")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _key(location: Sequence[int | str]) -> str:
    """("step", 2, "sweep", "speed") -> "step 3, speed": counted from one, without pydantic's union tags."""
    parts: list[str] = []
    after_index = False
    for part in location:
        if isinstance(part, int):
            parts[-1] = f"{parts[-1]} {part + 1}" if parts else f"item {part + 1}"
            after_index = True
        elif after_index and parts and part in _TAGS:
            after_index = False
        else:
            parts.append(part)
            after_index = False
    parts = [p for p in parts if p not in _TAGS] or ["(the file as a whole)"]
    return ", ".join(parts)


# Names that pydantic puts into an error's location for the branch of a union; they are not keys of the file.
_TAGS = {
    "home",
    "zero",
    "approach",
    "precondition",
    "ramp",
    "hold",
    "prompt",
    "sweep",
    "voltage",
    "return",
    "zaber",
    "gsv8",
    "keyence-lkg",
    "iseg-edcp",
    "cia404",
    "shvps",
    "str",
    "MaterialTable",
}


def _allowed_keys(table: type[Table], location: Sequence[int | str]) -> list[str]:
    """The keys of the table at ``location``, followed through lists, options and unions."""
    current: list[type[BaseModel]] = [table]
    for part in location:
        if isinstance(part, int):
            continue
        if part in _TAGS:
            current = [c for c in current if _is_branch(c, part)] or current
            continue
        following: list[type[BaseModel]] = []
        for model in current:
            field = model.model_fields.get(part)
            if field is not None:
                following += _tables_in(field.annotation)
        if following:
            current = following
    return sorted({name for model in current for name in model.model_fields})


def _is_branch(model: type[BaseModel], tag: str) -> bool:
    for name in ("do", "driver"):
        field = model.model_fields.get(name)
        if field is not None and tag in get_args(field.annotation):
            return True
    return False


def _tables_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for argument in get_args(annotation) for found in _tables_in(argument)]
