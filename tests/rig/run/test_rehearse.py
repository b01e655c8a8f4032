"""What `run` refuses before its first step, `check` refuses too; and what can hardly be meant."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import pytest
from click.testing import CliRunner

from rig.cli.app import main

FIXTURES = Path(str(files("sim_fixtures")))
BEGIN = '[[step]]\ndo = "home"\n[[step]]\ndo = "zero"\n'
APPROACH = BEGIN + '[[step]]\ndo = "approach"\n'
SHORT = (FIXTURES / "protocols" / "short.toml").read_text()


def check(tmp_path: Path, protocol: str, *changes: tuple[str, str], command: str = "check") -> tuple[int, str]:
    text = (FIXTURES / "scenes" / "cone-4mm.toml").read_text().replace('"../', f'"{FIXTURES}/')
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    (tmp_path / "scene.toml").write_text(text)
    (tmp_path / "protocol.toml").write_text(protocol)
    arguments = [command, str(tmp_path / "scene.toml"), str(tmp_path / "protocol.toml")]
    if command == "run":
        arguments += ["-o", str(tmp_path / f"{len(list(tmp_path.iterdir()))}.mcap")]
    done = CliRunner().invoke(main, arguments)
    return done.exit_code, done.output


@pytest.mark.parametrize(
    ("changes", "code", "words"),
    [
        ([("[simulation.hv]", "[simulation.hv]\nnominal_voltage_V = 700.0")], 3, "highest voltage, for this supply"),
        ([("[simulation.hv]", "[simulation.hv]\nnominal_current_mA = 0.001")], 3, "current_uA, for this supply"),
        ([("ramp_V_per_s = 300.0", "ramp_V_per_s = 1900.0")], 3, "ramp_V_per_s, for this supply"),
        ([("[simulation.hv]", "[simulation.stage]\ntravel_mm = 41.0\n[simulation.hv]")], 3, "Largest displacement"),
        ([("approach_from_mm = 36.0", "approach_from_mm = 1.0")], 3, "Clearance of the return step"),
        ([("[hv]", '[hv]\nserial = "nobody"')], 2, "serial number nobody is wanted"),
    ],
)
def test_what_the_instruments_cannot_do_is_refused_by_check_as_by_run(
    tmp_path: Path, changes: list[tuple[str, str]], code: int, words: str
) -> None:
    for command in ("check", "run"):
        found, said = check(tmp_path, SHORT, *changes, command=command)
        assert (found, words in said) == (code, True), (command, found, said)


def test_without_such_changes_both_are_content(tmp_path: Path) -> None:
    assert check(tmp_path, SHORT)[0] == 0


@pytest.mark.parametrize(
    ("threshold", "words"),
    [
        (3.9, "lost in the force noise of the certificate; give at least 4"),
        (380.0, "by the model the film gives 378 mN"),
        (950.0, "not below limits.force_N = 0.9"),
    ],
)
def test_a_threshold_that_would_not_be_felt_in_time(tmp_path: Path, threshold: float, words: str) -> None:
    code, said = check(tmp_path, f"{APPROACH}threshold_mN = {threshold}\n")
    assert code == 3 and words in said, said


def test_a_threshold_between_noise_and_limit_is_accepted(tmp_path: Path) -> None:
    for threshold in (4.1, 370.0):
        assert check(tmp_path, f"{APPROACH}threshold_mN = {threshold}\n")[0] == 0


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("limits.force_N", ("force_N = 0.9", "force_N = 1.1")),  # the certificate reaches 1 N
        ("limits.field_V_per_um", ("field_V_per_um = 80.0", "field_V_per_um = 900.0")),
        ("limits.displacement_mm", ("displacement_mm = 14.0", "displacement_mm = 1400.0")),
    ],
)
def test_a_limit_that_protects_nothing_needs_to_be_accepted_by_name(
    tmp_path: Path, key: str, change: tuple[str, str]
) -> None:
    code, said = check(tmp_path, BEGIN, change)
    assert code == 2 and key in said and f'accept = ["{key}"]' in said, said
    code, said = check(tmp_path, BEGIN, change, ("[specimen]", f'accept = ["{key}"]\n\n[specimen]'))
    assert code == 0, said


def test_a_protocol_of_hundreds_of_thousands_of_actions_is_refused_at_once(tmp_path: Path) -> None:
    sweep = '[[step]]\ndo = "sweep"\ndisplacement_mm = 2\nspeed_mm_per_s = 1\ncycles = 1000\n'
    code, said = check(tmp_path, APPROACH + 30 * sweep)
    assert code == 2 and "Step 28 (sweep)" in said and "more than 50000 actions" in said, said


def test_a_protocol_of_years_is_refused(tmp_path: Path) -> None:
    code, said = check(tmp_path, f'accept = ["step.duration_s"]\n{BEGIN}[[step]]\ndo = "hold"\nduration_s = 1e9\n')
    assert code == 2 and "days" in said, said


def test_a_long_plan_shows_its_beginning_and_its_end(tmp_path: Path) -> None:
    sweep = '[[step]]\ndo = "sweep"\ndisplacement_mm = 2\nspeed_mm_per_s = 1\ncycles = 200\n'
    code, said = check(tmp_path, f'{APPROACH}{sweep}[[step]]\ndo = "return"\n')
    assert code == 0 and "204 more, which hold too" in said and "back from the film" in said
    assert len(said.splitlines()) < 250  # six pages, each with its head
