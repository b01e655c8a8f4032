"""A scene, and a command, pay only for what they name: looked at in fresh interpreters, by what they imported."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import pytest

from rig.cli.app import main
from rig.run.backend import simulated_bench
from rig.scene.scene import load_scene
from rig.sim.served import ServedBench

FIXTURES = Path(str(files("sim_fixtures")))

HEAVY = ("scipy", "lmfit", "matplotlib", "rerun", "can", "serial", "numpy", "pydantic", "google.protobuf", "mcap")


def imported_by(code: str) -> set[str]:
    """Which of HEAVY a fresh interpreter has loaded after running ``code``."""
    show = f"import sys\n{code}\nprint(','.join(m for m in {HEAVY!r} if m in sys.modules))"
    root = Path(__file__).resolve().parents[3]
    done = subprocess.run(
        [sys.executable, "-c", show], capture_output=True, text=True, check=True, cwd=root, timeout=60
    )
    return set(done.stdout.splitlines()[-1].split(",")) - {""}


def test_help_imports_nothing_heavy() -> None:
    code = (
        "from click.testing import CliRunner\nfrom rig.cli.app import main\n"
        "assert CliRunner().invoke(main, ['--help']).exit_code == 0"
    )
    assert imported_by(code) == set()


def test_help_imports_no_command_and_says_of_each_what_it_does_in_one_line() -> None:
    code = (
        "import sys\nfrom click.testing import CliRunner\nfrom rig.cli.app import main\n"
        "print(CliRunner().invoke(main, ['--help']).output)\n"
        "print(*(m for m in sys.modules if m.startswith('rig')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    *page, modules = done.stdout.splitlines()
    assert set(modules.split()) == {"rig", "rig.cli", "rig.cli.app"}
    for name in main.list_commands(None):  # type: ignore[arg-type]
        [line] = [line for line in page if line.startswith(f"  {name} ")]
        assert len(line) <= 80 and len(line.split()) > 3, line
    assert all(len(line) <= 80 for line in page)


def test_the_help_of_each_command_imports_nothing_heavy() -> None:
    code = (
        "from click.testing import CliRunner\nfrom rig.cli.app import main\n"
        "for name in main.list_commands(None):\n"
        "    assert CliRunner().invoke(main, [name, '--help']).exit_code == 0, name"
    )
    assert imported_by(code) == set()


def test_checking_a_scene_without_hv_opens_no_door_to_hardware_or_fitting() -> None:
    code = (
        "from pathlib import Path\nfrom rig.protocol.experiment import prepare\n"
        "f = Path('sim_fixtures')\nprepare(f / 'scenes/no-hv.toml', f / 'protocols/passive.toml')"
    )
    assert imported_by(code) & {"can", "serial", "lmfit", "matplotlib", "rerun"} == set()


def test_checking_a_scene_with_hv_starts_no_guard_and_opens_no_bus() -> None:
    code = (
        "from pathlib import Path\nfrom rig.protocol.experiment import prepare\n"
        "f = Path('sim_fixtures')\nprepare(f / 'scenes/cone-4mm.toml', f / 'protocols/short.toml')\n"
        "assert not {'multiprocessing', 'rig.safety.remote', 'rig.safety.process'} & set(sys.modules)"
    )
    assert imported_by(code) & {"can", "serial"} == set()


@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")
def test_a_run_without_hv_on_real_ports_starts_no_guard_and_imports_no_can() -> None:
    scene, _ = load_scene(FIXTURES / "scenes" / "no-hv.toml")
    with ServedBench(simulated_bench(scene)) as served:
        code = (
            "from pathlib import Path\nfrom rig.scene.scene import load_scene\nfrom rig.run.backend import open_bench\n"
            f"scene = load_scene(Path({str(FIXTURES / 'scenes' / 'no-hv.toml')!r}))[0]\n"
            f"bench = open_bench(scene.with_ports({dict(served.ports)!r}))\n"
            "bench.attach(lambda role, way, data, t: None)\n"
            "while not all(device.ready for device in bench.devices.values()):\n"
            "    for role in bench.devices: bench.poll(role, bench.clock.now())\n"
            "    bench.clock.sleep_until(bench.clock.now() + 0.002)\n"
            "bench.close()\n"
            "assert not {'multiprocessing', 'rig.safety.remote', 'rig.safety.process'} & set(sys.modules)"
        )
        found = imported_by(code)
    assert "serial" in found and "can" not in found


CONTROL = {"rig", "rig.cli", "rig.cli.app", "rig.cli.files", "rig.cli.talk", "rig.operator", "rig.operator.live"}
CONTROL |= {"rig.base", "rig.base.errors", "rig.base.clock"}
# An error is told by `rig.base.terminal` (a terminal that takes nothing must not hold "stop" up), and what it quotes
# by `rig.base.text` (nothing in it drives the terminal). Both need only click and the standard library.
CONTROL |= {"rig.base.text", "rig.base.terminal"}
# The user's own directory is found in the same way as for locks on ports, by the standard library alone.
CONTROL |= {"drivers", "drivers.links", "drivers.links.own_directory", "drivers.links.system"}


@pytest.mark.parametrize("word", ["stop", "pause", "continue"])
def test_the_commands_for_emergencies_load_the_control_channel_and_nothing_else(word: str, tmp_path: Path) -> None:
    code = (
        "import sys\nfrom click.testing import CliRunner\nfrom rig.cli.app import main\nbefore = len(sys.modules)\n"
        f"done = CliRunner().invoke(main, [{word!r}])\nassert done.exit_code == 2, done.output\n"
        "own = sorted(m for m in sys.modules if m.split('.')[0] in ('rig', 'drivers', 'model', 'calibration'))\n"
        "print(len(sys.modules) - before, *own)"
    )
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60, env=environment)
    more, *own = done.stdout.split()
    module = "rig.cli.continue_" if word == "continue" else f"rig.cli.{word}"
    assert set(own) <= CONTROL | {module}, own
    assert int(more) < 70  # click alone has 150 and more


@pytest.mark.slow
def test_they_and_the_help_cost_at_most_half_as_much_again_as_the_version(tmp_path: Path) -> None:
    """CPU time of whole processes, the least of several, in alternation: what else the machine does meets all alike.

    A disturbed process only costs more, so the least comes down to what is true with more rounds: it ends as soon as
    it holds, after three rounds at least.
    """
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}

    def cost(word: str) -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-m", "rig", word], capture_output=True, timeout=60, env=environment)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    words = ("--version", "--help", "stop", "pause", "continue")
    least = dict.fromkeys(words, float("inf"))
    for done in range(1, 31):
        least = {word: min(least[word], cost(word)) for word in words}
        if done >= 3 and max(least.values()) <= 1.5 * least["--version"]:
            return
    pytest.fail(f"CPU time in s: {least}")
