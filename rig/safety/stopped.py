"""Whether another process of ours stands still: stopped by a signal, not held up by a busy computer.

A process that is only short of processor time keeps the state "running" or "sleeping" and is given its time. One that
was stopped does nothing more until somebody continues it: there is nothing to wait for. Linux says so under ``/proc``;
elsewhere nothing is known, and the silence of the process tells.
"""

from __future__ import annotations

import os
from contextlib import suppress

LOOK_S = 0.04  # a process that has said nothing for this long is looked at: twice what it may take to say something
STOPPED = b"T"  # not "t", a debugger's


class Peer:
    """Process ``pid``, looked at through a descriptor that is ready from the beginning: none is needed later."""

    def __init__(self, pid: int) -> None:
        self._stat: int | None = None
        with suppress(OSError):
            self._stat = os.open(f"/proc/{pid}/stat", os.O_RDONLY)

    @property
    def stopped(self) -> bool:
        """Whether it was stopped and not continued; False where that is not known."""
        if self._stat is None:
            return False
        try:
            os.lseek(self._stat, 0, os.SEEK_SET)  # makes the text anew
            line = os.read(self._stat, 1024)
        except OSError:  # it has ended, which is told otherwise
            return False
        return line.rpartition(b")")[2].split()[:1] == [STOPPED]

    def close(self) -> None:
        """Let go of the descriptor. Calling it twice does no harm."""
        stat, self._stat = self._stat, None
        if stat is not None:
            os.close(stat)
