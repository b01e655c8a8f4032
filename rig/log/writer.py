"""Writes one log, so that whatever happens to the process, what was recorded can be read."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rig.log import schema, space
from rig.log.checks import Checks
from rig.log.container import ContainerWriter
from rig.log.decimation import KEPT, Decimation
from rig.log.errors import LogError
from rig.log.part_file import PartFile

# A chunk is written when its first message is this old, so that a loop that ticks every 20 ms or faster
# never has more than 100 ms of samples in memory.
CHUNK_SECONDS = 0.08
# Where most is left out, a chunk a cycle would make an index as large as the log. So much a power cut may take along;
# the end of the process that records takes nothing, since another one writes.
SPARSE_CHUNK_SECONDS = 2.0
FREE_SECONDS = 1.0
PLACE_SECONDS = 0.5  # how often it is looked whether the file is still where it was made


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

    Attributes
    ----------
    part : Path
        Where the log is until it is finished.
    kept : Path or None
        Where it stayed when the block ended without `finish`.

    Raises
    ------
    LogError
        From every method: the file cannot be made or written, exists already, or what is to be written is not valid.
        Invalid input leaves the log as it was. After a failed write (disk full) the file is closed, and every later
        call raises.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.kept: Path | None = None
        self._free: int | None = None
        self._next_look = -math.inf
        self._channels: dict[str, int] = {}
        self._checks = Checks(path)
        self._decimation = Decimation()
        self._next_place = -math.inf
        self._chunk_since: float | None = None
        self._ended = False
        self._file = PartFile(path)
        try:
            self._container = ContainerWriter(self._file.put)
            self.metadata("log", {"schema_version": str(schema.SCHEMA_VERSION), "package": schema.PACKAGE})
            self.metadata("fields", schema.meanings())
        except LogError:
            self._file.discard()
            raise

    @property
    def part(self) -> Path:
        """Where the log is until it is finished."""
        return self._file.part

    @property
    def size(self) -> int:
        """Bytes of the file so far, with the index that it ends with."""
        return self._container.size

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
        self._file.check()
        self.add(topic, self._checks.message(topic, fields, log_ns, publish_ns), log_ns, publish_ns)

    def add(self, topic: str, data: bytes, log_ns: int, publish_ns: int) -> None:
        """`write` of a message that `rig.log.checks.Checks` has encoded."""
        self._file.check()
        if self._decimation.keeping and topic != KEPT:  # nearly always
            self._put(topic, data, log_ns, publish_ns)
            return
        for row in self._decimation.take((topic, data, log_ns, publish_ns)):
            self._put(*row)

    def _put(self, topic: str, data: bytes, log_ns: int, publish_ns: int) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._container.add_channel(topic, schema.schema_name(topic), schema.schema_data(topic))
            self._channels[topic] = channel
        self._container.add_message(channel, data, log_ns, publish_ns)

    def tick(self, now: float) -> int | None:
        """Send what is due to the file. To be called in every turn of the loop, with the clock's time in seconds.

        Returns the bytes free on the disk, looked up once a second; None when the system does not tell.
        """
        self._file.check()
        if now >= self._next_place:
            self._next_place = now + PLACE_SECONDS
            self._file.check_place()
        if now >= self._next_look:
            self._next_look = now + FREE_SECONDS
            with suppress(OSError):
                self._free = space.free(self.part.parent)
        if self._container.chunk_is_empty:
            self._chunk_since = None
        elif self._chunk_since is None:
            self._chunk_since = now
        elif not now - self._chunk_since < (CHUNK_SECONDS if self._decimation.keeping else SPARSE_CHUNK_SECONDS):
            self._container.end_chunk()
            self._chunk_since = None
        return self._free

    def sync(self) -> None:
        """Have the disk confirm what was sent to the file; may take long, so not to be called by who drives a rig."""
        self._file.sync()

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Put a file into the log: ``scene.toml``, ``protocol.toml``, a certificate."""
        self._file.check()
        self._checks.attachment(name, data)
        self._container.add_attachment(name, media_type, data)

    def metadata(self, name: str, mapping: Mapping[str, str]) -> None:
        """Put a table of strings into the log. Facts about the host belong in the one named ``host``."""
        self._file.check()
        self._checks.metadata(name, mapping)
        self._container.add_metadata(name, mapping)

    def finish(self, outcome: Mapping[str, str]) -> None:
        """Write why and how the run ended as metadata ``outcome``, end the file, sync it, give it its final name."""
        self.metadata("outcome", outcome)
        self._container.finish()
        self._ended = True
        try:
            self._file.finish()
        except LogError:
            self.kept = self.part
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if not self._ended:
            self._keep_or_remove()
        if error is not None and self.kept is not None:
            error.add_note(f"What was recorded is kept in {self.kept}.")

    def _keep_or_remove(self) -> None:
        if self._container.messages == 0:
            self._file.discard()
            return
        self.kept = self.part
        if self._file.is_open:
            with suppress(LogError):  # what was written before stays readable
                self._container.finish()
                self._file.end()
