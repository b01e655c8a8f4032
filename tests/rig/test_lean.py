"""A scene, and a command, pay only for what they name: looked at in fresh interpreters, by what they imported."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HEAVY = ("scipy", "lmfit", "matplotlib", "rerun", "can", "serial", "numpy", "pydantic", "google.protobuf", "mcap")


def imported_by(code: str) -> set[str]:
    """Which of HEAVY a fresh interpreter has loaded after running ``code``."""
    show = f"import sys\n{code}\nprint(','.join(m for m in {HEAVY!r} if m in sys.modules))"
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, "-c", show], capture_output=True, text=True, check=True, cwd=root, timeout=60
    )
    return set(done.stdout.splitlines()[-1].split(",")) - {""}


def test_help_imports_nothing_heavy() -> None:
    code = (
        "from click.testing import CliRunner\nfrom rig.cli import main\n"
        "assert CliRunner().invoke(main, ['--help']).exit_code == 0"
    )
    assert imported_by(code) == set()


def test_the_help_of_each_command_imports_nothing_heavy() -> None:
    code = (
        "from click.testing import CliRunner\nfrom rig.cli import main\n"
        "for name in main.commands:\n    assert CliRunner().invoke(main, [name, '--help']).exit_code == 0, name"
    )
    assert imported_by(code) == set()


def test_checking_a_scene_without_hv_opens_no_door_to_hardware_or_fitting() -> None:
    code = (
        "from pathlib import Path\nfrom rig.experiment import prepare\n"
        "f = Path('sim_fixtures')\nprepare(f / 'scenes/no-hv.toml', f / 'protocols/passive.toml')"
    )
    assert imported_by(code) & {"can", "serial", "lmfit", "matplotlib", "rerun"} == set()
