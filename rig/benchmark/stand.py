"""Short runs with high voltage over real ports, on a bench served beside them: something to kill processes of.

The engine and its guard are processes of their own; what is judged is the simulated supply's own output. POSIX only.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Any, Self

from rig.base.errors import RigError
from rig.run.backend import simulated_bench
from rig.scene.scene import load_scene
from rig.sim.bench import SimulatedBench
from rig.sim.served import Driven, ServedBench

WAIT_S = 60.0  # with a machine that does much else
LOOK_S = 0.005

# From the scene of the examples to one with short ways. The time-outs are not what is tried here.
CHANGES = {
    "approach_from_mm = 36.0": "approach_from_mm = 3.0\ntimeout_s = 3.0",
    'driver = "gsv8"': 'driver = "gsv8"\ntimeout_s = 3.0',
    'driver = "iseg-edcp"': 'driver = "iseg-edcp"\ntimeout_s = 2.0',
    "ramp_V_per_s = 300.0": "ramp_V_per_s = 1200.0",
    '[displacement]\ndriver = "keyence-lkg"\ncertificate = "../calibrations/displacement.toml"\n': "",
    "[simulation.displacement]\ngain_error = -3e-4\n": "",
    "contact_position_mm = 40.0\nrig_compliance_um_per_N = 2.0": "contact_position_mm = 5.0",
    "[simulation.film]": "[simulation.stage]\nstart_position_mm = 0.5\n\n[simulation.film]",
}
PROTOCOL = """
title = "Live as soon as can be"
[[step]]
do = "home"
[[step]]
do = "zero"
duration_s = 0.4
[[step]]
do = "approach"
speed_mm_per_s = 4.0
threshold_mN = 12.0
[[step]]
do = "voltage"
voltage_V = 800
settle_s = 0.1
[[step]]
do = "ramp"
displacement_mm = 2.0
speed_mm_per_s = 4.0
[[step]]
do = "hold"
duration_s = HOLD_S
[[step]]
do = "return"
speed_mm_per_s = 5.0
clearance_mm = 0.5
"""


def scene_text(more: str = "") -> str:
    """The scene of the runs; ``more`` are further tables."""
    fixtures = Path(str(files("sim_fixtures")))
    text = (fixtures / "scenes" / "cone-4mm.toml").read_text(encoding="utf-8")
    for old, new in CHANGES.items():
        if old not in text:
            raise ValueError(f"the example scene has no {old!r} any more")
        text = text.replace(old, new)
    text = text.replace("[simulation]\n", f"{more}\n[simulation]\n", 1)
    return text.replace("../calibrations", (fixtures / "calibrations").as_posix())


class Run:
    """One run: its engine's and guard's process numbers; ``status`` once the engine has ended."""

    def __init__(self, stand: Stand, log: Path) -> None:
        self.log = log
        self._words, self._from = stand.words, stand.words.stat().st_size
        self.engine = self.guard = 0
        self.status: int | None = None
        self.began = stand.bench.clock.now()

    @property
    def said(self) -> str:
        """What engine and guard said to the operator."""
        path = self.log.with_suffix(".err")
        return (path.read_text() if path.exists() else "") + self._words.read_bytes()[self._from :].decode()

    @property
    def beats(self) -> list[float]:
        """When the engine sent its heartbeats, for a run that came to its end."""
        return [float(line) for line in self.log.with_suffix(".beats").read_text().split()]


class Stand:
    """One served bench and one process that forks engines; runs come one after the other.

    Parameters
    ----------
    folder : Path
        For scene, protocol and logs.
    hold_s : float
        How long a run holds voltage and displacement.
    more : str
        Further tables of the scene.
    """

    def __init__(self, folder: Path, hold_s: float = 1.0, more: str = "") -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self.words = folder / "words.txt"  # what guards say
        self.words.touch()
        self.scene, self.protocol = folder / "scene.toml", folder / "protocol.toml"
        self.scene.write_text(scene_text(more), encoding="utf-8")
        self.protocol.write_text(PROTOCOL.replace("HOLD_S", f"{hold_s:g}"), encoding="utf-8")
        loaded, _ = load_scene(self.scene)
        self.bench = ServedBench(simulated_bench(loaded))
        self._server: subprocess.Popen[bytes] | None = None
        self._buffer = b""
        self._runs: list[Run] = []

    def start(self, *, power_cycle: bool = True) -> Run:
        """Start a run, by default after switching the supply off and on; returns once there is an engine."""
        if self._server is None:
            command = [sys.executable, "-m", "rig.benchmark.forkserver", str(self.scene), str(self.protocol)]
            with self.words.open("ab") as words:
                self._server = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=words)
            while self._line() != "ready":
                pass
        if power_cycle:
            self.bench.power_cycle()
        if self.do(lambda bench: bench.wire("hv").gone):
            self.plug_in("hv")
        run = Run(self, self.folder / f"run-{len(self._runs)}.mcap")
        assert self._server.stdin is not None
        self._server.stdin.write(json.dumps({"ports": self.ports(), "log": str(run.log)}).encode() + b"\n")
        self._server.stdin.flush()
        self._runs.append(run)
        self.wait(lambda: run.engine > 0, "an engine")
        return run

    def ports(self) -> dict[str, dict[str, Any]]:
        """Ports by role, under names that stay the same when a port comes back as another pseudo-terminal."""
        named: dict[str, dict[str, Any]] = {}
        for role, keys in self.bench.ports.items():
            if "host" in keys:
                named[role] = dict(keys)
                continue
            key = "can_channel" if "can_channel" in keys else "port"
            name = self.folder / f"tty-{role}"
            if name.is_symlink() and str(name.readlink()) != str(keys[key]):
                name.unlink()
            if not name.is_symlink():
                name.symlink_to(str(keys[key]))
            named[role] = {**{of: str(value) for of, value in keys.items()}, key: str(name)}
        return named

    def pull(self, role: str) -> float:
        """Pull a port; gives back when."""
        at = self.bench.clock.now()
        self.do(lambda bench: bench.wire(role).cut())
        return at

    def plug_in(self, role: str) -> float:
        """Put a port that was pulled back, under its name; gives back when it was there."""
        before = self.bench.ports[role]
        self.do(lambda bench: bench.wire(role).restore())
        self.wait(lambda: self.bench.ports[role] != before, "the port", WAIT_S)
        self.ports()
        return self.bench.clock.now()

    def kill(self, pid: int, number: signal.Signals = signal.SIGKILL) -> float:
        """Send a signal to an engine or guard of ours; gives back when."""
        at = self.bench.clock.now()
        os.kill(pid, number)
        return at

    def wait(self, done: Callable[[], bool], what: str, seconds: float = WAIT_S) -> None:
        """Until ``done()``.

        Raises
        ------
        RigError
            It did not happen in time.
        """
        end = self.bench.clock.now() + seconds
        while not done():
            self._listen(LOOK_S)
            if self.bench.clock.now() > end:
                said = self._runs[-1].said if self._runs else ""
                raise RigError(f"Waited in vain for {what}. What was said: {said or 'nothing'}")

    def wait_until_live(self, run: Run, volts: float = 400.0) -> None:
        """Until the supply's true output exceeds ``volts``."""
        self.wait(lambda: run.status is not None or self.bench.voltage() > volts, "high voltage")
        if run.status is not None:
            raise RigError(f"The run ended before it was live: {run.said}")

    def off_after(self, at: float) -> Driven | None:
        """What first sent the supply's output to zero after clock time ``at``; None if it is not on, or stays on."""
        return next((one for one in list(self.bench.driven) if one.t >= at and one.target == 0.0), None)

    def was_on(self, at: float) -> bool:
        """Whether the output was at a voltage, or on its way to one, at clock time ``at``."""
        before = [one for one in list(self.bench.driven) if one.t < at]
        return bool(before) and before[-1].target > 0.0

    def wait_until_alone(self, run: Run) -> None:
        """Until engine and guard have ended."""
        self.wait(lambda: run.status is not None, "the engine's end")
        self.wait(lambda: not _lives(run.guard), "the guard's end")

    def do(self, act: Callable[[SimulatedBench], Any]) -> Any:
        """Let the bench do something."""
        return self.bench.do(act)

    def _line(self) -> str:
        while b"\n" not in self._buffer:
            self._read(WAIT_S)
        line, _, self._buffer = self._buffer.partition(b"\n")
        return line.decode()

    def _read(self, seconds: float) -> None:
        assert self._server is not None and self._server.stdout is not None
        ready, _, _ = select.select([self._server.stdout], [], [], seconds)
        if ready:
            data = os.read(self._server.stdout.fileno(), 65536)
            if not data:
                raise RigError(f"The process that forks engines has ended: {self.words.read_text()[-2000:]}")
            self._buffer += data

    def _listen(self, seconds: float) -> None:
        self._read(seconds)
        while b"\n" in self._buffer:
            word, engine, *rest = self._line().split()
            if word == "engine":
                self._runs[-1].engine = int(engine)
                continue
            run = next(run for run in self._runs if run.engine == int(engine))
            if word == "guard":
                run.guard = int(rest[0])
            else:
                run.status = int(rest[0])

    def __enter__(self) -> Self:
        self.bench.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        for run in self._runs:
            # A guard whose supply never went off goes on trying.
            for pid in [run.guard] * _lives(run.guard) + [run.engine] * (run.status is None):
                if pid > 0:
                    with suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
        if self._server is not None:
            assert self._server.stdin is not None and self._server.stdout is not None
            self._server.stdin.close()
            self._server.wait(WAIT_S)
            self._server.stdout.close()
        self.bench.__exit__(*error)


def _lives(pid: int) -> bool:
    """Whether there is such a process, and it is no mere remainder of one."""
    if pid <= 0:
        return False
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except ProcessLookupError:  # it went while it was looked at
        return False
    except FileNotFoundError:
        if Path("/proc/self").exists():
            return False
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return False
        return True
    return state != "Z"
