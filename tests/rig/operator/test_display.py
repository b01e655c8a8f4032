"""What a run shows, on a terminal of 80 columns and in a file."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

SHOW = """
from rig.operator.display import Display
from rig.operator.status import Status
from rig.base.clock import RealClock
with Display("SIMULATED: in memory. film", "SIMULATED") as display:
    clock = RealClock()
    for k in range(20):
        label = f"step {k // 10 + 1} sweep: 0 to 6 mm at 1000 V"
        display.show(Status(k // 10 + 1, 2, k / 20, 20.0 - k, label, 0.1, 4e-3, 1000.0, 1e-7, 35e6, "field", 0.44))
        if k == 10:
            display.say("Paused: the stage stands, the voltage is off.")
        clock.sleep_until(0.02 * k)
"""


@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")
def test_on_a_terminal_numbers_stand_on_one_line_and_words_on_lines_of_their_own() -> None:
    ours, theirs = os.openpty()
    environment = {**os.environ, "COLUMNS": "80", "LINES": "24"}
    with subprocess.Popen([sys.executable, "-c", SHOW], stderr=theirs, env=environment) as shown:
        os.close(theirs)
        said = b""
        try:
            while data := os.read(ours, 4096):
                said += data
        except OSError:  # the other end is closed
            pass
    os.close(ours)
    assert shown.returncode == 0
    text = said.decode().replace("\r\n", "\n")
    assert text.startswith("SIMULATED: in memory. film\n")
    lines = [re.sub(r"\x1b\[K", "", one) for one in re.split(r"[\r\n]", text)]
    numbers = [one for one in lines if one.startswith("SIMULATED | step")]
    assert len(numbers) >= 5 and all(len(one) < 80 for one in numbers)
    assert any("0.100 N, 4.00 mm, 1000 V, 0.1 uA" in one for one in numbers)
    assert "Paused: the stage stands, the voltage is off." in lines


def test_in_a_file_each_step_has_a_line(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", SHOW], stderr=subprocess.PIPE, text=True, check=True, timeout=60)
    lines = done.stderr.splitlines()
    assert lines[0] == "SIMULATED: in memory. film" and len(lines) == 4
    assert lines[1].startswith(
        "    0 %, 20 s left  step 1 sweep: 0 to 6 mm at 1000 V (0.100 N, 4.00 mm, 1000 V, 0.1 uA"
    )
    assert "Paused: the stage stands, the voltage is off." in lines
