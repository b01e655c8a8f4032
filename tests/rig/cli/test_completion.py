"""What the shell completes: click's own way, as the manual says it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rig.cli.app import main

DEA_RIG = Path(sys.executable).with_name("dea-rig")
MANUAL = Path(__file__).resolve().parents[3] / "rig" / "cli" / "README.md"


def completed(*words: str) -> list[str]:
    environment = {
        **os.environ,
        "_DEA_RIG_COMPLETE": "bash_complete",
        "COMP_WORDS": " ".join(words),
        "COMP_CWORD": str(len(words) - 1),
    }
    done = subprocess.run([DEA_RIG], env=environment, capture_output=True, text=True, check=True, timeout=60)
    return [line.partition(",")[2] for line in done.stdout.splitlines()]


@pytest.mark.skipif(not DEA_RIG.exists(), reason="the program is not installed beside this Python")
def test_commands_options_and_choices_are_completed() -> None:
    assert set(completed("dea-rig", "")) == set(main.list_commands(None))  # type: ignore[arg-type]
    assert completed("dea-rig", "st") == ["stop", "stroke"]
    assert {"--ports", "--arm", "--yes", "--take-down", "--out"} <= set(completed("dea-rig", "run", "--"))
    assert completed("dea-rig", "verify", "") == ["force", "displacement", "hv"]


@pytest.mark.skipif(shutil.which("bash") is None or not DEA_RIG.exists(), reason="needs bash and the program")
def test_the_line_of_the_manual_works_in_bash() -> None:
    [line] = [line for line in MANUAL.read_text().splitlines() if line.startswith("eval ") and "bash_source" in line]
    script = (
        f'{line}\nCOMP_WORDS=(dea-rig pa)\nCOMP_CWORD=1\n_dea_rig_completion dea-rig\necho "${{COMPREPLY[@]}}"\n'
        "complete -p dea-rig\n"
    )
    environment = {**os.environ, "PATH": f"{DEA_RIG.parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "--norc", "-c", script], env=environment, capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.splitlines()[0] == "pause" and "_dea_rig_completion" in done.stdout
