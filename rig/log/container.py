"""Writes the MCAP container (https://mcap.dev/spec): records in order into a sink, chunk by chunk.

The mcap package's own ``Writer`` describes schemas and channels only in its first chunk, so that one damaged chunk
orphans the whole file. Here every chunk opens with the descriptions of the channels that it holds; they also stand
before the first chunk that uses them and in the summary, where other readers look. Nothing of the host enters the
bytes: the same calls give the same file.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from tempfile import SpooledTemporaryFile

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"
LIBRARY = "dea-rig"
CHUNK_BYTES = 256 * 1024
INDEX_IN_MEMORY = 1024 * 1024  # bytes of the index of chunks; a longer one waits for the end in a temporary file

_MESSAGE_HEAD = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_INDEX_ENTRY = struct.Struct("<QQ")  # log time, offset in the chunk


class ContainerWriter:
    """One MCAP file as a sequence of calls to ``sink``, which must take all the bytes it is given or raise.

    ``sink`` is always given whole records, a chunk together with its message indexes.
    """

    def __init__(self, sink: Callable[[bytes], None]) -> None:
        self._sink = sink
        self._compressor = zstandard.ZstdCompressor(level=3)
        self._offset = 0
        self._crc = 0
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._described: list[bytes] = []  # per channel: its schema and channel records
        self._counts: list[int] = []
        self._sequence: list[int] = []
        self._chunk_indexes = _Spool()
        self._chunks = 0
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._first_ns: int | None = None
        self._last_ns = 0
        self._clear_chunk()
        self._put(MAGIC + _record(Header(profile="", library=LIBRARY)))

    @property
    def messages(self) -> int:
        """How many messages have been added."""
        return sum(self._counts)

    @property
    def size(self) -> int:
        """Bytes of the file so far, the index that is still to come included."""
        return self._offset + self._chunk_indexes.size

    @property
    def chunk_is_empty(self) -> bool:
        return not self._messages

    def add_channel(self, topic: str, schema_name: str, schema_data: bytes) -> int:
        """Describe a channel of protobuf messages; the number to give to `add_message`."""
        same = [schema for schema in self._schemas if (schema.name, schema.data) == (schema_name, schema_data)]
        schema = same[0] if same else Schema(len(self._schemas) + 1, schema_data, "protobuf", schema_name)
        if not same:
            self._schemas.append(schema)
        channel = Channel(len(self._channels) + 1, topic, "protobuf", {}, schema.id)
        self._channels.append(channel)
        self._counts.append(0)
        self._sequence.append(0)
        self._described.append(_record(schema) + _record(channel))
        self._put(self._described[-1])
        return channel.id

    def add_message(self, channel: int, data: bytes, log_ns: int, publish_ns: int, sequence: int | None = None) -> None:
        """Add a message to the chunk in the making; sequence numbers count from 1 in each channel unless given."""
        index = self._indexes.get(channel)
        if index is None:
            index = self._indexes[channel] = bytearray()
            self._add_to_chunk(self._described[channel - 1])
        if not self._messages:
            self._chunk_first_ns = self._chunk_last_ns = log_ns
        self._chunk_first_ns = min(self._chunk_first_ns, log_ns)
        self._chunk_last_ns = max(self._chunk_last_ns, log_ns)
        self._messages += 1
        self._counts[channel - 1] += 1
        if sequence is None:
            sequence = self._sequence[channel - 1] + 1
        self._sequence[channel - 1] = sequence
        index += _INDEX_ENTRY.pack(log_ns, self._size)
        self._add_to_chunk(
            _MESSAGE_HEAD.pack(Opcode.MESSAGE, 22 + len(data), channel, sequence, log_ns, publish_ns) + data
        )
        if self._size >= CHUNK_BYTES:
            self.end_chunk()

    def end_chunk(self) -> None:
        """Send the chunk in the making to the sink, if it holds anything."""
        if not self._messages:
            return
        content = b"".join(self._parts)
        chunk = Chunk(
            compression="zstd",
            data=self._compressor.compress(content),
            message_start_time=self._chunk_first_ns,
            message_end_time=self._chunk_last_ns,
            uncompressed_crc=zlib.crc32(content),
            uncompressed_size=len(content),
        )
        record = _record(chunk)
        indexes = b""
        offsets: dict[int, int] = {}
        for channel, entries in self._indexes.items():
            offsets[channel] = self._offset + len(record) + len(indexes)
            indexes += struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(entries), channel, len(entries)) + entries
        index = ChunkIndex(
            message_start_time=chunk.message_start_time,
            message_end_time=chunk.message_end_time,
            chunk_start_offset=self._offset,
            chunk_length=len(record),
            message_index_offsets=offsets,
            message_index_length=len(indexes),
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            uncompressed_size=chunk.uncompressed_size,
        )
        if self._first_ns is None or self._chunk_first_ns < self._first_ns:
            self._first_ns = self._chunk_first_ns
        self._last_ns = max(self._last_ns, self._chunk_last_ns)
        self._clear_chunk()
        self._put(record + indexes)
        self._chunk_indexes.add(_record(index))
        self._chunks += 1

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write a file into the log, behind what was added before it."""
        self.end_chunk()
        record = _record(Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data))
        self._attachment_indexes.append(
            AttachmentIndex(self._offset, len(record), 0, 0, len(data), name=name, media_type=media_type)
        )
        self._put(record)

    def add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Write a table of strings into the log, behind what was added before it."""
        self.end_chunk()
        record = _record(Metadata(name=name, metadata=dict(entries)))
        self._metadata_indexes.append(MetadataIndex(self._offset, len(record), name))
        self._put(record)

    def finish(self) -> None:
        """End the data with its checksum and write the summary; nothing may be added after it."""
        self.end_chunk()
        self._put(_record(DataEnd(data_section_crc=self._crc)))
        start = self._offset
        groups: list[tuple[int, Iterable[bytes]]] = [
            (Opcode.SCHEMA, map(_record, self._schemas)),
            (Opcode.CHANNEL, map(_record, self._channels)),
            (Opcode.STATISTICS, [_record(self._statistics())]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes.pieces()),
            (Opcode.ATTACHMENT_INDEX, map(_record, self._attachment_indexes)),
            (Opcode.METADATA_INDEX, map(_record, self._metadata_indexes)),
        ]
        offsets, crc, waiting = b"", 0, b""
        for opcode, records in groups:
            begun = self._offset + len(waiting)
            for data in records:
                waiting += data
                crc = zlib.crc32(data, crc)
                if len(waiting) > INDEX_IN_MEMORY:  # few writes, and little memory
                    self._put(waiting)
                    waiting = b""
            if size := self._offset + len(waiting) - begun:
                offsets += _record(SummaryOffset(opcode, begun, size))
        offsets_start = self._offset + len(waiting)
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offsets_start)
        crc = zlib.crc32(footer, zlib.crc32(offsets, crc))
        self._put(waiting + offsets + _record(Footer(start, offsets_start, crc)) + MAGIC)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts=dict(enumerate(self._counts, 1)),
            chunk_count=self._chunks,
            message_count=self.messages,
            message_end_time=self._last_ns,
            message_start_time=self._first_ns or 0,
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )

    def _clear_chunk(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0
        self._messages = 0
        self._indexes: dict[int, bytearray] = {}
        self._chunk_first_ns = self._chunk_last_ns = 0

    def _add_to_chunk(self, data: bytes) -> None:
        self._parts.append(data)
        self._size += len(data)

    def _put(self, data: bytes) -> None:
        self._sink(data)
        self._offset += len(data)
        self._crc = zlib.crc32(data, self._crc)


class _Spool:
    """Records that are wanted again at the end: what does not fit into memory waits in a temporary file."""

    def __init__(self) -> None:
        self._file = SpooledTemporaryFile(max_size=INDEX_IN_MEMORY)  # noqa: SIM115 # as long as this object
        self.size = 0
        self._size = 0
        self._rest: list[bytes] = []  # once the file takes no more

    def __del__(self) -> None:
        self._file.close()

    def add(self, data: bytes) -> None:
        """Keep ``data`` behind what was kept before; never raises."""
        self.size += len(data)
        if not self._rest:
            with suppress(OSError):
                self._file.write(data)
                self._size += len(data)
                return
        self._rest.append(data)

    def pieces(self) -> Iterator[bytes]:
        """All of it, in order."""
        with suppress(OSError):  # an index with a hole is better than a log without an end
            self._file.seek(0)
            for begin in range(0, self._size, INDEX_IN_MEMORY):
                yield self._file.read(min(INDEX_IN_MEMORY, self._size - begin))
        yield from self._rest


def _record(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
