"""Text that came from a device or a file, made safe to show."""

from __future__ import annotations


def printable(text: str) -> str:
    """``text`` with control characters spelled out, so that it cannot drive a terminal."""
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)
