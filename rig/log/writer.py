"""Writes one log, so that whatever happens to the process, what was recorded can be read."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rig.log import schema
from rig.log.container import ContainerWriter
from rig.log.errors import LogError

# A chunk is written when its first message is this old, so that a loop that ticks every 20 ms or faster
# never has more than 100 ms of samples in memory.
CHUNK_SECONDS = 0.08

_NAME = re.compile(r"(?!\.)[A-Za-z0-9._-]{1,64}")
_MAX_ATTACHMENT = 32 * 1024 * 1024
_MAX_MESSAGE = 64 * 1024
_MAX_NS = 2**63 - 1


class LogWriter:
    """Writes ``path``, as a context manager.

    Until `finish` the file is ``<path>.part``; a finished file is synced and renamed, and never overwrites another.
    If the block ends without `finish` or with an exception, the file is ended so that every reader can read it and
    kept as ``.part`` (``kept`` names it, and a note on the exception says so); a file in which no message had been
    recorded is removed instead. Channels appear in the file when they are first written to. Each chunk can be
    understood and checked alone.

    Parameters
    ----------
    path : Path
        The log to write.

    Raises
    ------
    LogError
        From every method: the file cannot be made or written, exists already, or what is to be written is not valid.
        Invalid input leaves the log as it was. After a failed write (disk full) the file is closed, and every later
        call raises.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.part = path.with_name(path.name + ".part")
        self.kept: Path | None = None
        self._channels: dict[str, int] = {}
        self._names: set[tuple[str, str]] = set()
        self._chunk_since: float | None = None
        self._failure: LogError | None = None
        self._ended = False
        self._whole = 0  # file size up to the last complete record
        self._fd = self._create()
        try:
            self._container = ContainerWriter(self._put)
            self.metadata("log", {"schema_version": str(schema.SCHEMA_VERSION), "package": schema.PACKAGE})
            self.metadata("fields", schema.meanings())
        except LogError:
            self.part.unlink(missing_ok=True)
            raise

    def write(self, topic: str, fields: Mapping[str, Any], log_ns: int, publish_ns: int) -> None:
        """Record one message.

        Parameters
        ----------
        topic, fields
            As `rig.log.schema.CHANNELS` lists them; every field must be given.
        log_ns : int
            When the host had it, nanoseconds since 1970.
        publish_ns : int
            The time that it is about (a sample's own time), nanoseconds since 1970.
        """
        self._check_open()
        if topic not in schema.CHANNELS:
            raise LogError(self.path, f"there is no topic {topic!r}", f"Topics: {', '.join(schema.CHANNELS)}.")
        for name, ns in (("log_ns", log_ns), ("publish_ns", publish_ns)):
            if type(ns) is not int or not 0 <= ns <= _MAX_NS:
                raise LogError(self.path, f"{name} is {ns!r} on {topic}", "It must be nanoseconds since 1970, an int.")
        try:
            data = schema.encode(topic, fields)
        except ValueError as error:
            raise LogError(self.path, str(error), "See rig.log.schema.CHANNELS.") from error
        if len(data) > _MAX_MESSAGE:
            raise LogError(
                self.path, f"a message of {len(data)} bytes on {topic}", f"At most {_MAX_MESSAGE} are allowed."
            )
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._container.add_channel(topic, schema.schema_name(topic), schema.schema_data(topic))
            self._channels[topic] = channel
        self._container.add_message(channel, data, log_ns, publish_ns)

    def tick(self, now: float) -> None:
        """Send what is due to the file. To be called in every turn of the loop, with the clock's time in seconds."""
        self._check_open()
        if self._container.chunk_is_empty:
            self._chunk_since = None
        elif self._chunk_since is None:
            self._chunk_since = now
        elif not now - self._chunk_since < CHUNK_SECONDS:
            self._container.end_chunk()
            self._chunk_since = None

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Put a file into the log: ``scene.toml``, ``protocol.toml``, a certificate."""
        self._check_open()
        if len(data) > _MAX_ATTACHMENT:
            raise LogError(
                self.path, f"attachment {name} has {len(data)} bytes", f"At most {_MAX_ATTACHMENT} are allowed."
            )
        self._check_name("attachment", name)
        self._container.add_attachment(name, media_type, data)

    def metadata(self, name: str, mapping: Mapping[str, str]) -> None:
        """Put a table of strings into the log. Facts about the host belong in the one named ``host``."""
        self._check_open()
        for text in (part for item in mapping.items() for part in item):
            if not isinstance(text, str) or any("\ud800" <= letter <= "\udfff" for letter in text):
                raise LogError(self.path, f"metadata {name}: {text!r} is not text", "Keys and values must be text.")
        self._check_name("metadata", name)
        self._container.add_metadata(name, mapping)

    def finish(self, outcome: Mapping[str, str]) -> None:
        """Write why and how the run ended as metadata ``outcome``, end the file, sync it, give it its final name."""
        self.metadata("outcome", outcome)
        self._container.finish()
        self._sync_and_close()
        self._ended = True
        if self.path.exists():
            self.kept = self.part
            raise self._fail(
                f"a file of this name appeared while the log was written; the log is complete in {self.part}"
            )
        try:
            self.part.rename(self.path)
            _sync_directory(self.path.parent)
        except OSError as error:
            self.kept = self.part
            raise self._fail(f"cannot be given its name ({error.strerror}); it is complete in {self.part}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if not self._ended:
            self._keep_or_remove()
        if error is not None and self.kept is not None:
            error.add_note(f"What was recorded is kept in {self.kept}.")

    def _keep_or_remove(self) -> None:
        if self._container.messages == 0:
            self._close()
            self.part.unlink(missing_ok=True)
            return
        self.kept = self.part
        if self._fd is not None:
            with suppress(LogError):  # what was written before stays readable
                self._container.finish()
                self._sync_and_close()

    def _create(self) -> int | None:
        for existing in (self.path, self.part):
            if existing.exists():
                raise LogError(existing, "exists already", "Logs are never overwritten: name another, or move it away.")
        try:
            fd = os.open(self.part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
            _sync_directory(self.part.parent)
        except OSError as error:
            raise LogError(
                self.path, f"cannot be made ({error.strerror})", "Name a directory you can write to."
            ) from error
        return fd

    def _put(self, data: bytes) -> None:
        assert self._fd is not None
        view = memoryview(data)
        try:
            while view:
                view = view[os.write(self._fd, view) :]
        except BaseException as error:  # an interrupt may leave a torn record just as a full disk does
            with suppress(OSError):
                os.ftruncate(self._fd, self._whole)
            self._close()
            reason = error.strerror if isinstance(error, OSError) else type(error).__name__
            failure = self._fail(f"writing failed ({reason}); nothing more is recorded")
            if isinstance(error, OSError):
                raise failure from error
            raise
        self._whole += len(data)

    def _sync_and_close(self) -> None:
        assert self._fd is not None
        try:
            os.fsync(self._fd)
        except OSError as error:
            self._close()
            raise self._fail(f"the disk did not confirm the end of the log ({error.strerror})") from error
        self._close()

    def _close(self) -> None:
        if self._fd is not None:
            fd, self._fd = self._fd, None
            with suppress(OSError):
                os.close(fd)

    def _fail(self, what: str) -> LogError:
        self._failure = LogError(self.path, what, "Free some space or use another disk, then repeat the run.")
        return self._failure

    def _check_open(self) -> None:
        if self._failure is not None:
            raise LogError(self._failure.path, self._failure.what, self._failure.advice)
        if self._fd is None:
            raise LogError(self.path, "is finished; nothing can be added")

    def _check_name(self, kind: str, name: str) -> None:
        if not _NAME.fullmatch(name):
            raise LogError(self.path, f"{kind} name {name!r}", "Allowed: 1 to 64 of A-Z a-z 0-9 . _ -, no leading dot.")
        if (kind, name) in self._names:
            raise LogError(self.path, f"{kind} {name!r} is in the log already", "Each name once.")
        self._names.add((kind, name))


def _sync_directory(directory: Path) -> None:
    fd = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
