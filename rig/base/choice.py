"""A table of a file whose kind one of its keys names, looked up in a registry: ``do`` of a step, ``driver``, ``law``.

In place of a union of types that somebody has to list: whoever registers a kind is known here, and a kind from another
package is loaded only when a file names it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationError
from pydantic_core import CoreSchema, InitErrorDetails, PydanticCustomError, PydanticKnownError, core_schema

from rig.base.table import Table


@dataclass(frozen=True)
class Choice:
    """Put beside the base type of the tables: ``Annotated[Step, Choice("do", find, names)]``.

    Parameters
    ----------
    key : str
        The key that names the kind.
    find : callable
        The table of a kind; None where nobody has registered it.
    names : callable
        All kinds, for messages and the JSON Schema.
    """

    key: str
    find: Callable[[str], type[Table] | None]
    names: Callable[[], Sequence[str]]

    def table_of(self, value: object) -> type[Table] | None:
        """The table that ``value``, as read from a file, is meant to be; None where it does not say so."""
        kind = value.get(self.key) if isinstance(value, Mapping) else None
        return self.find(kind) if isinstance(kind, str) else None

    def validate(self, value: object) -> Table:
        """The table made from ``value``; one that is made already is taken as it is."""
        if isinstance(value, Table):
            return value
        if not isinstance(value, Mapping):
            raise PydanticKnownError("model_type", {"class_name": self.key})
        table = self.table_of(value)
        if table is None:
            raise ValidationError.from_exception_data(self.key, [self._problem(value)])
        return table.model_validate(value)

    def _problem(self, value: Mapping[str, Any]) -> InitErrorDetails:
        """What `rig.base.problems` puts into words."""
        missing = self.key not in value
        kind = "choice_missing" if missing else "choice_unknown"
        error = PydanticCustomError(kind, "no such kind", {"allowed": list(self.names())})
        return InitErrorDetails(type=error, loc=(self.key,), input=value if missing else value[self.key])

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.validate)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        tables = [table for name in self.names() if (table := self.find(name)) is not None]
        kinds = [handler(table.__pydantic_core_schema__) for table in tables]
        return {"oneOf": kinds, "discriminator": {"propertyName": self.key}}
