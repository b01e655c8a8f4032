"""The list of runs is made from the logs, with an index or without."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from click.testing import CliRunner

from rig.base.errors import ConfigError
from rig.cli.app import main
from rig.log import catalogue
from rig.log.catalogue import FIT, INDEX, chosen, runs_in
from rig.log.notes import add_note
from rig.log.writer import LogWriter


def write(path: Path, specimen: str, operator: str, started: str, status: str = "complete") -> Path:
    path.parent.mkdir(exist_ok=True)
    with LogWriter(path) as log:
        log.attach("scene.toml", "application/toml", f'[session]\noperator = "{operator}"\n'.encode())
        log.metadata("run", {"specimen": specimen, "bench": "simulated in memory"})
        log.metadata("host", {"started": started})
        log.write("/event", {"t_s": 0.0, "severity": "info", "source": "rig", "message": "begun"}, 7, 7)
        log.finish({"status": status})
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write(tmp_path / "b.mcap", "vhb-2", "Noether", "2026-03-31T23:30:00-02:00", "limit")  # in April, by UTC
    write(tmp_path / "a.mcap", "vhb-1", "Curie", "2026-03-31T10:00:00+00:00")
    write(tmp_path / "more" / "c.mcap", "elastosil-1", "Curie", "2025-12-01T10:00:00+00:00")
    (tmp_path / "bad.mcap").write_text("no log")
    return tmp_path


def test_all_logs_the_oldest_first_and_what_they_say(folder: Path) -> None:
    found = runs_in(folder)
    assert [one.log for one in found] == ["bad.mcap", "more/c.mcap", "a.mcap", "b.mcap"]
    bad, _, a, b = found
    assert bad.outcome == "cannot be read" and "bad.mcap" in bad.problem
    assert (a.specimen, a.operator, a.bench, a.outcome) == ("vhb-1", "Curie", "SIMULATED", "complete")
    assert (b.date, b.outcome) == ("2026-04-01T01:30:00+00:00", "limit")


def test_the_second_look_reads_no_log_that_has_not_changed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = runs_in(folder)
    read, real = [], catalogue.read_log
    monkeypatch.setattr(catalogue, "read_log", lambda path: (read.append(path.name), real(path))[1])
    assert runs_in(folder) == first and read == []
    add_note(folder / "a.mcap", "A scratch.", "Curie")
    (folder / "b.mcap").unlink()
    write(folder / "more" / "d.mcap", "vhb-3", "", "2026-05-01T00:00:00+00:00")
    second = runs_in(folder)
    assert sorted(read) == ["a.mcap", "d.mcap"]
    assert [one.log for one in second] == ["bad.mcap", "more/c.mcap", "a.mcap", "more/d.mcap"]
    assert second[2].notes == "Curie: A scratch."


@pytest.mark.parametrize("damage", ["deleted", "no database", "torn", "another version", "a folder", "other columns"])
def test_the_index_may_be_lost_or_damaged_at_any_time(folder: Path, damage: str) -> None:
    first, index = runs_in(folder), folder / INDEX
    if damage in ("deleted", "a folder"):
        index.unlink()
    if damage == "a folder":
        index.mkdir()
    if damage == "no database":
        index.write_bytes(b"x" * 5000)
    if damage == "torn":
        index.write_bytes(index.read_bytes()[:5000])
    if damage in ("another version", "other columns"):
        with closing(sqlite3.connect(index)) as database, database:
            database.execute("drop table runs")
            database.execute("create table runs (nonsense text)")
            database.execute(f"pragma user_version = {999 if damage == 'another version' else catalogue.VERSION}")
    assert runs_in(folder) == first
    if damage != "a folder":  # the index is whole again
        with closing(sqlite3.connect(index)) as database:
            assert database.execute("select count(*) from runs").fetchone() == (4,)


def test_a_fit_beside_a_log_counts_only_for_the_logs_it_was_made_from(folder: Path) -> None:
    fit = {
        "quantities": {"stiffness": {"verdict": "weakly identified"}},
        "lack_of_fit": {"likely": ["viscous"]},
        "provenance": {"data": {"logs": {"somewhere/a.mcap": "hash"}}},
    }
    (folder / FIT).write_text(json.dumps(fit))
    fits = {one.log: one.fit for one in runs_in(folder)}
    told = "stiffness weakly identified; residuals look like viscous"
    assert fits == {"a.mcap": told, "b.mcap": "", "bad.mcap": "", "more/c.mcap": ""}
    (folder / FIT).write_text("[1, 2")
    a, b = runs_in(folder)[-2:]
    assert a.fit == "" and FIT in a.problem and a.outcome == "complete" and b.outcome == "limit"


def test_searching(folder: Path) -> None:
    entries = runs_in(folder)

    def logs(*words: str, **options: str) -> list[str]:
        return [one.log for one in chosen(entries, words, **options)]

    assert logs("CURIE") == ["more/c.mcap", "a.mcap"]
    assert logs("curie", "vhb") == ["a.mcap"]
    assert logs(specimen="vhb") == logs(since="2026") == ["a.mcap", "b.mcap"]
    assert logs(operator="noether", outcome="limit") == ["b.mcap"]
    assert logs(specimen="curie") == []
    assert logs(since="2025-12-02", until="2026-03") == ["a.mcap"]
    assert logs(since="2026-04-01") == logs(since="2026-04-01", until="2026-04-01") == ["b.mcap"]


def test_the_command_lists_and_counts(folder: Path) -> None:
    done = CliRunner().invoke(main, ["runs", str(folder), "vhb", "--since", "2026-04"])
    assert done.exit_code == 0, done.output
    assert "vhb-2" in done.output and "vhb-1" not in done.output
    assert "1 of 4 runs" in done.output
    assert CliRunner().invoke(main, ["runs", str(folder), "--since", "yesterday"]).exit_code == 2
    assert CliRunner().invoke(main, ["runs", str(folder / "none")]).exit_code == 2


def test_no_such_folder(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such folder"):
        runs_in(tmp_path / "none")
