"""What the operator wants of a run while it goes on: to stop it, pause it, let it continue, or answer a question.

Wishes come from signals (`rig.operator.signals`), from the keyboard of the run's own terminal, and from other
terminals of the
same user (`rig.operator.remote`). They are only noted down here; the engine's loop looks once a turn and never waits
for input.
"""

from __future__ import annotations

import math
import os
import select
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from rig.operator.signals import StopRequest

LOOK_S = 0.05  # how often keyboard and remote wishes are looked for
STOP, PAUSE, CONTINUE = ("stop", "s", "q"), ("pause", "p"), ("continue", "c")
HELP = "Type p to pause, c to continue, s to stop (and Enter); Ctrl-C stops too."


@dataclass(frozen=True)
class Question:
    """What the operator is asked.

    ``expected`` is what has to be typed, letter by letter; empty: anything will do. ``hint`` says what may be typed.
    ``number`` says which of how many it is ("3 of 34").
    """

    text: str
    expected: str = ""
    hint: str = ""
    number: str = ""

    @property
    def shown(self) -> str:
        """The text with its number in front."""
        return f"{self.number}: {self.text}" if self.number else self.text


@dataclass(frozen=True)
class Answer:
    """What was answered, and by whom or what."""

    text: str
    source: str

    def __str__(self) -> str:
        return f"{self.text!r}, by {self.source}"


class Source(Protocol):
    """Where wishes come from. Reading never waits and never raises."""

    name: str

    def read(self, control: Control) -> Sequence[str]:
        """The lines that have arrived since the last time."""
        ...

    def close(self) -> None: ...


class Control(StopRequest):
    """The operator's wishes for one run.

    Parameters
    ----------
    sources : sequence of Source
        Looked at by `poll`.
    unattended : str
        When nobody is there to be asked: why every question may be answered as expected, for the log ("--yes on the
        command line"). Empty when somebody is.
    say : callable
        Shows one line to the operator; returns at once (`rig.operator.display.Display.say`).

    Attributes
    ----------
    pausing : str
        Who asked for a pause; empty while none is wanted.
    question : Question or None
        What the operator is being asked.
    answer : Answer or None
        The answer to it, once given.
    doing : str
        What the run is doing, for whoever asks from another terminal.
    left : float
        Seconds that it still takes, by the plan; NaN while that is not known.
    measured : mapping of str to float
        What is measured now, the unit in the name, with the time ``t_s``; for where the log does not keep all of it.
    """

    def __init__(
        self,
        sources: Sequence[Source] = (),
        unattended: str = "",
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        super().__init__()
        self.unattended = unattended
        self.pausing = ""
        self.question: Question | None = None
        self.answer: Answer | None = None
        self.doing = ""
        self.left = math.nan
        self.measured: Mapping[str, float] = {}
        self._sources = tuple(sources)
        self._say = say
        self._next_look = 0.0

    def ask_pause(self, source: str) -> None:
        """Ask for a pause; while one lasts this changes nothing."""
        self.pausing = self.pausing or source

    def say(self, text: str) -> None:
        """Show a line to the operator; a terminal that is gone is no reason to end a run."""
        try:
            self._say(text)
        except Exception:
            self._say = lambda text: None

    def put(self, question: Question) -> None:
        """Put a question. When nobody is there it is answered as expected at once."""
        self.question, self.answer = question, None
        if self.unattended:
            self.answer = Answer(question.expected or "yes", self.unattended)
            return
        wanted = question.hint or (
            f"type {question.expected}" if question.expected else "press Enter, or type a remark for the log"
        )
        self.say(f"{question.shown}\n  -> {wanted}; or s to stop. From another terminal: dea-rig continue")

    def withdraw(self) -> None:
        """The question is no longer asked."""
        self.question = self.answer = None

    def poll(self, now: float) -> None:
        """Look for what the operator wants, at most every `LOOK_S` seconds of the bench's clock."""
        if now < self._next_look:
            return
        self._next_look = now + LOOK_S
        for source in self._sources:
            for line in source.read(self):
                self.say(self.take(line, source.name))

    def take(self, line: str, source: str) -> str:
        """Note down one line of the operator's; returns what he is told.

        A word of command is obeyed always; while a question is open any other line is its answer.
        """
        text = line.strip()
        word = text.lower()
        if word in STOP:
            self.ask(source)
            return "Stopping: the voltage goes off, the stage stands." if self.count == 1 else "Hastened: off at once."
        if word in PAUSE:
            if self.pausing:
                return "The run is paused already."
            self.ask_pause(source)
            return "Pausing: the stage stops, the voltage ramps to zero."
        if self.question is not None and self.answer is None:  # the loop takes the answer at its next turn
            if self.question.expected and not _is_expected(text, self.question.expected):
                return f"That is not what is asked for: type {self.question.expected}, or s to stop."
            self.answer = Answer(text, source)
            return "Answered."
        if word in CONTINUE:
            if not self.pausing:
                return "The run is going on; there is nothing to continue."
            self.pausing = ""
            return "Continuing."
        return HELP

    def describe(self) -> dict[str, str]:
        """The state of the run for another terminal."""
        question = self.question if self.answer is None else None
        state = "ending" if self.count else "asking" if question else "paused" if self.pausing else "running"
        return {
            "state": state,
            "doing": self.doing,
            "question": question.shown if question is not None else "",
            "expected": question.expected if question is not None else "",
            "left_s": f"{self.left:.1f}" if math.isfinite(self.left) else "",
            **{name: repr(value) for name, value in self.measured.items() if math.isfinite(value)},
        }

    def close(self) -> None:
        """Close every source."""
        for source in self._sources:
            source.close()


def _is_expected(text: str, expected: str) -> bool:
    """Whether that was typed, letter by letter; a voltage may have its unit behind it ("800 V" for "800")."""
    if text == expected:
        return True
    number = text.removesuffix("V").removesuffix("v").rstrip()
    return expected.replace(".", "", 1).isdigit() and number == expected


class Keyboard:
    """Whole lines from the terminal that the run was started in. The terminal's settings stay as they are."""

    name = "the keyboard"

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._open = True
        self._rest = b""

    @classmethod
    def here(cls) -> Keyboard | None:
        """The keyboard of this process's terminal; None when there is none, or the system has no `select` for it."""
        try:
            fd = sys.stdin.fileno()
            return cls(fd) if os.name == "posix" and os.isatty(fd) else None
        except (OSError, ValueError, AttributeError):
            return None

    def read(self, control: Control) -> list[str]:
        try:
            # In the background the keys belong to the shell, and reading them would stop this process.
            if not self._open or os.tcgetpgrp(self._fd) != os.getpgrp():
                return []
            if not select.select([self._fd], [], [], 0)[0]:
                return []
            data = os.read(self._fd, 4096)
        except OSError:  # not our terminal any more, or not now
            return []
        self._open = bool(data)  # Ctrl-D, or the terminal is gone
        *lines, self._rest = (self._rest + data).split(b"\n")
        self._rest = self._rest[-4096:]
        return [line.decode(errors="replace") for line in lines]

    def close(self) -> None:
        self._open = False
