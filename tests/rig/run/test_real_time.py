"""The same drivers and engine over pseudo-terminals and slcan, in real time, with the bench in a process of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import pytest

FIXTURES = Path(str(files("sim_fixtures")))
pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")

# Short ways, and patience with a busy machine: the time-outs are not what is tested here.
CHANGES = {
    "approach_from_mm = 36.0": "approach_from_mm = 5.0\ntimeout_s = 2.0",
    'driver = "gsv8"': 'driver = "gsv8"\ntimeout_s = 2.0',
    'driver = "keyence-lkg"': 'driver = "keyence-lkg"\ntimeout_s = 1.0',
    'driver = "iseg-edcp"': 'driver = "iseg-edcp"\ntimeout_s = 2.0',
    "contact_position_mm = 40.0": "contact_position_mm = 7.0\n[simulation.stage]\nstart_position_mm = 2.0",
    "ramp_V_per_s = 300.0": "ramp_V_per_s = 1000.0",
    "../calibrations": str(FIXTURES / "calibrations"),
}


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    text = (FIXTURES / "scenes" / "cone-4mm.toml").read_text()
    # [simulation] goes on after the inserted [simulation.stage]: put its own keys first.
    for old, new in CHANGES.items():
        assert old in text, old
        if old.startswith("contact"):
            text = text.replace("rig_compliance_um_per_N = 2.0\n", "")
        text = text.replace(old, new)
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return path


@pytest.fixture
def ports(scene: Path, tmp_path: Path) -> Iterator[Path]:
    with dea_rig("sim", scene) as bench:
        try:
            assert bench.stdout is not None
            path = tmp_path / "ports.json"
            path.write_text(bench.stdout.readline())
            assert set(json.loads(path.read_text())) == {"served_by", "stage", "force", "displacement", "hv"}
            yield path
        finally:
            bench.terminate()
            assert bench.wait(10) == 0


@pytest.fixture
def live_soon(tmp_path: Path) -> Path:
    """The short protocol without its sweep at 0 V."""
    text = (FIXTURES / "protocols/short.toml").read_text()
    assert "[0, 800]" in text
    path = tmp_path / "live_soon.toml"
    path.write_text(text.replace("[0, 800]", "[800]"))
    return path


def dea_rig(*arguments: str | Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "rig", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_the_job_end_to_end(scene: Path, ports: Path, tmp_path: Path) -> None:
    log, fit = tmp_path / "run.mcap", tmp_path / "fit.json"
    run = dea_rig("run", scene, FIXTURES / "protocols/short.toml", "-o", log, "--ports", ports, "--arm", "--yes")
    out, err = run.communicate(timeout=90)
    assert run.returncode == 0, err
    assert "high voltage off" in out
    # Half a minute of data does not tell two terms apart: the fit of two may end anywhere, and says so.
    identified = dea_rig("fit", log, "--terms", "1", "-o", fit)
    out, err = identified.communicate(timeout=90)
    assert identified.returncode == 0, err
    found = json.loads(fit.read_text())
    assert found["reduced_chi_square"] == pytest.approx(1.0, abs=0.25)
    eps_r = found["quantities"]["eps_r"]
    assert abs(eps_r["value"] - 1.7) < 4 * eps_r["standard_uncertainty"] < 2 * 1.7


@pytest.mark.slow
def test_without_arm_there_is_no_high_voltage_and_no_log(scene: Path, ports: Path, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    run = dea_rig("run", scene, FIXTURES / "protocols/short.toml", "-o", log, "--ports", ports)
    _, err = run.communicate(timeout=60)
    assert run.returncode == 2 and "--arm" in err
    assert not list(tmp_path.glob("*.mcap*"))


@pytest.mark.slow
# In CI: `tests/faults/test_terminal.py`, SIGINT there by its key, and `tests/rig/operator/test_signals.py`.
@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT])
def test_a_signal_ends_a_run_safely(
    scene: Path, live_soon: Path, ports: Path, tmp_path: Path, number: signal.Signals
) -> None:
    from rig.log.reader import read_log

    log = tmp_path / "run.mcap"
    run = dea_rig("run", scene, live_soon, "-o", log, "--ports", ports, "--arm", "--yes")
    assert run.stderr is not None
    for line in run.stderr:
        if "800 V" in line and "sweep: 0 to" in line:
            break
    time.sleep(0.5)
    run.send_signal(number)
    _, err = run.communicate(timeout=30)
    assert run.returncode == 130, err
    assert "high voltage off" in err
    outcome = read_log(log).outcome
    assert outcome is not None and outcome["status"] == "stopped" and outcome["safe"] == "yes"


@pytest.mark.slow
def test_a_run_is_paused_continued_and_stopped_from_another_terminal(
    scene: Path, live_soon: Path, ports: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rig.log.reader import read_log

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    log, slow = tmp_path / "run.mcap", tmp_path / "slow.toml"
    slow.write_text(live_soon.read_text().replace("= 6.0\nspeed_mm_per_s = 4.0", "= 6.0\nspeed_mm_per_s = 1.0"))
    with dea_rig("run", scene, slow, "-o", log, "--ports", ports, "--arm") as run:
        try:
            assert run.stderr is not None

            said: list[str] = []

            def wait_for(words: str) -> None:
                for line in run.stderr or ():
                    said.append(line)
                    if words in line:
                        return
                raise AssertionError(f"never said: {words}; but: {said}")

            wait_for("High voltage up to 800 V")
            assert "Answered" in other_terminal("continue", "800\n")
            wait_for("0 to 6 mm at 800 V")
            run.send_signal(signal.SIGTSTP)  # Ctrl-Z does not freeze it: it pauses
            wait_for("Paused: the stage stands, the voltage is off")
            assert "paused already" in other_terminal("pause")
            assert "Answered" in other_terminal("continue", "800\n")
            wait_for("0 to 6 mm at 800 V")
            assert "The run has ended" in other_terminal("stop")
            assert run.wait(10) == 130
        finally:
            run.kill()
    told = [m.fields["command"] for m in read_log(log).messages("/command") if m.fields["device"] == "hv"]
    ramp = ["arm", "set_voltage", "switch_on"]
    assert told == [*ramp, "switch_off", *ramp, "switch_off"]
    outcome = read_log(log).outcome
    assert outcome is not None and outcome["status"] == "stopped" and outcome["safe"] == "yes"
    assert not list(tmp_path.glob("dea-rig/*"))


def other_terminal(word: str, typed: str = "") -> str:
    """What ``dea-rig WORD`` says, with ``typed`` typed into it."""
    command = [sys.executable, "-m", "rig", word]
    done = subprocess.run(command, input=typed, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
