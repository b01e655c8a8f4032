"""The fits of a closed loop, in a process of their own: the loop that drives the rig never waits for them."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rig.base.clock import RealClock
from rig.protocol.experiment import Experiment
from rig.steps.advisor import Advice, Ask, Kind
from rig.steps.learn import Learn

IN_MEMORY_S = 2.0  # of the bench's time that a fit takes where that time stands still meanwhile
LOOK_S = 0.1
PATIENCE_S = 600.0  # of the host, where no rig waits
LEAVE_S = 1.0
LONGEST = 65536  # bytes of an answer


class RefitProcess:
    """An `rig.steps.advisor.Advisor` that asks a process; a context manager.

    One that has died or takes too long is ended, and the next question starts another; so does the first question of
    another step.

    Parameters
    ----------
    experiment : Experiment
        Of the run; its steps `rig.steps.learn.Learn` say what is wanted.
    log : Path
        Which the run writes.
    """

    def __init__(self, experiment: Experiment, log: Path) -> None:
        self._steps = {n: step for n, step in enumerate(experiment.protocol.step, 1) if isinstance(step, Learn)}
        self._served = min(self._steps)
        self._run = {
            "log": str(log.resolve()),
            "earlier": [str(one.resolve()) for one in experiment.earlier],
            "scene": experiment.scene_text,
        }
        self._in_memory = not experiment.scene.on_real_ports
        self._process: subprocess.Popen[bytes] | None = None
        self._asked = 0.0
        self._heard = b""
        self._waiting = False

    @property
    def pid(self) -> int | None:
        """Of the process; None while there is none."""
        return None if self._process is None else self._process.pid

    def ask(self, question: Ask, now: float) -> None:
        """Put a question; the process is started for the first."""
        if self._waiting or question.step != self._served:  # an answer has not come in time; another step asks
            self._end()
        self._served = question.step
        if self._process is None:
            self._start()
        self._asked, self._heard, self._waiting = now, b"", True
        self._send(question.__dict__)

    def answer(self, now: float, stopping: Callable[[], bool]) -> Advice | None:
        """The answer, once there is one; in memory, where time stands still meanwhile, it is waited for."""
        if not self._in_memory:
            return self._look(0.0)
        if now - self._asked < IN_MEMORY_S:
            return None
        clock = RealClock()
        while (advice := self._look(LOOK_S)) is None and not stopping():
            if clock.now() > PATIENCE_S:
                self._end()
                return Advice(Kind.FAILED, f"the fit took longer than {PATIENCE_S:.0f} s")
        return advice

    def close(self) -> None:
        """End the process."""
        self._end()

    def __enter__(self) -> Self:
        self._start()  # before the run: what it imports takes its time
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def _start(self) -> None:
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "rig.analysis.refit"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # signals of the terminal are not for it
            )
        except OSError:
            self._process = None
            return
        assert self._process.stdout is not None and self._process.stdin is not None
        os.set_blocking(self._process.stdout.fileno(), False)
        os.set_blocking(self._process.stdin.fileno(), False)
        self._send({**self._run, "step": self._steps[self._served].model_dump()})

    def _send(self, line: Mapping[str, Any]) -> None:
        process = self._process
        if process is not None and process.stdin is not None:
            with suppress(OSError):  # it is gone: the answer will say so
                process.stdin.write(json.dumps(dict(line)).encode() + b"\n")
                process.stdin.flush()

    def _look(self, seconds: float) -> Advice | None:
        """What the process has said within so many seconds."""
        process = self._process
        if process is None or process.stdout is None:
            return Advice(Kind.FAILED, "the process that fits cannot be started")
        ready, _, _ = select.select([process.stdout], [], [], seconds)
        if not ready:
            return None
        data = process.stdout.read(LONGEST)
        if data is None:
            return None
        if not data:
            self._end()
            return Advice(Kind.FAILED, "the process that fits has ended")
        self._heard += data
        if not self._heard.endswith(b"\n"):
            return None
        self._waiting = False
        return _advice(self._heard)

    def _end(self) -> None:
        process, self._process, self._waiting = self._process, None, False
        if process is None:
            return
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()
        process.kill()
        with suppress(subprocess.TimeoutExpired):
            process.wait(LEAVE_S)


def _advice(line: bytes) -> Advice:
    try:
        fields: dict[str, Any] = json.loads(line)
        return Advice.from_fields(fields, fields["known"])
    except (ValueError, KeyError, TypeError) as error:
        return Advice(Kind.FAILED, f"the process that fits says what is no answer ({error!r})")
