"""Every recorded log, held against today's drivers and engine, and against the truth that was simulated."""

from __future__ import annotations

import pytest

from rig.analysis.film import identify_logs
from rig.benchmark.fixtures import LOGS, load_fixture, names
from rig.replay.rerun import rerun
from rig.replay.verify import verify

QUICK = ("killed", "no-hv", "noisy-wire")
REMAKE = "If the change is meant, make the recorded logs anew: .ci/fixtures"
ALL = [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in names()]


def whole(name):
    return load_fixture(name).expected.status != "cut short"


def test_there_is_one_of_each_kind():
    assert names() == ["breakdown", "killed", "no-hv", "no-laser", "noisy-wire", "paper", "wrinkled"]


def test_they_are_small():
    sizes = [(LOGS / name / "log.mcap").stat().st_size for name in names()]
    assert max(sizes) < 1e6
    assert sum(sizes) < 5e6


@pytest.mark.parametrize("name", names())
def test_every_sample_comes_out_of_its_bytes_again(recorded, name):
    recording = recorded(name)
    found = verify(recording)
    assert found.difference is None, f"{found.report}\n{REMAKE}"
    assert found.samples == {role: recording.log.topics[f"/{role}/sample"] for role in found.samples}
    assert found.exit_code == (0 if whole(name) else 3)


@pytest.mark.parametrize("name", ALL)
def test_the_run_asks_the_same_again_and_ends_the_same(recorded, name):
    recording = recorded(name)
    found = rerun(recording)
    assert found.exit_code == (0 if whole(name) else 3), f"{found.report}\n{REMAKE}"
    if whole(name):
        assert found.requests == {role: recording.log.topics[f"/raw/{role}/tx"] for role in found.requests}


@pytest.mark.slow
@pytest.mark.parametrize("name", names())
def test_led_through_the_recorded_turns_the_run_is_the_same(recorded, name):
    """What a run in real time needs must do no harm to one in virtual time."""
    found = rerun(recorded(name), steered=True)
    assert found.exit_code == (0 if whole(name) else 3), found.report


@pytest.mark.parametrize("name", names())
def test_the_run_ended_as_expected(recorded, name):
    log, expected = recorded(name).log, load_fixture(name).expected
    outcome = log.outcome or {"status": "cut short", "reason": "", "safe": "yes"}
    assert outcome["status"] == expected.status
    assert expected.reason in outcome["reason"]
    assert outcome["safe"] == "yes"
    assert log.ended == whole(name)
    assert not [gap for gap in log.gaps if gap.start < gap.end]


@pytest.mark.parametrize("name", names())
def test_the_truth_is_what_was_simulated(recorded, name):
    """The fixture's truth is worked out from the film that the scene simulates."""
    truth, scene = load_fixture(name).truth, recorded(name).experiment.scene
    film, believed = scene.simulation.film, scene.specimen.specimen().material
    assert truth.G_Pa == pytest.approx(film.material(believed).shear_modulus, rel=1e-12)
    assert truth.eps_r == (None if scene.hv is None else film.eps_r)


def test_the_wrinkled_run_wrinkled(recorded):
    """The model's relaxed film at the recorded displacements and voltages; the believed film stays taut there."""
    from model.membrane.solve import Status, solve_many
    from rig.log.dataset import load_run
    from rig.sim.world import true_specimen

    recording = recorded("wrinkled")
    scene = recording.experiment.scene
    believed = scene.specimen.specimen()
    run = load_run(recording.log.path)
    high = run.voltage > 1450
    h, voltage = run.h[high][::3], run.voltage[high][::3]
    true = solve_many(true_specimen(scene.simulation, believed), h, voltage, wrinkling="tension_field")
    assert (true.status == Status.WRINKLED).sum() > 5
    assert (solve_many(believed, h, voltage).status == Status.TAUT).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in names() if load_fixture(name).expected.fit is not None])
def test_the_film_is_identified(name):
    fixture = load_fixture(name)
    expected, truth = fixture.expected.fit, fixture.truth
    found = identify_logs([LOGS / name / "log.mcap"], terms=expected.terms).identification.quantities
    assert found["G"].value == pytest.approx(truth.G_Pa, rel=expected.G_relative_tolerance)
    assert ("eps_r" in found) == (truth.eps_r is not None)
    if truth.eps_r is not None:
        assert found["eps_r"].value == pytest.approx(truth.eps_r, rel=expected.eps_r_relative_tolerance)


def test_every_command_of_the_software_can_be_given_again():
    """The words that guard and engine write into a log, looked up in their texts."""
    import re
    from inspect import getsource

    from rig.engine import engine
    from rig.replay.verify import commands
    from rig.run.backend import open_bench
    from rig.safety import guard
    from rig.scene.scene import load_scene
    from rig.steps import home, rig

    written = {("hv", word) for word in re.findall(r'_tell\("(\w+)"', getsource(guard))}
    for module in (home, rig, engine):
        written |= set(re.findall(r'\.command\("(\w+)", "(\w+)"', getsource(module)))
    assert len(written) >= 10
    bench = open_bench(load_scene(LOGS.parent / "scenes" / "cone-4mm.toml")[0])
    assert written <= commands(bench).keys()
    bench.close()
