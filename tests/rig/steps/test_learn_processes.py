"""A closed loop over real processes: stopped, killed, and its fitting process killed, in the midst of it.

Asserted on the simulated supply's own output, on the log, and on which processes are left.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from rig.base.clock import RealClock
from rig.benchmark.stand import scene_text
from rig.log.follow import growing
from rig.log.reader import Log, read_log
from rig.protocol.experiment import SERVED_BY, SERVER
from rig.run.backend import simulated_bench
from rig.scene.scene import load_scene
from rig.sim.served import ServedBench

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are looked up in /proc"),
    pytest.mark.timeout(900),
]
PROTOCOL = """
[[step]]
do = "home"
[[step]]
do = "zero"
duration_s = 0.3
[[step]]
do = "approach"
speed_mm_per_s = 4.0
threshold_mN = 12.0
[[step]]
do = "learn"
until = "eps_r 0.6 % noise and zeros"
at_most_min = 4
settle_s = 0.2
terms = 1
[[step]]
do = "return"
speed_mm_per_s = 5.0
clearance_mm = 0.5
"""
WAIT_S = 240.0  # with a machine that does much else
LOOK_S = 0.05


class Bench:
    """A served bench, and commands on it in processes of their own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "scene.toml").write_text(scene_text(), encoding="utf-8")
        (folder / "protocol.toml").write_text(PROTOCOL, encoding="utf-8")
        scene, _ = load_scene(folder / "scene.toml")
        self.served = ServedBench(simulated_bench(scene))
        self.running: list[subprocess.Popen[str]] = []

    def start(self, *words: object) -> subprocess.Popen[str]:
        ports = self.folder / "ports.json"
        ports.write_text(
            json.dumps({role: dict(keys) for role, keys in self.served.ports.items()} | {SERVED_BY: SERVER})
        )
        command = [sys.executable, "-m", "rig", *map(str, words), "--ports", str(ports), "--arm", "--yes"]
        run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self.running.append(run)
        return run

    def run(self, name: str) -> tuple[subprocess.Popen[str], Path]:
        self.served.power_cycle()
        log = self.folder / name
        return self.start("run", self.folder / "scene.toml", self.folder / "protocol.toml", "-o", log), log


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    folder = tmp_path_factory.mktemp("loop")
    own = folder / "own"
    own.mkdir(mode=0o700)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(own))
        bench = Bench(folder)
        with bench.served:
            yield bench
            for run in bench.running:
                if run.poll() is None:
                    run.kill()
                    run.communicate()
                assert run.stdout is not None
                run.stdout.close()


def wait(done: Callable[[], Any], what: str, seconds: float = WAIT_S) -> Any:
    clock = RealClock()
    while not (found := done()):
        assert clock.now() < seconds, f"waited in vain for {what}"
        time.sleep(LOOK_S)
    return found


def dea_rig(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "rig", *map(str, words)], capture_output=True, text=True, timeout=WAIT_S, check=False
    )


def fitting(parent: int) -> list[int]:
    """Processes that fit for the engine ``parent``."""
    found = []
    for entry in Path("/proc").iterdir():
        with suppress(OSError, ValueError, IndexError):
            words = (entry / "cmdline").read_bytes().split(b"\0")
            status = (entry / "stat").read_text().rpartition(")")[2].split()
            if b"rig.analysis.refit" in words and int(status[1]) == parent and status[0] != "Z":
                found.append(int(entry.name))
    return found


def lives(pid: int) -> bool:
    with suppress(OSError):
        return (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def decisions(log: Path) -> list[dict[str, Any]]:
    """What the run that is writing ``log`` has decided so far."""
    with suppress(Exception):  # not begun, or in the midst of a record
        return [message.fields for message in read_log(growing(log)).messages("/decision")]
    return []


def in_midst(bench: Bench, run: subprocess.Popen[str], log: Path) -> int:
    """Until the loop measures under voltage; the process that fits."""

    def there() -> bool:
        assert run.poll() is None, run.communicate()[0]
        return bench.served.voltage() > 200.0 and bool(decisions(log))

    wait(there, "voltage in the loop")
    (pid,) = fitting(run.pid)
    return pid


def outcome(log: Path) -> tuple[Log, dict[str, Any]]:
    found = read_log(log)
    return found, dict(found.outcome or {})


def test_a_killed_engine_leaves_no_voltage_no_fit_and_a_run_that_goes_on_until_it_is_stopped(bench: Bench) -> None:
    """The rest is stopped from another terminal, in the midst of it too."""
    run, log = bench.run("killed.mcap")
    pid = in_midst(bench, run, log)
    run.send_signal(signal.SIGKILL)
    run.communicate()
    wait(lambda: bench.served.voltage() < 60.0, "the output's end", 20.0)
    wait(lambda: not lives(pid), "the end of the process that fits")
    before = decisions(log)
    whole = bench.folder / "recovered.mcap"
    done = dea_rig("recover", growing(log), "-o", whole)
    assert whole.exists(), done.stdout + done.stderr
    refused = bench.start("resume", whole, "-o", bench.folder / "refused.mcap")
    said, _ = refused.communicate(timeout=WAIT_S)
    assert refused.returncode != 0 and "has latched" in said and "--clear" in said, said
    assert bench.served.voltage() < 60.0
    rest = bench.folder / "rest.mcap"
    again = bench.start("resume", whole, "-o", rest, "--clear")

    pid = in_midst(bench, again, rest)
    first, last = decisions(rest)[0], before[-1]
    assert first["number"] == last["number"] + 1 and first["spent_s"] > last["spent_s"]
    done = dea_rig("stop")
    assert done.returncode == 0, done.stdout + done.stderr
    said, _ = again.communicate(timeout=WAIT_S)
    assert again.returncode == 130, said
    assert bench.served.voltage() < 60.0
    wait(lambda: not lives(pid), "the end of the process that fits")
    found, how = outcome(rest)
    assert (how["status"], how["safe"]) == ("stopped", "yes")
    (who,) = [message.fields for message in found.messages("/operator") if message.fields["act"] == "stops"]
    assert who["by"] == "another terminal"


@pytest.mark.long
def test_a_killed_fit_is_said_another_goes_on_and_three_in_a_row_end_the_step(bench: Bench) -> None:
    run, log = bench.run("unfitted.mcap")
    first = in_midst(bench, run, log)
    os.kill(first, signal.SIGKILL)
    wait(lambda: any(one["outcome"] == "failed" for one in decisions(log)), "the word that the fit has ended")
    killed = {first}

    def kill_the_next() -> bool:
        if run.poll() is not None:
            return True
        failed = [one["outcome"] for one in decisions(log)]
        if "failed" not in failed or (failed[-1] != "failed" and len(killed) == 1):
            return False
        for pid in set(fitting(run.pid)) - killed:
            os.kill(pid, signal.SIGKILL)
            killed.add(pid)
        return False

    wait(kill_the_next, "the end of the run")
    said, _ = run.communicate()
    found, how = outcome(log)
    assert (how["status"], how["safe"]) == ("complete", "yes"), said
    rows = [message.fields for message in found.messages("/decision")]
    assert [one["outcome"] for one in rows][-3:] == ["failed"] * 3 and len(killed) >= 3
    assert "has ended" in rows[-1]["reason"] and "the process that fits has ended" in said
    assert bench.served.voltage() < 60.0
    assert not any(map(lives, killed))
