"""One calibration of every kind on the simulated bench: certificate, evidence, replay from its log, daily check."""

import io
import math
import re
import tomllib
from datetime import date
from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner
from rich.console import Console

from calibration.film.propagation import secant_modulus
from rig.analysis.certificate_file import certificate_text
from rig.analysis.film import identify_logs
from rig.analysis.sensor_protocols import protocol_text
from rig.analysis.sensors import Calibration, Lag, calibrate
from rig.base.certificates import load_certificate
from rig.base.errors import DataError, LimitError
from rig.base.toml_file import load_table, parse_table
from rig.cli.app import main
from rig.cli.calibrate import calibration_table
from rig.log.reader import read_log
from rig.protocol.plan import plan
from rig.protocol.predict import check_plan
from rig.protocol.protocol import Protocol
from rig.scene.scene import load_scene
from rig.steps.places import MARGIN
from rig.steps.standards import series

FIXTURES = Path(str(files("sim_fixtures")))
TRUTH = {
    "force": "[simulation.force]\nfull_scale_N = 1.0\ngain_error = 8e-3\n",
    "displacement": "[simulation.displacement]\ngain_error = -4e-3\nlag_ms = 12.0\n",
    "compliance": "rig_compliance_um_per_N = 8.0\n[simulation.force]\nfull_scale_N = 1.0\n",
    "hv": "[simulation.hv]\ngain_error = 6e-3\n",
}


@pytest.fixture(scope="module")
def found(bench_calibration):
    return {quantity: bench_calibration(quantity, f"seed = 5\n{truth}") for quantity, truth in TRUTH.items()}


def test_the_hidden_truth_is_found_within_the_stated_uncertainty(found):
    for quantity, true in (("force", 0.5 / 1.008), ("displacement", 1 / 0.996), ("hv", 1.006)):
        one = found[quantity].characteristic
        assert abs(one.gain - true) <= 2 * one.gain_uncertainty * true, quantity
        # An error of this size is seen, not drowned in a generous uncertainty.
        nominal = 0.5 if quantity == "force" else 1.0
        assert abs(true - nominal) > 3 * one.gain_uncertainty * true, quantity
    compliance = found["compliance"].characteristic
    assert 1e6 / compliance.gain == pytest.approx(8.0, rel=2 * compliance.gain_uncertainty)
    assert found["displacement"].lags["displacement"].lag == pytest.approx(12e-3, abs=2e-3)


@pytest.mark.parametrize("quantity", TRUTH)
def test_the_certificate_says_what_was_found_and_how(found, quantity, tmp_path):
    calibration = found[quantity]
    path = tmp_path / "certificate.toml"
    path.write_text(certificate_text(calibration))
    certificate, one = load_certificate(path), calibration.characteristic
    if quantity == "compliance":
        assert certificate.compliance == pytest.approx(1 / one.gain, rel=1e-6)
        assert certificate.role == "stage"
    else:
        assert certificate.gain == pytest.approx(one.gain, rel=1e-6)
        assert certificate.gain_uncertainty == pytest.approx(one.gain_uncertainty, rel=1e-6)
        assert certificate.role == quantity
    assert (
        certificate.serial == {"force": "14209876", "displacement": "", "hv": "484216", "compliance": "50443"}[quantity]
    )
    assert (certificate.valid_until - certificate.valid_from).days == 365
    evidence = tomllib.loads(path.read_text())
    assert re.fullmatch("[0-9a-f]{64}", evidence["data_sha256"])
    assert len(evidence["standstill"]) == len(one.standstills)
    squares = sum(line["relative"] ** 2 for line in evidence["budget"])
    assert squares**0.5 == pytest.approx(one.gain_uncertainty, rel=1e-5)


def test_a_recorded_log_gives_the_same_again(found):
    for quantity, calibration in found.items():
        again = calibrate(calibration.path, quantity)
        assert certificate_text(again) == certificate_text(calibration)


def test_a_log_without_the_steps_is_refused(found):
    with pytest.raises(DataError, match="holds no standstill of a weigh step"):
        calibrate(found["displacement"].path, "force")
    with pytest.raises(DataError, match="holds no samples of displacement"):
        calibrate(found["force"].path, "displacement")
    with pytest.raises(DataError, match="holds no glide step"):
        calibrate(found["force"].path, "timing")


def test_voltage_of_a_calibration_ends_measured_off(found):
    outcome = read_log(found["hv"].path).outcome
    assert (outcome["status"], outcome["safe"]) == ("complete", "yes")
    assert abs(float(outcome["measured_voltage_V"])) < 5


def test_series_rises_and_falls():
    assert series([2, 0, 1], 1) == [(1, 1, 0), (1, 1, 1), (1, 1, 2), (1, -1, 2), (1, -1, 1), (1, -1, 0)]


@pytest.mark.parametrize("quantity", ["force", "displacement", "compliance", "hv", "timing"])
def test_the_usual_protocol_fits_every_scene(quantity):
    for name in ("cone-4mm", "cone-6mm", "other-instruments"):
        scene, _ = load_scene(FIXTURES / "scenes" / f"{name}.toml")
        if scene.instruments.get(quantity, True) is None:
            continue
        actions = plan(parse_table(protocol_text(quantity, scene), Protocol, "protocol", "usual"), scene)
        check_plan(actions, scene)


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        ('[[step]]\ndo = "weigh"\nweights_g = [0, 100]\n', "100 g pull with 0.98"),
        ('[[step]]\ndo = "visit"\npositions_mm = [0, 5]\n', "needs a home step"),
        ('[[step]]\ndo = "home"\n[[step]]\ndo = "press"\nforce_N = 1.0\n', "beyond limits.force_N"),
        ('[[step]]\ndo = "meter"\nvoltages_V = [0, 100]\n', "has no .hv. instrument"),
    ],
)
def test_standards_beyond_the_limits_are_refused(steps, words):
    scene, _ = load_scene(FIXTURES / "scenes" / "no-hv.toml")
    with pytest.raises(LimitError, match=words):
        plan(parse_table(steps, Protocol, "protocol", "test"), scene)


# The commands


def call(*arguments):
    return CliRunner().invoke(main, [str(one) for one in arguments])


@pytest.mark.slow
def test_from_a_scene_to_files_and_from_its_log_again(tmp_path, write_scene, steps):
    scene = write_scene(tmp_path, "seed = 3\n" + TRUTH["force"])
    (tmp_path / "steps.toml").write_text(steps["force"])
    first = call("calibrate", "force", scene, "-o", tmp_path / "first", "--protocol", tmp_path / "steps.toml")
    assert first.exit_code == 0, first.output
    assert "local gravity" in first.output
    assert {one.name for one in (tmp_path / "first").iterdir()} == {"force.mcap", "force.toml", "force.png"}
    again = call("calibrate", "force", tmp_path / "first" / "force.mcap", "-o", tmp_path / "again")
    assert again.exit_code == 0, again.output
    assert (tmp_path / "first" / "force.toml").read_text() == (tmp_path / "again" / "force.toml").read_text()
    over = call("calibrate", "force", tmp_path / "first" / "force.mcap", "-o", tmp_path / "again")
    assert over.exit_code == 2
    assert "exists already" in over.output


@pytest.mark.slow
@pytest.mark.parametrize(("error", "code", "words"), [(5e-4, 0, "holds"), (2e-2, 1, "DOES NOT AGREE")])
def test_daily_check_passes_a_good_sensor_and_fails_one_that_has_changed(tmp_path, write_scene, error, code, words):
    scene = write_scene(tmp_path, f"seed = 3\n[simulation.force]\nfull_scale_N = 1.0\ngain_error = {error}\n")
    said = call("verify", "force", scene, "--standard", "60", "-o", tmp_path / "check.mcap")
    assert said.exit_code == code, said.output
    assert words in said.output


@pytest.mark.slow
def test_the_daily_check_of_the_voltage_stands_on_the_voltage_asked_for(tmp_path, write_scene):
    """Not on a mean with the readings without voltage, which a meter never shows as exactly nothing."""
    said = call(
        "verify", "hv", write_scene(tmp_path, "seed = 3\n", hv=True), "--standard", 800, "-o", tmp_path / "c.mcap"
    )
    assert said.exit_code == 0, said.output
    numbers = re.search(r"applied ([\d.]+) V, measured ([\d.]+) V", said.output)
    assert [float(one) for one in numbers.groups()] == pytest.approx([800.0, 800.0], abs=3.0)


def test_what_timing_finds_is_told_as_lines_of_the_certificates():
    lags = {"force": Lag("force", 0.0123, 0.0015, 0.0)}
    found = Calibration("timing", None, None, lags, "", "", date(2020, 1, 1), "", "", Path("log.mcap"))
    console = Console(width=100, file=io.StringIO())
    for one in calibration_table(found):
        console.print(one)
    assert "force: lag_s = 0.01230, lag_uncertainty_s = 0.00150" in console.file.getvalue()


# Certificates in use


def run(folder, scene, protocol="passive.toml"):
    return call("run", scene, FIXTURES / "protocols" / protocol, "-o", folder / "run.mcap")


def with_certificate(write_scene, folder, role, **changes):
    """A scene whose certificate of ``role`` has other lines."""
    text = (FIXTURES / "calibrations" / f"{role}.toml").read_text()
    for key, value in changes.items():
        text = re.sub(rf"(?m)^{key} = [^#\n]*", f"{key} = {value} ", text)
    (folder / f"{role}.toml").write_text(text)
    scene = write_scene(folder, "seed = 3\n" + TRUTH["force"], laser=True)
    scene.write_text(scene.read_text().replace(f"{(FIXTURES / 'calibrations').as_posix()}/{role}.toml", f"{role}.toml"))
    return scene


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"valid_until": "2019-06-01"}, "expired on 2019-06-01"),
        ({"serial": '"1"'}, "is for serial number 1, the instrument says 14209876"),
    ],
)
def test_an_expired_or_foreign_certificate_is_told_by_log_and_fit(tmp_path, write_scene, changes, words):
    said = run(tmp_path, with_certificate(write_scene, tmp_path, "force", **changes))
    assert said.exit_code == 0, said.output
    fitted = call("fit", tmp_path / "run.mcap", "--terms", "1")
    assert fitted.exit_code == 0, fitted.output
    assert words in " ".join(fitted.output.split())


def test_a_missing_certificate_is_refused_and_leaves_nothing(tmp_path, write_scene):
    scene = write_scene(tmp_path, "seed = 3\n" + TRUTH["force"])
    scene.write_text(scene.read_text().replace("/force.toml", "/gone.toml"))
    said = run(tmp_path, scene)
    assert said.exit_code == 2
    assert "gone.toml" in said.output
    assert not list(tmp_path.glob("*.mcap*"))


def test_nothing_is_planned_beyond_the_calibrated_range(tmp_path, write_scene):
    said = run(tmp_path, with_certificate(write_scene, tmp_path, "force", range_N="[-0.01, 0.01]"))
    assert said.exit_code == 3
    assert "calibrated up to 0.01 N only" in " ".join(said.output.split())
    assert not list(tmp_path.glob("*.mcap*"))


@pytest.mark.slow
def test_the_compliance_of_the_rig_is_taken_off_where_the_stage_stands_for_the_disk(tmp_path, write_scene):
    """A rig that gives way makes the film look softer, unless its certificate says so.

    Without a certificate the compliance is fitted along, the results are less certain, and the operator is told.
    """
    found = {}
    cases = (("rigid", 0.0, True), ("unknown", 3e-4, False), ("corrected", 3e-3, True))
    for name, compliance, certified in cases:
        folder = tmp_path / name
        folder.mkdir()
        scene = write_scene(folder, f"seed = 3\nrig_compliance_um_per_N = {compliance * 1e6}\n" + TRUTH["force"])
        if certified:
            (folder / "stage.toml").write_text(
                'format = "dea-rig certificate 1"\nrole = "stage"\ninstrument = "stage"\nserial = "50443"\n'
                f"valid_from = 2019-01-01\nvalid_until = 2099-01-01\ncompliance_m_per_N = {compliance}\n"
                "compliance_uncertainty_m_per_N = 3e-5\nrange_N = [0.0, 1.0]\n"
            )
            text = scene.read_text().replace('driver = "zaber"', 'driver = "zaber"\ncertificate = "stage.toml"')
            scene.write_text(text)
        assert run(folder, scene).exit_code == 0
        found[name] = identify_logs([folder / "run.mcap"], terms=1)
    modulus = {name: one.identification.material.shear_modulus for name, one in found.items()}
    assert modulus["corrected"] == pytest.approx(modulus["rigid"], rel=0.01)
    rigid, unknown = (found[name].identification for name in ("rigid", "unknown"))
    stiffness = unknown.quantities["stiffness"]
    known = secant_modulus(rigid.material, *unknown.stretch)
    assert abs(stiffness.value - known) < 2.0 * stiffness.uncertainty
    assert stiffness.budget["compliance"] > 5.0 * rigid.quantities["stiffness"].budget["compliance"]
    told = {name: any("dea-rig calibrate compliance" in note for note in one.notes) for name, one in found.items()}
    assert told == {"rigid": False, "unknown": True, "corrected": False}


def test_a_calibration_that_cannot_begin_leaves_nothing_in_its_way(tmp_path, write_scene):
    """Neither the protocol that was written for it nor a new folder; a file that was there stays."""
    scene = write_scene(tmp_path, "seed = 3\n" + TRUTH["force"])
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(scene.read_text().replace("/force.toml", "/gone.toml"))
    for arguments in (("calibrate", "force", wrong, "-o", tmp_path / "new" / "folder"),
                      ("verify", "force", wrong, "--standard", "60", "-o", tmp_path / "check.mcap"),
                      ("calibrate", "force", tmp_path / "no.mcap", "-o", tmp_path / "other")):  # fmt: skip
        assert call(*arguments).exit_code in (1, 2)
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path not in (scene, wrong)]
    assert not (tmp_path / "new" / "folder").exists()
    assert not (tmp_path / "other").exists()
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "force.protocol.toml").write_text("mine")
    assert call("calibrate", "force", wrong, "-o", tmp_path / "kept").exit_code == 2
    assert (tmp_path / "kept" / "force.protocol.toml").read_text() == "mine"


def test_the_usual_calibration_of_the_voltage_reaches_what_runs_ask_for():
    scene, _ = load_scene(FIXTURES / "scenes" / "cone-4mm.toml")
    steps = parse_table(protocol_text("hv", scene), Protocol, "protocol", "usual")
    asked = load_table(FIXTURES / "protocols" / "paper.toml", Protocol, "protocol")[0]
    reach = max(max(step.voltages_V) for step in steps.step if step.do == "meter")
    assert max(max(step.voltages_V) for step in asked.step if step.do == "sweep") <= reach <= scene.limits.voltage_V
    assert reach >= math.floor(MARGIN * scene.limits.voltage_V)  # what `dea-rig plan` goes up to
