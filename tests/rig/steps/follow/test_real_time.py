"""The closed loop over pseudo-terminals and slcan, in real time."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from rig.analysis.strokes import strokes
from rig.log.dataset import load_run
from rig.log.reader import read_log

# Short ways, and patience with a busy machine: the time-outs are not what is tested here.
CHANGES = """approach_from_mm = 36.0 -> approach_from_mm = 5.0@timeout_s = 2.0
driver = "gsv8" -> driver = "gsv8"@timeout_s = 2.0
driver = "keyence-lkg" -> driver = "keyence-lkg"@timeout_s = 1.0
driver = "iseg-edcp" -> driver = "iseg-edcp"@timeout_s = 2.0
rig_compliance_um_per_N = 2.0 -> rig_compliance_um_per_N = 2.0@@[simulation.stage]@start_position_mm = 2.0
contact_position_mm = 40.0 -> contact_position_mm = 7.0
ramp_V_per_s = 300.0 -> ramp_V_per_s = 1000.0"""


def rig(*arguments):
    command = [sys.executable, "-m", "rig", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
@pytest.mark.timeout(200)
@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")
def test_thirty_cycles_a_second(tmp_path, write_bench):
    scene, protocol = write_bench(
        tmp_path, ["mass"], [1300.0], CHANGES, rate_Hz=50.0, speed_mm_per_s=3.0, average_s=3.0
    )
    scene.write_text(scene.read_text().replace("@", "\n"))
    ports, log = tmp_path / "ports.json", tmp_path / "log.mcap"
    with rig("sim", scene) as bench:
        try:
            ports.write_text(bench.stdout.readline())
            assert "hv" in json.loads(ports.read_text())
            run = rig("run", scene, protocol, "-o", log, "--ports", ports, "--arm", "--yes")
            _, said = run.communicate(timeout=120)
            assert run.returncode == 0, said
        finally:
            bench.terminate()
            bench.wait(10)
    moves = read_log(log).tables(["/target"])["/target"]["t_s"]
    data = load_run(log)
    rates = []
    for phase, after in zip(data.phases, data.phases[1:], strict=False):
        if phase.kind == "release":
            rates.append(np.count_nonzero((moves >= phase.t) & (moves < after.t)) / (after.t - phase.t))
    assert len(rates) == 3
    assert min(rates) >= 30.0
    (one,) = strokes(log)
    assert abs(one.stroke - one.expected_stroke) <= 4 * one.stroke_uncertainty
