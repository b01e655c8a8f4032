"""The numbers of the status line, held against the simulated hardware; the time left against the time it took."""

from __future__ import annotations

import math
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from model.membrane.solve import solve
from rig.engine.engine import Engine
from rig.log.nowhere import NoLog
from rig.log.writer import LogWriter
from rig.operator.control import Control
from rig.operator.status import Status
from rig.protocol.experiment import gains_of, prepare
from rig.run.backend import open_bench

pytestmark = pytest.mark.slow  # the whole protocol of the paper

FIXTURES = Path(str(files("sim_fixtures")))


def run(pause_at: float = math.inf, pause_s: float = 0.0) -> list[tuple[float, Status, float, float]]:
    """Clock time, status, and the true force (N) and voltage (V) then; the end of the run last."""
    experiment = prepare(FIXTURES / "scenes" / "cone-4mm.toml", FIXTURES / "protocols" / "paper.toml")
    bench = open_bench(experiment.scene)
    assert bench.simulated is not None
    world = bench.simulated.world
    found: list[tuple[float, Status, float, float]] = []
    control = Control(unattended="a test")

    def show(status: Status) -> None:
        now = bench.clock.now()
        volts = float(world.voltage(np.array([now]))[0])
        found.append((now, status, float(world.force(np.array([now]))[0]), volts))
        if pause_at <= now < pause_at + 0.25:
            control.ask_pause("a test")
        elif now > pause_at + pause_s:
            control.pausing = ""

    engine = Engine(
        bench,
        experiment.actions,
        cast(LogWriter, NoLog()),
        gains_of(experiment.certificates),
        control,
        lambda done, total, label: None,
        experiment.certificates,
        requested="a test",
        show=show,
    )
    outcome, error = engine.run()
    assert error is None and outcome.safe
    return found


@pytest.fixture(scope="module")
def looks() -> list[tuple[float, Status, float, float]]:
    return run()


def test_the_numbers_are_those_of_the_hardware(looks: list[tuple[float, Status, float, float]]) -> None:
    inside = [one for one in looks if np.isfinite(one[1].displacement)]
    assert len(inside) > 100
    volts = np.array([(one[1].voltage, one[3]) for one in inside])
    assert np.percentile(np.abs(volts[:, 0] - volts[:, 1]), 95) < 70.0  # measured ten times a second on a ramp
    under = [one[1] for one in inside if one[1].voltage > 900.0]
    assert under
    film = prepare(FIXTURES / "scenes" / "cone-4mm.toml", FIXTURES / "protocols" / "paper.toml").scene.specimen
    for status in under[:: max(len(under) // 10, 1)]:
        state = solve(film.specimen(), max(status.displacement, 1e-6), status.voltage)
        assert status.field == pytest.approx(float(state.peak_field), rel=1e-6)
        assert status.nearest in ("force", "displacement", "voltage", "field", "current")
        assert 0.0 < status.nearest_part < 1.05
        assert status.nearest_part >= max(status.voltage / 1800.0, status.force / 0.9) - 1e-9


def test_the_time_left_is_within_15_percent_from_a_tenth_of_the_run_on(
    looks: list[tuple[float, Status, float, float]],
) -> None:
    end = looks[-1][0]
    for now, status, _, _ in looks:
        if 0.1 * end < now < 0.97 * end:
            assert status.left == pytest.approx(end - now, rel=0.15, abs=3.0), f"{now:.1f} of {end:.1f} s"


@pytest.mark.long
def test_a_pause_is_not_counted_and_what_is_done_anew_is() -> None:
    paused = run(pause_at=70.0, pause_s=30.0)
    end = paused[-1][0]
    resting = [status.left for now, status, _, _ in paused if 80.0 < now < 99.0]
    assert max(resting) - min(resting) < 0.1  # the time left stands still
    for now, status, _, _ in paused:
        if 100.0 < now < 0.97 * end:
            assert status.left == pytest.approx(end - now, rel=0.15, abs=3.0), f"{now:.1f} of {end:.1f} s"


def test_steps_and_parts_only_go_on(looks: list[tuple[float, Status, float, float]]) -> None:
    steps = [one[1].step for one in looks]
    done = [one[1].done for one in looks]
    assert steps == sorted(steps) and steps[0] == 1 and {one[1].steps for one in looks} == {max(steps)}
    assert all(later >= earlier - 1e-12 for earlier, later in pairwise(done))
    assert done[-1] > 0.95
