"""The campaign file: which specimens, what is done with each, in which order, and when to stop.

A specimen's scene is the campaign's scene with the specimen's own keys put over it. Its name is that of its log.
"""

from __future__ import annotations

import os
import random
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from rig.base.errors import ConfigError
from rig.base.outputs import write_text
from rig.base.table import Table
from rig.base.text_file import read_text
from rig.base.toml_file import load_table
from rig.base.toml_text import parse_toml
from rig.base.toml_write import toml_of
from rig.protocol.experiment import Experiment, prepare

MOST = 1000  # specimens
SCENES = "scenes"  # folder of the campaign in which the scene of each specimen is written
PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,59}")


class SpecimenTable(Table):
    """One specimen of a campaign."""

    name: str = Field(
        description="Its name, also of its log: letters, digits, dot, dash, underscore. Each stands once."
    )
    batch: str = Field(default="", description="Sheet or day of making. Blocks have one specimen of each batch.")
    protocol: str | None = Field(
        default=None, description="Its protocol, as seen from the campaign; absent: that of all."
    )
    note: str = Field(default="", description="Remark, shown when it is mounted.")
    scene: dict[str, Any] = Field(
        default={},
        description="Keys put over those of the scene, in the scene's own tables: {specimen = {thickness_um = 41.2}}. "
        "Each measured dimension belongs here.",
    )

    @model_validator(mode="after")
    def _named(self) -> Self:
        if PLAIN_NAME.fullmatch(self.name) is None:
            raise ValueError(f"name = {self.name!r}: letters, digits, dot, dash and underscore only, 60 at most")
        if re.search(r"\.\d+$", self.name):
            raise ValueError(f"name = {self.name!r}: a dot and a number at its end mean a second run of a specimen")
        return self


class CampaignTable(Table):
    """A campaign: many specimens on one bench."""

    title: str = Field(default="", description="What it is for.")
    scene: str = Field(description="The scene of all specimens, as seen from this file.")
    protocol: str | None = Field(
        default=None, description="The protocol of those that name none, as seen from this file."
    )
    logs: str = Field(default="logs", description="Folder of the logs, as seen from this file. Made when needed.")
    order: Literal["as written", "random"] = Field(
        default="as written",
        description="random: by chance, in blocks that have one specimen of each batch, so that drift of the bench "
        "over the days does not look like a difference between batches.",
    )
    seed: Annotated[int, Field(ge=0)] = Field(
        default=1, description="Of the random order; the same seed, the same order."
    )
    most_failed_in_a_row: Annotated[int, Field(ge=1, le=1000)] = Field(
        default=2, description="After so many runs in a row that did not end complete the campaign stops. Typical: 2."
    )
    specimen: Annotated[list[SpecimenTable], Field(min_length=1, max_length=MOST)] = Field(
        description="One table [[specimen]] for each."
    )

    @model_validator(mode="after")
    def _makes_sense(self) -> Self:
        seen: set[str] = set()
        for one in self.specimen:
            if one.name.casefold() in seen:
                raise ValueError(f"specimen {one.name!r} stands twice")
            seen.add(one.name.casefold())
            if one.protocol is None and self.protocol is None:
                raise ValueError(f"specimen {one.name!r} has no protocol, and the campaign none for all")
        return self


@dataclass(frozen=True)
class Campaign:
    """A campaign file, read.

    Attributes
    ----------
    path : Path
        Of the file; what it names is seen from there.
    specimens : list of SpecimenTable
        In the order in which they are to be done.
    """

    path: Path
    table: CampaignTable
    specimens: list[SpecimenTable]

    @property
    def logs(self) -> Path:
        """The folder of the logs."""
        return self.path.parent / self.table.logs

    def number(self, name: str) -> int:
        """Place of a specimen in the order, from 1.

        Raises
        ------
        ConfigError
            There is no such specimen.
        """
        names = [one.name for one in self.specimens]
        if name not in names:
            raise ConfigError(f"{self.path}: there is no specimen {name!r}. There are: {', '.join(names)}.")
        return names.index(name) + 1

    def told(self, one: SpecimenTable) -> dict[str, str]:
        """What the log of a run of ``one`` says of its campaign; the file as seen from the log."""
        place = {"number": str(self.number(one.name)), "of": str(len(self.specimens))}
        return {"file": os.path.relpath(self.path, self.logs), "specimen": one.name, **place}

    def scene_text(self, one: SpecimenTable) -> str:
        """The scene of a specimen as TOML: the campaign's, with the specimen's own keys over it."""
        source = self.path.parent / self.table.scene
        raw = parse_toml(read_text(source, "scene"), "scene", str(source))
        merged = _over(raw, {**one.scene, "specimen": {**one.scene.get("specimen", {}), "name": one.name}})
        for table in merged.values():  # certificates are named as seen from the scene's own folder
            if isinstance(table, dict) and isinstance(table.get("certificate"), str):
                table["certificate"] = os.path.relpath(source.parent / table["certificate"], self.path.parent / SCENES)
        return f"# Specimen {one.name} of {self.path.name}, made from {self.table.scene}.\n{toml_of(merged)}"

    def prepare(self, one: SpecimenTable, ports: dict[str, dict[str, object]] | None = None) -> Experiment:
        """The experiment of a specimen, checked; its scene is written to the campaign's folder `SCENES`.

        Raises
        ------
        ConfigError, LimitError
            As `rig.protocol.experiment.prepare`; the file named is the specimen's own scene.
        """
        scene = self.path.parent / SCENES / f"{one.name}.toml"
        text = self.scene_text(one)
        scene.parent.mkdir(exist_ok=True)
        if not scene.is_file() or scene.read_text(encoding="utf-8") != text:
            scene.unlink(missing_ok=True)
            write_text(scene, text)
        protocol = self.path.parent / (one.protocol or self.table.protocol or "")
        return prepare(scene, protocol, ports)


def load_campaign(path: Path) -> Campaign:
    """The campaign in ``path``.

    Raises
    ------
    ConfigError
        Naming file, key, value and what is allowed.
    """
    table, _ = load_table(path, CampaignTable, "campaign")
    return Campaign(path, table, list(_ordered(table)))


def _ordered(table: CampaignTable) -> list[SpecimenTable]:
    """As written; or by chance in blocks, each with one specimen of every batch that has any left."""
    if table.order == "as written":
        return list(table.specimen)
    rng = random.Random(table.seed)
    batches: dict[str, list[SpecimenTable]] = {}
    for one in table.specimen:
        batches.setdefault(one.batch, []).append(one)
    for members in batches.values():
        rng.shuffle(members)
    found: list[SpecimenTable] = []
    while left := [members for members in batches.values() if members]:
        block = [members.pop() for members in left]
        rng.shuffle(block)
        found += block
    return found


def _over(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """``below`` with the keys of ``above`` put over it, table by table."""
    merged = dict(below)
    for key, value in above.items():
        old = merged.get(key)
        merged[key] = _over(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return merged
