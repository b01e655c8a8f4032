"""A log on one screen."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from rig.base.errors import ConfigError
from rig.base.text import printable
from rig.log.contents import air_in, identities_in, session_in
from rig.log.notes import notes_on
from rig.log.reader import Log, read_log
from rig.log.schema import ROLES

MOST_LINES = 12


def info(path: Path) -> str:
    """What the log at ``path`` holds: run, devices, rates, gaps, outcome.

    Raises `LogError` when it cannot be read.
    """
    log = read_log(path)
    lines = [f"{path}: {_state(log)}", ""]
    lines += _table("run", log.metadata.get("run", {}))
    lines += _table("session", session_in(log) | air_in(log))
    lines += [_row("began", _date(log.start_ns)), _row("lasted", f"{(log.end_ns - log.start_ns) * 1e-9:.3f} s")]
    lines += _table("outcome", log.outcome if log.outcome is not None else {"status": "not recorded"})
    lines += _notes(path)
    lines += ["", *_devices(log), *_table("unit of", log.metadata.get("units", {}))]
    lines += ["", *_rates(log)]
    if log.attachments:
        lines += ["", "inside"]
        lines += _most([f"  {printable(a.name)}  {len(a.data)} bytes" for a in log.attachments.values()])
    if log.gaps:
        lines += ["", "could not be read"]
        lines += _most([f"  bytes {gap.start} to {gap.end}: {gap.reason}" for gap in log.gaps])
    return "\n".join(lines)


def _state(log: Log) -> str:
    size = f"{log.path.stat().st_size / 1e6:.1f} MB"
    if log.whole:
        return f"whole, {size}" if log.outcome is not None else f"sound, but the run was CUT SHORT, {size}"
    if log.ended:
        return f"DAMAGED, {size}; dea-rig recover copies what is sound"
    return f"CUT SHORT, {size}; dea-rig recover makes it whole"


def _notes(path: Path) -> list[str]:
    """What was noted on the log since, the newest last; of a file that cannot be used, why."""
    try:
        notes = notes_on(path)
    except ConfigError as error:
        return ["", "notes", *(f"  {printable(line)}" for line in str(error).splitlines())]
    left_out = [f"  ... and {len(notes) - MOST_LINES} before"] if len(notes) > MOST_LINES else []
    shown = [
        f"  {printable(note.written)} {printable(note.by)}: {printable(note.text)}" for note in notes[-MOST_LINES:]
    ]
    return ["", "notes", *left_out, *shown] if notes else []


def _devices(log: Log) -> list[str]:
    """What each instrument said of itself at the start of the run."""
    lines = ["devices"]
    said = {
        role: f"model {one.model or '-'}, serial {one.serial or '-'}, firmware {one.firmware or '-'}"
        for role, one in identities_in(log).items()
    }
    for role in ROLES:
        if any(topic.startswith((f"/{role}/", f"/raw/{role}/")) for topic in log.topics):
            lines.append(_row(role, said.get(role, "")))
    return lines


def _rates(log: Log) -> list[str]:
    lines = [f"{'topic':<24}{'messages':>10}{'missing':>10}{'rate / Hz':>12}{'longest pause / s':>20}"]
    tables = log.tables([topic for topic in log.topics if topic.endswith("/sample")])
    for topic, count in log.topics.items():
        rate, pause = f"{'-':>12}", f"{'-':>20}"
        if topic in tables:
            steps = np.diff(np.sort(tables[topic]["t_s"]))
            if steps.size > 0 and float(np.median(steps)) > 0:
                rate, pause = f"{1.0 / float(np.median(steps)):12.2f}", f"{float(steps.max()):20.4f}"
        lines.append(f"{topic:<24}{count:>10}{log.missing.get(topic, 0):>10}{rate}{pause}")
    lines += [f"{printable(topic):<24}{count:>10}  (not of this program)" for topic, count in log.unknown.items()]
    return lines


def _table(title: str, table: dict[str, str]) -> list[str]:
    return [_row(f"{title}.{key}", value) for key, value in table.items() if value]


def _row(name: str, value: str) -> str:
    return f"  {printable(name):<27} {printable(value)}"


def _most(lines: list[str]) -> list[str]:
    return lines if len(lines) <= MOST_LINES else [*lines[:MOST_LINES], f"  ... and {len(lines) - MOST_LINES} more"]


def _date(ns: int) -> str:
    return datetime.fromtimestamp(ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
