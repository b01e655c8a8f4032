"""Breakdown tests from the bench to the statistics: films of known strength, one of which bears the ceiling."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner

from rig.analysis.breakdown_logs import log_rows
from rig.cli.app import main
from rig.log.writer import LogWriter
from tests.protocols import TO_THE_FILM

SCENES = Path(str(files("sim_fixtures"))) / "scenes"
PROTOCOL = (
    TO_THE_FILM
    + """[[step]]
do = "ramp"
displacement_mm = 3.0
speed_mm_per_s = 4.0
[[step]]
do = "breakdown"
ceiling_V = 1200
rate_V_per_s = 200
"""
)
STRENGTHS = {"weak": 34.0, "middle": 38.0, "strong": 41.0, "unbroken": 70.0}  # V/um; the ceiling is at about 47


@pytest.mark.slow
def test_films_of_known_strength_come_out_with_it_and_one_is_censored(tmp_path: Path) -> None:
    protocol = tmp_path / "breakdown.toml"
    protocol.write_text(PROTOCOL)
    logs = []
    for name, strength in STRENGTHS.items():
        text = (SCENES / "cone-4mm.toml").read_text().replace("../calibrations", str(SCENES.parent / "calibrations"))
        text = text.replace("[simulation.film]", f"[simulation.film]\nbreakdown_field_MV_per_m = {strength}")
        text = text.replace('name = "cone-4mm"', f'name = "{name}"')
        for far, near in (
            ("approach_from_mm = 36.0", "approach_from_mm = 13.0"),
            ("contact_position_mm = 40.0", "contact_position_mm = 17.0"),
        ):
            assert far in text
            text = text.replace(far, near)
        scene, log = tmp_path / f"{name}.toml", tmp_path / f"{name}.mcap"
        scene.write_text(text)
        done = CliRunner().invoke(main, ["run", str(scene), str(protocol), "-o", str(log), "--arm", "--yes"])
        assert done.exit_code == 0, done.output
        assert name == "unbroken" or "breakdown at" in done.output
        logs.append(str(log))
    out = tmp_path / "out.json"
    done = CliRunner().invoke(
        main, ["analyse", "breakdown", *logs, "--value", "field-at-disk", "--simulated", "200", "-o", str(out)]
    )
    assert done.exit_code == 0, done.output
    found = json.loads(out.read_text())
    specimens = {one["specimen"]: one for one in found["specimens"]}
    assert set(specimens) == set(STRENGTHS)
    for name, strength in STRENGTHS.items():
        if name == "unbroken":
            assert not specimens[name]["failed"]
        else:
            assert specimens[name]["failed"]
            assert specimens[name]["value"] == pytest.approx(strength * 1e6, rel=0.06), name


@pytest.mark.parametrize(("name", "no_current"), [("cone-4mm", False), ("other-instruments", True)])
def test_breakdowns_on_a_supply_without_a_current_are_upper_bounds_by_the_scene_in_the_log(
    tmp_path: Path, name: str, no_current: bool
) -> None:
    path = tmp_path / "run.mcap"
    with LogWriter(path) as log:
        log.attach("scene.toml", "application/toml", (SCENES / f"{name}.toml").read_bytes())
        result = {"t_s": 1.0, "kind": "breakdown", "standard_uncertainty": 0.0, "name": "field", "unit": "V/m"}
        for step, outcome in ((4, "breakdown"), (5, "ceiling")):
            log.write("/result", result | {"step": step, "outcome": outcome, "value": 40e6}, step, step)
        log.finish({"status": "complete"})
    assert [row["upper_bound"] for row in log_rows(path, "field")] == [no_current, False]


def test_a_log_without_such_a_step_is_refused_by_name() -> None:
    some = Path(str(files("sim_fixtures"))) / "logs" / "paper" / "log.mcap"
    done = CliRunner().invoke(main, ["analyse", "breakdown", str(some)])
    assert done.exit_code == 1 and some.name in done.output and "breakdown" in done.output
