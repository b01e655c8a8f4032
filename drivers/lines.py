"""Bytes to lines, for the instruments that speak in lines."""

from __future__ import annotations


class LineSplitter:
    r"""Cuts what arrives into lines that end with ``end``, however it was split on its way.

    A line of more than ``longest`` bytes is dropped and counted in ``counters["too_long"]``; no more than that is ever
    kept of an unfinished one.
    """

    def __init__(self, end: bytes, longest: int, counters: dict[str, int]) -> None:
        self._end = end
        self._longest = longest
        self._counters = counters
        counters.setdefault("too_long", 0)
        self._rest = bytearray()
        self._skipping = False

    @property
    def held(self) -> int:
        """How many bytes of an unfinished line are kept."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[bytes]:
        """The lines that ``data`` completes, in order, without their end."""
        self._rest += data
        *complete, rest = self._rest.split(self._end)
        lines: list[bytes] = []
        for line in complete:
            if self._skipping:
                self._skipping = False
            elif len(line) > self._longest:
                self._counters["too_long"] += 1
            else:
                lines.append(bytes(line))
        if len(rest) > self._longest:
            self._counters["too_long"] += not self._skipping
            self._skipping = True
            rest = bytearray()
        self._rest = rest
        return lines
