"""One rule for what is real: only the pseudo-terminals that `dea-rig sim` printed, and the bench in memory, are not."""

from __future__ import annotations

import json
import os
from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from rig.analysis.film import _check_one_kind
from rig.base.errors import ConfigError, DataError
from rig.cli.app import main
from rig.log.contents import IN_MEMORY, ON_PORTS, ON_SERVED_PORTS
from rig.protocol.experiment import SERVED_BY, SERVER, Experiment, prepare
from rig.run.resume import _check_bench
from rig.run.run import Consent, run

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")

FIXTURES = Path(str(files("sim_fixtures")))
SCENE, PROTOCOL = FIXTURES / "scenes" / "cone-4mm.toml", FIXTURES / "protocols" / "short.toml"
REAL = "/dev/ttyUSB77"


@pytest.fixture
def terminal() -> str:
    master, slave = os.openpty()
    try:
        yield os.ttyname(slave)  # type: ignore[misc]
    finally:
        os.close(master)
        os.close(slave)


def ports(port: str, hv: str) -> dict[str, dict[str, str]]:
    bus = {"interface": "slcan", "can_channel": hv}
    return {"stage": {"port": port}, "force": {"port": port}, "displacement": {"port": port}, "hv": bus}


def experiment(wanted: dict[str, dict[str, str]], *, marked: bool) -> Experiment:
    return prepare(SCENE, PROTOCOL, {**wanted, **({SERVED_BY: SERVER} if marked else {})})  # type: ignore[arg-type]


def test_only_pseudo_terminals_that_the_simulation_printed_are_simulated(terminal: str, tmp_path: Path) -> None:
    assert prepare(SCENE, PROTOCOL).bench == IN_MEMORY
    assert experiment(ports(terminal, terminal), marked=True).bench == ON_SERVED_PORTS
    assert experiment(ports(terminal, terminal), marked=False).bench == ON_PORTS
    assert experiment(ports(terminal, REAL), marked=True).bench == ON_PORTS  # somebody changed the file
    assert experiment(ports(REAL, terminal), marked=True).bench == ON_PORTS
    named = tmp_path / "by-another-name"
    named.symlink_to(terminal)
    assert experiment(ports(str(named), terminal), marked=True).bench == ON_SERVED_PORTS
    named.unlink()
    named.symlink_to(REAL)
    assert experiment(ports(str(named), terminal), marked=True).bench == ON_PORTS


def invoke(tmp_path: Path, scene: Path, *options: str) -> Result:
    return CliRunner().invoke(main, ["run", str(scene), str(PROTOCOL), "-o", str(tmp_path / "run.mcap"), *options])


@pytest.mark.parametrize("by", ["scene", "file"])
def test_yes_never_arms_real_ports(tmp_path: Path, terminal: str, by: str) -> None:
    """The scene still has its [simulation] table, as the examples' have: that says nothing about its ports."""
    scene, options = SCENE, ["--arm", "--yes"]
    wanted = ports(terminal, terminal)
    if by == "file":
        (tmp_path / "ports.json").write_text(json.dumps(wanted))
        options += ["--ports", str(tmp_path / "ports.json")]
    else:
        text = SCENE.read_text().replace("../calibrations", str(FIXTURES / "calibrations"))
        for role, keys in wanted.items():
            lines = "".join(f"{key} = {json.dumps(value)}\n" for key, value in keys.items())
            assert f"[{role}]\n" in text
            text = text.replace(f"[{role}]\n", f"[{role}]\n{lines}")
        scene = tmp_path / "scene.toml"
        scene.write_text(text)
    result = invoke(tmp_path, scene, *options)
    assert result.exit_code == 2, result.output
    assert result.output.startswith("REAL PORTS: real ports")
    assert "typed by somebody who is there" in result.output and "Nothing was touched" in result.output
    assert not list(tmp_path.glob("run.mcap*"))


def test_nor_does_a_program_that_asks_for_it(terminal: str, tmp_path: Path) -> None:
    wanted = experiment(ports(terminal, terminal), marked=False)
    with pytest.raises(ConfigError, match="typed by somebody"):
        run(wanted, tmp_path / "run.mcap", lambda *_: None, Consent("a program", "a program"))


def test_a_run_is_not_taken_up_on_another_bench(terminal: str) -> None:
    in_memory = prepare(SCENE, PROTOCOL)
    served = experiment(ports(terminal, terminal), marked=True)
    real = experiment(ports(terminal, terminal), marked=False)
    for one, then in ((in_memory, ON_PORTS), (in_memory, ON_SERVED_PORTS), (served, ON_PORTS), (real, IN_MEMORY)):
        with pytest.raises(ConfigError, match="begun on another bench"):
            _check_bench(one, then, Path("run.mcap"))
    for one, then in ((in_memory, IN_MEMORY), (served, ON_SERVED_PORTS), (real, ON_PORTS), (real, "")):
        _check_bench(one, then, Path("run.mcap"))


def test_logs_of_hardware_and_simulated_ones_are_not_fitted_together() -> None:
    _check_one_kind({"a": IN_MEMORY, "b": ON_SERVED_PORTS})
    _check_one_kind({"a": ON_PORTS, "b": ON_PORTS})
    with pytest.raises(DataError, match="a: SIMULATED, b: REAL PORTS"):
        _check_one_kind({"a": IN_MEMORY, "b": ON_PORTS})
    with pytest.raises(DataError, match="different benches"):
        _check_one_kind({"a": IN_MEMORY, "b": "replay of run.mcap"})
