"""Settings that a run changes in stage and sensors, and that they get back whatever ends the run.

The driver gives them back when the run ends. A run that is killed cannot, so what was found is kept in a file of the
user's own directory until the instrument has confirmed that it has everything back; the next run with it reads the
file, compares it with what the instrument has now, and gives back at its end what the killed one had found.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Protocol

from drivers.links.own_directory import remove_if_empty, user_directory
from drivers.roles import GivesBack, Identity
from rig.base.errors import ConfigError
from rig.base.outputs import write_text
from rig.bench.bench import Bench
from rig.bench.devices import ROLE
from rig.log.recorder import Recorder

GIVE_BACK_S = 1.0  # how long an instrument may take to confirm that it has its settings back
LARGEST = 4096  # bytes of such a file


class Kept(Protocol):
    """Where a run keeps what it has found, by role and instrument, should it be killed."""

    def left(self, role: str, who: Identity) -> Mapping[str, float]:
        """What a killed run has left there; empty where none has."""
        ...

    def keep(self, role: str, who: Identity, found: Mapping[str, float]) -> None:
        """Keep it. Raises OSError or `ConfigError` where that cannot be."""
        ...

    def forget(self, role: str) -> None:
        """The instrument has confirmed that it has everything back. Never raises."""
        ...


class UsersFiles:
    """In files of the user's own directory, one an instrument."""

    def __init__(self) -> None:
        self._paths: dict[str, Path] = {}

    def left(self, role: str, who: Identity) -> Mapping[str, float]:
        return _read(self._path(role, who))

    def keep(self, role: str, who: Identity, found: Mapping[str, float]) -> None:
        path = self._path(role, who)
        write_text(path, json.dumps(dict(found)) + "\n")
        self._paths[role] = path

    def forget(self, role: str) -> None:
        path = self._paths.get(role)
        if path is not None:
            with suppress(OSError):
                path.unlink(missing_ok=True)
                remove_if_empty(path.parent)

    @staticmethod
    def _path(role: str, who: Identity) -> Path:
        return user_directory() / f"{role}-{_plain(who.model)}-{_plain(who.serial)}.json"


class Lent:
    """What one run has of the instruments that the engine's loop owns; ``kept`` where, should it be killed."""

    def __init__(self, bench: Bench, recorder: Recorder, kept: Kept | None = None) -> None:
        self._bench = bench
        self._recorder = recorder
        self._kept = kept or UsersFiles()
        self._replayed = kept is not None  # then the ports of the recorded run may not be in the scene

    def begin(self) -> None:
        """After set-up, before anything moves: look what a killed run has left, and keep what there is."""
        for role, device in self._lenders().items():
            if self._replayed or self._bench.scene.instruments[role].connected:
                try:
                    self._begin(role, device)
                except (OSError, ConfigError) as error:
                    what = "what this run changes is not kept in a file, should it be killed"
                    self._recorder.event("warning", role, f"{what} ({error})")

    def _begin(self, role: str, device: GivesBack) -> None:
        if not device.found:
            return
        who = self._bench.devices[role].identity
        left = device.resume_found(self._kept.left(role, who))
        if left:
            self._recorder.command(role, "resume_found", as_argument(device.found))
            what = ", ".join(f"{key} {now}, before {before}" for key, (now, before) in left.items())
            message = f"an earlier run was killed and left changed: {what}; given back after this one"
            self._recorder.event("warning", role, message)
        self._kept.keep(role, who, device.found)

    def end(self, standing: bool) -> None:
        """Give everything back, and wait a little for each one's word that it has it. Never raises."""
        for role, device in self._lenders().items():
            if role == "stage" and not standing:
                continue
            if not device.given_back:
                self._recorder.command(role, "give_back", "")
                done = partial(getattr, device, "given_back")
                wait_given_back(role, device.give_back, done, self._bench, self._recorder)
            if not device.given_back:  # the driver's close tries once more, without waiting
                self._recorder.event("warning", role, "it has not confirmed that its settings are as they were found")
            else:
                self._kept.forget(role)

    def _lenders(self) -> dict[str, GivesBack]:
        """By role; what the supply has to get back its guard sees to."""
        devices = self._bench.devices.items()
        return {role: device for role, device in devices if role != ROLE and isinstance(device, GivesBack)}


def as_argument(found: Mapping[str, float]) -> str:
    """Settings as the argument of a command in the log."""
    return ", ".join(f"{key} {value}" for key, value in found.items())


def from_argument(text: str) -> dict[str, float]:
    """The settings that `as_argument` wrote."""
    pairs = (one.rsplit(" ", 1) for one in text.split(", ") if one)
    return {key: float(value) for key, value in pairs}


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
    return {key: value for key, value in found.items() if type(value) in (int, float) and math.isfinite(value)}
