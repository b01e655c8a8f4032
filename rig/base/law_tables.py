"""Tables of a file that hold the parameters of a law: one table a law, made from what the law says of itself."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, Literal, TypeVar, Union

from pydantic import BeforeValidator, Discriminator, Field, Tag, create_model

from model.material.law import Law
from model.material.laws import find_law, known_laws
from model.material.ogden import Ogden
from rig.base.table import Table

DEFAULT = Ogden.name  # the law of a table that names none
MOST_TERMS = 6

T = TypeVar("T", bound=Table)


@cache
def law_table(base: type[T], law: type[Law], *, optional: bool) -> type[T]:
    """``base`` with the keys of one law; with ``optional`` they may be left out, all together."""
    of_law = f"The film's law: {law.title}. Others: {', '.join(name for name in known_laws() if name != law.name)}."
    default: Any = law.name if law.name == DEFAULT else ...
    fields: dict[str, Any] = {"law": (Literal[law.name], Field(default=default, description=of_law))}
    for p in law.parameters(*law.counts(1)):
        bounds: dict[str, Any] = {"ge": p.lower, "le": p.upper}
        number: Any = Annotated[float, Field(**{how: at for how, at in bounds.items() if math.isfinite(at)})]
        kind: Any = Annotated[list[number], Field(min_length=1, max_length=MOST_TERMS)] if law.series else number
        words = f"{p.description} One value a term." if law.series else p.description
        if optional:
            kind, words = kind | None, f"{words} Absent: as in the scene."
        fields[p.key] = (kind, Field(default=None if optional else ..., description=words))
    return create_model(f"{law.__name__}{base.__name__}", __base__=base, __doc__=law.description, **fields)


def any_law(base: type[Table], *named: type[str], optional: bool = False) -> Any:
    """The type of a key that holds ``base`` with the keys of the law that it names; ``named``: or a name in quotes."""
    tables = [Annotated[law_table(base, law, optional=optional), Tag(name)] for name, law in known_laws().items()]
    names = [Annotated[str, Tag("str")] for _ in named]
    kinds: Any = Union[(*names, *tables)]  # made at run time
    return Annotated[kinds, Discriminator(_law_of), BeforeValidator(_of_known_law)]


def _law_of(value: object) -> str:
    if isinstance(value, str):
        return "str"
    if isinstance(value, Mapping):
        return str(value.get("law", DEFAULT))
    return str(getattr(value, "law", DEFAULT))


def _of_known_law(value: object) -> object:
    law = value.get("law", DEFAULT) if isinstance(value, Mapping) else DEFAULT
    if not isinstance(law, str):
        raise ValueError(f"law = {law!r}: the name of a law in quotes is needed here")
    try:
        find_law(law)
    except ValueError as error:
        near = difflib.get_close_matches(law, list(known_laws()), n=1, cutoff=0.5)
        raise ValueError(f"{error}{f'. Did you mean {near[0]!r}?' if near else ''}") from None
    return value


def law_values(table: Table) -> tuple[type[Law], dict[str, float | list[float]]]:
    """The law that a table names, and the parameters that it gives, by the law's own names.

    Raises
    ------
    ValueError : some parameters are given and others are not, or a series has not as many of each
    """
    law = find_law(getattr(table, "law", DEFAULT))
    keys = {p.key: p.name for p in law.parameters(*law.counts(1))}
    given = {key: value for key in keys if (value := getattr(table, key, None)) is not None}
    if given and (missing := [key for key in keys if key not in given]):
        verb = "come" if len(keys) > 1 else "comes"
        raise ValueError(f"{' and '.join(keys)} {verb} together; {', '.join(missing)} is missing")
    if law.series and len({len(value) for value in given.values()}) > 1:
        counts = " and ".join(f"{key} has {len(value)}" for key, value in given.items())
        raise ValueError(f"{counts} terms; they must pair up")
    return law, {keys[key]: value for key, value in given.items()}
