"""A run that ended early goes on from its log: what is done again, what is refused, and that both logs fit together."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner

from rig.analysis.film import identify_logs
from rig.base.clock import VIRTUAL_EPOCH_NS
from rig.base.errors import ConfigError, Stopped
from rig.base.toml_file import parse_table
from rig.cli.app import main
from rig.log.dataset import load_run
from rig.log.reader import read_log
from rig.protocol.experiment import prepare
from rig.protocol.plan import plan, plan_from
from rig.protocol.protocol import Protocol
from rig.run.resume import prepare_resumed
from rig.run.run import run
from rig.scene.scene import Scene, load_scene
from tests.protocols import near

SCENE = Path(str(files("sim_fixtures"))) / "scenes" / "cone-4mm.toml"
PROTOCOL = """
[[step]]
do = "home"
[[step]]
do = "prompt"
text = "Mount the specimen"
[[step]]
do = "zero"
duration_s = 0.5
[[step]]
do = "approach"
speed_mm_per_s = 4.0
threshold_mN = 8.0
max_travel_mm = 8.0
[[step]]
do = "precondition"
displacement_mm = 6.0
speed_mm_per_s = 4.0
cycles = 1
[[step]]
do = "sweep"
displacement_mm = 7.0
speed_mm_per_s = 2.0
voltages_V = [0]
[[step]]
do = "ramp"
displacement_mm = 4.0
speed_mm_per_s = 2.0
[[step]]
do = "voltage"
voltage_V = 1000
settle_s = 0.2
[[step]]
do = "ramp"
displacement_mm = 7.0
speed_mm_per_s = 2.0
[[step]]
do = "return"
speed_mm_per_s = 4.0
"""
MINUTE_NS = 60 * 10**9


def stop_when(words: str):
    def progress(done: float, total: float, label: str) -> None:
        if words in label:
            os.kill(os.getpid(), signal.SIGINT)

    return progress


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a run that was stopped in its ninth step, with 1000 V on."""
    folder = tmp_path_factory.mktemp("stopped")
    protocol = folder / "protocol.toml"
    protocol.write_text(PROTOCOL)
    log, scene = folder / "first.mcap", folder / "scene.toml"
    scene.write_text(near(SCENE.read_text().replace("../calibrations", (SCENE.parents[1] / "calibrations").as_posix())))
    with pytest.raises(Stopped):
        run(prepare(scene, protocol), log, stop_when("step 9 ramp"))
    return log


def kinds(log: Path) -> list[str]:
    return [f"{phase.step} {phase.kind}" for phase in load_run(log).phases]


@pytest.mark.slow
def test_the_rest_is_carried_out_and_fits_together_with_the_beginning(stopped: Path) -> None:
    second = stopped.with_name("second.mcap")
    result = CliRunner().invoke(main, ["resume", str(stopped), "-o", str(second)])
    assert result.exit_code == 0, result.output
    preamble = ["9 prompt", "1 home", "3 zero", "4 approach", "5 precondition", "5 precondition"]
    assert kinds(second) == [*preamble, "9 resume", "9 resume", "9 ramp", "10 return", "10 return"]
    log = read_log(second)
    assert log.metadata["resumed"]["log"] == "first.mcap" and log.metadata["resumed"]["at_step"] == "9"
    rest = load_run(second)
    ramp = rest.phase == kinds(second).index("9 ramp")
    assert rest.h[ramp].min() == pytest.approx(4e-3, abs=0.1e-3) and rest.h[ramp].max() > 6.9e-3
    assert abs(rest.voltage[ramp] - 1000).max() < 20
    found = identify_logs([stopped, second], terms=1)
    assert {curve.run for curve in found.curves} == {"first.mcap", "second.mcap"}
    assert found.identification.reduced_chi_square == pytest.approx(1.0, abs=0.2)
    eps_r = found.identification.quantities["eps_r"]
    assert abs(eps_r.value - 1.7) < 2.6 * eps_r.uncertainty < 0.4


@pytest.mark.parametrize(("minutes", "again"), [(30, False), (90, True), (-1, True)])
def test_preconditioning_is_not_done_again_while_it_holds(stopped: Path, minutes: int, again: bool) -> None:
    experiment = prepare_resumed(stopped, now_ns=VIRTUAL_EPOCH_NS + MINUTE_NS * minutes)
    assert ("precondition" in [action.kind for action in experiment.actions]) is again
    assert [action.kind for action in experiment.actions][:4] == ["prompt", "home", "zero", "approach"]


def test_the_instruments_must_be_those_of_the_log(stopped: Path) -> None:
    experiment = prepare_resumed(stopped)
    assert experiment.scene.stage.serial == "50443" and experiment.scene.force.serial == "14209876"
    raw = experiment.scene.model_dump(exclude_none=True)
    raw["stage"]["serial"] = "4711"
    other = replace(experiment, scene=Scene.model_validate(raw))
    with pytest.raises(ConfigError, match="4711"):
        run(other, stopped.with_name("swapped.mcap"), lambda done, total, label: None)


def test_the_zero_of_the_first_run_is_the_reference_of_the_second(stopped: Path) -> None:
    zero = next(m.fields["value"] for m in read_log(stopped).messages("/reference") if m.fields["name"] == "force_zero")
    assert prepare_resumed(stopped).stored_zero == zero


def test_a_run_that_came_to_its_end_is_not_resumed(stopped: Path) -> None:
    log = read_log(stopped)
    assert log.outcome is not None
    log.outcome["status"] = "complete"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rig.run.resume.read_log", lambda path: log)
        with pytest.raises(ConfigError, match="came to its end"):
            prepare_resumed(stopped)


def test_every_step_can_be_gone_on_with() -> None:
    scene, _ = load_scene(SCENE)
    protocol = parse_table(PROTOCOL, Protocol, "protocol", "test")
    whole = plan(protocol, scene)
    for first in range(1, 10):
        resumed = plan_from(protocol, scene, first)
        at = next(i for i, action in enumerate(resumed) if action.step >= first and action.kind != "resume")
        rest = [action for action in whole if action.step >= first]
        assert resumed[at:] == rest, first
        before = resumed[at - 1] if at else None
        if before is not None and rest[0].h[0] > 0:
            assert before.h[1] == rest[0].h[0] and before.voltage[1] == rest[0].voltage[0]
    with pytest.raises(ConfigError, match="Nothing but the way back"):
        plan_from(protocol, scene, 10)


@pytest.mark.parametrize("board", ["HVPS 7, serial 3", "serial 3, firmware 9; x", "counted: 1"])
def test_a_board_may_be_called_anything(tmp_path, board):
    """Its label is no serial number: the board has none, and none is asked for when the run goes on."""
    scene = (SCENE.parent / "other-instruments.toml").read_text()
    scene = scene.replace("[simulation.hv]", f'[simulation.hv]\nboard = "{board}"')
    assert board in scene
    for name in ("force-can", "displacement", "hv-shvps"):
        scene = scene.replace(
            f"../calibrations/{name}.toml", str(SCENE.parent.parent / "calibrations" / f"{name}.toml")
        )
    (tmp_path / "scene.toml").write_text(scene)
    (tmp_path / "protocol.toml").write_text(PROTOCOL)
    experiment = prepare(tmp_path / "scene.toml", tmp_path / "protocol.toml")
    with pytest.raises(Stopped):
        run(experiment, tmp_path / "a.mcap", stop_when("zero"))
    resumed = prepare_resumed(tmp_path / "a.mcap")
    assert resumed.scene.hv.serial is None
    assert resumed.scene.force.serial == "77120"
    with pytest.raises(Stopped):  # who answers is who is wanted
        run(resumed, tmp_path / "b.mcap", stop_when("zero"))
