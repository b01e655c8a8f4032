"""Settings that a run changes in the stage, and that the stage gets back whatever ends the run.

The driver gives them back when the run ends. A run that is killed cannot, so what was found is kept in a file of the
user's own directory until the stage has confirmed that it has everything back; the next run with this stage reads it,
compares it with what the stage has now, and gives back at its end what the killed one had found.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from drivers.links.own_directory import remove_if_empty, user_directory
from drivers.roles import GivesBack
from rig.base.errors import ConfigError
from rig.base.outputs import write_text
from rig.bench.bench import Bench
from rig.log.recorder import Recorder

GIVE_BACK_S = 1.0  # how long the stage may take to confirm that it has its settings back
LARGEST = 4096  # bytes of such a file


class Lent:
    """What one run has of the stage."""

    def __init__(self, bench: Bench, recorder: Recorder) -> None:
        self._bench = bench
        self._recorder = recorder
        self._path: Path | None = None

    def begin(self) -> None:
        """After set-up, before anything is changed: look what a killed run has left, and keep what there is."""
        stage = self._bench.stage
        if not isinstance(stage, GivesBack) or not self._bench.scene.stage.connected:
            return
        try:
            who = stage.identity
            self._path = user_directory() / f"stage-{_plain(who.model)}-{_plain(who.serial)}.json"
            left = stage.resume_found(_read(self._path))
            if left:
                now_found = ", ".join(f"{key} {value}" for key, value in stage.found.items())
                self._recorder.command("stage", "resume_found", now_found)
                what = ", ".join(f"{key} {now}, before {before}" for key, (now, before) in left.items())
                self._warn(f"an earlier run was killed and left changed: {what}; given back after this one")
            write_text(self._path, json.dumps(dict(stage.found)) + "\n")
        except (OSError, ConfigError) as error:
            self._path = None
            self._warn(f"what this run changes is not kept in a file, should it be killed ({error})")

    def end(self, standing: bool) -> None:
        """Give everything back, and wait a little for the stage's word that it has it. Never raises."""
        stage = self._bench.devices.get("stage")
        if not isinstance(stage, GivesBack) or not standing:
            return
        if not stage.given_back:
            self._recorder.command("stage", "give_back", "")
            wait_given_back("stage", stage.give_back, lambda: stage.given_back, self._bench, self._recorder)
        if not stage.given_back:  # the driver's close tries once more, without waiting
            self._warn("it has not confirmed that its settings are as they were found")
        elif self._path is not None:
            with suppress(OSError):
                self._path.unlink(missing_ok=True)
                remove_if_empty(self._path.parent)

    def _warn(self, what: str) -> None:
        self._recorder.event("warning", "stage", what)


def wait_given_back(
    role: str, give_back: Callable[[], None], done: Callable[[], bool], bench: Bench, recorder: Recorder
) -> None:
    """Ask a device for it and poll it until it is ``done``, but not long. Never raises."""
    clock = bench.clock
    end = clock.now() + GIVE_BACK_S
    with suppress(Exception):
        give_back()
        while clock.now() < end:
            for sample in bench.poll(role, clock.now()):
                recorder.add(sample)
            if done():
                clock.sleep_until(clock.now())  # where a run is led through its turns, this one ends here
                return
            clock.sleep_until(max(clock.now() + 1e-3, min(bench.devices[role].next_poll, end)))


def _plain(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "-", text).strip("-") or "any"


def _read(path: Path) -> dict[str, float]:
    """What a run kept there; nothing where there is no file, or one that no run has written."""
    try:
        with path.open("rb") as file:
            found = json.loads(file.read(LARGEST))
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(found, dict):
        return {}
    return {key: value for key, value in found.items() if type(value) is int}
