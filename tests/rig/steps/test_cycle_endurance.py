"""A million cycles in seven days on the virtual clock, interrupted in every way: none lost, none counted twice.

The step, the recorder, the log's writer and reader, and what takes a run up again are the product's. Engine and
instruments would take weeks for it; in their place stands a stage that counts its own strokes.
"""

from __future__ import annotations

import errno
import math
import os
import random
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from drivers.roles import ForceSample, SampleFlag, StageSample
from rig.analysis.cycles import read_cycles
from rig.base.clock import VirtualClock
from rig.base.errors import StaleData
from rig.log.errors import LogError
from rig.log.reader import read_log
from rig.log.recorder import Gains, Recorder
from rig.log.writer import LogWriter
from rig.operator.control import Control
from rig.protocol.experiment import Experiment, prepare
from rig.protocol.plan import plan_from
from rig.run.rehearse import log_size
from rig.run.resume import cycles_done
from rig.safety.arming import Arming
from rig.safety.limits import Limits
from rig.steps.base import write_phase
from rig.steps.cycle import Cycling
from rig.steps.rig import CyclesDone, Rig
from tests.rig.steps.test_keys_of_steps import SCENES

WEEK_S = 7 * 86_400.0
PERIOD_S = WEEK_S / 1e6
TURNS = 10  # of the stand-in's loop, in a cycle
FULL_AFTER = 5_000  # cycles after which everything that a run keeps of the last of them is there
CONTACT_M, LOW_M, HIGH_M = 40e-3, 1e-3, 1.4e-3
NO_FLAGS = SampleFlag(0)


class Killed(Exception):
    """The process that runs the test is gone; the one that writes its log is not."""


class StageThatCounts:
    """Goes where it is sent, and knows how often it came back."""

    def __init__(self, clock: VirtualClock) -> None:
        self._clock = clock
        self.at = self._goal = CONTACT_M + LOW_M
        self._until = 0.0
        self.strokes = 0

    @property
    def moving(self) -> bool:
        return self._clock.now() < self._until

    def move_to(self, position: float, speed: float) -> None:
        self._goal = position
        self._until = self._clock.now() + abs(position - self.at) / speed

    def stop(self) -> None:
        self._until = self._clock.now()

    def turn(self) -> None:
        if not self.moving and self.at != self._goal:
            self.strokes += self._goal < self.at
            self.at = self._goal


def stiffness(number: int) -> float:
    """Of the film (N/m): 3 % less every decade."""
    return 25.0 * (1.0 - 0.03 * math.log10(max(number, 1)))


class Stand:
    """The bench over all runs: time and strokes go on while programs come and go."""

    def __init__(self, experiment: Experiment, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.experiment = experiment
        self._monkeypatch = monkeypatch
        self.folder = folder
        self.clock = VirtualClock()
        self.stage = StageThatCounts(self.clock)
        self.logs: list[Path] = []
        self.turns = 0
        self.memory: list[tuple[int, int]] = []  # of each run: when all its buffers have been full once, at its end
        self._rng = np.random.default_rng(1)
        self._noise: Iterator[float] = iter(())

    def run(self, done: CyclesDone | None, ends: dict[int, str]) -> None:
        """One run, from what was ``done`` on; it ends by itself or in the turn named in ``ends``."""
        scene = self.experiment.scene
        actions = plan_from(self.experiment.protocol, scene, 4, done=done)
        action = next(one for one in actions if isinstance(one, Cycling))
        path = self.folder / f"{len(self.logs)}.mcap"
        with LogWriter(path) as log:
            log.attach("protocol.toml", "application/toml", self.experiment.protocol_text.encode())
            recorder = Recorder(log, self.clock, Gains(), has_laser=False)
            recorder.contact, recorder.force_zero = CONTACT_M, 0.0
            bench = SimpleNamespace(clock=self.clock, scene=scene, simulated=None, stage=self.stage)
            rig = Rig(cast("Any", bench), recorder, Limits.of(scene), Gains(), Control(), Arming(""), 0.0)
            self.logs.append(path if not ends else log.part)
            self._measure(rig)
            turns = action.carry_out(rig)
            write_phase(rig, action, action.kind, action.label)
            begun, full = self.turns, 0
            try:
                for _ in turns:
                    self._turn(rig, ends)
                    if self.turns == begun + TURNS * FULL_AFTER:
                        full = resident()
            finally:
                if full:
                    self.memory.append((full, resident()))
                turns.close()
            log.finish({"status": "complete"})

    def _turn(self, rig: Rig, ends: dict[int, str]) -> None:
        self.turns += 1
        match ends.get(self.turns):
            case "kill":
                raise Killed
            case "port":
                raise StaleData("force: no sample for 0.30 s.")
            case "disk":
                self._monkeypatch.setattr(os, "write", full)
        self.clock.sleep_until(self.clock.now() + PERIOD_S / TURNS)
        self.stage.turn()
        self._measure(rig)
        rig.recorder.tick(self.clock.now())

    def _measure(self, rig: Rig) -> None:
        noise = next(self._noise, None)
        if noise is None:
            self._noise = iter(self._rng.normal(0.0, 1e-5, 10_000).tolist())
            noise = 0.0
        t, h = self.clock.now(), self.stage.at - CONTACT_M
        force = stiffness(self.stage.strokes) * h + noise
        for sample in (StageSample(t, self.stage.at, False, True, 0), ForceSample(t, force, NO_FLAGS)):
            rig.recorder.add(sample)
            if rig.listener is not None:
                rig.listener(sample)


def full(fd: int, data: object) -> int:
    """The disk is full."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def resident() -> int:
    """Bytes of memory that this process has."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def experiment_of(folder: Path, cycles: int) -> Experiment:
    protocol = folder / "protocol.toml"
    protocol.write_text(
        "".join(f'[[step]]\ndo = "{name}"\n' for name in ("home", "zero", "approach"))
        + f'[[step]]\ndo = "cycle"\nfrom_mm = 1\nto_mm = 1.4\nperiod_s = {PERIOD_S}\ncycles = {cycles}\n'
    )
    return prepare(SCENES / "no-hv.toml", protocol)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads its memory in /proc")
@pytest.mark.parametrize(
    "cycles",
    [
        pytest.param(2_000, marks=pytest.mark.slow),
        pytest.param(10**6, marks=[pytest.mark.long, pytest.mark.timeout(7200)]),
    ],
)
def test_no_cycle_is_lost_or_counted_twice_memory_is_flat_and_the_log_as_long_as_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cycles: int
) -> None:
    experiment = experiment_of(tmp_path, cycles)
    stated = log_size(experiment)
    assert stated is not None
    stand, rng = Stand(experiment, tmp_path, monkeypatch), random.Random(3)
    whens = sorted(rng.sample(range(TURNS * 50, TURNS * (cycles - 500)), 5))
    kinds = ["kill", "port", "kill", "disk", "kill"]
    done: CyclesDone | None = None
    for when, kind in [*zip(whens, kinds, strict=True), (None, "")]:
        before = stand.stage.strokes
        try:
            stand.run(done, {} if when is None else {when: kind})
        except Killed:
            assert kind == "kill"
        except StaleData:
            assert kind == "port"
        except LogError as error:
            assert kind == "disk" and "No space left" in str(error)
            monkeypatch.undo()
        if when is None:
            break
        done = cycles_done(read_log(stand.logs[-1]), 4) or done
        assert done is not None
        lost = stand.stage.strokes - done.count
        # What the log says is what the stage did; a full disk takes the chunk in the making along, two seconds.
        assert 0 <= lost <= (2.0 / PERIOD_S + 2 if kind == "disk" else 1), (kind, lost)
        stand.stage.strokes = done.count
        stand.stage.at = CONTACT_M + LOW_M
        stand.stage.move_to(stand.stage.at, 1.0)
        assert stand.stage.strokes >= before
    assert stand.stage.strokes == cycles
    found = read_cycles(stand.logs)
    assert found.whole["cycle"].tolist() == list(range(1, cycles + 1))
    assert not found.missing.size and not found.twice.size
    expected = stiffness(cycles)
    assert found.whole["stiffness_N_per_m"][-100:].mean() == pytest.approx(expected, rel=2e-3)
    assert found.reference == pytest.approx(np.mean([stiffness(n) for n in range(10, 15)]), rel=0.01)
    size = sum(path.stat().st_size for path in stand.logs)
    if cycles == 10**6:
        print("memory of each run (bytes):", stand.memory)
        assert stand.clock.now() == pytest.approx(WEEK_S, rel=1e-3)
        assert size == pytest.approx(stated, rel=0.1)
        # Of each run: what takes it up again reads the log of the one before, and begins with more.
        assert len(stand.memory) >= 4 and all(end <= 1.05 * full for full, end in stand.memory), stand.memory
