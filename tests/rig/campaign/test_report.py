"""The report of a campaign, from logs of known results: page, table, research object."""

from __future__ import annotations

import csv
import hashlib
import json
import math
from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner

from rig.campaign.campaign import load_campaign
from rig.campaign.progress import progress_of
from rig.campaign.report import (
    as_csv,
    as_table,
    bounds_words,
    certificate_problems,
    rows_of,
    statistics,
    statistics_cells,
)
from rig.cli.app import main
from rig.log.catalogue import INDEX, runs_in
from rig.log.writer import LogWriter

SCENE = Path(str(files("sim_fixtures"))) / "scenes" / "cone-4mm.toml"
FIELDS = {"a1": 30e6, "a2": 32e6, "a3": 31e6, "b1": 40e6, "b2": 42e6, "b3": 41e6, "b4": 45e6}
START_NS = 1_800_000_000 * 10**9
DAY_NS = 86_400 * 10**9


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    """Seven films that broke, the last bore the ceiling; one a day; the second with an old certificate."""
    (tmp_path / "logs").mkdir()
    (tmp_path / "scene.toml").write_text(SCENE.read_text())
    (tmp_path / "protocol.toml").write_text('[[step]]\ndo = "home"\n')
    specimens = "".join(f'[[specimen]]\nname = "{name}"\nbatch = "{name[0].upper()}"\n' for name in FIELDS)
    file = tmp_path / "campaign.toml"
    file.write_text(f'title = "A <b> & B"\nscene = "scene.toml"\nprotocol = "protocol.toml"\n{specimens}')
    for day, (name, field) in enumerate(FIELDS.items()):
        with LogWriter(tmp_path / "logs" / f"{name}.mcap") as log:
            log.metadata("run", {"specimen": name, "certificate_problems": "force: expired" if name == "a2" else ""})
            ns = START_NS + day * DAY_NS
            result = {"t_s": 1.0, "step": 4, "kind": "breakdown", "standard_uncertainty": math.nan}
            result |= {"outcome": "ceiling" if name == "b4" else "breakdown", "name": "field", "unit": "V/m"}
            log.write("/result", result | {"value": field}, ns, ns)
            log.finish({"status": "complete"})
    return file


@pytest.mark.slow
def test_scatter_batches_and_drift_are_of_the_films_that_broke(campaign: Path) -> None:
    loaded = load_campaign(campaign)
    rows = rows_of(loaded)
    (field,) = statistics(rows, loaded)
    assert (field.specimens, field.bounds, field.repeated) == (6, 1, 0)
    assert field.mean == pytest.approx(36e6) and field.between == pytest.approx(5.55e6, rel=0.01)
    assert {name: (one.specimens, one.mean) for name, one in field.groups.items()} == {
        "A": (3, pytest.approx(31e6)),
        "B": (3, pytest.approx(41e6)),
    }
    assert field.p_groups < 1e-3
    assert field.drift_per_day == pytest.approx(0.5e6)  # in both batches, by least squares
    assert certificate_problems(rows, loaded) == {"a2": ["force: expired"]}


@pytest.mark.slow
def test_films_that_broke_on_a_supply_without_a_current_are_counted_as_upper_bounds(campaign: Path) -> None:
    loaded = load_campaign(campaign)
    rows = rows_of(loaded)
    (before,) = statistics(rows, loaded)
    assert before.upper_bounds == 0 and "at most" not in bounds_words([before])
    for name, outcome in (("a1", "breakdown"), ("b4", "ceiling")):
        path = campaign.parent / "logs" / f"{name}.mcap"
        path.unlink()
        with LogWriter(path) as log:
            log.metadata("run", {"specimen": name})
            log.attach("scene.toml", "application/toml", SCENE.with_name("other-instruments.toml").read_bytes())
            result = {"t_s": 1.0, "step": 4, "kind": "breakdown", "standard_uncertainty": math.nan, "value": 30e6}
            result |= {"outcome": outcome, "name": "field", "unit": "V/m"}
            log.write("/result", result, START_NS, START_NS)
            log.write("/result", result | {"name": "displacement", "unit": "m", "value": 3e-3}, START_NS, START_NS)
            log.finish({"status": "complete"})
    newest = rows_of(loaded)
    fields = dict(zip(FIELDS, as_table(loaded, newest).columns[6].cells, strict=True))
    assert (fields["a1"], fields["a2"], fields["b4"]) == ("at most 30", f"{FIELDS['a2'] / 1e6:.4g}", "at least 30")
    table = csv.DictReader(as_csv(newest).splitlines())
    bounds = {one["specimen"]: one["bound of field"] for one in table}
    assert (bounds["a1"], bounds["a2"], bounds["b4"]) == ("at most", "", "at least")
    found = {one.name: one for one in statistics(newest, loaded)}
    field, displacement = found["breakdown: field"], found["breakdown: displacement"]
    assert (field.upper_bounds, field.bounds, displacement.upper_bounds) == (1, 1, 0)
    assert "at most" in bounds_words([field]) and statistics_cells([field])[0][-1] == "1, 1 at most"


@pytest.mark.slow
def test_the_page_and_the_research_object_hold_all_of_it(campaign: Path) -> None:
    crate, page = campaign.parent / "crate", campaign.parent / "page.html"
    words = ["campaign", "report", str(campaign), "--page", str(page), "--crate", str(crate)]
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 0, done.output
    text = page.read_text()
    assert "A &lt;b&gt; &amp; B" in text and "<b> & B" not in text
    assert text.count("<svg") == 1 and "http://" not in text.replace("http://www.w3.org", "").replace(
        "http://purl.org", ""
    ).replace("http://creativecommons.org", "")
    assert "force: expired" in text and "3.6e+07" in text
    graph = json.loads((crate / "ro-crate-metadata.json").read_text())["@graph"]
    by_id = {one["@id"]: one for one in graph}
    names = {path.relative_to(crate).as_posix() for path in crate.rglob("*") if path.is_file()}
    assert names - {"ro-crate-metadata.json"} == {one["@id"] for one in by_id["./"]["hasPart"]}
    assert {f"logs/{name}.mcap" for name in FIELDS} < names
    for name in names - {"ro-crate-metadata.json"}:
        assert by_id[name]["sha256"] == hashlib.sha256((crate / name).read_bytes()).hexdigest()
    (quantity,) = (one for one in graph if one["@type"] == "PropertyValue")
    assert quantity["value"] == pytest.approx(36e6) and quantity["unitText"] == "V/m"
    again = CliRunner().invoke(main, [*words[:3], "--crate", str(crate)])
    assert again.exit_code == 2 and "there already" in again.output


def test_the_index_deleted_is_made_again_the_same_and_serves_runs_and_campaigns_alike(campaign: Path) -> None:
    logs = campaign.parent / "logs"
    before, done = runs_in(logs), progress_of(load_campaign(campaign))
    (logs / INDEX).unlink()
    assert runs_in(logs) == before and progress_of(load_campaign(campaign)) == done
    content = (logs / INDEX).read_bytes()
    assert progress_of(load_campaign(campaign)) == done and (logs / INDEX).read_bytes() == content
    listed = CliRunner().invoke(main, ["runs", str(logs), "--specimen", "b4"])
    assert listed.exit_code == 0 and "1 of 7 runs" in listed.output
