"""A load cell on CAN and a serial high-voltage supply take the two roles: either bus carries either."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from drivers.links.link import DeviceError
from model.membrane.solve import solve_many
from rig.base.certificates import load_certificate
from rig.base.errors import ConfigError, RigError, Stopped
from rig.engine.engine import Engine
from rig.engine.outcome import Outcome
from rig.log.dataset import Run, load_run
from rig.log.export import export
from rig.log.info import info
from rig.log.recorder import Gains
from rig.log.writer import LogWriter
from rig.operator.control import Control
from rig.protocol.experiment import prepare
from rig.run.backend import open_bench
from rig.run.run import run as run_experiment
from rig.sim.bench import SimulatedBench
from tests.protocols import near

FIXTURES = Path(str(files("sim_fixtures")))
SCENE = FIXTURES / "scenes" / "other-instruments.toml"
NOISE_N = 0.005
PROTOCOL = """
[[step]]
do = "home"
[[step]]
do = "zero"
duration_s = 1.0
[[step]]
do = "approach"
speed_mm_per_s = 4.0
threshold_mN = 8.0
max_travel_mm = 8.0
[[step]]
do = "voltage"
voltage_V = 1000
settle_s = 0.5
[[step]]
do = "ramp"
displacement_mm = 6.0
speed_mm_per_s = 2.0
[[step]]
do = "hold"
duration_s = 2.0
[[step]]
do = "return"
speed_mm_per_s = 4.0
"""


@dataclass
class Story:
    """What the software says of a run, and what the simulated supply's own output did."""

    outcome: Outcome
    error: RigError | DeviceError | None
    run: Run
    bench: SimulatedBench
    highest_output: float
    final_output: float


def tell(folder: Path, *, mischief: Callable[[Control], None] | None = None, gains: Gains | None = None) -> Story:
    protocol, path = folder / "protocol.toml", folder / "run.mcap"
    protocol.write_text(PROTOCOL)
    scene = folder / "scene.toml"
    scene.write_text(near(SCENE.read_text().replace("../calibrations", (FIXTURES / "calibrations").as_posix())))
    experiment = prepare(scene, protocol)
    bench, stop = open_bench(experiment.scene), Control(unattended="a test")
    simulated, clock = bench.simulated, bench.clock
    assert simulated is not None
    outputs = [0.0]

    def progress(done: float, total: float, label: str) -> None:
        outputs.append(simulated.world.output.at(clock.now())[0])
        if mischief is not None and "hold" in label and not stop.count:
            mischief(stop)

    certificate = experiment.certificates["force"]
    gains = gains or Gains(force=certificate.gain, force_unit=certificate.reading_unit)
    with LogWriter(path) as log:
        outcome, error = Engine(bench, experiment.actions, log, gains, stop, progress, requested="a test").run()
        bench.close()
        log.finish(outcome.as_text())
    final = simulated.world.output.at(clock.now())[0]
    return Story(outcome, error, load_run(path), simulated, max(outputs), final)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Story:
    return tell(tmp_path_factory.mktemp("whole"))


def test_a_whole_run_really_had_voltage_and_ends_off(whole: Story) -> None:
    assert whole.error is None and whole.outcome.status == "complete", whole.outcome
    assert whole.highest_output == pytest.approx(1000.0 * (1 + 5e-4), abs=1e-6)
    assert whole.outcome.safe and whole.final_output == 0.0


def test_the_force_is_the_models(whole: Story) -> None:
    run = whole.run
    rows = np.flatnonzero((run.h > 0.5e-3) & np.isfinite(run.voltage))
    assert rows.size > 400 and run.voltage[rows].max() > 990
    predicted = solve_many(whole.bench.world.specimen, run.h[rows], run.voltage[rows]).force
    residual = run.force[rows] - predicted
    zero = NOISE_N / 10  # the mean of a hundred samples
    assert abs(residual.mean()) < 4 * np.hypot(zero, NOISE_N / np.sqrt(rows.size))
    assert residual.std() == pytest.approx(NOISE_N, rel=0.1)
    assert np.ptp(predicted) > 10 * NOISE_N


def test_the_ramp_of_a_supply_that_has_none(whole: Story) -> None:
    hv = whole.run.log.columns("/hv/sample")
    rising = (hv["voltage_V"] > 100) & (hv["voltage_V"] < 900) & (hv["t_s"] < hv["t_s"][hv["voltage_V"].argmax()])
    slope, _ = np.polyfit(hv["t_s"][rising], hv["voltage_V"][rising], 1)
    assert slope == pytest.approx(300.0, rel=0.1)


def test_the_log_says_what_is_not_watched_and_in_what_the_readings_are(whole: Story, tmp_path: Path) -> None:
    log = whole.run.log
    events = [message.fields["message"] for message in log.messages("/event")]
    assert len([text for text in events if "does not measure its current" in text]) == 1
    assert np.isnan(log.columns("/hv/sample")["current_A"]).all()
    assert log.metadata["units"] == {"/force/sample reading": "N"}
    assert "N" in next(line for line in info(log.path).splitlines() if "unit of" in line)
    zero = whole.run.reference("force_zero")
    assert zero is not None and zero.unit == "N" and zero.value == pytest.approx(0.004, abs=4 * NOISE_N / 10)
    assert whole.run.force_per_reading == pytest.approx(1.0)
    table = tmp_path / "force.csv"
    export(log.path, table, "/force/sample")
    assert "reading_N" in table.read_text().splitlines()[0].split(",")


def test_a_stop_in_the_middle_ends_off(tmp_path: Path) -> None:
    story = tell(tmp_path, mischief=lambda stop: stop.ask("a test"))
    assert isinstance(story.error, Stopped) and story.outcome.status == "stopped"
    assert story.highest_output > 990
    assert story.outcome.safe and story.final_output < 60


def test_a_certificate_for_other_readings_is_refused_before_anything_moves(tmp_path: Path) -> None:
    other = load_certificate(FIXTURES / "calibrations" / "force.toml")
    story = tell(tmp_path, gains=Gains(force=other.gain, force_unit=other.reading_unit))
    assert isinstance(story.error, ConfigError)
    assert "mV/V" in str(story.error) and "in N" in str(story.error)
    commands = [message.fields["command"] for message in story.run.log.messages("/command")]
    assert not {"home", "arm", "set_voltage"} & set(commands)
    assert story.highest_output == 0.0


@pytest.mark.slow
def test_the_same_seed_gives_the_same_run(tmp_path: Path) -> None:
    protocol = tmp_path / "protocol.toml"
    protocol.write_text(PROTOCOL)
    columns = []
    for name in ("a", "b"):
        path = tmp_path / f"{name}.mcap"
        assert run_experiment(prepare(SCENE, protocol), path, lambda done, total, label: None).safe
        run = load_run(path)
        columns.append([run.t, run.force, run.h, run.voltage])
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(*columns, strict=True))


# Short ways, and patience with a busy machine: the time-outs are not what is tested here.
CHANGES = {
    "approach_from_mm = 36.0": "approach_from_mm = 5.0\ntimeout_s = 2.0",
    'driver = "cia404"': 'driver = "cia404"\ntimeout_s = 2.0',
    'driver = "keyence-lkg"': 'driver = "keyence-lkg"\ntimeout_s = 1.0',
    'driver = "shvps"': 'driver = "shvps"\ntimeout_s = 2.0',
    "rig_compliance_um_per_N = 2.0": "",
    "contact_position_mm = 40.0": "contact_position_mm = 7.0\n[simulation.stage]\nstart_position_mm = 2.0",
    "ramp_V_per_s = 300.0": "ramp_V_per_s = 1000.0",
    "../calibrations": str(FIXTURES / "calibrations"),
}


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")
def test_over_pseudo_terminals_and_slcan_in_real_time(tmp_path: Path) -> None:
    text = SCENE.read_text()
    for old, new in CHANGES.items():
        assert old in text, old
        text = text.replace(old, new)
    scene, protocol, ports, log = (tmp_path / name for name in ("s.toml", "p.toml", "ports.json", "run.mcap"))
    scene.write_text(text)
    protocol.write_text(PROTOCOL)

    def dea_rig(*arguments: str | Path) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "rig", *map(str, arguments)]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    with dea_rig("sim", scene) as bench:
        try:
            assert bench.stdout is not None
            ports.write_text(bench.stdout.readline())
            served = json.loads(ports.read_text())
            assert served["force"]["interface"] == "slcan" and set(served["hv"]) == {"port"}
            run = dea_rig("run", scene, protocol, "-o", log, "--ports", ports, "--arm", "--yes")
            out, err = run.communicate(timeout=90)
            assert run.returncode == 0, err
            assert "high voltage off" in out
        finally:
            bench.terminate()
            bench.wait(10)
    recorded = load_run(log)
    assert np.nanmax(recorded.voltage) == pytest.approx(1000, abs=10)
    assert np.nanmax(recorded.force) > 0.05
