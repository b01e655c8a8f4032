"""One rule for what is real: only the pseudo-terminals that `dea-rig sim` printed, and the bench in memory, are not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from rig.analysis.film import _check_one_kind
from rig.base.clock import RealClock
from rig.base.errors import ConfigError, DataError
from rig.base.served import Announcement, _began, are_served, tcp_port
from rig.cli.app import main
from rig.log.contents import IN_MEMORY, ON_PORTS, ON_SERVED_PORTS
from rig.protocol.experiment import SERVED_BY, SERVER, Experiment, prepare
from rig.run.resume import _check_bench
from rig.run.run import Consent, run
from rig.scene.scene import load_scene
from rig.sim.bench import SimulatedBench
from rig.sim.server import Server
from rig.sim.settings import SimulationSettings

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX")

FIXTURES = Path(str(files("sim_fixtures")))
SCENE, PROTOCOL = FIXTURES / "scenes" / "cone-4mm.toml", FIXTURES / "protocols" / "short.toml"
REAL = "/dev/ttyUSB77"


@pytest.fixture
def own_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "dea-rig"


@pytest.fixture
def unserved() -> Iterator[str]:
    master, slave = os.openpty()
    try:
        yield os.ttyname(slave)
    finally:
        os.close(master)
        os.close(slave)


@pytest.fixture
def terminal(own_directory: Path, unserved: str) -> Iterator[str]:
    """One that this process says it serves."""
    announcement = Announcement()
    announcement.say([unserved])
    yield unserved
    announcement.withdraw()


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


def test_a_list_of_ports_whose_server_has_ended_is_of_real_ports(own_directory: Path, unserved: str) -> None:
    """The system has given the names to somebody else since."""
    assert experiment(ports(unserved, unserved), marked=True).bench == ON_PORTS
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    own = {"pid": os.getpid(), "began": _began(os.getpid()), "ports": [unserved]}
    file = own_directory / "served-1-0.json"
    for said, bench in (
        (own, ON_SERVED_PORTS),
        (own | {"pid": ended.pid}, ON_PORTS),  # killed: nobody withdrew it
        (own | {"began": "1"}, ON_PORTS),  # another process has its number
        (own | {"ports": ["/dev/pts/99999"]}, ON_PORTS),
        ([], ON_PORTS),
    ):
        file.write_text(json.dumps(said))
        assert experiment(ports(unserved, unserved), marked=True).bench == bench
    if Path("/proc/self/fdinfo").is_dir():
        other = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
        file.write_text(json.dumps(own | {"pid": other.pid, "began": _began(other.pid)}))
        bench = experiment(ports(unserved, unserved), marked=True).bench  # it lives, and has no such terminal
        other.communicate(b"\n")
        assert bench == ON_PORTS


def test_a_served_bench_says_which_terminals_are_its_own(own_directory: Path) -> None:
    bench = SimulatedBench(SimulationSettings(seed=1), load_scene(SCENE)[0].specimen.specimen(), {"stage", "hv"})
    server = Server(bench, RealClock())
    names = [keys.get("port", keys.get("can_channel")) for keys in server.ports.values()]
    assert are_served(map(str, names)) and not are_served(["/dev/null"])
    server.close()
    assert not are_served(map(str, names)) and not list(own_directory.glob("served-*"))


def test_a_served_bench_says_which_tcp_ports_are_its_own(own_directory: Path) -> None:
    """It counts only while that very process listens there, on this machine alone."""
    settings = SimulationSettings.model_validate({"seed": 1, "monitor": {"driver": "scpi"}})
    server = Server(SimulatedBench(settings, load_scene(SCENE)[0].specimen.specimen(), {"monitor"}), RealClock())
    name = tcp_port(int(server.ports["monitor"]["tcp_port"]))
    assert are_served([name]) and not are_served([tcp_port(9)])
    file = next(own_directory.glob("served-*"))
    said = json.loads(file.read_text())
    file.write_text(json.dumps(said | {"ports": [tcp_port(9), name]}))
    assert are_served([name])
    if Path("/proc/net/tcp").exists():
        assert not are_served([tcp_port(9)])  # nobody listens there, whatever the file says
    server.close()
    assert not are_served([name])


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
