"""The keys of a file's tables, as their tables declare them: for the reference page, presets and tests."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from datetime import date
from typing import Any, Literal, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from rig.base.problems import options, shown
from rig.base.unusual import usual_of

KINDS = {float: "number", int: "whole number", str: "text", bool: "true or false", date: "date"}


@dataclass(frozen=True)
class Key:
    """One key of a table.

    Attributes
    ----------
    name : str
    kind : str
        What its value is, in words: "number", "list of numbers", "table".
    allowed : str
        Its range or its choices; empty when any value of the kind will do.
    default : str or None
        As it would stand in a file; None when the key must be given, empty when it may be left out.
    usual : tuple or None
        Between which values it usually is.
    text : str
        Its description.
    """

    name: str
    kind: str
    allowed: str
    default: str | None
    usual: tuple[float, float] | None
    text: str

    @property
    def needed(self) -> bool:
        return self.default is None


def keys_of(table: type[BaseModel]) -> list[Key]:
    """The keys of one table, in the order in which they are declared."""
    return [_key(name, field) for name, field in table.model_fields.items()]


def _key(name: str, field: FieldInfo) -> Key:
    kinds = options(field.annotation)
    words = dict.fromkeys(_kind(kind) for kind in kinds)
    limits = [*_limits(field.metadata), *_choices(kinds)]
    inner = [one for kind in kinds if get_origin(kind) is list for one in get_args(kind)]
    limits += [f"each {limit}" for one in inner for limit in _limits(getattr(one, "__metadata__", ()))]
    default = None if field.is_required() else _default(field)
    return Key(name, " or ".join(words), ", ".join(limits), default, usual_of(field), field.description or "")


def _kind(kind: Any) -> str:
    origin = get_origin(kind)
    if origin is list:
        inner = " or ".join(dict.fromkeys(_kind(one) for one in options(get_args(kind)[0])))
        return f"list of {inner}s" if inner in ("number", "whole number", "text", "table") else f"list of {inner}"
    if origin is Literal:
        return "true or false" if set(get_args(kind)) == {True, False} else KINDS.get(type(get_args(kind)[0]), "text")
    if origin is dict or (isinstance(kind, type) and issubclass(kind, BaseModel)):
        return "table"
    return KINDS.get(kind, "value")


def _limits(said: Sequence[Any]) -> list[str]:
    """The range that constraints allow, in words: "1 to 6", "greater than 0"."""
    flat = [inner for one in said for inner in getattr(one, "metadata", [one])]
    low = next((f"{one.ge:g}" for one in flat if isinstance(one, Ge)), None)
    high = next((f"{one.le:g}" for one in flat if isinstance(one, Le)), None)
    above = next((f"greater than {one.gt:g}" for one in flat if isinstance(one, Gt)), None)
    below = next((f"less than {one.lt:g}" for one in flat if isinstance(one, Lt)), None)
    if low is not None and high is not None:
        return [f"{low} to {high}"]
    found = [f"at least {low}" if low is not None else above, f"at most {high}" if high is not None else below]
    return [text for text in found if text is not None]


def _choices(kinds: Sequence[Any]) -> list[str]:
    found = [shown(one) for kind in kinds if get_origin(kind) is Literal for one in get_args(kind)]
    return [" | ".join(found)] if found else []


def _default(field: FieldInfo) -> str:
    value = field.get_default(call_default_factory=True) if not _needs_data(field) else None
    if value is None or isinstance(value, BaseModel) or value in ("", [], {}):
        return ""
    return f"[{', '.join(shown(one) for one in value)}]" if isinstance(value, list) else shown(value)


def _needs_data(field: FieldInfo) -> bool:
    return bool(field.default_factory_takes_validated_data)


def tables_in(
    table: type[BaseModel], name: str = "", without: Collection[type[BaseModel]] = ()
) -> Iterator[tuple[str, type[BaseModel]]]:
    """A table and those within it, each once, with the name under which it stands in the file.

    ``without`` names tables that are left out, with what is in them.
    """
    seen = set(without)
    waiting = [(name, table)]
    while waiting:
        name, table = waiting.pop(0)
        if table in seen:
            continue
        seen.add(table)
        yield name, table
        for key, field in table.model_fields.items():
            waiting += [(f"{name}.{key}" if name else key, one) for one in _tables(field.annotation, field.metadata)]


def _tables(annotation: Any, said: Sequence[Any] = ()) -> list[type[BaseModel]]:
    """The tables that an annotation allows, those of a registry (`rig.base.choice.Choice`) among them."""
    for one in (*said, *getattr(annotation, "__metadata__", ())):
        if hasattr(one, "table_of"):
            return [table for name in one.names() if (table := one.find(name)) is not None]
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [table for inner in get_args(annotation) for table in _tables(inner)]


def undescribed(table: type[BaseModel], name: str) -> list[str]:
    """Dotted names of the keys in a file's tables that have no description."""
    return [
        f"{place}.{key.name} ({one.__name__})"
        for place, one in tables_in(table, name)
        for key in keys_of(one)
        if not key.text
    ]
