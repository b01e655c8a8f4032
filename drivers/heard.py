"""What came on a wire and answered nothing, in words: for the message that says that there was no answer.

Wrong baud rate, another instrument on that port, a display in other units: each leaves traces, and who sees them finds
the cause.
"""

from __future__ import annotations

import re
from collections import Counter

from drivers.links.link import CanFrame

KEPT = 64  # bytes that are kept, the newest
SHOWN = 32  # of them in a message
IDENTIFIERS = 6  # in a message

_LOOKS = (
    (rb"[@!#][0-9]{2} [0-9] ", "a Zaber stage"),
    (rb"M[0-2],[+-][0-9]+[\r,]", "a Keyence whose display has no decimal point (set one in the controller)"),
    (rb"(?:M[0-2],[+-XF]|ER,[A-Z0-9]{2},)", "a Keyence LK-G"),
    (rb"t[0-7][0-9A-Fa-f]{2}[0-8](?:[0-9A-Fa-f]{2})*\r", "a CAN adapter (slcan)"),
    (rb"V[0-9A-F]{4}\r|[ -~]*github[ -~]*\r", "a CAN adapter (slcan)"),
    (rb"(?:slave|master) [0-9]+\r", "an shvps supply"),
    (rb"\$(?:GP|GN|GL)[A-Z]{3},", "a satellite receiver"),
    (rb"\xaa[\x11-\x1f\x50-\x5f\xa0-\xbf].{2,72}?\x85", "a GSV amplifier"),
    (rb"AT[A-Z+&0-9]*\r", "somebody who looks for a modem (ModemManager does so with new ports)"),
    (rb"(?:[+-]?[0-9]+(?:\.[0-9]+)?[,;\t ]?)+\r?\n", "a sensor that sends numbers by itself (ascii-stream)"),
)
LOOKS = tuple((re.compile(pattern, re.DOTALL), words) for pattern, words in _LOOKS)
"""What stands somewhere in bytes of others, and who sends it."""


class Heard:
    """Bytes or frames since the last answer. ``hint`` is what a driver thinks of something that it dropped."""

    def __init__(self) -> None:
        self.hint = ""
        self._data = bytearray()
        self._came = 0
        self._frames: Counter[int] = Counter()
        self._last: dict[int, bytes] = {}

    def bytes(self, data: bytes) -> bytes:
        """Note what a port gave, and give it on."""
        if data:
            self._came += len(data)
            self._data += data
            del self._data[:-KEPT]
        return data

    def frames(self, frames: list[CanFrame]) -> list[CanFrame]:
        """Note what a bus gave, and give it on."""
        for frame in frames:
            self._frames[frame.id] += 1
            self._last[frame.id] = frame.data
        return frames

    def clear(self) -> None:
        """Something was answered: what came before says nothing any more."""
        if self._came:
            self._data.clear()
            self._came = 0
        if self._frames:
            self._frames.clear()
            self._last.clear()
        self.hint = ""

    def __str__(self) -> str:
        """To be appended to "no answer"; nothing if nothing came."""
        if self._frames:
            return _frames_in_words(self._frames, self._last)
        if not self._came:
            return ""
        shown = bytes(self._data[-SHOWN:])
        text = "".join(chr(byte) if 0x20 <= byte < 0x7F else "." for byte in shown)
        more = "... " if self._came > len(shown) else ""
        looks = self.hint or looks_like(bytes(self._data))
        came = f"{self._came} byte{'s' * (self._came != 1)} came"
        return f", but {came} that answer nothing: {more}{shown.hex(' ')} ({more}{text}), as of {looks}"


def looks_like(data: bytes) -> str:
    """Who may have sent bytes that are no answer, in words."""
    for pattern, words in LOOKS:
        if pattern.search(data):
            return words
    plain = sum(0x20 <= byte < 0x7F or byte in b"\r\n\t" for byte in data)
    if plain > 0.9 * len(data):
        return "text of another instrument"
    return "another baud rate, or another instrument"


def _frames_in_words(counts: Counter[int], last: dict[int, bytes]) -> str:
    named = [
        f"{identifier:03X} {last[identifier].hex(' ') or '(empty)'}{_sender(identifier, last[identifier])}"
        for identifier, _ in counts.most_common(IDENTIFIERS)
    ]
    more = ", ..." if len(counts) > IDENTIFIERS else ""
    return f", but {counts.total()} frames came that answer nothing: {', '.join(named)}{more}"


def _sender(identifier: int, data: bytes) -> str:
    node = identifier & 0x7F
    match identifier & 0x780:
        case 0x700 if node and len(data) == 1:
            return f" (CANopen node {node} is there)"
        case 0x580 if node and len(data) == 8:
            return f" (an answer of CANopen node {node})"
        case 0x080 if node and len(data) == 8:
            return f" (emergency message of CANopen node {node})"
    if identifier & 0x601 == 0x201 and data[:1] == b"\xd8":
        return f" (iseg module {identifier >> 3 & 0x3F} announces itself)"
    return ""
