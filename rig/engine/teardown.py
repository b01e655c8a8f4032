"""The way to the safe state, whatever ended the run: voltage off and measured off, stage standing.

Nothing may skip it. A device that fails on the way is reported and tried again; it does not keep the others from being
made safe. The log is written as far as it can be, and its failure is no reason to stop either.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from drivers.roles import HVSample, MonitorSample
from rig.bench.bench import Bench
from rig.log.recorder import Recorder
from rig.operator.control import Control
from rig.safety.guard import ADVICE, AT_ONCE_S, NOT_SAFE, AnyGuard

SHORTEST_S = 0.001  # of a turn
AGAIN_S = 0.1  # a command that failed is given again at this interval
LISTEN_S = 2.0  # for a supply that was never commanded: how long to wait for measurements of it


@dataclass(frozen=True)
class Rest:
    """What was measured at the end.

    ``safe``: the output was measured off twice (`rig.safety.guard.Guard.output_is_safe`), or the scene has no HV.
    ``standing``: the stage said that it stands still.
    """

    safe: bool
    standing: bool


class Teardown:
    """Makes one bench safe. ``guard`` is None when the scene has no HV, or its supply was never reached."""

    def __init__(self, bench: Bench, guard: AnyGuard | None, recorder: Recorder, control: Control) -> None:
        self._bench = bench
        self._guard = guard
        self._recorder = recorder
        self._control = control
        self._told: set[str] = set()
        self._failed: set[str] = set()  # roles that did not answer when last asked; hv: not told off since then
        self._again = dict.fromkeys(bench.devices, -math.inf)

    def run(self, cause: str, orderly: bool, next_turn: Callable[[float], float], listen_until: float) -> Rest:
        """Stop the stage, take the voltage off, and wait until both have been measured.

        An orderly end ramps down; otherwise the output is taken off at once. A second signal, a supply that fails,
        or a ramp that takes too long turn the ramp into an emergency off. What the instruments say is recorded until
        ``listen_until`` at least, unless the operator is in a hurry.
        """
        clock, guard = self._bench.clock, self._guard
        self._recorder.best_effort = True
        commanded = guard is not None and guard.commanded
        hastened = not orderly
        at_once = AT_ONCE_S if guard is None else guard.off_limit
        limit = at_once - AT_ONCE_S + LISTEN_S
        if guard is not None and commanded:
            limit = at_once if hastened else guard.ramp_limit
        end = clock.now() + limit
        self._stop_stage()  # first: it waits for nobody, and a guard that hangs would keep it moving
        if "stage" in self._bench.devices:
            self._attempt("stage", partial(self._poll, "stage"))
        self._off(cause, at_once=hastened)
        while self._bench.devices:
            now = self._recorder.turn = clock.now()
            self._control.poll(now)
            late = now >= end and not self._safe()
            if commanded and not hastened and (self._control.count >= 2 or "hv" in self._failed or late):
                hastened, end = True, now + at_once
                self._off(f"{cause}; hastened", at_once=True)
            for role in sorted(self._bench.devices, key=lambda role: role != "hv"):
                answers = self._attempt(role, partial(self._poll, role), heals=not (role == "hv" and commanded))
                failed = role in self._failed if role == "hv" else not answers
                if failed and now >= self._again[role]:
                    self._again[role] = now + AGAIN_S
                    if role == "hv" and hastened:
                        self._off(f"{cause}; again", at_once=True)
                    elif role == "stage":
                        self._stop_stage()
            heard = now >= listen_until or self._control.count >= 2
            given_up = now >= end and (hastened or not commanded or self._safe())
            if given_up or (heard and self._safe() and self._standing()):
                break
            self._recorder.tick(now)
            clock.sleep_until(self._due(next_turn, now))
        rest = Rest(self._safe(), self._standing())
        if not rest.safe:
            second = "" if guard is None else guard.second_words
            self._recorder.event("error", "hv", f"{NOT_SAFE} {f'Also: {second}. ' if second else ''}{ADVICE}")
        return rest

    def _off(self, cause: str, *, at_once: bool) -> None:
        guard = self._guard
        if guard is not None:
            self._attempt("hv", lambda: guard.kill(cause) if at_once else guard.ramp_off(cause))

    def _stop_stage(self) -> None:
        if "stage" in self._bench.devices:
            self._recorder.command("stage", "stop", "")
            self._attempt("stage", self._bench.stage.stop)

    def _poll(self, role: str) -> None:
        for sample in self._bench.poll(role, self._bench.clock.now()):
            added = self._recorder.add(sample)
            if isinstance(added, HVSample) and self._guard is not None:
                self._guard.on_sample(added)
            elif isinstance(added, MonitorSample) and self._guard is not None:
                self._guard.on_monitor(added)

    def _attempt(self, role: str, act: Callable[[], None], *, heals: bool = True) -> bool:
        """Whether ``act`` succeeded. Any error at all is only reported: here nothing must stand in the way.

        What ``heals`` takes back that the role failed before. That a supply can be read again does not: the off that
        was sent to it may be lost, and only another one makes up for it.
        """
        try:
            act()
        except BaseException as error:
            self._failed.add(role)
            text = str(error) or repr(error)
            if text not in self._told:
                self._told.add(text)
                self._recorder.event("error", role, text)
            return False
        if heals:
            self._failed.discard(role)
        return True

    def _due(self, next_turn: Callable[[float], float], now: float) -> float:
        due = now
        with suppress(Exception):  # of a driver that cannot say when
            due = next_turn(now)
        return max(now + SHORTEST_S, due)

    def _safe(self) -> bool:
        if self._guard is None:
            return self._bench.scene.hv is None
        return self._guard.output_is_safe and "hv" not in self._failed

    def _standing(self) -> bool:
        with suppress(Exception):  # of a driver that cannot say whether
            return "stage" in self._bench.devices and "stage" not in self._failed and not self._bench.stage.moving
        return False
