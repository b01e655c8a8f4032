"""A protocol step is added by one file outside the tree, named by an entry point of another distribution."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import pytest

from rig.log.dataset import load_run
from tests.elsewhere import dea_rig

SCENES = Path(str(files("sim_fixtures"))) / "scenes"
STEP = '''
"""``do = "knock"``: the disk goes in and out a little, several times."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from pydantic import Field

from rig.base.errors import LimitError
from rig.steps.base import Action, Positive, Step
from rig.steps.turns import go


class Knock(Step):
    """Go in and out a little, several times."""

    needs_contact: ClassVar[bool] = True
    records: ClassVar[bool] = True

    do: Literal["knock"] = Field(description="The kind of step.")
    depth_mm: Positive = Field(description="How deep (mm). Typical: 0.5 to 1.")
    times: int = Field(default=2, ge=1, le=10, description="How often.")

    def plan(self, state, scene):
        depth = self.depth_mm * 1e-3
        if depth > 1e-3:
            raise LimitError(f"{self.where(state.number)}: more than 1 mm is no knock.")
        for cycle in range(1, self.times + 1):
            yield Knocking(
                by=self, step=state.number, label=f"knock {cycle}", h=(state.h, state.h + depth), duration=2.0,
                speed=2e-3, cycle=cycle, record=True,
            )
            state.h += depth


@dataclass(frozen=True, kw_only=True)
class Knocking(Action):
    def carry_out(self, rig):
        yield from go(rig, self.h[1], self.speed, self.allowed_s)
'''
PROTOCOL = """
title = "With a step from elsewhere"
[[step]]
do = "home"
[[step]]
do = "zero"
[[step]]
do = "approach"
speed_mm_per_s = 2.0
max_travel_mm = 8.0
threshold_mN = 8.0
[[step]]
do = "knock"
depth_mm = 0.8
times = 3
[[step]]
do = "return"
"""


@pytest.fixture
def other_package(tmp_path: Path) -> Path:
    (tmp_path / "knocking.py").write_text(STEP)
    about = tmp_path / "knocking_for_rigs-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: knocking-for-rigs\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[dea_rig.steps]\nknock = knocking:Knock\n")
    (tmp_path / "protocol.toml").write_text(PROTOCOL)
    return tmp_path


def test_the_step_is_checked_run_recorded_and_replayed(other_package: Path) -> None:
    scene, protocol, log = other_package / "scene.toml", other_package / "protocol.toml", other_package / "run.mcap"
    text = (SCENES / "no-hv.toml").read_text().replace("../calibrations", str(SCENES.parent / "calibrations"))
    text = text.replace("approach_from_mm = 36.0", "approach_from_mm = 5.0")  # less way to go
    text = text.replace("seed = 7", "seed = 7\ncontact_position_mm = 7.0")
    scene.write_text(text + "\n[simulation.stage]\nstart_position_mm = 2.0\n")
    checked, told, done, replayed = dea_rig(
        str(other_package),
        ["check", scene, protocol],
        ["keys", "knock"],
        ["run", scene, protocol, "-o", log],
        ["replay", log],
    )
    assert checked.returncode == 0, checked.stderr
    assert "knock: knock 3" in checked.stdout
    assert told.returncode == 0 and "How deep (mm). Typical: 0.5 to 1." in told.stdout, told.stderr
    assert done.returncode == 0, done.stderr
    assert replayed.returncode == 0, replayed.all
    run = load_run(log, {})
    assert [(p.cycle, p.direction) for p in run.phases if p.kind == "knock" and p.record] == [(1, 1), (2, 1), (3, 1)]
    assert max(h for h in run.h if h == h) > 2.3e-3


def test_its_errors_list_its_own_keys_and_its_plan_refuses_in_the_family(other_package: Path) -> None:
    changes = [("times = 3", "time = 3"), ("depth_mm = 0.8", "depth_mm = 3"), ('"knock"', '"knok"')]
    protocols = [other_package / f"protocol-{number}.toml" for number in range(len(changes))]
    for path, change in zip(protocols, changes, strict=True):
        path.write_text(PROTOCOL.replace(*change))
    scene = SCENES / "no-hv.toml"
    key, depth, name = dea_rig(str(other_package), *(["check", scene, protocol] for protocol in protocols))
    assert key.returncode == 2
    assert "step 4, time: unknown key; did you mean times? Allowed here: depth_mm, do, times." in key.stderr
    where = f"{protocols[1]} on {scene}"
    assert (depth.returncode, depth.stderr) == (3, f"{where}: Step 4 (knock): more than 1 mm is no knock.\n")
    assert name.returncode == 2 and 'did you mean "knock"?' in name.stderr


SPOILT = {
    "knock": ("import no_such_module_at_all\n", "no_such_module_at_all"),
    "rap": ("Knock = 7\n", "is no rig.steps.base.Step"),
    "bang": (STEP.replace('"knock"', '"tap"'), "its `do` is 'tap'"),
    "thud": (STEP.replace('"knock"', '"thud"').replace("depth_mm: Positive", "depth_mm: type(Step.plan)"), "schema"),
}


def test_those_that_cannot_be_loaded_name_their_package_and_leave_other_protocols_alone(tmp_path: Path) -> None:
    scene, without = SCENES / "no-hv.toml", tmp_path / "without.toml"
    beginning = PROTOCOL.split('[[step]]\ndo = "knock"')[0]
    without.write_text(beginning)
    for do, (text, _) in SPOILT.items():
        (tmp_path / f"package_{do}.py").write_text(text)
        about = tmp_path / f"{do}_for_rigs-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {do}-for-rigs\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text(f"[dea_rig.steps]\n{do} = package_{do}:Knock\n")
        (tmp_path / f"{do}.toml").write_text(f'{beginning}[[step]]\ndo = "{do}"\ndepth_mm = 0.8\n')
    commands = [["check", scene, tmp_path / f"{do}.toml"] for do in SPOILT]
    *done, other = dea_rig(str(tmp_path), *commands, ["check", scene, without])
    for (do, (_, words)), one in zip(SPOILT.items(), done, strict=True):
        assert one.returncode == 2 and "Traceback" not in one.stderr
        assert f"package {do}-for-rigs" in one.stderr and words in one.stderr
    assert other.returncode == 0, other.stderr


@pytest.mark.slow
def test_a_name_of_the_programs_own_is_not_taken_over(other_package: Path) -> None:
    about = other_package / "knocking_for_rigs-1.0.dist-info" / "entry_points.txt"
    about.write_text("[dea_rig.steps]\nhome = knocking:Knock\n")
    protocol = other_package / "protocol.toml"
    protocol.write_text('[[step]]\ndo = "home"\n')
    (done,) = dea_rig(str(other_package), ["check", SCENES / "no-hv.toml", protocol])
    assert done.returncode == 0 and "find the reference position" in done.stdout
