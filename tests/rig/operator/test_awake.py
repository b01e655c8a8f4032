"""The lock against sleep, with programs of ours in the place of the system's."""

from __future__ import annotations

import os
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rig.log.contents import ON_PORTS, ON_SERVED_PORTS
from rig.operator.awake import INHIBITOR, LEAVE_S, kept_awake
from rig.run.run import _awake

pytestmark = pytest.mark.skipif(os.name != "posix", reason="a shell script stands for the system's program")


@pytest.fixture
def inhibitor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where to write the program; it is the only one of its name on the path."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder) + os.pathsep + "/bin" + os.pathsep + "/usr/bin")
    return folder / INHIBITOR


def install(program: Path, text: str) -> None:
    program.write_text(f"#!/bin/sh\n{text}\n")
    program.chmod(0o755)


def soon(done: object, seconds: float = 5.0) -> bool:
    end = time.monotonic() + seconds
    while not done():  # type: ignore[operator]
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True


def test_the_lock_is_held_inside_and_let_go_after(inhibitor: Path, tmp_path: Path) -> None:
    held = tmp_path / "held"
    install(inhibitor, f'echo "$@" > {held}; cat > /dev/null; rm {held}')
    with kept_awake("high voltage on a film") as how:
        assert how == f"kept from going to sleep by {INHIBITOR}"
        assert soon(held.exists)
        said = held.read_text()
        assert "--what=sleep" in said and "--mode=block" in said and "--why=high voltage on a film" in said
    assert soon(lambda: not held.exists())


def test_it_is_let_go_when_the_run_fails(inhibitor: Path, tmp_path: Path) -> None:
    held = tmp_path / "held"
    install(inhibitor, f"touch {held}; cat > /dev/null; rm {held}")
    with pytest.raises(ZeroDivisionError), kept_awake("a test"):
        assert soon(held.exists)
        raise ZeroDivisionError
    assert soon(lambda: not held.exists())


def test_one_that_hangs_holds_nobody_up(inhibitor: Path, tmp_path: Path) -> None:
    number = tmp_path / "number"
    install(inhibitor, f"echo $$ > {number}; exec sleep 600")
    with kept_awake("a test"):
        assert soon(lambda: number.exists() and number.read_text().strip() != "")
        pid = int(number.read_text())
        began = time.monotonic()
    assert time.monotonic() - began < LEAVE_S + 2.0
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@pytest.mark.parametrize("how", ["missing", "refused", "no program"])
def test_where_there_is_no_lock_it_is_said_and_the_run_goes_on(
    inhibitor: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    if how == "missing":
        monkeypatch.setenv("PATH", str(inhibitor.parent))
    else:
        install(inhibitor, "exit 1")
        if how == "no program":
            inhibitor.write_bytes(b"#!/no/such/interpreter\n")
    with kept_awake("a test") as said:
        assert said.startswith("nothing keeps this computer from going to sleep") and "by hand" in said
        assert {"missing": "is missing", "refused": "ended with 1", "no program": "No such file"}[how] in said


@pytest.mark.parametrize(
    ("bench", "volts", "asked"), [(ON_PORTS, 800.0, True), (ON_PORTS, 0.0, False), (ON_SERVED_PORTS, 800.0, False)]
)
def test_it_is_asked_for_where_there_may_be_high_voltage_on_real_ports(
    inhibitor: Path, tmp_path: Path, bench: str, volts: float, asked: bool
) -> None:
    held = tmp_path / "held"
    install(inhibitor, f"touch {held}; cat > /dev/null; rm {held}")
    specimen = SimpleNamespace(name="a film")
    experiment: Any = SimpleNamespace(highest_voltage=volts, scene=SimpleNamespace(specimen=specimen))
    with _awake(experiment, bench) as said:
        assert bool(said) is asked
        assert not asked or soon(held.exists)
    assert soon(lambda: not held.exists())
