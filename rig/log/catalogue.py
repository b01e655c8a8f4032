"""The logs of a folder: who measured what and when, how it ended, whether it was fitted.

What was read of a log is kept in an index (SQLite) in the folder, so that a second look costs no reading of logs. The
index holds nothing of its own: it may be deleted at any time, is renewed for every file that has changed, and is made
anew when it is damaged or of another version. Where the folder cannot be written to there is none.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import astuple, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rig.base.errors import ConfigError
from rig.base.json_text import parse_json
from rig.base.text_file import read_text
from rig.log.contents import bench_of, bench_word, session_in
from rig.log.errors import LogError
from rig.log.notes import notes_file, notes_on
from rig.log.reader import Log, read_log

INDEX = ".dea-rig-runs.sqlite"
VERSION = 1  # of the index; another one is made anew
FIT = "fit.json"
LARGEST_FIT = 16 * 1024 * 1024


@dataclass(frozen=True)
class Entry:
    """One log of the folder; texts are empty where nothing is known.

    Attributes
    ----------
    log : str
        Its path, as seen from the folder.
    date : str
        When the run was started, by the host's calendar; else the time of its first message (UTC, ISO 8601).
    bench : str
        SIMULATED, REAL PORTS or REPLAY.
    outcome : str
        The status that the run ended with; "cut short" without one; "cannot be read" for a file that is no log.
    fit : str
        What a ``fit.json`` beside the log, which names it, says of the film's stiffness; and of what imperfection the
        residuals have the shape, if any.
    problem : str
        Why the log, its notes or its fit cannot be read.
    """

    log: str
    date: str = ""
    specimen: str = ""
    operator: str = ""
    sample: str = ""
    scene: str = ""
    protocol: str = ""
    bench: str = ""
    outcome: str = ""
    fit: str = ""
    notes: str = ""
    problem: str = ""


COLUMNS = [field.name for field in fields(Entry)]


def runs_in(folder: Path) -> list[Entry]:
    """All logs in ``folder`` and the folders in it, the oldest first.

    Raises
    ------
    ConfigError
        There is no such folder.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder}: there is no such folder.")
    paths = {path.relative_to(folder).as_posix(): path for path in _logs(folder)}
    with closing(_index(folder)) as index:
        known = {row[1]: (row[0], Entry(*row[1:])) for row in index.execute("select * from runs")}
        found, new = [], []
        for name, path in paths.items():
            state = _state(path)
            if name in known and known[name][0] == state:
                found.append(known[name][1])
                continue
            found.append(_entry(name, path))
            new.append((state, *astuple(found[-1])))
        gone = [(name,) for name in known if name not in paths]
        if new or gone:
            with suppress(sqlite3.Error), index:  # a full disk, or another one is writing: next time
                index.executemany("delete from runs where log = ?", gone)
                marks = ", ".join("?" * (len(COLUMNS) + 1))
                index.executemany(f"insert or replace into runs values ({marks})", new)
    return sorted(found, key=lambda entry: (entry.date, entry.log))


def chosen(
    entries: list[Entry],
    words: tuple[str, ...] = (),
    *,
    specimen: str = "",
    operator: str = "",
    outcome: str = "",
    since: str = "",
    until: str = "",
) -> list[Entry]:
    """Those of ``entries`` that have all ``words`` in any of their texts, and the other texts in theirs.

    Upper and lower case are the same. ``since`` and ``until`` are beginnings of ISO dates, both included:
    ``until = "2026-03"`` takes all of March.
    """

    def has(text: str, part: str) -> bool:
        return part.casefold() in text.casefold()

    return [
        entry
        for entry in entries
        if all(has("\n".join(astuple(entry)), word) for word in words)
        and has(entry.specimen, specimen)
        and has(entry.operator, operator)
        and has(entry.outcome, outcome)
        and entry.date >= since
        and (not until or entry.date[: len(until)] <= until)
    ]


def _logs(folder: Path) -> Iterator[Path]:
    for pattern in ("*.mcap", "*.mcap.part"):
        yield from (path for path in folder.rglob(pattern) if path.is_file())


def _state(path: Path) -> str:
    """Size and time of all files that an entry depends on: when it is another, the entry is made anew."""
    found = []
    for one in (path, notes_file(path), path.parent / FIT):
        try:
            stat = one.stat()
            found.append(f"{stat.st_size} {stat.st_mtime_ns}")
        except OSError:
            found.append("")
    return "; ".join(found)


def _index(folder: Path) -> sqlite3.Connection:
    """The index of ``folder``, made anew where it cannot be used; in memory where the folder takes none."""
    path = folder / INDEX
    try:
        return _opened(path)
    except sqlite3.OperationalError:  # the folder takes no file, or another one is writing
        return _opened(":memory:")
    except sqlite3.DatabaseError:  # no index, or damaged
        with suppress(OSError):
            path.unlink()
    try:
        return _opened(path)
    except sqlite3.Error:
        return _opened(":memory:")


def _opened(path: Path | str) -> sqlite3.Connection:
    """An index with our table in it. Raises `sqlite3.Error`."""
    connection = sqlite3.connect(path, timeout=2.0)
    try:
        wanted = ["state", *COLUMNS]
        version = connection.execute("pragma user_version").fetchone()[0]
        if version != VERSION or [row[1] for row in connection.execute("pragma table_info(runs)")] != wanted:
            with connection:
                connection.execute("drop table if exists runs")
                columns = ", ".join(f'"{name}" text not null' for name in wanted)
                connection.execute(f"create table runs ({columns}, primary key (log))")
                connection.execute(f"pragma user_version = {VERSION}")
        if connection.execute("pragma quick_check").fetchone()[0] != "ok":
            raise sqlite3.DatabaseError("damaged")
    except BaseException:
        connection.close()
        raise
    return connection


def _entry(name: str, path: Path) -> Entry:
    problems: list[str] = []
    try:
        log = read_log(path)
    except LogError as error:
        return Entry(name, outcome="cannot be read", problem=str(error))
    notes = []
    try:
        notes = [f"{note.by}: {note.text}" if note.by else note.text for note in notes_on(path)]
    except ConfigError as error:
        problems.append(str(error))
    fit = ""
    try:
        fit = _fit_of(path)
    except ConfigError as error:
        problems.append(str(error))
    run, session = log.metadata.get("run", {}), session_in(log)
    return Entry(
        name,
        date=_date(log),
        specimen=run.get("specimen", ""),
        operator=session.get("operator", ""),
        sample=session.get("sample", ""),
        scene=run.get("scene", ""),
        protocol=run.get("protocol", ""),
        bench=bench_word(bench_of(log)) if bench_of(log) else "",
        outcome="cut short" if log.outcome is None else log.outcome.get("status", ""),
        fit=fit,
        notes="\n".join([*([session["notes"]] if "notes" in session else []), *notes]),
        problem="\n".join(problems),
    )


def _date(log: Log) -> str:
    started = log.metadata.get("host", {}).get("started", "")
    with suppress(ValueError):
        return datetime.fromisoformat(started).astimezone(UTC).isoformat(timespec="seconds")
    return datetime.fromtimestamp(log.start_ns // 10**9, UTC).isoformat(timespec="seconds") if log.start_ns else ""


def _fit_of(log: Path) -> str:
    """What the fit beside ``log`` says of it; empty without one, or where the fit is of other logs."""
    path = log.parent / FIT
    if not path.exists():
        return ""
    fit = parse_json(read_text(path, "fit", LARGEST_FIT), "fit", str(path))
    logs = _inside(fit, "provenance", "data", "logs")
    if not isinstance(logs, dict) or log.name not in {Path(name).name for name in logs}:
        return ""
    verdict = _inside(fit, "quantities", "stiffness", "verdict")
    likely = _inside(fit, "lack_of_fit", "likely")
    told = f"stiffness {verdict}" if isinstance(verdict, str) else "fitted"
    return f"{told}; residuals look like {likely[0]}" if isinstance(likely, list) and likely else told


def _inside(value: Any, *keys: str) -> Any:
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return value
