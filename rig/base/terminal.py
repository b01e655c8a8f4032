"""Words to a terminal or pipe that may take nothing: nobody waits for it longer than stated.

A terminal that has been stopped (Ctrl-S), or a pipe that nobody reads, blocks an ordinary ``print`` for ever.
"""

from __future__ import annotations

import os
import select
import stat
import sys
from contextlib import suppress
from typing import Literal

import click

from rig.base.clock import RealClock

AT_ONCE = 512  # bytes that a pipe takes whole once it says that it is ready (POSIX: PIPE_BUF)
LAST_WORD_S = 1.0


def write_within(fd: int, data: bytes, seconds: float) -> int:
    """Write to a descriptor for at most so long; returns how many bytes were taken. POSIX only.

    A terminal promises room for one byte only, so it gets them one by one.

    Raises
    ------
    OSError
        Nobody is there any more.
    """
    step = AT_ONCE if stat.S_ISFIFO(os.fstat(fd).st_mode) else 1
    if stat.S_ISREG(os.fstat(fd).st_mode):
        step = len(data) or 1
    clock, sent = RealClock(), 0
    while sent < len(data):
        left = max(seconds - clock.now(), 0.0)
        if not select.select([], [fd], [], left)[1]:
            break
        sent += os.write(fd, data[sent : sent + step])
    return sent


def tell(text: str, to: Literal["stdout", "stderr"] = "stderr", *, colour: str = "") -> None:
    """A line to the operator, given up after `LAST_WORD_S`."""
    stream = getattr(sys, to)
    try:
        fd = stream.fileno()
    except (OSError, ValueError, AttributeError):  # a test's, or closed
        fd = -1
    if fd < 0 or os.name != "posix":
        with suppress(OSError, ValueError):
            click.secho(text, file=stream, fg=colour or None)
        return
    if colour and stream.isatty():
        text = click.style(text, fg=colour)
    with suppress(OSError, ValueError):
        write_within(fd, f"{text}\n".encode(errors="replace"), LAST_WORD_S)
