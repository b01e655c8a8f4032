"""Runs whose turns are as uneven as on a busy machine, led through their logs again: the order is the log's."""

from __future__ import annotations

import contextlib
import random

import pytest

from drivers.links.link import DeviceError
from rig.base.clock import VirtualClock
from rig.base.errors import RigError
from rig.benchmark.fixtures import LOGS
from rig.protocol.experiment import prepare
from rig.replay.recording import Recording, load_recording
from rig.replay.rerun import rerun
from rig.run.run import run

STEP_S, WAKING_S = 20e-6, 100e-6  # mean time between two looks at the clock; by which a sleep is too long
HELD_UP, HELD_UP_S = 0.03, 0.03  # how often something else has the processor meanwhile, and for how long at most


class BusyClock(VirtualClock):
    """Time passes while the program works, at random; the bench lives on meanwhile."""

    def __init__(self, advance, seed):
        super().__init__(advance)
        self._random = random.Random(seed)

    def now(self):
        held_up = self._random.uniform(0.0, HELD_UP_S) if self._random.random() < HELD_UP else 0.0
        self._pass_until(self._now + self._random.expovariate(1.0 / STEP_S) + held_up)
        return self._now

    def sleep_until(self, t):
        if t > self._now:
            self._pass_until(t + self._random.expovariate(1.0 / WAKING_S))

    def _pass_until(self, t):
        self.advance(t)
        self._now = t


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", ["no-hv", "breakdown"])
def test_requests_keep_their_order_however_busy_the_machine_was(tmp_path, monkeypatch, name, seed):
    log = tmp_path / "run.mcap"
    experiment = prepare(LOGS / name / "scene.toml", LOGS / name / "protocol.toml")
    with monkeypatch.context() as busy, contextlib.suppress(RigError, DeviceError):
        busy.setattr("rig.bench.opening.VirtualClock", lambda advance: BusyClock(advance, seed))
        run(experiment, log, lambda done, total, label: None)
    recording = load_recording(log)
    monkeypatch.setattr(Recording, "in_virtual_time", False)
    found = rerun(recording)
    assert found.exit_code == 0, found.report
    assert found.outcome.reason == recording.log.outcome["reason"]
    for role in found.requests.keys() - {"hv"}:  # where the supply's last polls end is not in a log
        assert found.requests[role] == recording.log.topics[f"/raw/{role}/tx"]
