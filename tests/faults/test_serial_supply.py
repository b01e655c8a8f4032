"""Engine and guard killed with the other instruments: a supply on a serial port, without trip or ramp of its own."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import pytest

from rig.benchmark.stand import PROTOCOL
from rig.protocol.experiment import SERVED_BY, SERVER
from rig.run.backend import simulated_bench
from rig.scene.scene import load_scene
from rig.sim.served import ServedBench

pytestmark = [
    pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="looks for the guard in /proc"),
    pytest.mark.slow,
]
FIXTURES = Path(str(files("sim_fixtures")))
# Short ways, a fast ramp, and patience with a busy machine.
CHANGES = {
    r"approach_from_mm = [\d.]+": "approach_from_mm = 3.0\ntimeout_s = 2.0",
    r"contact_position_mm = [\d.]+": "contact_position_mm = 4.0",
    r"ramp_V_per_s = [\d.]+": "ramp_V_per_s = 800.0\ntimeout_s = 1.0",
    r'driver = "cia404"': 'driver = "cia404"\ntimeout_s = 2.0',
}


def guard_of(engine: int) -> int:
    children = Path(f"/proc/{engine}/task/{engine}/children").read_text().split()
    return next(int(pid) for pid in children if b"rig.safety.process" in Path(f"/proc/{pid}/cmdline").read_bytes())


@pytest.mark.parametrize("who", ["engine", "guard"])
def test_killed(tmp_path: Path, who: str) -> None:
    text = (FIXTURES / "scenes" / "other-instruments.toml").read_text()
    for old, new in CHANGES.items():
        text, found = re.subn(old, new, text, count=1)
        assert found, old
    scene, protocol, ports = (tmp_path / name for name in ("scene.toml", "protocol.toml", "ports.json"))
    scene.write_text(text.replace("../calibrations", str(FIXTURES / "calibrations")))
    protocol.write_text(PROTOCOL.replace("HOLD_S", "60"))
    with ServedBench(simulated_bench(load_scene(scene)[0])) as bench, (tmp_path / "said").open("w+b") as said:
        ports.write_text(json.dumps({**bench.ports, SERVED_BY: SERVER}))
        command = [sys.executable, "-m", "rig", "run", scene, protocol, "-o", tmp_path / "run.mcap", "--ports", ports]
        engine = subprocess.Popen([*command, "--arm", "--yes"], stderr=said, stdout=said)

        def wait(done: Callable[[], bool], what: str) -> None:
            end = bench.clock.now() + 60.0
            while not done():
                assert bench.clock.now() < end, f"waited in vain for {what}: {(tmp_path / 'said').read_text()}"
                bench.voltage()  # waits a little

        try:
            wait(lambda: bench.voltage() > 780.0 or engine.poll() is not None, "high voltage")
            assert engine.poll() is None, (tmp_path / "said").read_text()
            pid = engine.pid if who == "engine" else guard_of(engine.pid)
            at = bench.clock.now()
            os.kill(pid, signal.SIGKILL)
            wait(lambda: any(one.t > at and one.target == 0.0 for one in bench.driven), "the output's end")
            wait(lambda: bench.voltage() < 60.0, "the output's discharge")
            first = next(one for one in bench.driven if one.t > at and one.target == 0.0)
            assert all(one.target == 0.0 for one in bench.driven if one.t > first.t)
            assert first.t - at < 1.5  # a generous multiple of 50 and 200 ms
            word = "high voltage is off, measured" if who == "engine" else "the guard is lost (its process has died)"
            wait(lambda: word in (tmp_path / "said").read_text(), "the word")
            assert engine.wait(60) == (-signal.SIGKILL if who == "engine" else 4)
        finally:
            if engine.poll() is None:
                engine.kill()
                engine.wait(30)
