"""`dea-rig read` and `dea-rig jog`: what the instruments say, and the stage by hand, with the voltage left off."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from contextlib import closing, suppress
from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from rig.cli.app import main
from rig.log.reader import read_log, read_tables
from rig.protocol.experiment import SERVED_BY, SERVER
from rig.run.backend import simulated_bench
from rig.scene.scene import load_scene
from rig.sim.served import ServedBench

FIXTURES = Path(str(files("sim_fixtures")))
SCENE = (FIXTURES / "scenes" / "cone-4mm.toml").read_text().replace("../calibrations", str(FIXTURES / "calibrations"))
# The command becomes the terminal's foreground job, as if started from a shell there.
JOB = "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); os.execv(sys.executable, sys.argv[1:])"
LINE = re.compile(r"^  (stage|force|displacement|hv) +(-?[0-9.]+) (mm|N|V)", re.M)


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    return path


def say(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [str(one) for one in arguments])


def commands(log: Path) -> list[tuple[str, str]]:
    table = read_tables(log, ["/command"])[1]["/command"]
    return list(zip(table["device"], table["command"], strict=True))


def test_read_says_a_line_for_each_instrument_and_commands_nothing(scene: Path, tmp_path: Path) -> None:
    done = say("read", scene, "-o", "read.mcap")
    assert done.exit_code == 0, done.output
    said = {role: (float(value), unit) for role, value, unit in LINE.findall(done.output)}
    assert said.keys() == {"stage", "force", "displacement", "hv"}
    assert said["stage"] == (0.0, "mm") and "no reference position" in done.output
    assert abs(said["hv"][0]) < 3 and "set-point 0 V, channel off  (iseg" in done.output
    assert abs(said["force"][0]) < 0.05  # the unloaded cell's offset
    assert commands(tmp_path / "read.mcap") == [("stage", "stop")]  # as every run ends
    assert all(len(line) <= 110 for line in done.output.splitlines())


def test_read_keeps_no_log_unless_asked(scene: Path, tmp_path: Path) -> None:
    assert say("read", scene).exit_code == 0
    assert list(tmp_path.iterdir()) == [scene]


def test_read_tells_of_a_live_output_and_leaves_it(scene: Path, tmp_path: Path) -> None:
    scene.write_text(SCENE.replace("[simulation.hv]", "[simulation.hv]\nstart_live_V = 500.0"))
    done = say("read", scene, "-o", "live.mcap")
    assert done.exit_code == 4 and "NOT SAFE" in done.output and re.search(r"measured (49\d|50\d)", done.output)
    assert {device for device, _ in commands(tmp_path / "live.mcap")} == {"stage"}


def test_jog_goes_where_it_is_told_with_the_voltage_off(scene: Path, tmp_path: Path) -> None:
    done = say("jog", scene, "home", "20", "+0.5", "-2", "-o", "jog.mcap")
    assert done.exit_code == 0, done.output
    log, tables = read_tables(tmp_path / "jog.mcap", ["/stage/sample", "/hv/sample"])
    assert log.outcome is not None and log.outcome["status"] == "complete"
    places = [float(value) for role, value, _ in LINE.findall(done.output) if role == "stage"]
    assert places == pytest.approx([0.0, 20.0, 20.5, 18.5], abs=0.002)
    assert tables["/stage/sample"]["position_m"][-1] == pytest.approx(18.5e-3, abs=2e-6)
    assert max(abs(tables["/hv/sample"]["voltage_V"])) < 5
    assert {device for device, _ in commands(tmp_path / "jog.mcap")} == {"stage"}


@pytest.mark.parametrize(
    ("moves", "code", "words"),
    [
        (("20",), 3, "no reference position yet. Type home"),
        (("home", "500"), 3, "stage position 500 mm is outside the limits"),
        (("up",), 2, "'up' is none of: home; read; a position in mm (20)"),
        (("--fast",), 2, "'--fast' is none of"),
        ((), 2, "simulated in memory, where nobody can type"),
        (("home", "20", "--speed-mm-per-s", "50"), 3, "beyond limits.speed_mm_per_s"),
    ],
)
def test_what_jog_refuses(scene: Path, moves: tuple[str, ...], code: int, words: str) -> None:
    done = say("jog", scene, *moves, "-o", "jog.mcap")
    assert done.exit_code == code and words in " ".join(done.output.split()), done.output
    assert not Path("jog.mcap").exists() or code == 3


def test_jog_stops_at_the_force_limit(scene: Path) -> None:
    """Contact is at 40 mm: the limit ends it, and the log says where."""
    scene.write_text(SCENE.replace("force_N = 0.9", "force_N = 0.05"))
    done = say("jog", scene, "home", "52", "--speed-mm-per-s", "4", "-o", "jog.mcap")
    assert done.exit_code == 3 and "force" in done.output
    assert (read_log(Path("jog.mcap")).outcome or {})["status"] == "limit"


class Terminal:
    """A command at a pseudo-terminal of its own."""

    def __init__(self, *arguments: str | Path) -> None:
        self._ours, theirs = os.openpty()
        os.set_blocking(self._ours, False)
        command = [sys.executable, "-c", JOB, sys.executable, "-m", "rig", *map(str, arguments)]
        self._process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True)
        os.close(theirs)
        self.seen = ""
        self._done = 0

    def type(self, line: str) -> None:
        os.write(self._ours, f"{line}\n".encode())

    def wait_for(self, text: str) -> None:
        """Until ``text`` has been shown once more."""
        end = time.monotonic() + 60
        while (at := self.seen.find(text, self._done)) < 0:
            assert time.monotonic() < end and self._look(), self.seen
        self._done = at + len(text)

    def ended(self) -> int:
        end = time.monotonic() + 60
        while self._look():
            assert time.monotonic() < end, self.seen
        return self._process.wait(10)

    def _look(self) -> bool:
        """Whether it goes on; takes in what it shows."""
        time.sleep(0.05)
        gone = self._process.poll() is not None
        with suppress(OSError):
            self.seen += os.read(self._ours, 65536).decode()
        return not gone

    def close(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait(10)
        os.close(self._ours)


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")
def test_over_ports_the_moves_are_typed_and_the_supply_is_never_driven(scene: Path, tmp_path: Path) -> None:
    with ServedBench(simulated_bench(load_scene(scene)[0])) as served:
        ports = tmp_path / "ports.json"
        ports.write_text(json.dumps({**served.ports, SERVED_BY: SERVER}))
        command = [sys.executable, "-m", "rig", "read", scene, "--ports", ports]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0 and len(LINE.findall(done.stdout)) == 4, done.stderr
        with closing(Terminal("jog", scene, "--ports", ports, "--step-mm", "0.5", "-o", tmp_path / "jog.mcap")) as jog:
            for typed in ("home", "3", "+", "up", "-1", "end"):
                jog.wait_for("-> + or -")
                jog.type(typed)
            assert jog.ended() == 0, jog.seen
        assert "'up' is not understood" in jog.seen and "SIMULATED" in jog.seen
        assert served.driven == []
    _, tables = read_tables(tmp_path / "jog.mcap", ["/stage/sample"])
    assert tables["/stage/sample"]["position_m"][-1] == pytest.approx(2.5e-3, abs=2e-6)
    assert {device for device, _ in commands(tmp_path / "jog.mcap")} == {"stage"}
