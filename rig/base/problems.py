"""What a strict table refuses, in words of the file: key, value, what is allowed, and what is probably meant."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from rig.base.errors import ConfigError
from rig.base.text import printable
from rig.base.unusual import slip, usual_of

T = TypeVar("T")

MOST_LINES = 10  # problems that are told of one file

# By which keys a file of each kind is known when it is named in another's place.
SIGNS = {
    "scene": {"specimen", "limits", "stage"},
    "protocol": {"step"},
    "certificate": {"valid_from", "valid_until"},
    "study": {"study"},
    "campaign": {"specimen", "logs", "order"},
}


def explain(error: ValidationError, raw: Mapping[str, Any], table: type[BaseModel], kind: str, source: str) -> str:
    """The problems of one file, one line each.

    Parameters
    ----------
    raw : mapping
        The values as parsed.
    table : type
        What they were held against.
    kind, source : str
        What the file should be ("scene"), and its name.
    """
    wrong = wrong_kind(raw, kind, source)
    if wrong:
        return wrong
    found = [(place_of(table, raw, one["loc"]), one) for one in error.errors(include_url=False)]
    problems = _one_branch_each(found)
    unknown = {_near(place, problem) for place, problem in problems if problem["type"] == "extra_forbidden"}
    lines = [
        f"  {place.name}{_words(place, problem)}"
        for place, problem in problems
        if not (problem["type"] == "missing" and place.keys[-1:] and place.keys[-1] in unknown)
    ]
    lines = list(dict.fromkeys(lines))
    rest = [f"  ... and {len(lines) - MOST_LINES} more."] if len(lines) > MOST_LINES else []
    return "\n".join([f"{source}: this {kind} file cannot be used.", *lines[:MOST_LINES], *rest])


def wrong_kind(raw: Mapping[str, Any], kind: str, source: str) -> str:
    """What to tell of a file that is empty or of another kind than is wanted; empty when it may be that kind."""
    if not raw:
        return f"{source}: this {kind} file is empty. `dea-rig keys {kind}` lists what belongs in it."
    other = next((name for name, signs in SIGNS.items() if name != kind and signs & raw.keys()), None)
    if other is not None and not SIGNS.get(kind, set()) & raw.keys():
        return f"{source}: this is a {other} file, not a {kind} file. Were two files named in the wrong order?"
    return ""


def kind_of_table(raw: Mapping[str, Any], key: str, kinds: Mapping[str, T], kind: str, source: str) -> T:
    """Which of several kinds of one file a table is, by its key ``key``.

    Raises
    ------
    ConfigError
        With the kinds that there are.
    """
    tag = raw.get(key)
    if isinstance(tag, str) and tag in kinds:
        return kinds[tag]
    wrong = wrong_kind(raw, kind, source)
    if wrong:
        raise ConfigError(wrong)
    what = f"{key} = {shown(tag)}" if key in raw else f"{key}: this key is missing"
    raise ConfigError(f"{source}: this {kind} file cannot be used.\n  {what}: {_one_of(str(tag), list(kinds))}.")


@dataclass
class Place:
    """Where in a file a problem is.

    Attributes
    ----------
    keys : list of str
        From the outermost table on; of lists the items are counted from one ("step 3").
    types : list of type
        What may stand there.
    tables : list of type
        What the table is in which it stands.
    field : FieldInfo or None
        The declaration of its key.
    value : object
        What stands there in the file.
    branches : list of (depth, label, whether that is a table, whether the file has a table there)
        Which of several types the problem speaks of.
    """

    keys: list[str]
    types: list[Any]
    tables: list[type[BaseModel]]
    field: FieldInfo | None
    value: Any
    branches: list[tuple[int, str, bool, bool]]

    @property
    def name(self) -> str:
        names = (key if len(key) <= 60 else f"{key[:57]}..." for key in self.keys)
        return printable(", ".join(names)) or "(the file as a whole)"


def place_of(table: type[BaseModel], raw: Any, location: Sequence[int | str]) -> Place:
    """Follow pydantic's location through types and values; names of a union's branches are no keys."""
    place = Place([], [table], [], None, raw, [])
    for depth, part in enumerate(location):
        if len(place.types) > 1:
            chosen = [one for one in place.types if _answers(one, str(part))] or place.types
            place.types = chosen[:1]
            place.branches.append((depth, str(part), _is_table(place.types[0]), isinstance(place.value, Mapping)))
        elif isinstance(part, int):
            _enter_item(place, part)
        else:
            _enter_key(place, part)
    return place


def _enter_item(place: Place, number: int) -> None:
    name = f"{place.keys.pop()} {number + 1}" if place.keys else f"item {number + 1}"
    place.keys.append(name)
    known = isinstance(place.value, list) and number < len(place.value)
    place.value = place.value[number] if known else None
    place.types = [one for kind in place.types for inner in get_args(kind) for one in options(inner, place.value)]


def _enter_key(place: Place, key: str) -> None:
    place.keys.append(key)
    place.tables = [one for one in place.types if _is_table(one)]
    place.field = next((one.model_fields[key] for one in place.tables if key in one.model_fields), None)
    place.value = place.value.get(key) if isinstance(place.value, Mapping) else None
    if place.field is not None:
        place.types = _chosen(place.field.metadata, place.value) or options(place.field.annotation, place.value)
    else:  # a table of any keys, or an unknown key
        inner = [get_args(kind)[1] for kind in place.types if get_origin(kind) is dict]
        place.types = [one for kind in inner for one in options(kind, place.value)]


def options(annotation: Any, value: Any = None) -> list[Any]:
    """The types that an annotation allows, without None; of a registry's tables the one that ``value`` names."""
    origin = get_origin(annotation)
    if origin is Annotated:
        kind, *said = get_args(annotation)
        return _chosen(said, value) or options(kind, value)
    if origin in (Union, UnionType):
        return [one for argument in get_args(annotation) for one in options(argument, value)]
    return [] if annotation in (None, NoneType) else [annotation]


def _chosen(said: Sequence[Any], value: Any) -> list[Any]:
    """The table that a value names where a registry (`rig.base.choice.Choice`) stands beside the type."""
    tables = [one.table_of(value) for one in said if hasattr(one, "table_of")]
    return [table for table in tables if table is not None]


def _is_table(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _answers(kind: Any, label: str) -> bool:
    """Whether a union's branch goes by this name: its tag, or its class."""
    name = getattr(kind, "__name__", str(kind))
    if label == name or f"{name}]" in label or label.startswith(f"{name}["):
        return True
    return _is_table(kind) and any(
        get_origin(one) is Literal and label in get_args(one)
        for field in kind.model_fields.values()
        for one in options(field.annotation)
    )


def _one_branch_each(found: list[tuple[Place, ErrorDetails]]) -> list[tuple[Place, ErrorDetails]]:
    """Of a value that may be one thing or another, only what speaks of what it probably is."""
    kept = []
    for place, problem in found:
        rivals = [
            (other, one)
            for other, one in found
            if any(
                mine[0] == theirs[0] and mine[1] != theirs[1] and problem["loc"][: mine[0]] == one["loc"][: mine[0]]
                for mine in place.branches
                for theirs in other.branches
            )
        ]
        wrong = any(is_table != has_table for _, _, is_table, has_table in place.branches)
        better = any(all(is_table == has for _, _, is_table, has in other.branches) for other, _ in rivals)
        if not (rivals and wrong and better):
            kept.append((place, problem))
    return kept


def _words(place: Place, problem: ErrorDetails) -> str:
    """What is wrong at a place: " = value: what is allowed"."""
    kind = problem["type"]
    if kind == "missing":
        what = "table" if place.types and all(map(_is_table, place.types)) else "key"
        return f": this {what} is missing. {_described(place)}".rstrip()
    if kind == "extra_forbidden":
        allowed = sorted({name for one in place.tables for name in one.model_fields})
        near = _near(place, problem)
        hint = f"; did you mean {near}?" if near else "."
        return f": unknown key{hint} Allowed here: {', '.join(allowed)}."
    value = problem["input"]
    found = "" if isinstance(value, Mapping) or not place.keys else f" = {shown(value)}"
    if kind == "value_error":
        text = str(problem.get("ctx", {}).get("error", "")) or "this cannot be"
        return f"{found}: {text.removesuffix('.')}{'' if text.endswith('?') else '.'}"
    hints = [_slip(place, value), _described(place)]
    return f"{found}: {_rule(place, problem)}. {' '.join(hint for hint in hints if hint)}".rstrip()


def _near(place: Place, problem: ErrorDetails) -> str:
    """The allowed key that is most like the unknown one."""
    allowed = sorted({name for one in place.tables for name in one.model_fields})
    near = difflib.get_close_matches(str(problem["loc"][-1])[:60], allowed, n=1, cutoff=0.5)
    return near[0] if near else ""


def _rule(place: Place, problem: ErrorDetails) -> str:
    """What is allowed, in words of the file rather than of the program that reads it."""
    context: Mapping[str, Any] = problem.get("ctx", {})
    value = problem["input"]
    match problem["type"]:
        case "greater_than":
            return f"it must be greater than {context['gt']:g}"
        case "greater_than_equal":
            return f"it must be at least {context['ge']:g}"
        case "less_than":
            return f"it must be less than {context['lt']:g}"
        case "less_than_equal":
            return f"it must be at most {context['le']:g}"
        case "finite_number":
            return "it must be a finite number"
        case "float_type" | "float_parsing" | "int_type" | "int_parsing" | "int_from_float" | "int_parsing_size":
            return _number_needed(value, whole=problem["type"].startswith("int"))
        case "bool_type" | "bool_parsing":
            return "true or false is needed here, without quotes"
        case "string_type":
            return "a text in quotes is needed here"
        case "string_too_short":
            return f"at least {context['min_length']} letters are needed"
        case "string_too_long":
            return f"at most {context['max_length']} letters are allowed"
        case "string_pattern_mismatch":
            return "it holds letters that are not allowed here"
        case "too_short":
            return f"at least {context['min_length']} values are needed, there are {context['actual_length']}"
        case "too_long":
            return f"at most {context['max_length']} values are allowed, there are {context['actual_length']}"
        case "list_type":
            if isinstance(value, Mapping):
                return f"each of these tables begins with two brackets: [[{place.keys[-1]}]]"
            example = f": [{shown(value)}]" if isinstance(value, int | float | str) else ""
            return f"a list in square brackets is needed here{example}"
        case "model_type" | "dict_type" | "model_attributes_type":
            return f"a table of keys is needed here, [{place.keys[-1]}]" if place.keys else "keys are needed here"
        case "literal_error":
            return _one_of(str(value), [str(a) for one in place.types for a in get_args(one)] or [context["expected"]])
        case "union_tag_invalid":
            tags = [tag.strip("' ") for tag in str(context["expected_tags"]).split(",")]
            return f"{str(context['discriminator']).strip(chr(39))} = {shown(context['tag'])} is not known; " + _one_of(
                str(context["tag"]), tags
            )
        case "union_tag_not_found":
            key = str(context["discriminator"]).strip("'").removesuffix("()") or "kind"
            return f"the key {key} is missing, which says what kind of table this is; allowed are {_tags(place, key)}"
        case "choice_unknown":
            return _one_of(str(value), context["allowed"])
        case "choice_missing":
            allowed = ", ".join(shown(name) for name in context["allowed"])
            return f"this key is missing, which says what kind of table this is; allowed are {allowed}"
        case "date_type" | "date_parsing" | "date_from_datetime_parsing" | "date_from_datetime_inexact":
            return "a date without quotes is needed here: 2026-01-31"
    return "this value cannot be used here"


def _number_needed(value: object, *, whole: bool) -> str:
    what = "a whole number" if whole else "a number"
    if isinstance(value, str):
        text = value.strip().replace(",", ".")
        digits = text.split()[0] if text else ""
        try:
            float(digits)
        except ValueError:
            return f"{what} without quotes is needed here"
        return f"{what} without quotes is needed here: {digits}"
    return f"{what} is needed here"


def _one_of(value: str, allowed: list[str]) -> str:
    near = difflib.get_close_matches(value[:60], allowed, n=1, cutoff=0.5)
    hint = f"did you mean {shown(near[0])}? " if near else ""
    return f"{hint}allowed are {', '.join(shown(one) for one in allowed)}"


def _tags(place: Place, key: str) -> str:
    found = [
        shown(tag)
        for table in place.types
        if _is_table(table) and key in table.model_fields
        for one in options(table.model_fields[key].annotation)
        for tag in get_args(one)
    ]
    return ", ".join(found) or "those that `dea-rig keys` lists"


def _slip(place: Place, value: object) -> str:
    usual = usual_of(place.field)
    if usual is None or isinstance(value, bool) or not (isinstance(value, int | float) and math.isfinite(value)):
        return ""
    return f"Usual are {usual[0]:g} to {usual[1]:g}. {slip(place.keys[-1].split(' ')[0], value, usual)}".rstrip()


def _described(place: Place) -> str:
    text = (place.field.description or "") if place.field is not None else ""
    return text and (text if text.endswith(".") else f"{text}.")


def shown(value: object) -> str:
    """A value as it stands in the file, cut to a few words."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int) and abs(value) > 10**30:
        return "a very long number"
    text = f'"{printable(value)}"' if isinstance(value, str) else printable(repr(value))
    return text if len(text) <= 60 else text[:57] + "..."
