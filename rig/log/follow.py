"""Follows a log while it grows, from outside: the writer knows nothing of it.

Every chunk of our logs describes its own channels, so each can be read as soon as it is whole. What is not whole yet is
read next time; what is damaged is left out, as in `rig.log.reader`.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode

from rig.log.container import MAGIC
from rig.log.errors import UnusableFile
from rig.log.reader import Columns, tables_of
from rig.log.scan import MAX_CHUNK, ChannelInfo, Damaged, Scan, Source, chunk_content

MOST_BYTES = 8 * 1024 * 1024  # read in one step, so that a long log does not hold its reader up


def growing(path: Path) -> Path:
    """The file to follow for the log ``path``: itself, or its ``.part`` while the run goes on.

    Raises
    ------
    UnusableFile
        Neither exists.
    """
    part = path.with_name(path.name + ".part")
    if path.exists() or not part.exists():
        if not path.exists():
            raise UnusableFile(path, "there is no such file", "Check the name.")
        return path
    return part


@dataclass
class News:
    """What was added since the last look. ``tables`` has the wanted topics that have new messages."""

    tables: list[dict[str, Columns]] = field(default_factory=list)
    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    ended: bool = False
    more: bool = False  # whether reading stopped at `MOST_BYTES`


class Follower:
    """Reads what is new in the log at ``path`` each time it is asked. Raises `LogError`."""

    def __init__(self, path: Path, topics: Collection[str]) -> None:
        self._source = Source(growing(path))
        self._scan = Scan(self._source)
        self._topics = frozenset(topics)
        self._offset = len(MAGIC)
        self._channels: dict[int, ChannelInfo] = {}
        self.ended = False

    def read(self) -> News:
        """All whole records behind the last one read."""
        news = News(ended=self.ended)
        begun = self._offset
        self._source.refresh()
        while not news.ended:
            if self._offset - begun > MOST_BYTES:
                news.more = True
                break
            try:
                record = self._scan.record_at(self._offset)
            except Damaged:
                # The writer may be in the middle of it. Only what has a sound record behind it is damaged.
                found = self._scan.next_landmark(self._offset + 1)
                if found >= self._source.size:
                    break
                self._offset = found
                continue
            self._offset = record.end
            try:
                if record.opcode == Opcode.CHUNK:
                    content = chunk_content(self._source, record, MAX_CHUNK)
                    if tables := tables_of(self._source.path, content, self._channels, self._topics):
                        news.tables.append(tables)
                elif record.opcode == Opcode.ATTACHMENT:
                    name, _, data = self._scan.attachment(record)
                    news.attachments[name] = data
                elif record.opcode == Opcode.METADATA:
                    name, table = self._scan.metadata(record)
                    news.metadata[name] = table
                elif record.opcode == Opcode.DATA_END:
                    self.ended = news.ended = True
            except Damaged:
                continue
        return news

    def close(self) -> None:
        self._source.close()
