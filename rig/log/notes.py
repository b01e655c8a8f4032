"""Notes on a log, added after the run: a TOML file beside it, so that the log's bytes stay as they were written.

The notes of ``run.mcap`` (and of ``run.mcap.part`` while the run goes on) are in ``run.mcap.notes.toml``::

    [[note]]
    written = "2026-03-01T10:20:30+00:00"
    by = "M. Curie"
    text = "Film had a scratch near the ring."
"""

from __future__ import annotations

import getpass
import json
import os
from pathlib import Path

from pydantic import Field

from rig.base.clock import calendar_now
from rig.base.errors import ConfigError
from rig.base.table import Table
from rig.base.text import control_in
from rig.base.text_file import MAX_BYTES
from rig.base.toml_file import load_table
from rig.log.container import MAGIC
from rig.log.errors import UnusableFile

LONGEST = 4000  # letters of one note
MOST = 1000  # notes on one log
KIND = "notes"


class Note(Table):
    """One note on a log."""

    written: str = Field(max_length=40, description="When it was written: date and time, ISO 8601.")
    by: str = Field(default="", max_length=100, description='Who wrote it. Default: "", not said.')
    text: str = Field(min_length=1, max_length=LONGEST, description="The note.")


class Notes(Table):
    """The notes on one log, the oldest first."""

    note: list[Note] = Field(default_factory=list, max_length=MOST, description="The notes, the oldest first.")


def notes_file(log: Path) -> Path:
    """Where the notes on ``log`` are, whether or not there are any."""
    return log.with_name(log.name.removesuffix(".part") + ".notes.toml")


def notes_on(log: Path) -> list[Note]:
    """The notes on ``log``, the oldest first. Raises `ConfigError` when their file cannot be used."""
    path = notes_file(log)
    return load_table(path, Notes, KIND)[0].note if path.exists() else []


def add_note(log: Path, text: str, by: str = "") -> Path:
    """Append a note on ``log``; the log itself is not written to. Returns the file of the notes.

    Raises
    ------
    UnusableFile
        ``log`` is not a log.
    ConfigError
        The note cannot be kept, or the file of the notes is damaged; it is left as it was.
    """
    _check_log(log)
    text = text.strip()
    if not text or len(text) > LONGEST or (control := control_in(text + by)) is not None:
        why = "it is empty" if not text else f"it holds the control character {control}" if len(text) <= LONGEST else ""
        raise ConfigError(f"The note was not kept: {why or f'it has more than {LONGEST} letters'}. Write it anew.")
    if len(by) > 100:
        raise ConfigError("The note was not kept: the name after --by has more than 100 letters.")
    path = notes_file(log)
    kept = notes_on(log)
    said = {"written": calendar_now().isoformat(timespec="seconds"), "by": by or _user(), "text": text}
    # A JSON text with its letters as they are is a TOML text, for all letters that `control_in` lets pass.
    block = "\n[[note]]\n" + "".join(
        f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in said.items()
    )
    if len(kept) >= MOST or (path.exists() and path.stat().st_size + len(block.encode()) > MAX_BYTES):
        raise ConfigError(f"{path}: the note was not kept: the file is full. Move it away, or shorten it by hand.")
    _append(path, block.encode())
    return path


def _check_log(log: Path) -> None:
    part = log.with_name(log.name + ".part")
    path = part if part.exists() and not log.exists() else log
    try:
        with path.open("rb") as file:
            is_log = file.read(len(MAGIC)) == MAGIC
    except FileNotFoundError:
        raise UnusableFile(path, "there is no such file", "Check the name.") from None
    except OSError as error:
        raise UnusableFile(path, f"cannot be read: {error.strerror}") from None
    if not is_log:
        raise UnusableFile(path, "is not a log (MCAP)", "Name the log that the note is about.")


def _user() -> str:
    try:
        return getpass.getuser()[:100]
    except (KeyError, OSError):  # no name for this user
        return ""


def _append(path: Path, block: bytes) -> None:
    """Add the whole block or nothing of it, in one write, so that two notes at once do not mix."""
    try:
        fd = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        try:
            before = os.fstat(fd).st_size
            try:
                if os.write(fd, block) != len(block):
                    raise OSError(28, "no space left on the disk")
            except OSError:
                os.ftruncate(fd, before)
                raise
            os.fsync(fd)
        finally:
            os.close(fd)
    except OSError as error:
        raise ConfigError(f"{path}: the note was not kept: {error.strerror}.") from None
