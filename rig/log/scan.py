"""Walks the records of an MCAP file that may be unfinished, damaged or hostile.

Only the data section is read; the summary is for other readers. Every number in the file is checked before it is
used, and nothing is believed without its checksum: chunks and attachments carry one each. Where the bytes make no
sense the walk looks for the next sound record and notes the gap. It never goes back, so its time grows linearly
with the file, and it holds one record at a time.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from array import array
from collections.abc import Iterator
from functools import cache, lru_cache
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np
import zstandard
from mcap.opcode import Opcode
from numpy.typing import NDArray

from rig.log.container import MAGIC
from rig.log.errors import LogError, UnusableFile

MAX_RECORD = 64 * 1024 * 1024
MAX_CHUNK = 16 * 1024 * 1024
MAX_MESSAGE = 1024 * 1024
MAX_CHANNELS = 1000
MAX_TABLES = 1000
MAX_GAPS = 1000
SHORT = 4096  # descriptions up to this many bytes, which every chunk repeats, are remembered
# What the chunks of a file may expand to in all. Real logs expand to less than ten times their size, because the
# message indexes are not compressed; a decompression bomb stops here.
EXPANSION = (32 * 1024 * 1024, 32)

_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")  # first time, last time, size, crc, length of the compression's name
_MESSAGE = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)
_U16 = struct.Struct("<H")
_U32 = struct.Struct("<I")
_U64 = struct.Struct("<Q")
_IN_DATA = {
    Opcode.HEADER,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.MESSAGE,
    Opcode.CHUNK,
    Opcode.MESSAGE_INDEX,
    Opcode.ATTACHMENT,
    Opcode.METADATA,
    Opcode.DATA_END,
}
# What a record worth finding again looks like: chunk, attachment, metadata or end of data, and a length below 2^32.
_LANDMARK = re.compile(rb"(?=[\x06\x09\x0c\x0f][\x00-\xff]{4}\x00{4})")
_WINDOW = 1024 * 1024
_LOOK = 512  # enough of a record's beginning to judge it


class Gap(NamedTuple):
    """Bytes ``start`` to ``end`` of the file that could not be read, and why."""

    start: int
    end: int
    reason: str


class Damaged(Exception):
    """A record that makes no sense; the message says why."""


class Record(NamedTuple):
    """A record that has the right shape: opcode, where it starts, where it ends."""

    opcode: int
    start: int
    end: int


class ChannelInfo(NamedTuple):
    """A channel as a chunk describes it."""

    topic: str
    encoding: str
    schema_name: str
    schema_data: bytes


class Messages(NamedTuple):
    """The messages of one chunk, in order; arrays of shape (n,)."""

    channel: NDArray[np.uint16]
    sequence: NDArray[np.uint32]
    log_ns: NDArray[np.uint64]
    publish_ns: NDArray[np.uint64]
    start: NDArray[np.int64]  # of the payload in the chunk's content
    end: NDArray[np.int64]


class Source:
    """A file, read at any offset. Raises `LogError` when it cannot be."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._fd = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0))
        except FileNotFoundError:
            raise UnusableFile(path, "there is no such file", "Check the name.") from None
        except OSError as error:
            raise UnusableFile(path, f"cannot be opened ({error.strerror})") from error
        try:
            if not path.is_file():
                raise UnusableFile(path, "is not a file", "Name one log.")
            self.size = os.fstat(self._fd).st_size
            if self.size == 0:
                raise UnusableFile(path, "is empty", "The run ended before anything was recorded.")
            if self.at(0, len(MAGIC)) != MAGIC:
                raise UnusableFile(path, "is not a log: it does not begin like an MCAP file", "Name a .mcap file.")
        except LogError:
            self.close()
            raise

    def at(self, offset: int, length: int) -> bytes:
        """Up to ``length`` bytes from ``offset``; fewer at the end of the file."""
        parts: list[bytes] = []
        try:
            while length > 0:
                os.lseek(self._fd, offset, os.SEEK_SET)
                part = os.read(self._fd, length)
                if not part:
                    break
                parts.append(part)
                offset, length = offset + len(part), length - len(part)
        except OSError as error:
            raise LogError(self.path, f"cannot be read at byte {offset} ({error.strerror})") from error
        return b"".join(parts)

    def refresh(self) -> None:
        """Look how long the file is now."""
        self.size = os.fstat(self._fd).st_size

    def body(self, record: Record) -> bytes:
        """The record without its opcode and length."""
        body = self.at(record.start + _HEAD.size, record.end - record.start - _HEAD.size)
        if len(body) != record.end - record.start - _HEAD.size:
            raise LogError(self.path, "became shorter while it was read", "Wait until nothing writes to it.")
        return body

    def close(self) -> None:
        os.close(self._fd)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()


class Scan:
    """The records of the data section, in order, with the gaps between them.

    After the walk ``ended`` tells whether the file has its end-of-data record, ``gaps`` what could not be read. The
    caller adds, through `damaged`, the records whose content turns out to be unsound.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.gaps: list[Gap] = []
        self.ended = False
        self._may_expand = EXPANSION[0] + EXPANSION[1] * source.size

    def records(self) -> Iterator[Record]:
        offset, size = len(MAGIC), self.source.size
        while offset < size and len(self.gaps) < MAX_GAPS:
            try:
                record = self.record_at(offset)
            except Damaged as why:
                found = self.next_landmark(offset + 1)
                self._gap(offset, found, str(why))
                offset = found
                continue
            offset = record.end
            if record.opcode == Opcode.DATA_END:
                self.ended = True
                self._check_data_crc(record)
                return
            if record.opcode == Opcode.MESSAGE:
                self.damaged(record, "a message outside a chunk has no checksum")
                continue
            yield record
        if offset < size:
            self._gap(offset, size, f"reading stopped after {MAX_GAPS} damaged places")
        elif not (self.gaps and self.gaps[-1].end == size):
            self._gap(size, size, "the file ends here without its end record")

    def damaged(self, record: Record, reason: str) -> None:
        """Note that the content of ``record`` cannot be used."""
        self._gap(record.start, record.end, reason)

    def chunk(self, record: Record) -> bytes:
        """The checked content of a chunk. Raises `Damaged`."""
        size = _CHUNK_HEAD.unpack(self.source.at(record.start + _HEAD.size, _CHUNK_HEAD.size))[2]
        if size > MAX_CHUNK:
            raise Damaged(f"a chunk of {size} bytes; at most {MAX_CHUNK} are read")
        if size > self._may_expand:
            raise Damaged("a chunk beyond what a log of this size can hold")
        self._may_expand -= size
        return chunk_content(self.source, record)

    def attachment(self, record: Record) -> tuple[str, str, bytes]:
        """Name, media type and content of an attachment, checked. Raises `Damaged`."""
        body = self.source.body(record)
        if zlib.crc32(memoryview(body)[:-4]) != _U32.unpack_from(body, len(body) - 4)[0]:
            raise Damaged("an attachment whose checksum does not match")
        name, at = _text(body, 16)
        media_type, at = _text(body, at)
        return name, media_type, body[at + 8 : -4]

    def metadata(self, record: Record) -> tuple[str, dict[str, str]]:
        """Name and content of a metadata record; it has no checksum of its own. Raises `Damaged`."""
        body = self.source.body(record)
        name, at = _text(body, 0)
        table = _table(body, at)
        return name, table

    def record_at(self, offset: int) -> Record:
        """The record at ``offset`` if it has the right shape. Raises `Damaged`."""
        look = self.source.at(offset, _LOOK)
        if len(look) < _HEAD.size:
            raise Damaged("the file ends in the middle of a record")
        opcode, length = _HEAD.unpack_from(look)
        if opcode not in _IN_DATA:
            raise Damaged(f"no record begins here (0x{opcode:02x})")
        end = offset + _HEAD.size + length
        if length > MAX_RECORD or not _shape(opcode, length, look[_HEAD.size :]):
            raise Damaged(f"a record (0x{opcode:02x}) with impossible lengths")
        if end > self.source.size:
            raise Damaged("the file ends in the middle of a record")
        record = Record(opcode, offset, end)
        if opcode == Opcode.ATTACHMENT and not self._attachment_shape(record):
            raise Damaged("an attachment with impossible lengths")
        return record

    def _attachment_shape(self, record: Record) -> bool:
        look = self.source.at(record.start + _HEAD.size, 16 + 4 + _LOOK + 4 + _LOOK + 8)
        try:
            _, at = _span(look, 16)
            _, at = _span(look, at)
            return at + 8 + _U64.unpack_from(look, at)[0] + 4 == record.end - record.start - _HEAD.size  # type: ignore[no-any-return]
        except (Damaged, struct.error):
            return False

    def next_landmark(self, offset: int) -> int:
        """Where the next sound record begins at or behind ``offset``; the file's size if there is none."""
        while offset < self.source.size:
            window = self.source.at(offset, _WINDOW + _HEAD.size - 1)
            for match in _LANDMARK.finditer(window):
                at = offset + match.start()
                try:
                    self.record_at(at)
                except Damaged:
                    continue
                return at
            offset += _WINDOW
        return self.source.size

    def _gap(self, start: int, end: int, reason: str) -> None:
        if self.gaps and self.gaps[-1].end == start and self.gaps[-1].reason == reason:
            start = self.gaps.pop().start
        self.gaps.append(Gap(start, end, reason))

    def _check_data_crc(self, end: Record) -> None:
        if self.gaps:
            return
        crc, offset = 0, 0
        while offset < end.start:
            block = self.source.at(offset, min(_WINDOW, end.start - offset))
            crc, offset = zlib.crc32(block, crc), offset + len(block)
        if crc != _U32.unpack(self.source.body(end))[0]:
            self._gap(
                0,
                end.start,
                "the checksum over all data does not match, though every chunk and attachment read is sound: "
                "a header, a metadata record or an index is damaged",
            )


def chunk_content(source: Source, record: Record, most: int = MAX_CHUNK) -> bytes:
    """The content of a chunk of at most ``most`` bytes, with its checksum checked. Raises `Damaged`."""
    body = source.body(record)
    _, _, size, crc, name_length = _CHUNK_HEAD.unpack_from(body)
    if size > most:
        raise Damaged(f"a chunk of {size} bytes; at most {most} are read")
    compression = body[_CHUNK_HEAD.size : _CHUNK_HEAD.size + name_length]
    data = memoryview(body)[_CHUNK_HEAD.size + name_length + 8 :]
    if compression == b"zstd":
        try:
            content = _decompressor().stream_reader(data).read(min(size, MAX_CHUNK) + 1)
        except (zstandard.ZstdError, MemoryError):
            raise Damaged("a chunk that cannot be decompressed") from None
    elif compression == b"":
        content = bytes(data)
    else:
        raise Damaged(f"a chunk with unknown compression {compression!r}")
    if len(content) != size or zlib.crc32(content) != crc:
        raise Damaged("a chunk whose checksum does not match")
    return content


@cache
def _decompressor() -> zstandard.ZstdDecompressor:
    return zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK)


def messages(content: bytes, channels: dict[int, ChannelInfo]) -> Messages:
    """The messages of a chunk's content; channels described in it are added to ``channels``.

    Raises `Damaged` when the content is not a sequence of schemas, channels and messages on described channels.
    """
    starts = array("q")
    schemas: dict[int, tuple[str, bytes]] = {}
    described: set[int] = set()
    offset, size = 0, len(content)
    append, unpack = starts.append, _HEAD.unpack_from
    try:
        while offset < size:  # only this loop runs once a message
            opcode, length = unpack(content, offset)
            if opcode == 5:  # Opcode.MESSAGE
                append(offset)
            else:
                body = content[offset + 9 : offset + 9 + length]
                if len(body) < length:
                    break
                _describe(opcode, body, schemas, channels, described)
            offset += 9 + length
    except struct.error:
        offset = -1
    if offset != size or (starts and starts[-1] + _MESSAGE.itemsize > size):
        raise Damaged("a chunk that ends in the middle of a record")
    start = np.frombuffer(starts, dtype=np.int64)
    head = rows(content, start, _MESSAGE.itemsize).view(_MESSAGE)
    if not ((head["length"] >= 22) & (head["length"] <= MAX_MESSAGE + 22)).all():
        raise Damaged("a chunk with a message of impossible length")
    end = start + 9 + head["length"].astype(np.int64)
    found = Messages(head["channel"], head["sequence"], head["log"], head["publish"], start + _MESSAGE.itemsize, end)
    if not set(np.unique(found.channel).tolist()) <= channels.keys():
        raise Damaged("a chunk with messages of a channel that is nowhere described")
    return found


def rows(content: bytes, start: NDArray[np.int64], size: int) -> NDArray[np.void]:
    """``size`` bytes of ``content`` from each of the offsets ``start``, which must leave room for them."""
    if not len(start):
        return np.empty(0, dtype=f"V{size}")
    return np.ndarray((len(content) - size + 1,), dtype=f"V{size}", buffer=content, strides=(1,))[start]


def _describe(
    opcode: int,
    body: bytes,
    schemas: dict[int, tuple[str, bytes]],
    channels: dict[int, ChannelInfo],
    described: set[int],
) -> None:
    """Take in a schema or a channel of a chunk."""
    short = len(body) <= SHORT
    if opcode == Opcode.SCHEMA:
        number, name, data = _known_schema(body) if short else _schema(body)
        schemas[number] = name, data
    elif opcode == Opcode.CHANNEL:
        number, schema_number, topic, encoding = _known_channel(body) if short else _channel(body)
        if schema_number not in schemas:
            raise Damaged("a chunk with a channel without schema")
        channel = ChannelInfo(topic, encoding, *schemas[schema_number])
        if number in described and channel != channels[number]:
            raise Damaged("a chunk that describes a channel in two ways")
        described.add(number)
        channels[number] = channel
        if len(channels) > MAX_CHANNELS:
            raise Damaged(f"more than {MAX_CHANNELS} channels")
    else:
        raise Damaged("a chunk with a record that does not belong there")


def _shape(opcode: int, length: int, look: bytes) -> bool:
    """Whether the lengths inside a record agree with its own, as far as its first bytes tell."""
    try:
        match opcode:
            case Opcode.CHUNK:
                name_length = _CHUNK_HEAD.unpack_from(look)[4]
                if name_length > 16:
                    return False
                at = _CHUNK_HEAD.size + name_length
                return bool(_U64.unpack_from(look, at)[0] == length - at - 8)
            case Opcode.METADATA:
                _, at = _span(look, 0)
                return bool(_U32.unpack_from(look, at)[0] == length - at - 4)
            case Opcode.MESSAGE_INDEX:
                entries = _U32.unpack_from(look, 2)[0]
                return bool(entries == length - 6 and entries % 16 == 0)
            case Opcode.DATA_END:
                return length == 4
            case Opcode.MESSAGE:
                return length >= 22
            case Opcode.ATTACHMENT:
                return length >= 36
            case Opcode.HEADER:
                _, at = _span(look, 0)
                return bool(_U32.unpack_from(look, at)[0] == length - at - 4)
            case Opcode.SCHEMA | Opcode.CHANNEL:
                _, at = _span(look, 2 if opcode == Opcode.SCHEMA else 4)
                _, at = _span(look, at)
                return bool(_U32.unpack_from(look, at)[0] == length - at - 4)
    except (Damaged, struct.error):
        pass
    return False


def _schema(body: bytes) -> tuple[int, str, bytes]:
    try:
        number = _U16.unpack_from(body)[0]
        name, at = _text(body, 2)
        _, at = _text(body, at)
        length = _U32.unpack_from(body, at)[0]
    except struct.error:
        raise Damaged("a schema that ends too early") from None
    if at + 4 + length != len(body):
        raise Damaged("a schema with impossible lengths")
    return number, name, body[at + 4 :]


def _channel(body: bytes) -> tuple[int, int, str, str]:
    try:
        number, schema_number = _U16.unpack_from(body)[0], _U16.unpack_from(body, 2)[0]
        topic, at = _text(body, 4)
        encoding, at = _text(body, at)
    except struct.error:
        raise Damaged("a channel that ends too early") from None
    _table(body, at)
    return number, schema_number, topic, encoding


_known_schema = lru_cache(maxsize=256)(_schema)
_known_channel = lru_cache(maxsize=256)(_channel)


def _table(body: bytes, at: int) -> dict[str, str]:
    if len(body) - at < 4 or _U32.unpack_from(body, at)[0] != len(body) - at - 4:
        raise Damaged("a table with impossible lengths")
    table: dict[str, str] = {}
    at += 4
    while at < len(body):
        key, at = _text(body, at)
        table[key], at = _text(body, at)
        if len(table) > MAX_TABLES:
            raise Damaged("a table with too many entries")
    return table


def _span(body: bytes, at: int) -> tuple[int, int]:
    """Start and end of the length-prefixed text at ``at``."""
    if at + 4 > len(body):
        raise Damaged("a text that ends too early")
    start = at + 4
    end = start + _U32.unpack_from(body, at)[0]
    if end > len(body):
        raise Damaged("a text of impossible length")
    return start, end


def _text(body: bytes, at: int) -> tuple[str, int]:
    start, end = _span(body, at)
    try:
        return body[start:end].decode(), end
    except UnicodeDecodeError:
        raise Damaged("a text that is not UTF-8") from None
