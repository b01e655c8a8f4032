"""A run that an instrument's fault has ended is verified and run again like any other."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest

from drivers.links.link import DeviceError
from rig.base.errors import RigError
from rig.benchmark.fixtures import LOGS
from rig.protocol.experiment import prepare
from rig.replay.recording import load_recording
from rig.replay.rerun import rerun
from rig.replay.verify import verify
from rig.run.run import run

pytestmark = pytest.mark.slow

AT_S = 12.5  # in a sweep, at 1000 V


@pytest.mark.parametrize(
    ("role", "kind", "duration_s", "links"),
    [
        ("stage", "silent", None, {}),
        ("stage", "reset", None, {}),
        ("stage", "vanish", 0.6, {"gone": 1, "back": 1}),
        ("force", "vanish", None, {"gone": 1}),
        ("hv", "silent", None, {}),
        ("hv", "vanish", 0.6, {"gone": 1, "back": 1}),
    ],
)
def test_it_comes_out_the_same(
    tmp_path: Path, role: str, kind: str, duration_s: float | None, links: dict[str, int]
) -> None:
    fault = f'[[simulation.fault]]\nrole = "{role}"\nkind = "{kind}"\nat_s = {AT_S}\n'
    if duration_s is not None:
        fault += f"duration_s = {duration_s}\n"
    fixture = LOGS / "no-laser"
    scene, log = tmp_path / "scene.toml", tmp_path / "run.mcap"
    text = (fixture / "scene.toml").read_text().replace('"../', f'"{fixture}/../')
    # Its film pulls in before it has its strength, and where it does takes long to find.
    stiffening = text.replace("mu_Pa = [80e3]\nalpha = [2.5]", "mu_Pa = [5e3, 35e3]\nalpha = [2.5, 5.6]")
    assert stiffening != text
    scene.write_text(stiffening + fault)
    with contextlib.suppress(RigError, DeviceError):
        run(prepare(scene, fixture / "protocol.toml"), log, lambda done, total, label: None)
    recording = load_recording(log)
    assert recording.log.outcome is not None
    assert recording.log.outcome["status"] in ("fault", "NOT SAFE")
    told = [row.topic.split("/") for row in recording.rows if row.topic.endswith(("/gone", "/back"))]
    assert {way: sum(one[-1] == way for one in told) for way in links} == links
    assert all(one[2] == role for one in told)
    if kind in ("silent", "reset"):  # what is lost tells it by its link
        assert any(row.topic == f"/raw/{role}/failed" for row in recording.rows)
    verified = verify(recording)
    assert verified.exit_code == 0, verified.report
    again = rerun(recording)
    assert again.exit_code == 0, again.report
