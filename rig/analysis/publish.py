"""A result as a research object (RO-Crate 1.1): data, settings and the command that fits them again, in one folder.

    ro-crate-metadata.json   what is in the folder, who made it with what, and the quantities that were found
    README.md                the command
    result.json              the result, as it was written
    data/                    logs with their notes, or tables with what was said of them, and the scene

Source: RO-Crate Metadata Specification 1.1 (w3id.org/ro/crate/1.1); terms are those of schema.org.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rig.base.clock import calendar_now
from rig.base.errors import ConfigError, DataError
from rig.base.json_text import parse_json
from rig.base.outputs import write_text
from rig.base.text_file import read_text
from rig.base.toml_write import toml_of
from rig.importing.options import SUFFIX
from rig.log.notes import notes_file

METADATA, RESULT, README, DATA = "ro-crate-metadata.json", "result.json", "README.md", "data"
CONTEXT = ["https://w3id.org/ro/crate/1.1/context", {"sha256": "https://schema.org/sha256"}]
PROFILE = "https://w3id.org/ro/crate/1.1"
FILM, SHEET = "dea-rig identification 1", "dea-rig homogeneous tests 1"
SHEET_OVER_TIME = "dea-rig homogeneous tests over time 1"
MOST_BYTES = 64 * 1024 * 1024
NO_TERMS = "No terms of use are stated: ask the authors."
SAME = 1e-6  # relative: digits that another machine may give


@dataclass(frozen=True)
class Input:
    """A file that a result was made from, and what was said of it (keys of ``DATA.import.toml``)."""

    path: Path
    sha256: str
    role: str  # "log", "table", "predicted", "cone" or "scene"
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Recipe:
    """How a result was made: its inputs, and the options of the command."""

    command: str
    inputs: list[Input]
    options: list[str]
    result: dict[str, Any]
    software: dict[str, str]

    def words(self, places: Sequence[Path | str]) -> list[str]:
        """The command line, with the inputs at ``places``."""
        at = list(zip(self.inputs, map(str, places), strict=True))
        found = [self.command, *(place for one, place in at if one.role in ("log", "table"))]
        for option, role in (("--scene", "scene"), ("--predict", "predicted"), ("--cone", "cone")):
            for one, place in at:
                found += [option, place] if one.role == role else []
        return [*found, *self.options]


def read_recipe(path: Path) -> Recipe:
    """What a result of `dea-rig fit -o` or `dea-rig fit-tests -o` says of how it was made.

    Raises
    ------
    ConfigError
        When the file is no such result, or was written before results told their settings.
    """
    result = parse_json(read_text(path, "result", MOST_BYTES), "result", str(path))
    try:
        if result["format"] not in (FILM, SHEET, SHEET_OVER_TIME):
            raise ValueError(f"its format is {result['format']!r}")
        record = result["provenance"]
        read = _film if result["format"] == FILM else _sheet
        inputs, options = read(record, result)
        software = {str(name): str(version) for name, version in record["software"].items()}
    except KeyError as error:
        raise ConfigError(
            f"{path}: the key {error} is missing: not a result of `dea-rig fit -o` or `dea-rig fit-tests -o`, or one "
            "of an older version. Fit once more with this version."
        ) from None
    except (TypeError, ValueError, AttributeError) as error:
        raise ConfigError(f"{path}: not a result of `dea-rig fit -o` or `dea-rig fit-tests -o`: {error}.") from None
    return Recipe("fit" if result["format"] == FILM else "fit-tests", inputs, options, result, software)


def _film(record: Mapping[str, Any], result: Mapping[str, Any]) -> tuple[list[Input], list[str]]:
    data, settings = record["data"], record["settings"]
    if "logs" in data:
        inputs = [Input(Path(path), digest, "log") for path, digest in data["logs"].items()]
    else:
        said = {one["file"]: one["options"] for one in data["import"]}
        inputs = [Input(Path(path), digest, "table", said[path]) for path, digest in data["tables"].items()]
        inputs += [Input(Path(path), digest, "scene") for path, digest in data["scene"].items()]
    if not inputs:
        raise ValueError("it was made from arrays, not from files")
    options = ["--law", settings["law"], "--terms", str(settings["terms"])]
    options += ["--wrinkled", "tension-field"] if settings["wrinkling"] == "tension_field" else []
    options += [word for name, value in settings["fixed"].items() for word in ("--fix", f"{name}={value!r}")]
    options += [word for key in settings["along"] for word in ("--along", key)]
    options += ["--permittivity", "charge"] if settings.get("charge") else []
    options += ["--negative-exponents"] if settings["negative_exponents"] else []
    options += ["--branches", str(settings["branches"])] if "branches" in settings else []
    options += ["--profiles"] if settings["profiles"] else []
    options += ["--compare"] if "comparison" in result else []
    if settings["fixed_stretch"] is not None:
        options += ["--stiffness-at", ",".join(map(repr, settings["fixed_stretch"]))]
    return inputs, options


def _sheet(record: Mapping[str, Any], result: Mapping[str, Any]) -> tuple[list[Input], list[str]]:
    settings = record["settings"]
    said = {one["file"]: one["options"] for one in result["import"]}
    inputs = [Input(Path(path), digest, "table", said[path]) for path, digest in record["tables"].items()]
    inputs += [Input(Path(path), digest, "predicted", said[path]) for path, digest in record["predicted"].items()]
    inputs += [Input(Path(path), digest, "cone") for path, digest in record.get("cones", {}).items()]
    options = ["--law", settings["law"], "--terms", str(settings["terms"])]
    options += [
        word for key in ("weighting", "branches") if key in settings for word in (f"--{key}", str(settings[key]))
    ]
    options += [word for name, value in settings["fixed"].items() for word in ("--fix", f"{name}={value!r}")]
    options += [] if settings["negative_exponents"] else ["--positive-exponents"]
    return inputs, options


@dataclass(frozen=True)
class About:
    """What a person says of a crate. ``authors`` are names, each with an ORCID in angle brackets or without."""

    license: str
    title: str = ""
    authors: tuple[str, ...] = ()


def publish(result: Path, crate: Path, about: About, moved: Path | None = None) -> list[Path]:
    """Write the crate of a result, whole or not at all; its files are returned.

    Inputs are looked for where the result says, and by their names in the folder ``moved``.

    Raises
    ------
    ConfigError
        When the result, or a file that it was made from, cannot be used, or the folder exists.
    """
    recipe = read_recipe(result)
    found = [_found(one, moved) for one in recipe.inputs]
    if crate.exists():
        raise ConfigError(f"{crate}: exists already; nothing is overwritten. Name another folder.")
    part = crate.with_name(f".{crate.name}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        (part / DATA).mkdir(parents=True)
        places = _copy(recipe, found, part)
        shutil.copyfile(result, part / RESULT)
        command = ["dea-rig", *recipe.words(places), "-o", "again.json"]
        write_text(part / README, _readme(recipe, command, about))
        write_text(part / METADATA, _metadata(recipe, part, places, command, about))
        part.replace(crate)
    except OSError as error:
        raise ConfigError(f"{crate}: cannot be written: {error.strerror}.") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return sorted(path for path in crate.rglob("*") if path.is_file())


def _found(one: Input, moved: Path | None) -> Path:
    """The file that an input was, by its hash."""
    places = [*([moved / one.path.name] if moved is not None else []), one.path]
    there = [path for path in places if path.is_file()]
    if not there:
        raise ConfigError(
            f"{one.path}: the result was made from this {one.role}, and it is not there. "
            "Option: --data FOLDER names where it is now."
        )
    if hashlib.sha256(there[0].read_bytes()).hexdigest() != one.sha256:
        raise ConfigError(
            f"{there[0]}: this {one.role} is not the one that the result was made from (another SHA-256). "
            "Fit once more, or name the folder of the right one with --data."
        )
    return there[0]


def _copy(recipe: Recipe, found: Sequence[Path], part: Path) -> list[str]:
    """Copy the inputs under their own names, files of one name into folders of their own; their places in the crate."""
    count = Counter(one.path.name for one in recipe.inputs)
    places = []
    for number, (one, path) in enumerate(zip(recipe.inputs, found, strict=True), start=1):
        folder = DATA if count[one.path.name] == 1 else f"{DATA}/{number}"
        (part / folder).mkdir(exist_ok=True)
        place = f"{folder}/{one.path.name}"
        shutil.copyfile(path, part / place)
        notes = notes_file(path)
        if one.role == "log" and notes.is_file():
            shutil.copyfile(notes, part / folder / notes.name)
        if one.options:
            write_text(part / f"{place}{SUFFIX}", toml_of(one.options))
        places.append(place)
    return places


def _title(recipe: Recipe, about: About) -> str:
    film = "force-displacement curves of a film" if recipe.command == "fit" else "homogeneous tests of a sheet"
    return about.title or f"{recipe.result['law']} law identified from {film}"


def _readme(recipe: Recipe, command: Sequence[str], about: About) -> str:
    version = recipe.software.get("dea-rig", "")
    return (
        f"# {_title(recipe, about)}\n\nFit the data again, in this folder, with dea-rig {version}:\n\n"
        f"    {' '.join(_quoted(word) for word in command)}\n\n"
        "`dea-rig publish --check .` does so and compares with `result.json`. Versions of all software: "
        f"`{METADATA}`.\n"
    )


def _quoted(word: str) -> str:
    return word if all(one.isalnum() or one in "-_./=,+" for one in word) else "'" + word.replace("'", "'\\''") + "'"


def _metadata(recipe: Recipe, part: Path, places: Sequence[str], command: Sequence[str], about: About) -> str:
    now = calendar_now().isoformat(timespec="seconds")
    files = sorted(path.relative_to(part).as_posix() for path in part.rglob("*") if path.is_file())
    people = [_person(one, k) for k, one in enumerate(about.authors, start=1)]
    quantities = [_quantity(name, one) for name, one in recipe.result["quantities"].items()]
    software = [
        {"@id": f"#{name}", "@type": "SoftwareApplication", "name": name, "softwareVersion": version}
        for name, version in recipe.software.items()
    ]
    root: dict[str, Any] = {
        "@id": "./",
        "@type": "Dataset",
        "name": _title(recipe, about),
        "description": f"{recipe.result.get('convention', '')} To fit again: {' '.join(command)}".strip(),
        "datePublished": now,
        "license": {"@id": about.license} if "://" in about.license else about.license,
        "hasPart": crate_ids(files),
        "mentions": {"@id": "#fit"},
        "variableMeasured": crate_ids(one["@id"] for one in quantities),
    }
    root |= {"author": crate_ids(one["@id"] for one in people)} if people else {}
    action = {
        "@id": "#fit",
        "@type": "CreateAction",
        "name": f"dea-rig {recipe.command}",
        "description": " ".join(command),
        "instrument": crate_ids(one["@id"] for one in software),
        "object": crate_ids(places),
        "result": {"@id": RESULT},
        "endTime": now,
    }
    about_itself = {
        "@id": METADATA,
        "@type": "CreativeWork",
        "conformsTo": {"@id": PROFILE},
        "about": {"@id": "./"},
    }
    graph = [about_itself, root, *(crate_file(part, name) for name in files), action, *software, *people, *quantities]
    return json.dumps({"@context": CONTEXT, "@graph": graph}, indent=2, allow_nan=False) + "\n"


def crate_ids(names: Any) -> list[dict[str, str]]:
    return [{"@id": name} for name in names]


FORMATS = {
    ".json": "application/json",
    ".md": "text/markdown",
    ".toml": "application/toml",
    ".csv": "text/csv",
    ".html": "text/html",
}


def crate_file(part: Path, name: str) -> dict[str, Any]:
    """The entity of the file ``name`` in the folder ``part`` of a crate."""
    content = (part / name).read_bytes()
    return {
        "@id": name,
        "@type": "File",
        "name": name.rsplit("/", 1)[-1],
        "contentSize": str(len(content)),
        "encodingFormat": FORMATS.get(Path(name).suffix, "application/octet-stream"),
        "sha256": hashlib.sha256(content).hexdigest(),
    }


def _person(words: str, number: int) -> dict[str, str]:
    name, _, orcid = words.partition("<")
    address = orcid.rstrip("> ").strip()
    if address and "://" not in address:
        address = f"https://orcid.org/{address}"
    return {"@id": address or f"#author-{number}", "@type": "Person", "name": name.strip()}


def _quantity(name: str, one: Mapping[str, Any]) -> dict[str, Any]:
    found = {"@id": f"#quantity-{name}", "@type": "PropertyValue", "name": name, "value": one["value"]}
    found |= {"unitText": one["unit"]} if one["unit"] else {}
    told = f"standard uncertainty {one['standard_uncertainty']}" if one["standard_uncertainty"] is not None else ""
    return found | {"description": ", ".join(filter(None, (told, one["verdict"])))}


def of_crate(crate: Path) -> Recipe:
    """The recipe of a crate, with its inputs inside it.

    Raises
    ------
    ConfigError
        When it is no crate, or a file of it was changed.
    """
    metadata = parse_json(read_text(crate / METADATA, "crate", MOST_BYTES), "crate", str(crate / METADATA))
    try:
        files = {one["@id"]: one["sha256"] for one in metadata["@graph"] if one.get("@type") == "File"}
        (action,) = (one for one in metadata["@graph"] if one.get("@type") == "CreateAction")
        places = [crate / one["@id"] for one in action["object"]]
    except (KeyError, TypeError, ValueError, AttributeError):
        raise ConfigError(f"{crate}: not a crate of `dea-rig publish`.") from None
    for name, digest in files.items():
        path = crate / name
        if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            raise ConfigError(f"{path}: not there, or changed since the crate was written.")
    recipe = read_recipe(crate / RESULT)
    if len(places) != len(recipe.inputs):
        raise ConfigError(f"{crate}: its metadata and its result name different inputs.")
    inputs = [Input(place, one.sha256, one.role, one.options) for one, place in zip(recipe.inputs, places, strict=True)]
    return Recipe(recipe.command, inputs, recipe.options, recipe.result, recipe.software)


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, float]:
    """Largest relative difference of value and uncertainty, by quantity.

    Raises
    ------
    DataError
        When the results do not hold the same quantities.
    """
    if set(old["quantities"]) != set(new["quantities"]):
        raise DataError("The fit of the crate gives other quantities than its result holds.")
    found = {}
    for name, one in old["quantities"].items():
        other, worst = new["quantities"][name], 0.0
        for key in ("value", "standard_uncertainty"):
            a, b = one[key], other[key]
            if (a is None) != (b is None):
                worst = float("inf")
            elif a is not None and a != b:
                worst = max(worst, abs(a - b) / max(abs(a), abs(b)))
        found[name] = worst
    return found
