"""`dea-rig keys`: every key is described where it is declared; page and schema come from there."""

from __future__ import annotations

import datetime
import functools
import json
import tomllib
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from click.testing import CliRunner

from drivers.registry import registered
from model.material.laws import known_laws
from rig.base.reference import keys_of, tables_in, undescribed
from rig.benchmark.fixtures import Fixture
from rig.cli.app import main
from rig.cli.keys import WIDTH
from rig.cli.topics import FILES, names
from rig.protocol.protocol import Protocol
from rig.scene.scene import Scene
from rig.steps import registry as steps

FIXTURES = Path(str(files("sim_fixtures")))
SHIPPED = {"scenes": "scene", "protocols": "protocol", "calibrations": "certificate", "studies": "study"}
SCREEN = 65  # lines


def keys(*arguments: str) -> str:
    done = CliRunner().invoke(main, ["keys", *arguments])
    assert done.exit_code == 0, done.output
    return done.output


def shipped() -> Iterator[tuple[Path, str]]:
    for folder, kind in SHIPPED.items():
        yield from ((path, kind) for path in sorted((FIXTURES / folder).glob("*.toml")))


@pytest.mark.parametrize("kind", list(FILES))
def test_every_key_has_a_description(kind: str) -> None:
    missing = [name for _, table in FILES[kind].tables for name in undescribed(table, kind)]
    assert not missing, "\n".join(missing)
    if kind == "scene":
        assert not undescribed(Fixture, "fixture")


def test_the_walk_reaches_every_step_instrument_law_and_twin() -> None:
    protocol = {table for _, table in tables_in(Protocol)}
    assert {steps.find(name) for name in steps.names()} <= protocol
    scene = {table for _, table in tables_in(Scene)}
    assert {one.settings for one in registered().instruments.values()} <= scene
    places = {name for name, _ in tables_in(Scene)}
    assert {"specimen.material", "limits", "simulation.fault", "simulation.film.maxwell"} <= places
    assert sum(len(keys_of(table)) for table in protocol | scene) > 250


@pytest.mark.parametrize("what", [name for some in names().values() for name in some])
def test_each_name_prints_tables_that_fit_a_screen(what: str) -> None:
    page = keys(what)
    assert max(map(len, page.splitlines())) <= WIDTH
    for table in page.split("\n\n"):
        assert len(table.splitlines()) <= SCREEN, table.splitlines()[0]


@pytest.mark.parametrize(
    ("what", "words"),
    [
        (
            "scene",
            ["[specimen]", "thickness_um   needed, number, greater than 0", "before pre-stretch", "[limits]"],
        ),
        ("sweep", ['[[step]] do = "sweep"', "cycles = 1   whole number, 1 to 1000", "voltages_V = [0.0]"]),
        ("follow", ['[step.bias] kind = "spring"', "stiffness_N_per_mm"]),
        ("gsv8", ['[force] driver = "gsv8"', '"int16" | "int24" | "float32"', "[simulation.force]", "full_scale_N"]),
        ("gent", ['[specimen.material] law = "gent"', "Jm"]),
        ("certificate", ['role = "hv"', "gain_V_per_V", "valid_from"]),
        ("study", ['study = "map"', "radius_ratio"]),
        ("simulation", ["seed", "contact_position_mm"]),
    ],
)
def test_pages_say_unit_default_and_range(what: str, words: list[str]) -> None:
    page = keys(what)
    for word in words:
        assert word in page, page


def test_what_there_is_and_a_slip_of_the_name() -> None:
    page = " ".join(keys().split())
    for name in (*steps.names(), *known_laws(), "gsv8", "certificate"):
        assert name in page
    done = CliRunner().invoke(main, ["keys", "swep"])
    assert done.exit_code == 2 and "Did you mean sweep?" in done.output
    done = CliRunner().invoke(main, ["keys", "sweep", "--json-schema"])
    assert done.exit_code == 2 and "scene, protocol" in done.output


@pytest.mark.parametrize("kind", list(SHIPPED.values()))
def test_the_shipped_schema_is_that_of_the_code(kind: str) -> None:
    shipped = (FIXTURES / "schema" / f"{kind}.json").read_text(encoding="utf-8")
    made = keys(kind, "--json-schema")
    assert made == shipped, f"Make it anew: dea-rig keys {kind} --json-schema > sim_fixtures/schema/{kind}.json"


def plain(value: Any) -> Any:
    """As a JSON validator knows it: TOML's dates are texts there."""
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [plain(inner) for inner in value]
    return value.isoformat() if isinstance(value, datetime.date) else value


@functools.cache
def validator(kind: str) -> jsonschema.Draft202012Validator:
    schema = json.loads((FIXTURES / "schema" / f"{kind}.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize(("path", "kind"), list(shipped()), ids=lambda value: Path(value).stem)
def test_every_shipped_file_names_its_schema_and_keeps_to_it(path: Path, kind: str) -> None:
    first, _, rest = path.read_text(encoding="utf-8").partition("\n")
    assert first == f"#:schema ../schema/{kind}.json"
    assert (path.parent / first.removeprefix("#:schema ")).is_file()
    problems = list(validator(kind).iter_errors(plain(tomllib.loads(rest))))
    assert not problems, [problem.message[:300] for problem in problems]


@pytest.mark.parametrize(
    ("kind", "path", "old", "new"),
    [
        ("scene", "scenes/cone-4mm.toml", "thickness_um = 40.0", "thickness_um = -40.0"),
        ("scene", "scenes/cone-4mm.toml", "thickness_um = 40.0", "thickness_mm = 0.04"),
        ("scene", "scenes/cone-4mm.toml", 'driver = "gsv8"', 'driver = "gsv-8"'),
        ("scene", "scenes/cone-4mm.toml", "[2.0, 5.0]", '"2, 5"'),
        ("protocol", "protocols/short.toml", 'do = "sweep"', 'do = "swep"'),
        ("protocol", "protocols/short.toml", "threshold_mN", "threshold_N"),
        ("certificate", "calibrations/force.toml", 'role = "force"', 'role = "hv"'),
        ("study", "studies/figure7.toml", 'study = "map"', 'study = "maps"'),
    ],
)
def test_the_schema_refuses_what_the_program_refuses(kind: str, path: str, old: str, new: str) -> None:
    text = (FIXTURES / path).read_text(encoding="utf-8")
    assert old in text
    assert list(validator(kind).iter_errors(plain(tomllib.loads(text.replace(old, new, 1)))))
