"""Cycles over pseudo-terminals, in real time: the run is killed, another goes on; every cycle is there once."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from importlib.resources import files
from pathlib import Path

import pytest

from rig.analysis.cycles import read_cycles
from rig.replay.recording import load_recording
from rig.replay.verify import verify
from tests.protocols import TO_THE_FILM

FIXTURES = Path(str(files("sim_fixtures")))
DEA_RIG = [sys.executable, "-m", "rig"]
CYCLES, KILLED_AFTER = 24, 12
STEP = f'[[step]]\ndo = "cycle"\nfrom_mm = 1\nto_mm = 2\nperiod_s = 1.0\ncycles = {CYCLES}\n'


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.skipif(os.name != "posix", reason="signals and pseudo-terminals are POSIX")
def test_killed_and_gone_on_with_every_cycle_is_there_once(tmp_path: Path) -> None:
    text = (FIXTURES / "scenes" / "no-hv.toml").read_text().replace("../calibrations", str(FIXTURES / "calibrations"))
    text = text.replace("approach_from_mm = 36.0", "approach_from_mm = 13.0")
    text = text.replace("[simulation]\n", "[simulation]\ncontact_position_mm = 17.0\n")
    (tmp_path / "scene.toml").write_text(text)
    (tmp_path / "protocol.toml").write_text(TO_THE_FILM + STEP)
    with subprocess.Popen([*DEA_RIG, "sim", tmp_path / "scene.toml"], stdout=subprocess.PIPE, text=True) as bench:
        try:
            assert bench.stdout is not None
            (tmp_path / "ports.json").write_text(bench.stdout.readline())
            ports = ["--ports", tmp_path / "ports.json", "--yes"]
            first, second = tmp_path / "one.mcap", tmp_path / "two.mcap"
            words = ["run", tmp_path / "scene.toml", tmp_path / "protocol.toml", "-o", first, *ports]
            run = subprocess.Popen([*DEA_RIG, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            part, end = first.with_name("one.mcap.part"), time.monotonic() + 120.0
            while not part.exists() or counted(part) < KILLED_AFTER:
                assert time.monotonic() < end and run.poll() is None
                time.sleep(0.5)
            run.kill()
            run.wait()
            time.sleep(1.0)  # the writer ends the log by itself
            rest = [*DEA_RIG, "resume", part, "-o", second, *ports]
            done = subprocess.run(rest, capture_output=True, text=True, timeout=200)
            assert done.returncode == 0, done.stderr
        finally:
            bench.terminate()
    found = read_cycles([part, second])
    assert found.whole["cycle"].tolist() == list(range(1, CYCLES + 1))
    for log in (part, second):
        verified = verify(load_recording(log))
        assert verified.difference is None and sum(verified.samples.values()) > 500


def counted(part: Path) -> int:
    """Whole cycles in a log that grows."""
    from rig.base.errors import DataError
    from rig.log.errors import LogError

    try:
        return int(read_cycles([part]).whole["cycle"].max(initial=0))
    except (DataError, LogError):
        return 0
