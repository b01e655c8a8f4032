"""What `dea-rig keys` can be asked for: files, steps, instruments and laws, from their registries."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, Field, TypeAdapter

from drivers.registry import registered
from model.material.laws import known_laws
from rig.base.certificates import FILES as CERTIFICATES
from rig.base.errors import ConfigError
from rig.base.law_tables import law_table
from rig.base.problems import options, shown
from rig.base.reference import tables_in
from rig.campaign.campaign import CampaignTable
from rig.design.study import KINDS as STUDIES
from rig.protocol.protocol import Protocol
from rig.scene.scene import Scene
from rig.scene.specimen import MaterialTable
from rig.sim.settings import SimulationSettings
from rig.sim.twins import of_role
from rig.steps import registry as steps

Headed = list[tuple[str, type[BaseModel]]]  # tables, each with its heading


@dataclass(frozen=True)
class File:
    """A kind of file: its outermost tables with their headings, and the type of the whole."""

    tables: Headed
    whole: Any

    def schema(self) -> dict[str, Any]:
        """Its JSON Schema (draft 2020-12)."""
        schema = _any_default(TypeAdapter(self.whole).json_schema())
        return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def _any_default(schema: Any) -> Any:
    """Tables whose kind may be left out can be several at once: any of them will do."""
    if isinstance(schema, list):
        return [_any_default(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    tagged = "discriminator" in schema
    return {"anyOf" if key == "oneOf" and not tagged else key: _any_default(value) for key, value in schema.items()}


def _kinds(title: str, key: str, kinds: Mapping[str, type[BaseModel]]) -> File:
    """A file whose key ``key`` says which of several tables it is."""
    whole: Any = Annotated[Union[tuple(kinds.values())], Field(discriminator=key)]  # noqa: UP007 # made at run time
    return File([(f'{title}, {key} = "{kind}"', table) for kind, table in kinds.items()], whole)


FILES = {
    "scene": File([("scene file", Scene)], Scene),
    "protocol": File([("protocol file", Protocol)], Protocol),
    "certificate": _kinds("certificate file", "role", CERTIFICATES),
    "simulation": File([("[simulation]", SimulationSettings)], SimulationSettings),
    "campaign": File([("campaign file", CampaignTable)], CampaignTable),
    "study": _kinds("study file", "study", STUDIES),
}


def names() -> dict[str, list[str]]:
    """Everything that can be asked for, by kind."""
    return {
        "files": list(FILES),
        "steps": steps.names(),
        "instruments": list(_instruments()),
        "laws": list(known_laws()),
    }


def tables_of(what: str) -> Headed:
    """Heading and table of everything that belongs to a name.

    Raises
    ------
    ConfigError
        When there is no such name; says which there are.
    """
    if what in FILES:
        return list(_of_file(what))
    step = steps.find(what)
    if step is not None:
        return [((f"[step.{name}]" if name else "[[step]]") + _tag(table), table) for name, table in tables_in(step)]
    if what in _instruments():
        return _instruments()[what]
    if what in known_laws():
        return [(f'[specimen.material] law = "{what}"', _law(what))]
    every = [name for some in names().values() for name in some]
    near = difflib.get_close_matches(what, every, n=1, cutoff=0.5)
    hint = f"Did you mean {near[0]}? " if near else ""
    raise ConfigError(f"There are no keys of {what!r}. {hint}`dea-rig keys` lists what there is.")


def _of_file(what: str) -> Iterator[tuple[str, type[BaseModel]]]:
    """The file's own tables; steps, instruments, laws and simulation have names of their own."""
    elsewhere = {table for some in _instruments().values() for _, table in some}
    elsewhere |= {_law(name) for name in known_laws()} | ({SimulationSettings} if what == "scene" else set())
    elsewhere |= {step for name in steps.names() if (step := steps.find(name)) is not None}
    for title, table in FILES[what].tables:
        for name, inner in tables_in(table, without=elsewhere):
            yield f"[{name}]{_tag(inner)}" if name else title, inner


def _tag(table: type[BaseModel]) -> str:
    """`` kind = "spring"``: the first key of a table that can have one value only."""
    for key, field in table.model_fields.items():
        allowed = [one for kind in options(field.annotation) if get_origin(kind) is Literal for one in get_args(kind)]
        if len(allowed) == 1:
            return f" {key} = {shown(allowed[0])}"
    return ""


def _law(name: str) -> type[BaseModel]:
    return law_table(MaterialTable, known_laws()[name], optional=False)


@cache
def _instruments() -> dict[str, Headed]:
    """Tables of each instrument: what a scene says of it, and what is true of the simulated one."""
    found: dict[str, Headed] = {}
    for (role, driver), one in registered().instruments.items():
        found.setdefault(driver, []).append((f'[{role}] driver = "{driver}"', one.settings))
        twin = of_role(role).get(driver)
        if twin is not None:
            found[driver].append((f"[simulation.{role}], of a simulated one", twin.truth))
    return found
