"""Text that came from a device or a file, made safe to show."""

from __future__ import annotations

import unicodedata

LAYOUT = "\n\t"  # control characters that a text of several lines may hold
TURNING = "\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"  # the direction of writing


def printable(text: str, keep: str = "") -> str:
    """``text`` with control characters spelled out, so that it cannot drive a terminal; ``keep`` stay as they are."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else repr(c)[1:-1] for c in text)


def control_in(text: str) -> str | None:
    """The first character that drives a terminal or turns the direction of writing, as ``U+001B``; None without one."""
    if text.isprintable():
        return None
    for letter in text:
        if letter in TURNING or (letter not in LAYOUT and unicodedata.category(letter) in ("Cc", "Cs")):
            return f"U+{ord(letter):04X}"
    return None
