"""`plan` for a film that takes time: quick moves with holds."""

from pathlib import Path
from shutil import copytree

import pytest

from rig.analysis.relax_proposal import propose_relaxation
from rig.protocol.plan import plan
from rig.protocol.protocol import load_protocol
from rig.scene.scene import load_scene

FIXTURES = Path(__file__).parents[3] / "sim_fixtures"


@pytest.mark.slow
def test_quick_moves_with_holds_are_proposed_and_tell_more_than_the_sweep(tmp_path: Path) -> None:
    for folder in ("scenes", "calibrations"):
        copytree(FIXTURES / folder, tmp_path / folder)
    path = tmp_path / "scenes" / "cone-4mm.toml"
    branches = "branches = [{ratio = 0.1, time_s = 1.0}, {ratio = 0.1, time_s = 30.0}]"
    path.write_text(path.read_text().replace("max_stretch = 2.4\n", f"max_stretch = 2.4\n{branches}\n", 1))
    found = propose_relaxation(path, 360.0)
    (tmp_path / "planned.toml").write_text(found.text)
    protocol, _ = load_protocol(tmp_path / "planned.toml")
    scene, _ = load_scene(path)
    relax = [step for step in protocol.step if step.kind == "relax"]
    assert len(relax) == 3
    assert all(step.model_dump()["hold_s"] > 5.0 for step in relax)
    assert max(step.model_dump()["speed_mm_per_s"] for step in relax) >= 0.3 * scene.limits.speed_mm_per_s
    assert sum(action.duration for action in plan(protocol, scene)) <= 360.0
    for name, value in found.planned.expected.items():
        assert value < found.sweep.expected[name], name
