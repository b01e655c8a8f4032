"""A published result: whole, described, and fitted again to the same digits by somebody who has only the folder."""

from __future__ import annotations

import hashlib
import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from rig.cli.app import main
from tests.calibration.film.independent import measured
from tests.calibration.film.table_road import through_table

TERMS = "https://creativecommons.org/licenses/by/4.0/"


def say(*words: str, code: int = 0) -> str:
    result = CliRunner().invoke(main, list(words))
    assert result.exit_code == code, result.output
    return result.output


def table(path: Path, modulus: float = 50e3) -> None:
    stretch = np.linspace(1.0, 2.0, 15)
    stress = modulus * (stretch - stretch**-2) * (1.0 + 0.002 * np.sin(40.0 * stretch))
    rows = zip(stretch.tolist(), (4.0 * stress * 1e-6).tolist(), strict=True)
    path.write_text("Stretch;Load (N)\n" + "".join(f"{x:.4f};{y:.8f}\n" for x, y in rows), encoding="utf-8")


@pytest.fixture
def published(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A crate of two tests of one file name, one of which is predicted, with options; the data are gone."""
    mine = tmp_path / "mine"
    (mine / "b").mkdir(parents=True)
    monkeypatch.chdir(mine)
    table(mine / "tensile.csv")
    table(mine / "b" / "tensile.csv", 52e3)
    options = ("--area-mm2", "4.1", "--terms", "1", "--fix", "alpha1=2", "--weighting", "relative")
    say("fit-tests", "tensile.csv", "--predict", "b/tensile.csv", *options, "-o", "fit.json")
    say(
        "publish",
        "fit.json",
        "-o",
        str(tmp_path / "crate"),
        "--license",
        TERMS,
        "--author",
        "Ada <0000-0002-1825-0097>",
    )
    (mine / "tensile.csv").unlink()
    monkeypatch.chdir(tmp_path)
    return tmp_path / "crate"


def entities(crate: Path) -> dict[str, dict[str, Any]]:
    metadata = json.loads((crate / "ro-crate-metadata.json").read_text())
    assert metadata["@context"][0] == "https://w3id.org/ro/crate/1.1/context"
    return {one["@id"]: one for one in metadata["@graph"]}


def test_the_crate_describes_what_it_holds(published: Path) -> None:
    graph = entities(published)
    root, action = graph["./"], graph["#fit"]
    assert graph["ro-crate-metadata.json"]["about"] == {"@id": "./"}
    assert {"name", "description", "datePublished", "license"} <= set(root)
    assert root["license"] == {"@id": TERMS} and root["author"] == [{"@id": "https://orcid.org/0000-0002-1825-0097"}]
    files = {one["@id"] for one in root["hasPart"]}
    there = {path.relative_to(published).as_posix() for path in published.rglob("*") if path.is_file()}
    assert files == there - {"ro-crate-metadata.json"}
    for name in files:
        assert graph[name]["sha256"] == hashlib.sha256((published / name).read_bytes()).hexdigest()
    references = [one["@id"] for key in ("object", "instrument") for one in action[key]]
    assert all(one in graph for one in (*references, action["result"]["@id"]))
    (measured_mu,) = (one for one in graph.values() if one.get("name") == "mu1")
    assert measured_mu["value"] == pytest.approx(50e3 * 4.0 / 4.1, rel=0.02)
    assert "standard uncertainty" in measured_mu["description"]


def test_a_stranger_fits_it_again_to_the_same_digits(
    published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the words of the page, in another folder under another name."""
    elsewhere = published.rename(tmp_path / "downloaded")
    (line,) = (one for one in (elsewhere / "README.md").read_text().splitlines() if one.startswith("    dea-rig "))
    monkeypatch.chdir(elsewhere)
    say(*shlex.split(line)[1:])
    old, new = (json.loads((elsewhere / name).read_text()) for name in ("result.json", "again.json"))
    assert new["quantities"] == old["quantities"] and new["r_squared"] == old["r_squared"]
    assert new["prediction_r_squared"] == old["prediction_r_squared"] != {}
    monkeypatch.chdir(tmp_path)
    assert "the same: 2 quantities to the last bit" in say("publish", str(elsewhere), "--check")


def test_what_was_changed_or_is_missing_is_refused(published: Path, tmp_path: Path) -> None:
    said = say("publish", str(published), "-o", str(tmp_path / "x"), "--license", TERMS, code=2)
    assert "result" in said
    data = next(path for path in published.rglob("tensile.csv"))
    data.write_text(data.read_text().replace("1.0714", "1.0715"))
    assert "changed since" in say("publish", str(published), "--check", code=2)
    lost = say("publish", str(published / "result.json"), "-o", str(tmp_path / "x"), "--license", TERMS, code=2)
    assert "tensile.csv" in lost and "--data" in lost
    assert not (tmp_path / "x").exists() and not list(tmp_path.glob(".*"))


def test_without_terms_of_use_it_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    table(tmp_path / "tensile.csv")
    say("fit-tests", "tensile.csv", "--area-mm2", "4", "--terms", "1", "--fix", "alpha1=2", "-o", "fit.json")
    assert "--license" in say("publish", "fit.json")
    assert "No terms of use" in entities(tmp_path / "fit-crate")["./"]["license"]
    assert "exists already" in say("publish", "fit.json", code=2)


@pytest.mark.slow
def test_a_cone_is_fitted_again_to_the_same_digits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    stated = dict.fromkeys(("thickness_uncertainty", "prestretch_uncertainty", "disk_radius_uncertainty"), 0.01)
    stated |= {"ring_radius_uncertainty": 0.002, "voltage_at_film": 0.002, "displacement_axis": 0.002}
    through_table(measured(np.random.default_rng(3), stated=stated, samples=60), stated, tmp_path)
    options = ("--terms", "1", "--along", "softening", "--fix", "eps_r=1.7", "--stiffness-at", "1.45,1.2")
    say("fit", "table.csv", "--scene", "scene.toml", *options, "-o", "fit.json")
    say("publish", "fit.json", "-o", "crate", "--license", "CC0-1.0")
    (tmp_path / "table.csv").unlink()
    assert "to the last bit" in say("publish", "crate", "--check")
