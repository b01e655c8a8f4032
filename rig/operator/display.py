"""What a run shows while it goes on: a bar with the time left on a terminal, a line a step elsewhere, and words.

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

from rig.base.clock import RealClock

MOST_LINES = 100  # that may wait to be shown
LAST_S = 0.5  # at the end, for what is left to be shown
BAR = 24  # characters


class Display:
    """A context; `update` and `say` return at once.

    Parameters
    ----------
    first : str
        The first line of all.
    """

    def __init__(self, first: str) -> None:
        self._clock = RealClock()
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

    def update(self, done: float, total: float, label: str) -> None:
        """How far the run has come, in seconds of its plan."""
        part = min(max(done / total, 0.0), 1.0) if total > 0 else 0.0
        left = f"{self._clock.now() * (1 - part) / part:4.0f} s left" if part > 0.01 else ""
        if self._on_terminal:
            filled = round(part * BAR)
            text = f"{'━' * filled}{'─' * (BAR - filled)} {100 * part:3.0f} % {left:11} {label}"
            self._bar = text[: shutil.get_terminal_size().columns - 1]
            self._wake.set()
        elif label != self._label:
            self._label = label
            self.say(f"  {100 * part:3.0f} %  {left:11}  {label}")

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
