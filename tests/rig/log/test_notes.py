"""Notes on a log lie beside it; the log keeps its bytes."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner

from calibration.report.sections.provenance import flat
from rig.analysis.film import said_in
from rig.base.errors import ConfigError, RigError
from rig.cli.app import main
from rig.log.info import info
from rig.log.notes import LONGEST, MOST, add_note, notes_file, notes_on
from rig.log.reader import read_log
from rig.log.writer import LogWriter

AWKWARD = "She said \"no\" \\ C:\\temp, 100 % — naïve 测试 😀\n[[note]]\ntext = 'x'"


def test_a_note_is_shown_and_the_log_keeps_its_bytes(small: Path) -> None:
    before = (small.read_bytes(), small.stat().st_mtime_ns)
    done = CliRunner().invoke(main, ["note", str(small), "A scratch near the ring.", "--by", "M. Curie"])
    assert done.exit_code == 0, done.output
    assert (small.read_bytes(), small.stat().st_mtime_ns) == before
    assert "M. Curie: A scratch near the ring." in info(small)
    (kept,) = tomllib.loads(notes_file(small).read_text(encoding="utf-8"))["note"]
    assert (kept["by"], kept["text"]) == ("M. Curie", "A scratch near the ring.")


@pytest.mark.parametrize("text", [AWKWARD, "x" * LONGEST, "'''", '"""', "\\", "#", "a\tb"])
def test_any_letters_come_back_as_they_were(small: Path, text: str) -> None:
    add_note(small, text)
    add_note(small, "second")
    assert [note.text for note in notes_on(small)] == [text, "second"]


def test_notes_made_during_the_run_stay_with_the_log(small: Path) -> None:
    part = small.rename(small.with_name("small.mcap.part"))
    add_note(part, "one")
    add_note(small, "two")  # by the name that the log will have
    part.rename(small)
    assert [note.text for note in notes_on(small)] == ["one", "two"]


@pytest.mark.parametrize("text", ["", "  \n", "x" * (LONGEST + 1), "\x1b[31m", "a\u202eb", "\ud800"])
def test_a_note_that_cannot_be_kept_is_refused(small: Path, text: str) -> None:
    with pytest.raises(ConfigError, match="not kept"):
        add_note(small, text)
    assert not notes_file(small).exists()


@pytest.mark.parametrize("name", ["none.mcap", "scene.toml"])
def test_only_logs_get_notes(tmp_path: Path, name: str) -> None:
    (tmp_path / "scene.toml").write_text("title = 'x'")
    with pytest.raises(RigError) as error:
        add_note(tmp_path / name, "text")
    assert error.value.exit_code == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.toml"]


def test_a_damaged_file_of_notes_is_left_as_it_is_and_said(small: Path) -> None:
    notes_file(small).write_text("[[note]\n")
    with pytest.raises(ConfigError, match="notes"):
        add_note(small, "text")
    assert notes_file(small).read_text() == "[[note]\n"
    assert "not valid TOML" in info(small)


def test_a_line_that_a_hand_left_open_does_not_swallow_the_next_note(small: Path) -> None:
    notes_file(small).write_text('[[note]]\nwritten = "2026-01-01"\ntext = "by hand"')
    add_note(small, "next")
    assert [note.text for note in notes_on(small)] == ["by hand", "next"]


def test_a_full_file_takes_no_more_and_stays_readable(small: Path) -> None:
    notes_file(small).write_text('[[note]]\nwritten = "2026"\ntext = "x"\n' * MOST)
    with pytest.raises(ConfigError, match="full"):
        add_note(small, "one more")
    assert len(notes_on(small)) == MOST


def test_a_full_disk_leaves_the_notes_as_they_were(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add_note(small, "kept")
    before = notes_file(small).read_bytes()
    write = os.write
    monkeypatch.setattr(os, "write", lambda fd, data: write(fd, data[:9]))
    with pytest.raises(ConfigError, match="not kept"):
        add_note(small, "lost")
    assert notes_file(small).read_bytes() == before


def test_operator_sample_and_air_of_the_scene_are_shown(tmp_path: Path) -> None:
    scene = b'[session]\noperator = "M. Curie"\nsample = "sheet 3"\ntemperature_C = 22.5\nhumidity_percent = 41\n'
    with LogWriter(tmp_path / "a.mcap") as log:
        log.attach("scene.toml", "application/toml", scene)
        log.finish({"status": "complete"})
    rows = [line.split(maxsplit=1) for line in info(tmp_path / "a.mcap").splitlines()]
    for row in (
        ["session.operator", "M. Curie"],
        ["session.temperature_C", "22.5"],
        ["session.humidity_percent", "41"],
    ):
        assert row in rows


def test_reports_name_session_and_notes_of_the_logs_that_have_any(small: Path, tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as log:
        log.attach("scene.toml", "application/toml", b'[session]\noperator = "M. Curie"\n')
        log.finish({"status": "complete"})
    logs = [read_log(small), read_log(tmp_path / "a.mcap")]
    assert said_in(logs[1:]) == {"session": {str(logs[1].path): {"operator": "M. Curie"}}}
    assert set(said_in(logs)["session"][str(small)]) == {
        "measured_temperature_C",
        "measured_humidity_percent",
    }  # one message of every kind is in it
    add_note(small, "A scratch.", "Noether")
    said = said_in(logs)
    assert list(said) == ["session", "notes"] and list(said["notes"]) == [str(small)]
    shown = dict(flat(said))
    assert shown[f"session › {logs[1].path} › operator"] == "M. Curie"
    assert shown[f"notes › {small}"].endswith("Noether: A scratch.")
