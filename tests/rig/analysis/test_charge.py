"""Permittivity by the charge, from the log of a whole simulated run to the fit: softening does not move it."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner

from calibration.electrical.agreement import SOFTENED
from rig.analysis import charged_film
from rig.analysis.charge import permittivity_of
from rig.analysis.charged_film import identify_with_charge
from rig.analysis.film import identify_logs, write_results
from rig.base.errors import DataError
from rig.cli.app import main
from rig.log import schema
from rig.log.reader import read_log
from rig.log.writer import LogWriter
from rig.protocol.experiment import prepare
from rig.run.run import run
from tests.protocols import TO_THE_FILM

FIXTURES = Path(str(files("sim_fixtures")))
TRUTH = 1.7  # of the fixture's hidden film; its scene believes 1.9
SWEEPS = TO_THE_FILM + (
    '[[step]]\ndo = "sweep"\ndisplacement_mm = 9\nfrom_mm = 1\nspeed_mm_per_s = 4\n'
    "voltages_V = [0, 1200]\nsettle_s = 0.5\n"
)
REPLACED = {
    "../calibrations": str(FIXTURES / "calibrations"),
    "approach_from_mm = 36.0": "approach_from_mm = 13.0",
    "contact_position_mm = 40.0": "contact_position_mm = 17.0",
    "[simulation.hv]": "[simulation.hv]\ncapacitance_of_film = true",
    "prestretch = 1.2\n": "prestretch = 1.2\nthickness_uncertainty_um = 0.4\nprestretch_uncertainty = 0.005\n",
}


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("swept")
    text = (FIXTURES / "scenes" / "cone-4mm.toml").read_text()
    for old, new in REPLACED.items():
        text = text.replace(old, new)
    assert "capacitance_of_film" in text and "thickness_uncertainty_um" in text
    (folder / "scene.toml").write_text(text)
    (folder / "protocol.toml").write_text(SWEEPS)
    run(prepare(folder / "scene.toml", folder / "protocol.toml"), folder / "log.mcap", lambda *_: None)
    return folder / "log.mcap"


def softened(path: Path, out: Path, share: float) -> Path:
    """The same log of a film that has lost ``share`` of its force with each change of the voltage under a sweep."""
    log = read_log(path)
    zero = next(m.fields["value"] for m in log.messages("/reference") if m.fields["name"] == "force_zero")
    swept = [(m.fields["t_s"], m.fields["voltage_V"]) for m in log.messages("/phase") if m.fields["record"]]
    begins = [t for k, (t, volts) in enumerate(swept) if k and volts != swept[k - 1][1]]

    def soften(fields: dict[str, Any]) -> None:
        left = (1.0 - share) ** sum(t <= fields["t_s"] for t in begins)
        fields["reading"] = zero + (fields["reading"] - zero) * left
        fields["force_N"] *= left

    return changed(path, out, "/force/sample", soften)


def changed(path: Path, out: Path, topic: str, change: Callable[[dict[str, Any]], None]) -> Path:
    """The same log with other values in the messages of a topic."""
    log = read_log(path)
    with LogWriter(out) as copy:
        for attachment in log.attachments.values():
            copy.attach(attachment.name, attachment.media_type, attachment.data)
        for name, table in log.metadata.items():
            if name not in ("log", "fields", "outcome"):
                copy.metadata(name, table)
        for message in log.raw_messages():
            if message is None:  # between chunks
                continue
            channel, _, log_ns, about_ns, payload = message
            fields = schema.decode(channel.topic, payload)
            if channel.topic == topic:
                change(fields)
            copy.write(channel.topic, fields, log_ns, about_ns)
        copy.finish(log.outcome or {})
    return out


@pytest.mark.slow
def test_softening_moves_the_permittivity_by_the_force_and_not_that_by_the_charge(swept: Path, tmp_path: Path) -> None:
    soft = softened(swept, tmp_path / "soft.mcap", 0.03)
    found = identify_with_charge([soft], terms=1)
    assert found.charge is not None and found.charge.by_force is not None and found.charge.charge is not None
    both = found.identification.charge
    assert both is not None
    eps_r = found.identification.quantities["eps_r"]
    assert abs(eps_r.value - TRUTH) < eps_r.uncertainty < 0.15
    by_force, error = found.charge.by_force
    assert by_force - TRUTH > 2 * error  # what the charge is for
    assert both.verdict == SOFTENED and both.plain.significant
    assert both.softened is not None and both.softened[0] == pytest.approx(0.03, abs=2 * both.softened[1])
    shares = [eps_r.share(part) for part in ("noise", "current noise", "current gain", "thickness")]
    assert min(shares) > 0.0 and sum(eps_r.share(part) for part in eps_r.budget) == pytest.approx(1.0, abs=0.05)
    write_results(found, tmp_path / "fit.json", tmp_path / "report.html")
    stated = json.loads((tmp_path / "fit.json").read_text())
    assert stated["charge"]["verdict"] == SOFTENED and stated["by_charge_alone"]["by_force"][0] == by_force
    assert stated["charge"]["softening_per_curve"][0] == both.softened[0] and stated["provenance"]["settings"]["charge"]
    assert len(stated["charge"]["capacitances"]) == len(both.capacitances) > 0
    page = (tmp_path / "report.html").read_text()
    assert "Force and charge" in page and "d(CV)/dV against displacement" in page


@pytest.mark.slow
def test_a_supply_that_cannot_resolve_its_current_leaves_the_fit_as_without(swept: Path, tmp_path: Path) -> None:
    coarse = changed(swept, tmp_path / "coarse.mcap", "/hv/sample", _in_steps_of_10_uA)
    found = identify_with_charge([coarse], terms=1)
    without = identify_logs([coarse], terms=1)
    assert found.identification.charge is None
    assert found.identification.quantities == without.identification.quantities
    assert "cannot resolve it" in found.notes[0] and "by the force alone" in found.notes[0]
    write_results(found, tmp_path / "fit.json", tmp_path / "report.html")
    stated = json.loads((tmp_path / "fit.json").read_text())
    assert "cannot resolve" in stated["by_charge_alone"]["left_out"] and "charge" not in stated
    assert "The charge was left out" in (tmp_path / "report.html").read_text()


@pytest.mark.slow
def test_forces_without_voltage_leave_the_charge_alone_and_say_so(swept: Path, tmp_path: Path) -> None:
    found = identify_with_charge([changed(swept, tmp_path / "passive.mcap", "/phase", _only_passive)], terms=1)
    assert found.identification.charge is None and "eps_r" not in found.identification.quantities
    assert found.charge is not None and found.charge.charge is not None
    assert abs(found.charge.charge.value - TRUTH) < 2 * found.charge.charge.standard_uncertainty
    assert "no force curve under voltage" in found.notes[0] and "by the charge alone" in found.notes[1]
    write_results(found, tmp_path / "fit.json", tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "by the force alone: no force curve under voltage" in page
    assert "The relative permittivity by the charge alone is" in page


def _only_passive(fields: dict[str, Any]) -> None:
    fields["record"] = fields["record"] and fields["voltage_V"] == 0.0


def test_a_fit_by_the_force_alone_that_fails_does_not_lose_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise DataError("no sample is left to fit.")

    monkeypatch.setattr(charged_film, "identify_logs", fails)
    found: Any = SimpleNamespace(identification=SimpleNamespace(material=None))
    by_force, words = charged_film._by_force([Path("log.mcap")], found, {})
    assert by_force is None and "no sample is left to fit" in words[0]


def _in_steps_of_10_uA(fields: dict[str, Any]) -> None:
    fields["current_A"] = round(fields["current_A"] / 1e-5) * 1e-5


@pytest.mark.slow
def test_the_command_states_it_and_its_budget(swept: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["analyse", "charge", str(swept), "-o", str(tmp_path / "c.json")])
    assert done.exit_code == 0, done.output
    stated = json.loads((tmp_path / "c.json").read_text())
    assert abs(stated["value"] - TRUTH) < 2 * stated["standard_uncertainty"]
    assert "current gain" in done.output and "assumed" in done.output


def test_logs_without_a_current_say_why_not() -> None:
    with pytest.raises(DataError, match="no \\[hv\\] instrument"):
        permittivity_of([FIXTURES / "logs" / "no-hv" / "log.mcap"])
