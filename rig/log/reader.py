"""Reads a log: finished, cut short, damaged or hostile. Data with an explicit list of gaps, or one `LogError`."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from rig.base.text import printable
from rig.log import schema
from rig.log.errors import LogError, UnusableFile
from rig.log.scan import (
    MAX_TABLES,
    ChannelInfo,
    Damaged,
    Gap,
    Messages,
    Record,
    Scan,
    Source,
    chunk_content,
    messages,
    rows,
)

Columns = dict[str, NDArray[Any]]

_TIMES = struct.Struct("<QQ")  # log time and publish time, as they lie before the payload


class Message(NamedTuple):
    """One message: when the host had it, the time that it is about (ns since 1970), its fields."""

    log_ns: int
    publish_ns: int
    fields: dict[str, Any]


class Attachment(NamedTuple):
    """A file inside the log. Its name is the log's claim and must not be used as a path."""

    name: str
    media_type: str
    data: bytes


class _Chunk(NamedTuple):
    record: Record
    channels: dict[int, ChannelInfo]  # those that have messages in it


@dataclass(frozen=True)
class Log:
    """What a log holds. Samples are decoded when they are asked for.

    Attributes
    ----------
    path : Path
    topics : dict of str to int
        Messages that can be read on each topic, in the order of the table in `rig.log.schema`.
    missing : dict of str to int
        Messages known to be lost on each topic, by their sequence numbers; nothing is known behind the last one read.
    unknown : dict of str to int
        Messages on topics that are not in the table; they are not decoded.
    attachments : dict of str to Attachment
    metadata : dict of str to dict
        ``run``, ``versions``, ``host``, ``outcome``, ... as written.
    gaps : tuple of Gap
        Bytes that could not be read, and why.
    start_ns, end_ns : int
        Log time of the first and the last message; 0 when there is none.
    ended : bool
        Whether the file has its end record, that is, was closed by its writer.
    """

    path: Path
    topics: dict[str, int]
    missing: dict[str, int]
    unknown: dict[str, int]
    attachments: dict[str, Attachment]
    metadata: dict[str, dict[str, str]]
    gaps: tuple[Gap, ...]
    start_ns: int
    end_ns: int
    ended: bool
    _chunks: tuple[_Chunk, ...]

    @property
    def outcome(self) -> dict[str, str] | None:
        """Why and how the run ended; None when the log was cut short."""
        return self.metadata.get("outcome")

    @property
    def whole(self) -> bool:
        """Whether everything that was written can be read."""
        return self.ended and not self.gaps and not self.missing

    def messages(self, topic: str) -> Iterator[Message]:
        """The messages on one topic in the order of the file; none when the topic is not in the log."""
        for channels, content, found in self._contents({topic}):
            for _, mine in _by_topic(channels, found):
                for k in np.flatnonzero(mine).tolist():
                    payload = content[found.start[k] : found.end[k]]
                    yield Message(int(found.log_ns[k]), int(found.publish_ns[k]), _decode(self.path, topic, payload))

    def columns(self, topic: str) -> Columns:
        """The messages on one topic as arrays of shape (n,): ``log_ns``, ``publish_ns`` and every field by its name.

        Numbers are float64, int64, uint32, int32 or bool; text and bytes are object arrays.
        """
        return self.tables([topic])[topic]

    def tables(self, topics: Collection[str]) -> dict[str, Columns]:
        """`columns` of several topics, in one pass over the file."""
        tables = _tables(self.path, topics)
        for channels, content, found in self._contents(tables.keys()):
            for topic, mine in _by_topic(channels, found):
                tables[topic].add(content, found, mine)
        return {topic: table.columns() for topic, table in tables.items()}

    def raw_messages(self) -> Iterator[tuple[ChannelInfo, int, int, int, bytes] | None]:
        """All messages as written: channel, sequence number, log time, publish time, payload; None ends each chunk."""
        for channels, content, found in self._contents(None):
            columns = (column.tolist() for column in found)
            for number, sequence, log_ns, publish_ns, start, end in zip(*columns, strict=True):
                yield channels[number], sequence, log_ns, publish_ns, content[start:end]
            yield None

    def _contents(self, topics: Collection[str] | None) -> Iterator[tuple[dict[int, ChannelInfo], bytes, Messages]]:
        """The chunks that have messages on ``topics`` (None: all): their channels on these, content and messages."""
        for topic in topics or ():
            _check_topic(self.path, topic)
        with Source(self.path) as source:
            for chunk in self._chunks:
                channels = {
                    n: channel for n, channel in chunk.channels.items() if topics is None or channel.topic in topics
                }
                if channels:
                    content = self._content(source, chunk)
                    yield channels, content, messages(content, dict(chunk.channels))

    def _content(self, source: Source, chunk: _Chunk) -> bytes:
        try:
            return chunk_content(source, chunk.record)
        except Damaged as why:
            raise LogError(self.path, f"changed while it was read ({why})", "Read it again.") from why


def read_log(path: Path) -> Log:
    """Read the log at ``path``, finished or not (``.part``), checking every checksum.

    Raises
    ------
    LogError
        The file cannot be read, is not a log, or was written with another schema version.
    """
    with Source(path) as source:
        return _read(source, {})


def read_tables(path: Path, topics: Collection[str]) -> tuple[Log, dict[str, Columns]]:
    """`read_log` and `Log.tables` in one pass over the file."""
    tables = _tables(path, topics)
    with Source(path) as source:
        log = _read(source, tables)
    return log, {topic: table.columns() for topic, table in tables.items()}


def tables_of(
    path: Path, content: bytes, channels: dict[int, ChannelInfo], topics: Collection[str]
) -> dict[str, Columns]:
    """The messages on ``topics`` in one chunk's checked ``content``; its channels are added to ``channels``.

    Raises
    ------
    Damaged
        The content is not a sequence of messages.
    LogError
        It was written with another schema version.
    """
    found = messages(content, channels)
    wanted = {number: channel for number, channel in channels.items() if channel.topic in topics}
    tally = _Tally(path)
    tally.version = ""
    for channel in set(wanted.values()):
        tally.check_schema(channel)
    tables: dict[str, Columns] = {}
    for topic, mine in _by_topic(wanted, found):
        if mine.any():
            table = _Table(path, topic)
            table.add(content, found, mine)
            tables[topic] = table.columns()
    return tables


def _read(source: Source, tables: dict[str, _Table]) -> Log:
    scan = Scan(source)
    tally = _Tally(source.path)
    attachments: dict[str, Attachment] = {}
    metadata: dict[str, dict[str, str]] = {}
    chunks: list[_Chunk] = []
    for record in scan.records():
        try:
            if record.opcode == Opcode.CHUNK:
                content = scan.chunk(record)
                channels, found = tally.add(content)
                chunks.append(_Chunk(record, channels))
                wanted = {number: channel for number, channel in channels.items() if channel.topic in tables}
                for topic, mine in _by_topic(wanted, found):
                    tables[topic].add(content, found, mine)
            elif record.opcode == Opcode.ATTACHMENT:
                attachment = Attachment(*scan.attachment(record))
                _check_new(attachments, attachment.name)
                attachments[attachment.name] = attachment
            elif record.opcode == Opcode.METADATA:
                name, table = scan.metadata(record)
                _check_new(metadata, name)
                if name == "log":
                    tally.version = table.get("schema_version", "")
                metadata[name] = table
        except Damaged as why:
            scan.damaged(record, str(why))
    if not tally.counts.keys() & schema.CHANNELS.keys():
        if "log" not in metadata:
            raise UnusableFile(source.path, "holds nothing that dea-rig wrote", "Name a log of dea-rig.")
        tally.check_version()
    return Log(
        path=source.path,
        topics={topic: tally.counts[topic] for topic in schema.CHANNELS if topic in tally.counts},
        missing={topic: tally.missing[topic] for topic in schema.CHANNELS if topic in tally.missing},
        unknown={topic: count for topic, count in tally.counts.items() if topic not in schema.CHANNELS},
        attachments=attachments,
        metadata=metadata,
        gaps=tuple(scan.gaps),
        start_ns=tally.start_ns or 0,
        end_ns=tally.end_ns,
        ended=scan.ended,
        _chunks=tuple(chunks),
    )


class _Tally:
    """Counts the messages of sound chunks and those that are missing between them."""

    def __init__(self, path: Path) -> None:
        self.counts: dict[str, int] = {}
        self.missing: dict[str, int] = {}
        self.start_ns: int | None = None
        self.end_ns = 0
        self.version = str(schema.SCHEMA_VERSION)  # as the log's metadata claims
        self._path = path
        self._channels: dict[int, ChannelInfo] = {}
        self._checked: set[ChannelInfo] = set()
        self._sequence: dict[str, int] = {}

    def add(self, content: bytes) -> tuple[dict[int, ChannelInfo], Messages]:
        """Count a chunk: its channels by number, its messages. Raises `Damaged`, and then counts nothing of it."""
        found = messages(content, self._channels)
        if not len(found.channel):
            return {}, found
        first_ns, last_ns = int(found.log_ns.min()), int(found.log_ns.max())
        if max(last_ns, int(found.publish_ns.max())) >= 2**63:
            raise Damaged("a chunk with an impossible time")
        channels = {number: self._channels[number] for number in np.unique(found.channel).tolist()}
        for channel in channels.values():
            self.check_schema(channel)
        for number, channel in channels.items():
            sequence = found.sequence[found.channel == number]
            topic, last = channel.topic, int(sequence[-1])
            lost = last - self._sequence.get(topic, 0) - len(sequence)
            if lost > 0:
                self.missing[topic] = self.missing.get(topic, 0) + lost
            self.counts[topic] = self.counts.get(topic, 0) + len(sequence)
            self._sequence[topic] = last
        self.start_ns = first_ns if self.start_ns is None else min(self.start_ns, first_ns)
        self.end_ns = max(self.end_ns, last_ns)
        return channels, found

    def check_version(self) -> None:
        """Refuse a log of another schema version, for which its metadata alone, without checksum, is no proof."""
        if self.version != str(schema.SCHEMA_VERSION):
            raise LogError(
                self._path,
                f"it was written with schema version {printable(self.version) or '(unknown)'}, and this dea-rig reads "
                f"version {schema.SCHEMA_VERSION}",
                "Read it with the version of dea-rig that wrote it; its metadata names it.",
            )

    def check_schema(self, channel: ChannelInfo) -> None:
        if channel in self._checked or channel.topic not in schema.CHANNELS:
            return
        expected = ("protobuf", schema.schema_name(channel.topic), schema.schema_data(channel.topic))
        if (channel.encoding, channel.schema_name, channel.schema_data) != expected:
            self.check_version()
            raise LogError(
                self._path,
                f"the messages on {channel.topic} are of another kind than those of schema version "
                f"{schema.SCHEMA_VERSION}",
                "Read it with the version of dea-rig that wrote it; its metadata names it.",
            )
        self._checked.add(channel)


class _Table:
    """The messages on one topic, gathered chunk by chunk."""

    def __init__(self, path: Path, topic: str) -> None:
        _check_topic(path, topic)
        self._path = path
        self._topic = topic
        self._packing = _packing(topic)
        self._blocks: list[NDArray[np.void]] = []
        self._fits: list[NDArray[np.bool_]] = []  # which rows are in the blocks
        self._others: list[bytes] = []

    def add(self, content: bytes, found: Messages, mine: NDArray[np.bool_]) -> None:
        """Take in the messages for which ``mine`` is true."""
        start, end = found.start[mine] - _TIMES.size, found.end[mine]
        size = self._packing.layout.itemsize if self._packing else -1
        fits = end - start == size
        self._blocks.append(rows(content, start[fits], size) if self._packing else np.empty(0, "V1"))
        self._fits.append(fits)
        others = ~fits
        for a, b in zip(start[others].tolist(), end[others].tolist(), strict=True):
            self._others.append(content[a:b])

    def columns(self) -> Columns:
        """The gathered messages by column."""
        fits = np.concatenate([np.empty(0, dtype=bool), *self._fits])
        fields = schema.CHANNELS[self._topic].fields
        columns: Columns = {name: np.empty(len(fits), dtype=np.int64) for name in ("log_ns", "publish_ns")}
        columns |= {field.name: np.empty(len(fits), dtype=_NUMPY[field.type]) for field in fields}
        unpacked: list[tuple[int, bytes]] = list(zip(np.flatnonzero(~fits).tolist(), self._others, strict=True))
        if self._packing and fits.any():
            data = np.concatenate(self._blocks)
            sound = self._packing.unpack(data, fits, columns)
            of_data = np.flatnonzero(~sound)
            unpacked += zip(np.flatnonzero(fits)[of_data].tolist(), (data[k].tobytes() for k in of_data), strict=True)
        for n, row in unpacked:
            columns["log_ns"][n], columns["publish_ns"][n] = _TIMES.unpack_from(row)
            for name, value in _decode(self._path, self._topic, row[_TIMES.size :]).items():
                columns[name][n] = value
        return columns


def _tables(path: Path, topics: Collection[str]) -> dict[str, _Table]:
    return {topic: _Table(path, topic) for topic in topics}


def _by_topic(channels: dict[int, ChannelInfo], found: Messages) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Each topic of ``channels``, with which of the messages are on it."""
    numbers: dict[str, list[int]] = {}
    for number, channel in channels.items():
        numbers.setdefault(channel.topic, []).append(number)
    for topic, of_topic in numbers.items():
        yield topic, found.channel == of_topic[0] if len(of_topic) == 1 else np.isin(found.channel, of_topic)


def _check_topic(path: Path, topic: str) -> None:
    if topic not in schema.CHANNELS:
        raise UnusableFile(path, f"no log has a topic {topic}")


def _decode(path: Path, topic: str, payload: bytes) -> dict[str, Any]:
    try:
        return schema.decode(topic, payload)
    except ValueError as error:
        raise LogError(path, str(error), "Another program wrote it, or wrote into it.") from error


def _check_new(found: dict[str, Any], name: str) -> None:
    if name in found:
        raise Damaged(f"a second {name!r}")
    if len(found) >= MAX_TABLES:
        raise Damaged(f"more than {MAX_TABLES} of its kind")


_NUMPY = {
    "double": np.dtype("<f8"),
    "bool": np.dtype("?"),
    "fixed32": np.dtype("<u4"),
    "sfixed64": np.dtype("<i8"),
    "uint32": np.dtype("<u4"),
    "sint32": np.dtype("<i4"),
    "string": np.dtype("O"),
    "bytes": np.dtype("O"),
}
_WIRE_TYPE = {"double": 1, "bool": 0, "fixed32": 5, "sfixed64": 1, "string": 2}


class _Packing(NamedTuple):
    """How the times and a message lie in their bytes when the message's texts are empty."""

    layout: np.dtype[Any]  # the numbers
    fixed: dict[int, int]  # offset and value of the bytes that are always the same
    bools: list[str]
    texts: list[str]

    def unpack(self, data: NDArray[np.void], fits: NDArray[np.bool_], columns: Columns) -> NDArray[np.bool_]:
        """Fill the rows ``fits`` of ``columns`` from ``data``, all at once; which of ``data`` do lie like this."""
        numbers = data.view(self.layout)
        octets = data.view(np.uint8).reshape(len(data), -1)
        sound = np.ones(len(data), dtype=bool)
        for offset, value in self.fixed.items():
            sound &= octets[:, offset] == value
        for name in self.bools:
            sound &= numbers[name] <= 1
        at = fits if sound.all() else np.flatnonzero(fits)[sound]
        good = numbers if sound.all() else numbers[sound]
        for name in self.layout.names or ():
            columns[name][at] = good[name]
        for name in self.texts:
            columns[name][at] = ""
        return sound


@cache
def _packing(topic: str) -> _Packing | None:
    """The packing of the messages on ``topic``; None when a field has no fixed size."""
    fields = schema.CHANNELS[topic].fields
    if any(field.type not in _WIRE_TYPE for field in fields):
        return None
    kinds: dict[str, tuple[np.dtype[Any], int]] = {"log_ns": (np.dtype("<i8"), 0), "publish_ns": (np.dtype("<i8"), 8)}
    fixed: dict[int, int] = {}
    size = _TIMES.size
    for number, field in enumerate(fields, 1):
        fixed[size] = number << 3 | _WIRE_TYPE[field.type]
        size += 1
        if field.type == "string":
            fixed[size] = 0
            size += 1
        else:
            kind = np.dtype("u1") if field.type == "bool" else _NUMPY[field.type]
            kinds[field.name] = kind, size
            size += kind.itemsize
    return _Packing(
        np.dtype(
            {
                "names": list(kinds),
                "formats": [kind for kind, _ in kinds.values()],
                "offsets": [offset for _, offset in kinds.values()],
                "itemsize": size,
            }
        ),
        fixed,
        [field.name for field in fields if field.type == "bool"],
        [field.name for field in fields if field.type == "string"],
    )
