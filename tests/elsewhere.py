"""Commands of the program in a fresh process that has another package on its path; one process for several of them.

Most of what a command takes is starting and importing. Commands that follow one another in one process see the package
as it was when the first one looked: what is changed in between needs a process of its own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

_COMMANDS = """
import json, sys, traceback
from click.testing import CliRunner
from rig.cli.app import main

for arguments in json.loads(sys.argv[1]):
    done = CliRunner().invoke(main, arguments)
    broken = done.exception is not None and not isinstance(done.exception, SystemExit)
    told = done.stderr + "".join(traceback.format_exception(done.exception) if broken else ())
    print(json.dumps([done.exit_code, done.stdout, told]))
"""


@dataclass(frozen=True)
class Told:
    """How one command ended, and what it said."""

    returncode: int
    stdout: str
    stderr: str

    @property
    def all(self) -> str:
        return self.stdout + self.stderr


def dea_rig(path: str, *commands: list[str | Path], cwd: Path | None = None) -> list[Told]:
    """What each of ``commands`` said, with ``path`` before all others from which is imported."""
    words = json.dumps([[str(word) for word in command] for command in commands])
    done = subprocess.run(
        [sys.executable, "-c", _COMMANDS, words],
        capture_output=True,
        text=True,
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": path, "COLUMNS": "160"},
        timeout=110 * len(commands),
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return [Told(*json.loads(line)) for line in done.stdout.splitlines()]
