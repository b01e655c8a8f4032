"""The stage in place of a bias: stroke and work that it measures, on the simulated bench."""

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner

from model.actuator.bias import Bistable, Mass, Spring
from model.actuator.equilibrium import Actuator
from rig.analysis.fit_file import read_fit
from rig.analysis.strokes import strokes
from rig.base.errors import FaultError, LimitError
from rig.cli.app import main
from rig.log.dataset import load_run
from rig.log.reader import read_log
from rig.protocol.experiment import prepare
from rig.run.run import run
from rig.scene.scene import load_scene
from rig.steps.follow import rest_from

DRAWN = 30  # films from a covariance: their scatter is known to 13 %


def nobody(done, total, label):
    """Progress that nobody looks at."""


@pytest.fixture(scope="module")
def short(tmp_path_factory, write_bench):
    """One release against a mass."""
    folder = tmp_path_factory.mktemp("mass")
    near = "approach_from_mm = 36.0 -> approach_from_mm = 3.0\ncontact_position_mm = 40.0 -> contact_position_mm = 4.0"
    run(prepare(*write_bench(folder, ["mass"], [1300.0], near, average_s=2.0)), folder / "log.mcap", nobody)
    return folder / "log.mcap"


def test_stroke_and_work_are_the_models_within_their_uncertainty(short):
    (found,) = strokes(short)
    assert found.stroke > 0.5e-3
    assert abs(found.stroke - found.expected_stroke) <= 3 * found.stroke_uncertainty
    assert found.stroke_uncertainty < 0.02 * found.stroke
    assert abs(found.work - found.expected_work) <= 3 * found.work_uncertainty
    assert found.work_uncertainty < 0.1 * found.work


def test_the_true_film_balances_the_law_at_rest(short):
    """Not what the sensors say: the simulation's own film at the simulation's own displacement."""
    data = load_run(short)
    scene = data.scene
    from model.membrane.solve import solve
    from rig.base.toml_file import parse_table
    from rig.scene.scene import Scene

    film = parse_table(scene, Scene, "scene", "inside").specimen.specimen()
    for phase, after in zip(data.phases, data.phases[1:], strict=False):
        if phase.kind == "rest":
            inside = (data.t >= phase.t) & (data.t < after.t)
            h, volts = float(data.h[inside].mean()), float(data.voltage[inside].mean())
            pull = solve(film, h, volts if phase.voltage else 0.0).force
            assert pull == pytest.approx(0.25, abs=6e-3), phase  # 6 mN are 0.1 mm: how far a noisy loop is off


def test_voltage_and_stage_end_safe(short):
    outcome = read_log(short).outcome
    assert (outcome["status"], outcome["safe"], outcome["stage_standing"]) == ("complete", "yes", "yes")


def test_table_and_picture(short, tmp_path):
    arguments = ["stroke", str(short), "-o", str(tmp_path / "s.csv"), "--picture", str(tmp_path / "s.png")]
    said = CliRunner().invoke(main, arguments)
    assert said.exit_code == 0, said.output
    heading, row = (tmp_path / "s.csv").read_text().split()
    values = dict(zip(heading.split(","), row.split(","), strict=True))
    assert float(values["stroke_m"]) == pytest.approx(strokes(short)[0].stroke, rel=1e-6)
    assert (tmp_path / "s.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_what_a_fit_does_not_know_is_told(short, tmp_path):
    """First order against drawn films: the expectation's uncertainty is that of the fit."""
    relative = {"mu1": 0.004, "alpha1": 0.003, "mu2": 0.002, "alpha2": 0.002, "eps_r": 0.01}
    true = {"mu1": 5e3, "alpha1": 2.5, "mu2": 35e3, "alpha2": 5.6, "eps_r": 1.7}
    fit = {
        "terms": 2,
        "parameters": list(true),
        "covariance": np.diag([(relative[name] * value) ** 2 for name, value in true.items()]).tolist(),
        "quantities": {
            name: {"value": value, "standard_uncertainty": relative[name] * value} for name, value in true.items()
        },
    }
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(fit))
    (found,) = strokes(short, path)
    rng = np.random.default_rng(3)
    specimen = load_scene_of_fixture()[0].specimen.specimen()
    drawn = []
    for _ in range(DRAWN):
        values = {name: value * (1 + relative[name] * rng.standard_normal()) for name, value in true.items()}
        for name, value in values.items():
            fit["quantities"][name]["value"] = value
        path.write_text(json.dumps(fit))
        film = read_fit(path, specimen.material).material
        actuator = Actuator(specimen.with_material(film), Mass(0.25))
        rest = rest_from(actuator, 0.0, 0.0, 20e-3)
        drawn.append(rest_from(actuator, rest, found.voltage, 20e-3) - rest)
    assert found.expected_stroke_uncertainty == pytest.approx(np.std(drawn, ddof=1), rel=0.4)
    assert found.expected_stroke == pytest.approx(np.mean(drawn), abs=3 * np.std(drawn) / math.sqrt(DRAWN))


def test_a_rest_is_the_next_stable_balance_that_way():
    scene, _ = load_scene_of_fixture()
    film = scene.specimen.specimen()
    middle = 8e-3
    snap = Actuator(film, Bistable(middle=middle, offset=0.15, rate=150.0, cubic=1.2e7))
    low, high = rest_from(snap, 0.0, 0.0, 14e-3), rest_from(snap, 14e-3, 0.0, 14e-3)
    assert low < middle < high
    assert rest_from(snap, low + 1e-4, 0.0, 14e-3) == pytest.approx(low, abs=1e-7)
    assert rest_from(Actuator(film, Mass(5.0)), 0.0, 0.0, 14e-3) is None
    rest = rest_from(Actuator(film, Spring(0.5, 30.0)), 0.0, 0.0, 14e-3)
    from model.membrane.solve import solve

    assert solve(film, rest).force == pytest.approx(0.5 - 30.0 * rest, rel=1e-6)


def load_scene_of_fixture():
    from importlib.resources import files
    from pathlib import Path

    return load_scene(Path(str(files("sim_fixtures"))) / "scenes" / "cone-4mm.toml")


def test_a_law_without_rest_within_the_limits_is_refused(tmp_path, write_bench):
    scene, protocol = write_bench(tmp_path, ["mass"], [1000.0])
    protocol.write_text(protocol.read_text().replace("weight_N = 0.25", "weight_N = 0.6"))
    with pytest.raises(LimitError, match="knows no rest"):
        prepare(scene, protocol)


def test_it_must_begin_in_contact(tmp_path, write_bench):
    scene, protocol = write_bench(tmp_path, ["mass"], [1000.0])
    approach = protocol.read_text().index('[[step]]\ndo = "approach"')
    follow = protocol.read_text().index('[[step]]\ndo = "follow"')
    text = protocol.read_text()
    protocol.write_text(text[:approach] + text[follow:])
    with pytest.raises(LimitError, match="needs the contact position"):
        prepare(scene, protocol)


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "laws",
    [
        pytest.param(["antagonist"], marks=pytest.mark.long),  # with five times the noise in CI: below
        pytest.param(["spring", "mass", "antagonist"], marks=pytest.mark.long),
    ],
    ids=len,
)
def test_cases_at_two_voltages_are_within_two_percent(tmp_path, write_bench, laws):
    scene, protocol = write_bench(tmp_path, laws, [1000.0, 1300.0], average_s=12.0, zero_s=5.0)
    run(prepare(scene, protocol), tmp_path / "log.mcap", nobody)
    found = strokes(tmp_path / "log.mcap")
    assert [one.kind for one in found] == [law for law in laws for _ in range(2)]
    for one in found:
        assert abs(one.deviation) < 0.02, one
        assert abs(one.stroke - one.expected_stroke) <= 3 * one.stroke_uncertainty, one


NOISY = """noise_fraction = 0.005 -> noise_fraction = 0.025
clock_drift_ppm = 40.0 -> clock_drift_ppm = 40.0\\nlink = { latency_ms = 50.5 }"""


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "law", [*(pytest.param(law, marks=pytest.mark.long) for law in ("spring", "mass")), "antagonist"]
)
def test_five_times_the_noise_and_fifty_milliseconds_more(tmp_path, write_bench, law):
    """It rests where it should, or it says why it does not; it never runs away."""
    truth = NOISY.replace("\\n", "@@")
    scene, protocol = write_bench(tmp_path, [law], [1300.0], truth, threshold_mN=30.0, average_s=5.0)
    scene.write_text(scene.read_text().replace("@@", "\n"))
    try:
        run(prepare(scene, protocol), tmp_path / "log.mcap", nobody)
    except FaultError as error:
        assert "no rest" in str(error)
    log = tmp_path / "log.mcap"
    data = load_run(log if log.exists() else tmp_path / "log.mcap.part")
    assert data.log.outcome["safe"] == "yes"
    for phase, after in zip(data.phases, data.phases[1:], strict=False):
        if phase.kind == "release":  # its last two seconds: no swing
            late = (data.t > after.t - 2.0) & (data.t < after.t)
            assert np.ptp(data.h[late]) < 2e-3
    if log.exists():
        (one,) = strokes(log)
        assert abs(one.stroke - one.expected_stroke) <= 4 * one.stroke_uncertainty
