"""The main job: one seed gives one log, and the truth is found within the stated uncertainties."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from calibration.film.identify import secant_modulus
from model.material.materials import NAMED
from rig.cli import demo as demo_module
from rig.cli.app import main
from rig.log.reader import read_log
from rig.protocol import experiment
from rig.protocol.experiment import prepare
from rig.run.run import run

pytestmark = pytest.mark.slow  # the whole of it, two films

LOGS = ("cone-4mm.mcap", "cone-6mm.mcap")
TRUTH = NAMED["parker-cao2018"]  # what sim_fixtures/scenes/cone-*.toml hide in [simulation.film]


def with_short_holds(scene: Path, protocol: Path) -> experiment.Experiment:
    text = protocol.read_text(encoding="utf-8")
    assert "hold_s = 40.0" in text
    protocol.write_text(text.replace("hold_s = 40.0", "hold_s = 8.0"), encoding="utf-8")
    return prepare(scene, protocol)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    out = tmp_path_factory.mktemp("demo") / "one"
    return out, CliRunner().invoke(main, ["demo", "--out", str(out)], catch_exceptions=False)


def test_it_ends_well_and_leaves_what_it_says(demo: tuple[Path, Result]) -> None:
    out, result = demo
    assert result.exit_code == 0, result.output
    for name in (*LOGS, "fit.json", "report.html"):
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
    assert quantity["standard_uncertainty_given_dimensions"] < 0.03 * truth
    assert quantity["standard_uncertainty"] < 0.08 * truth  # 5 % of the thickness, which nobody measured
    assert abs(quantity["value"] - truth) < 3 * quantity["standard_uncertainty"]


def test_each_log_proves_how_it_ended(demo: tuple[Path, Result]) -> None:
    for path in demo[0].glob("*.mcap"):
        outcome = read_log(path).outcome
        assert outcome is not None
        assert outcome["status"] == "complete" and outcome["safe"] == "yes"
        assert abs(float(outcome["measured_voltage_V"])) < 60


@pytest.mark.long  # of shorter runs: tests/rig/scene/test_other_instruments.py
def test_one_seed_gives_one_log(demo: tuple[Path, Result], tmp_path: Path) -> None:
    """The files that the demonstration left make its log again, with the same origin to the byte."""
    left = demo[0]
    first = read_log(left / "cone-4mm.mcap")
    origin = {name: first.metadata[name] for name in ("versions", "host")}
    again = tmp_path / "again.mcap"
    run(prepare(left / "scenes/cone-4mm.toml", left / "protocols/paper.toml"), again, lambda *_: None, origin=origin)
    assert len(first.topics) > 10
    assert again.read_bytes() == first.path.read_bytes()


def test_another_seed_gives_another_log(demo: tuple[Path, Result]) -> None:
    """The second film's seed is one more than the first's, not the scene's own; an unloaded cell has its noise."""
    logs = [read_log(demo[0] / name) for name in LOGS]
    assert [
        next(line for line in log.attachments["scene.toml"].data.decode().splitlines(True) if line.startswith("seed"))
        for log in logs
    ] == ["seed = 1\n", "seed = 2\n"]
    one, other = (log.columns("/force/sample")["reading"][:50] for log in logs)
    assert (one != other).mean() > 0.9


def test_an_existing_directory_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    result = CliRunner().invoke(main, ["demo", "--out", str(tmp_path)])
    assert result.exit_code == 2 and "exists already" in result.output
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.timeout(600)
@pytest.mark.parametrize("branches", [pytest.param(2, marks=pytest.mark.long), 1])
def test_a_film_that_relaxes_is_found_with_its_branches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, branches: int
) -> None:
    """As it is; and with shorter holds and one branch, which takes a quarter of the time."""
    out = tmp_path / "viscous"
    if branches == 1:
        monkeypatch.setattr(demo_module, "BRANCHES", ((0.3, 2.0),))
        monkeypatch.setattr(experiment, "prepare", with_short_holds)
    result = CliRunner().invoke(main, ["demo", "--viscous", "--out", str(out)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    found = json.loads((out / "fit.json").read_text())
    assert len(found["spectrum"]["branches"]) == branches
    # Terms that the data do not determine are no more certain than that.
    known = {
        "eps_r": TRUTH.eps_r,
        "mu1": TRUTH.mu[0],
        "mu2": TRUTH.mu[1],
        "alpha1": TRUTH.alpha[0],
        "alpha2": TRUTH.alpha[1],
    }
    for name, value in known.items():
        quantity = found["quantities"][name]
        assert abs(quantity["value"] - value) < 3 * quantity["standard_uncertainty"], name
    assert "Branches of the simulated film" in result.output
