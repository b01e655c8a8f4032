"""Guard and engine both dead or stopped: what no software covers. The amplifier's own watchdog takes the output off.

The whole run over TCP, its processes killed or stopped all at once while there is high voltage, and the simulated
device looked at: DAC and output.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

from rig.base.errors import RigError
from rig.operator.live import live_run
from rig.run.backend import simulated_bench
from rig.scene.scene import load_scene
from rig.sim.served import ServedBench

FIXTURES = Path(str(files("sim_fixtures")))
WATCHDOG_S = 3  # of the scene
MARGIN_S = 0.5  # of this test's own looking, on a busy machine
CHANGES = {
    "approach_from_mm = 36.0": "approach_from_mm = 5.0\ntimeout_s = 2.0",
    "rig_compliance_um_per_N = 2.0\n": "",
    "contact_position_mm = 40.0": "contact_position_mm = 7.0\n[simulation.stage]\nstart_position_mm = 2.0",
    "ramp_V_per_s = 300.0": "ramp_V_per_s = 1000.0\ntimeout_s = 2.0",
    "rate_Hz = 100.0": "rate_Hz = 100.0\ntimeout_s = 2.0",
    "mm_per_V = 4.0": "timeout_s = 1.0\nmm_per_V = 4.0",
    "[simulation]\nseed": '[monitor]\ndriver = "labjack-monitor"\nquantity = "voltage"\nfactor = 1000.0\n'
    "timeout_s = 2.0\n\n[simulation]\nseed",
    "../calibrations": str(FIXTURES / "calibrations"),
}
pytestmark = [
    pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="looks for processes in /proc"),
    pytest.mark.slow,
    pytest.mark.timeout(120),
]


class Running:
    """A run under way on a served bench."""

    def __init__(self, folder: Path, voltages: str = "[800]") -> None:
        self.folder = folder
        text = (FIXTURES / "scenes" / "analogue-amplifier.toml").read_text()
        for old, new in CHANGES.items():
            assert old in text, old
            text = text.replace(old, new)
        scene = folder / "scene.toml"
        scene.write_text(text)
        short = (FIXTURES / "protocols" / "short.toml").read_text()
        short = short.replace("duration_s = 0.5", "duration_s = 3.0")  # enough samples on a busy machine, too
        (folder / "protocol.toml").write_text(short.replace("[0, 800]", voltages))
        self.bench = ServedBench(simulated_bench(load_scene(scene)[0]))
        self.bench.__enter__()
        (folder / "ports.json").write_text(json.dumps(dict(self.bench.ports)))
        self.out = (folder / "out.txt").open("w+")
        command = "run scene.toml protocol.toml -o a.mcap --ports ports.json --arm"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "rig", *command.split()],
            cwd=folder,
            stdout=self.out,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
        )

    def dac(self) -> float:
        """What the DAC puts out (V)."""

        def look(bench: Any) -> float:
            return float(bench.instruments["hv"].box.dac[0])

        return self.bench.do(look)

    def until_live(self) -> None:
        end = time.monotonic() + 60
        while self.bench.voltage() < 600.0:
            self.confirm()
            if time.monotonic() > end or self.process.poll() is not None:
                self.out.seek(0)
                raise AssertionError(self.out.read())
            time.sleep(0.02)

    def confirm(self) -> None:
        """Type the highest voltage, as from another terminal."""
        with suppress(RigError, OSError):
            run = live_run(self.folder / "a.mcap")
            if expected := run.send("status").get("expected"):
                run.send(expected)

    def everyone(self) -> list[int]:
        """The run's process and all that it has started, guard and writer of the log among them."""
        parents = {}
        for entry in Path("/proc").iterdir():
            if entry.name.isdecimal():
                try:
                    parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                except OSError:
                    continue
        found = [self.process.pid]
        for pid in found:
            found += [child for child, parent in parents.items() if parent == pid]
        return found

    def close(self) -> None:
        for pid in self.everyone():
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        self.process.wait(10)
        self.bench.__exit__()
        self.out.close()


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    run = Running(tmp_path)
    yield run
    run.close()


def dea_rig(folder: Path, *arguments: str) -> str:
    command = [sys.executable, "-m", "rig", *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_whole_job_with_amplifier_force_and_monitor_on_one_device(tmp_path: Path) -> None:
    """Two connections: one of the sensors, one of the guard. Whoever comes third is turned away."""
    run = Running(tmp_path, "[0, 800]")
    try:
        places = {role: run.bench.ports[role] for role in ("force", "displacement", "hv", "monitor")}
        assert len({tuple(place.items()) for place in places.values()}) == 1
        run.until_live()
        third = (str(places["hv"]["host"]), int(places["hv"]["tcp_port"]))
        with socket.create_connection(third, timeout=5) as viewer:
            assert viewer.recv(10) == b""
        end = time.monotonic() + 80
        while run.process.poll() is None:
            run.confirm()
            assert time.monotonic() < end
            time.sleep(0.1)
        run.out.seek(0)
        told = run.out.read()
        assert run.process.returncode == 0 and "high voltage off" in told, told
        assert "(monitor) shows" in told and "A second reading of the voltage (monitor: labjack-monitor)" in told
        assert run.dac() == 0.0
    finally:
        run.close()
    assert "every sample comes out as recorded, bit for bit" in dea_rig(tmp_path, "replay", "--verify", "a.mcap")
    dea_rig(tmp_path, "fit", "a.mcap", "-o", "fit.json")
    found = json.loads((tmp_path / "fit.json").read_text())["quantities"]["eps_r"]
    assert abs(found["value"] - 1.7) < 4 * found["standard_uncertainty"] < 2 * 1.7


def off_within(running: Running, sent: int) -> float:
    """Send a signal to everyone, and say how long the DAC kept its voltage (s)."""
    running.until_live()
    pids = running.everyone()
    assert len(pids) >= 3  # engine, guard, log
    began = time.monotonic()
    for pid in pids:
        os.kill(pid, sent)
    while running.dac() > 0.0:
        assert time.monotonic() - began < WATCHDOG_S + MARGIN_S, "the watchdog has not acted"
        time.sleep(0.01)
    took = time.monotonic() - began
    time.sleep(0.2)
    assert running.bench.voltage() < 60.0
    return took


# A killed process lets go of its connection, which a device could notice; a stopped one keeps it open and silent.
@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "stopped"])
def test_the_output_goes_off_without_any_of_our_processes(running: Running, sent: int) -> None:
    took = off_within(running, sent)
    assert took > 0.5  # nobody else took it off
    assert running.bench.do(lambda bench: bench.instruments["hv"].box.watchdog_acted) >= 1  # type: ignore[attr-defined]


@pytest.mark.long
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "stopped"])
def test_fifty_times(tmp_path: Path, sent: int) -> None:
    times: list[float] = []
    for n in range(75):
        (tmp_path / str(n)).mkdir()
        run = Running(tmp_path / str(n))
        try:
            run.until_live()
        except AssertionError:  # a machine so busy that the run ended before there was voltage: it counts for nothing
            run.close()
            continue
        try:
            times.append(off_within(run, sent))
        finally:
            run.close()
        if len(times) == 50:
            break
    print(f"{len(times)} times, off after {min(times):.2f} to {max(times):.2f} s")
    assert len(times) == 50 and max(times) < WATCHDOG_S + MARGIN_S
