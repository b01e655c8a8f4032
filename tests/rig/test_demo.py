"""The main job: one seed gives one log, and the truth is found within the stated uncertainties."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from calibration.identify import secant_modulus
from model.materials import NAMED
from rig.cli import main
from rig.log.reader import read_log

TRUTH = NAMED["parker-cao2018"]  # what sim_fixtures/scenes/cone-*.toml hide in [simulation.film]


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    out = tmp_path_factory.mktemp("demo") / "one"
    return out, CliRunner().invoke(main, ["demo", "--out", str(out)], catch_exceptions=False)


def test_it_ends_well_and_leaves_what_it_says(demo: tuple[Path, Result]) -> None:
    out, result = demo
    assert result.exit_code == 0, result.output
    for name in ("cone-4mm.mcap", "cone-6mm.mcap", "fit.json", "report.html"):
        assert (out / name).stat().st_size > 1000, name
    assert not list(out.glob("*.part"))
    assert "Try next" in result.output


@pytest.mark.parametrize("name", ["eps_r", "stiffness"])
def test_the_truth_is_within_three_stated_uncertainties_and_they_are_small(
    demo: tuple[Path, Result], name: str
) -> None:
    found = json.loads((demo[0] / "fit.json").read_text())
    quantity = found["quantities"][name]
    at = found["stiffness_at"]
    truth = {
        "eps_r": TRUTH.eps_r,
        "stiffness": secant_modulus(TRUTH, at["meridional_stretch"], at["hoop_stretch"]),
    }[name]
    assert quantity["standard_uncertainty"] < 0.015 * truth
    assert abs(quantity["value"] - truth) < 3 * quantity["standard_uncertainty"]


def test_each_log_proves_how_it_ended(demo: tuple[Path, Result]) -> None:
    for path in demo[0].glob("*.mcap"):
        outcome = read_log(path).outcome
        assert outcome is not None
        assert outcome["status"] == "complete" and outcome["safe"] == "yes"
        assert abs(float(outcome["measured_voltage_V"])) < 60


def test_one_seed_gives_one_log(demo: tuple[Path, Result], tmp_path: Path) -> None:
    out = tmp_path / "two"
    CliRunner().invoke(main, ["demo", "--out", str(out)], catch_exceptions=False)
    for name in ("cone-4mm.mcap", "cone-6mm.mcap"):
        first, second = read_log(demo[0] / name), read_log(out / name)
        assert first.topics == second.topics and len(first.topics) > 10
        for topic in first.topics:  # as text, in which nan is nan
            one, two = (map(repr, log.messages(topic)) for log in (first, second))
            assert all(a == b for a, b in zip(one, two, strict=True)), topic
        differing = {key for key in first.metadata if first.metadata[key] != second.metadata[key]}
        assert differing <= {"host"}
        assert {k: a.data for k, a in first.attachments.items()} == {k: a.data for k, a in second.attachments.items()}


@pytest.mark.slow
def test_another_seed_gives_another_log(demo: tuple[Path, Result], tmp_path: Path) -> None:
    out = tmp_path / "other"
    CliRunner().invoke(main, ["demo", "--out", str(out), "--seed", "2"], catch_exceptions=False)
    assert (out / "cone-4mm.mcap").read_bytes() != (demo[0] / "cone-4mm.mcap").read_bytes()


def test_an_existing_directory_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    result = CliRunner().invoke(main, ["demo", "--out", str(tmp_path)])
    assert result.exit_code == 2 and "exists already" in result.output
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
