"""What a producer and the process that writes the log say to each other over a stream socket.

A frame is CRC-32 of the rest (4 bytes, little-endian), length of the body (4), kind (1), body. Bodies are plain bytes
or JSON; nothing in them can run. The messages of a turn travel in one frame.
"""

from __future__ import annotations

import struct
import zlib

_HEAD = struct.Struct("<IIB")
MOST = 48 * 1024 * 1024  # of a body; the largest is an attachment

# From a producer:
MESSAGES, ATTACHMENT, METADATA, FINISH = range(1, 5)
# From the writer:
READY, ALIVE, DONE, FAILED = range(5, 9)

# Before each message in MESSAGES: index of the topic in rig.log.schema.CHANNELS, log time, publish time, length.
MESSAGE_HEAD = struct.Struct("<BQQI")
# In ALIVE: bytes free on the disk (-1: not known), and for how long the writer has been busy with one turn (s).
STATE = struct.Struct("<qd")


def pack(kind: int, body: bytes) -> bytes:
    """One frame."""
    return _HEAD.pack(zlib.crc32(body, kind), len(body), kind) + body


class Unpacker:
    """Cuts a stream into frames; ``problem`` says what stands in it that is none, behind which nothing is read."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.problem = ""

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Kind and body of the frames that are complete with ``data``.

        Raises
        ------
        ValueError
            What comes next is not a frame; nothing after it can be understood.
        """
        self._buffer += data
        found = []
        at, size = 0, len(self._buffer)
        while not self.problem and size - at >= _HEAD.size:
            crc, length, kind = _HEAD.unpack_from(self._buffer, at)
            if length > MOST:
                self.problem = f"a frame of {length} bytes"
            elif size - at - _HEAD.size < length:
                break
            else:
                at += _HEAD.size
                body = bytes(self._buffer[at : at + length])
                at += length
                if zlib.crc32(body, kind) == crc:
                    found.append((kind, body))
                else:
                    self.problem = "a frame whose checksum does not match"
        if self.problem and not found:
            raise ValueError(self.problem)
        del self._buffer[:at]
        return found
