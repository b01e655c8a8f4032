"""A program that is started without standard streams gives their numbers to nothing else."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

CODE = """
import os, subprocess, sys
for number in CLOSED: os.close(number)
from rig.cli.app import keep_streams
keep_streams()
assert os.open(os.devnull, os.O_RDONLY) > 2
child = "import os; assert os.open(os.devnull, os.O_RDONLY) > 2"
sys.exit(subprocess.run([sys.executable, "-c", child]).returncode + 7)
"""


@pytest.mark.skipif(os.name != "posix", reason="numbers of files are inherited so on POSIX")
@pytest.mark.parametrize("closed", [(2,), (0, 1, 2)], ids=["error", "all"])
def test_no_port_gets_the_number_of_a_closed_stream(closed: tuple[int, ...]) -> None:
    done = subprocess.run([sys.executable, "-c", CODE.replace("CLOSED", repr(closed))], timeout=60)
    assert done.returncode == 7
