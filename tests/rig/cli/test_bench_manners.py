"""Manners at the bench: whose turn it is, where a line belongs, swapped ports, who is told at the end."""

from __future__ import annotations

import json
import os
import sys
import time
from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from rig.analysis.certificate_file import certificate_place
from rig.cli.app import main
from rig.log.reader import read_log
from rig.operator import notice
from rig.protocol.experiment import SERVED_BY, SERVER
from rig.run.backend import simulated_bench
from rig.scene.scene import load_scene
from rig.sim.served import ServedBench

FIXTURES = Path(str(files("sim_fixtures")))
SCENE = (FIXTURES / "scenes" / "cone-4mm.toml").read_text().replace("../calibrations", str(FIXTURES / "calibrations"))
ONE_STEP = '[[step]]\ndo = "zero"\nduration_s = 0.5\n'


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.toml").write_text(SCENE)
    (tmp_path / "p.toml").write_text(ONE_STEP)
    return tmp_path


def say(*arguments: str) -> Result:
    return CliRunner().invoke(main, list(arguments))


def test_the_line_of_the_scene_that_names_a_certificate(bench: Path) -> None:
    lines = SCENE.splitlines()
    said = certificate_place(bench / "s.toml", "hv", bench / "new" / "hv.toml")
    number = int(said.split("line ")[1].split(",")[0])
    assert lines[number - 1].startswith("certificate") and lines[number - 1].endswith('hv.toml"')
    assert '[hv]: certificate = "new/hv.toml"  (now "' in said
    said = certificate_place(bench / "s.toml", "compliance", bench / "new" / "compliance.toml")
    assert 'add to [stage]: certificate = "new/compliance.toml"' in said


@pytest.mark.slow
def test_a_failed_check_of_a_sensor_says_what_to_do_and_where(bench: Path) -> None:
    (bench / "s.toml").write_text(SCENE.replace("gain_error = 6e-4", "gain_error = 2e-2"))
    done = say("verify", "force", "s.toml", "--standard", "60", "-o", "check.mcap")
    assert done.exit_code == 1 and "DOES NOT AGREE" in done.output
    assert "dea-rig calibrate force s.toml -o FOLDER" in done.output and "in s.toml, line 36, [force]" in done.output


def test_ports_of_no_role_are_refused(bench: Path) -> None:
    (bench / "ports.json").write_text('{"stge": {"port": "/dev/pts/9"}}')
    for command in (("run", "s.toml", "p.toml", "-o", "x.mcap"), ("calibrate", "force", "s.toml", "-o", "x")):
        done = say(*command, "--ports", "ports.json")
        assert done.exit_code == 2 and "ports.json: 'stge' is no role" in done.output
        assert "Did you mean 'stage'?" in done.output
    done = say("verify", "force", "s.toml", "--standard", "20", "-o", "x.mcap", "--ports", "ports.json")
    assert done.exit_code == 2 and "is no role" in done.output
    assert sorted(path.name for path in bench.iterdir()) == ["p.toml", "ports.json", "s.toml"]


def test_every_page_of_a_plan_has_its_heads_and_the_summary_is_last(bench: Path) -> None:
    (bench / "p.toml").write_text(
        '[[step]]\ndo = "home"\n[[step]]\ndo = "zero"\n[[step]]\ndo = "approach"\n[[step]]\ndo = "sweep"\n'
        "displacement_mm = 3.0\nspeed_mm_per_s = 1.0\ncycles = 45\n"
    )
    done = say("check", "s.toml", "p.toml")
    assert done.exit_code == 0, done.output
    lines = done.output.splitlines()
    assert sum("action" in line and "step" in line for line in lines[:-8]) == 3  # 93 actions on pages of 40
    assert "(page 2 of 3)" in done.output
    assert lines[-1] == "All hold." and "displacement 3 mm, of 14 allowed" in lines[-4]


@pytest.mark.parametrize(("limit", "code", "words"), [("0.9", 0, "the protocol ended"), ("0.0051", 3, "outside")])
def test_when_a_run_ends_somebody_elsewhere_is_told(bench: Path, limit: str, code: int, words: str) -> None:
    """A program with its arguments as they are: no shell looks at them, and nobody waits."""
    told, script = bench / "told.txt", bench / "tell.py"
    script.write_text(
        "import os, sys, time\ntime.sleep(0.3)\n"
        f"names = ('DEA_RIG_LOG', 'DEA_RIG_EXIT_CODE', 'DEA_RIG_TEXT')\n"
        f"text = '\\n'.join([*sys.argv[1:], *(os.environ[name] for name in names)])\n"
        f"open({str(told)!r} + '.new', 'w').write(text)\nos.rename({str(told)!r} + '.new', {str(told)!r})\n"
    )
    command = json.dumps([sys.executable, str(script), "a b; touch $HOME", "*"])
    (bench / "s.toml").write_text(SCENE.replace("title =", f"on_end = {command}\ntitle =").replace("0.9", limit))
    done = say("run", "s.toml", "p.toml", "-o", "x.mcap")
    assert done.exit_code == code, done.output
    assert not told.exists()  # it is still at it
    end = time.monotonic() + 30
    while not told.exists():
        assert time.monotonic() < end
        time.sleep(0.02)
    said = told.read_text().split("\n")
    assert said[:4] == ["a b; touch $HOME", "*", str(bench / "x.mcap"), str(code)] and words in said[4]


def test_a_program_that_cannot_be_started_changes_nothing(bench: Path) -> None:
    (bench / "s.toml").write_text(SCENE.replace("title =", 'on_end = ["/no/such/program"]\ntitle ='))
    done = say("run", "s.toml", "p.toml", "-o", "x.mcap")
    assert done.exit_code == 0 and "on_end: '/no/such/program' could not be started" in done.output
    assert (read_log(bench / "x.mcap").outcome or {})["status"] == "complete"


def test_a_notification_is_shown_where_there_is_a_desktop(bench: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[list[str]] = []
    monkeypatch.setattr(notice, "_start", lambda command, environment: started.append(list(command)) or "")
    monkeypatch.setattr(notice.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.delenv("DBUS_SESSION_BUS_ADDRESS", raising=False)
    notice.tell_end([], "x.mcap", 0, "ended")
    assert started == [] or sys.platform == "darwin"
    monkeypatch.setenv("DBUS_SESSION_BUS_ADDRESS", "unix:path=/run/bus")
    notice.tell_end([], "x.mcap", 0, "-u ended")
    assert started[-1][-2:] == ["dea-rig: a run has ended", "-u ended"]


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")
def test_swapped_ports_are_recognised(bench: Path) -> None:
    with ServedBench(simulated_bench(load_scene(bench / "s.toml")[0])) as served:
        ports = dict(served.ports)
        ports["stage"], ports["force"] = ports["force"], ports["stage"]
        (bench / "ports.json").write_text(json.dumps({**ports, SERVED_BY: SERVER}))
        done = say("run", "s.toml", "p.toml", "-o", "x.mcap", "--ports", "ports.json")
        assert done.exit_code == 4, done.output
        said = " ".join(done.output.split())
        assert (
            f"On {ports['force']['port']}, which the scene names for [force], another instrument answers: stage" in said
        )
        assert (
            f"On {ports['stage']['port']}, which the scene names for [stage], another instrument answers: force" in said
        )
        assert "high voltage" in said and served.driven == []
