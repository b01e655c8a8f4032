"""What a run shows while it goes on: a line of numbers on a terminal, a line a step elsewhere, and words.

Everything is written by a thread of its own, straight to the descriptor: a terminal that takes nothing holds up neither
the loop nor the end of the program. What has become old before it could be shown is dropped.
"""

from __future__ import annotations

import os
import shutil
import sys
import threading
from collections import deque
from contextlib import suppress
from typing import Self

import click

from rig.operator.status import Status, minutes

MOST_LINES = 100  # that may wait to be shown
LAST_S = 0.5  # at the end, for what is left to be shown


class Display:
    """A context; `show` and `say` return at once.

    Parameters
    ----------
    first : str
        The first line of all.
    bench : str
        On what kind of bench, in front of the numbers: SIMULATED or REAL PORTS.
    """

    def __init__(self, first: str, bench: str = "") -> None:
        self._bench = bench
        self._lines: deque[str] = deque([first], maxlen=MOST_LINES)
        self._bar = self._shown_bar = ""
        self._label = ""
        self._ending = False
        self._wake = threading.Event()
        try:
            self._fd = sys.stderr.fileno()
            self._on_terminal = os.isatty(self._fd)
        except (OSError, ValueError, AttributeError):  # a test's, or closed
            self._fd, self._on_terminal = -1, False
        self._thread = threading.Thread(target=self._run, name="display", daemon=True)

    def show(self, status: Status) -> None:
        """Where the run stands."""
        if self._on_terminal:
            self._bar = status.line(shutil.get_terminal_size().columns - 1, self._bench)
            self._wake.set()
        elif status.label != self._label:
            self._label = status.label
            numbers = f" ({status.numbers})" if status.numbers else ""
            self.say(f"  {100 * status.done:3.0f} %, {minutes(status.left)} left  {status.label}{numbers}")

    def say(self, text: str) -> None:
        """Show a line."""
        self._lines.append(text)
        self._wake.set()

    def _run(self) -> None:
        try:
            while True:
                self._wake.wait()
                self._wake.clear()
                while self._lines:
                    self._write(("\r\x1b[K" if self._shown_bar else "") + self._lines.popleft() + "\n")
                    self._shown_bar = ""
                if self._on_terminal and self._bar != self._shown_bar:
                    self._shown_bar = self._bar
                    self._write(f"\r{self._bar}\x1b[K")
                if self._ending and not self._lines:
                    if self._shown_bar:
                        self._write("\r\x1b[K")
                    return
        except (OSError, ValueError):  # the terminal is gone
            return

    def _write(self, text: str) -> None:
        if self._fd < 0:
            click.echo(text, nl=False, err=True)
            return
        data = text.encode(errors="replace")
        while data:
            data = data[os.write(self._fd, data) :]

    def __enter__(self) -> Self:
        self._thread.start()
        self._wake.set()
        return self

    def __exit__(self, *error: object) -> None:
        self._ending = True
        self._wake.set()
        with suppress(RuntimeError):
            self._thread.join(LAST_S)
