"""What the guard has to say at the terminal, when nobody else is left to say it."""

from __future__ import annotations

import os
import select
from contextlib import suppress

import click

STDERR = 2


class LastWords:
    """To the terminal, if there still is one. One that takes nothing (stopped by Ctrl-S) holds nobody up."""

    def __init__(self) -> None:
        self._unsaid = b""

    def say(self, text: str) -> None:
        """Say it as far as it can be said at once; `speak` says the rest."""
        if os.name == "posix":
            self._unsaid += f"{text}\n".encode()
            self.speak()
        else:  # there is no way to ask a console whether it would take it
            with suppress(OSError, ValueError):
                click.echo(text, err=True)

    def speak(self) -> bool:
        """Whether everything is said. Byte by byte: the room for one is all that a terminal promises."""
        try:
            while self._unsaid and select.select([], [STDERR], [], 0)[1]:
                os.write(STDERR, self._unsaid[:1])
                self._unsaid = self._unsaid[1:]
        except (OSError, ValueError):  # nobody is there to hear it
            self._unsaid = b""
        return not self._unsaid
