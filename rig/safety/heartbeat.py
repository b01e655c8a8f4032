"""The engine's sign of life: what its loop tells the guard once a turn, and nothing else ever sends.

A timer thread or a periodic CAN task would go on while the loop hangs, so there is none. Each sign carries a counter,
which a repeater cannot get right, a checksum, and the times of the newest samples that the loop has found good: a loop
that turns without fresh data is no better than one that hangs.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field

INTERVAL_S = 0.02  # the engine sends one at most this often
# The guard takes the output off when it has had none for this long. A hung engine is then answered within 200 ms, and
# a loop that a loaded computer holds up for 0.1 s is not mistaken for one.
DEADLINE_S = 0.15
# The engine judges the age of its data itself; the guard, which sees them later, allows this much more.
MARGIN_S = 0.25

ROLES = ("stage", "force", "displacement")
_FORM = struct.Struct("<Q2d3d")  # counter, time of sending, displacement, newest sample of each role
_CHECK = struct.Struct("<I")


@dataclass(frozen=True)
class Heartbeat:
    """One sign of life.

    ``counter`` rises by one each time. ``t`` is the clock time of sending, ``samples`` the clock time of the newest
    good sample by role, ``displacement`` the newest measured displacement of the disk in metres (NaN before contact).
    """

    counter: int
    t: float
    displacement: float = math.nan
    samples: Mapping[str, float] = field(default_factory=dict)

    def encode(self) -> bytes:
        """Little-endian counter (8 bytes), five doubles, CRC-32."""
        times = (self.samples.get(role, math.nan) for role in ROLES)
        body = _FORM.pack(self.counter, self.t, self.displacement, *times)
        return body + _CHECK.pack(zlib.crc32(body))

    @classmethod
    def decode(cls, data: bytes) -> Heartbeat:
        """The sign of life in ``data``.

        Raises
        ------
        ValueError
            Wrong length or checksum.
        """
        if len(data) != _FORM.size + _CHECK.size:
            raise ValueError(f"{len(data)} bytes are no heartbeat")
        body = data[: _FORM.size]
        if _CHECK.unpack(data[_FORM.size :])[0] != zlib.crc32(body):
            raise ValueError("its checksum is wrong")
        counter, t, displacement, *times = _FORM.unpack(body)
        return cls(counter, t, displacement, dict(zip(ROLES, times, strict=True)))
