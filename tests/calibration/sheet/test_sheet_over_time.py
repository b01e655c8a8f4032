"""Sheets that take time: relaxation and cyclic tests made by scipy, through the law, the fit and the whole command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from calibration.sheet.sheet_tests import HomogeneousTest, TestHistory, TestsError
from calibration.sheet.timed.fit import fit_timed
from calibration.sheet.timed.predict import predict_sheets
from calibration.sheet.timed.record import SheetRecord, stress_fallen
from calibration.sheet.timed.result import TimedFit
from model.material.materials import Branch, Material
from rig.cli.app import main
from rig.importing.sheet_table import read_sheet_tests
from tests.calibration.sheet.timed_sheet import SECOND, Sheet, cycles, relaxation

SHEET = Sheet()
History = tuple[list[float], list[float]]


def table(kind: str, history: History, rate: float, noise: float, seed: int = 0, sheet: Sheet = SHEET) -> np.ndarray:
    """Rows of time (s), stretch, nominal stress (Pa); noise over the largest stress."""
    t = np.arange(0.0, history[0][-1], 1.0 / rate)
    stress = sheet.stress(kind, *history, t)
    stress = stress + noise * stress.max() * np.random.default_rng(seed).standard_normal(t.size)
    return np.stack((t, np.interp(t, *history), stress))


def made(
    kind: str, history: History, rate: float, noise: float, seed: int = 0, sheet: Sheet = SHEET
) -> HomogeneousTest:
    t, stretch, stress = table(kind, history, rate, noise, seed, sheet)
    columns = stretch, stretch ** SECOND[kind], stress, np.full_like(stress, np.nan)
    return HomogeneousTest(f"{kind} {seed}", kind, *columns, TestHistory(t, *columns))


def material(sheet: Sheet = SHEET) -> Material:
    return Material("sheet", sheet.mu, sheet.alpha, 1.0, branches=tuple(Branch(*one) for one in sheet.branches))


@pytest.mark.parametrize("kind", list(SECOND))
def test_the_law_in_a_sheet_is_that_of_an_independent_integration(kind: str) -> None:
    test = made(kind, ([0.0, 1.0, 8.0, 9.0, 12.0], [1.0, 2.5, 2.5, 1.4, 1.4]), 10.0, 0.0)
    (found,) = predict_sheets(material(), [test])
    assert np.abs(found.measured - found.model).max() < 1e-3 * found.largest
    assert found.rms < 2e-4 * found.largest
    (elastic,) = predict_sheets(Material("relaxed", SHEET.mu, SHEET.alpha, 1.0), [test])
    assert elastic.rms > 0.05 * found.largest  # or it would tell nothing


def check(found: TimedFit, sheet: Sheet = SHEET) -> None:
    """The truth within the stated uncertainty, and every branch identified."""
    shear = found.quantities["G"]
    assert abs(shear.value - sheet.modulus) < 3.0 * shear.uncertainty < 0.1 * sheet.modulus
    assert [one.verdict for one in found.spectrum.branches] == ["identified"] * len(sheet.branches)
    for one, (ratio, time) in zip(found.spectrum.branches, sheet.branches, strict=True):
        assert abs(one.ratio - ratio) < 3.0 * one.ratio_uncertainty
        assert abs(np.log(one.time / time)) < 3.0 * one.time_relative
    at_once = sheet.modulus * (1.0 + sum(ratio for ratio, _ in sheet.branches))
    assert abs(found.spectrum.instant.value - at_once) < 3.0 * found.spectrum.instant.uncertainty


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.long  # the whole command, below, finds the same
def test_relaxation_and_cycles_give_law_and_branches() -> None:
    """Fitted to a uniaxial relaxation test and to one of two rates; what took no part is predicted."""
    tests = [made("uniaxial", relaxation(hold=100.0), 10.0, 3e-3, 1), made("uniaxial", cycles(count=1), 20.0, 3e-3, 2)]
    found = fit_timed(tests, terms=2, predict=[made("pure shear", relaxation(hold=20.0), 10.0, 3e-3, 3)])
    check(found)
    assert found.reduced_chi_square == pytest.approx(1.0, abs=0.35)
    assert found.numerical < 1e-3
    assert found.predicted[0].rms < 0.03 * found.predicted[0].largest
    assert found.spectrum.slow >= 100.0
    assert any("would look like stiffness" in one for one in found.warnings)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_an_elastic_sheet_has_no_branch() -> None:
    sheet = Sheet(branches=())
    found = fit_timed([made("uniaxial", relaxation(hold=40.0), 10.0, 3e-3, 4, sheet)], terms=1)
    assert found.spectrum.branches == ()
    assert "no branch is needed to explain this record" in found.warnings


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_test_that_begins_stretched_was_pulled_there_and_says_so() -> None:
    t, stretch, stress = table("uniaxial", relaxation(ramp=0.05, hold=60.0), 20.0, 2e-3)
    rows = t >= 0.05
    columns = stretch[rows], stretch[rows] ** -0.5, stress[rows], np.full(int(rows.sum()), np.nan)
    test = HomogeneousTest("held", "uniaxial", *columns, TestHistory(t[rows], *columns))
    assert SheetRecord.of(test).pulled
    found = fit_timed([test], terms=1, branches=2)
    assert any("pulled" in one for one in found.warnings)
    for one, (_, time) in zip(found.spectrum.branches, SHEET.branches, strict=True):
        assert one.time == pytest.approx(time, rel=0.3)


def test_rows_without_time_are_refused_by_name_and_a_hold_is_told() -> None:
    plain = HomogeneousTest("plain", "uniaxial", *[np.linspace(1.0, 2.0, 30)] * 4)
    with pytest.raises(TestsError, match="plain: its rows have no time"):
        fit_timed([plain])
    assert stress_fallen(plain) == 0.0
    assert stress_fallen(made("uniaxial", relaxation(hold=20.0), 10.0, 1e-3)) > 0.1


def write(path: Path, rows: np.ndarray) -> Path:
    lines = ["Time (s),Stretch,Nominal stress (kPa)"]
    lines += [f"{t:.4f},{stretch:.6f},{stress / 1e3:.6f}" for t, stretch, stress in rows.T]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_all_rows_of_a_table_with_time_are_kept_for_the_history(tmp_path: Path) -> None:
    strong = Sheet(branches=((3.0, 1.0),))  # loses more than half of its stress: no break
    rows = table("uniaxial", relaxation(ramp=0.5, hold=10.0), 20.0, 1e-4, sheet=strong)
    (test,) = read_sheet_tests([write(tmp_path / "uniaxial.csv", rows)]).tests
    assert test.history is not None
    assert test.history.time == pytest.approx(rows[0], abs=1e-4)
    torn = rows.copy()
    torn[1, 60:], torn[2, 60:] = np.linspace(2.0, 2.02, rows.shape[1] - 60), 1.0
    (test,) = read_sheet_tests([write(tmp_path / "uniaxial-torn.csv", torn)]).tests
    assert test.history is not None
    assert test.history.time.size <= 61


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_whole_command_on_tables_of_two_rates(tmp_path: Path) -> None:
    """Tables in, law with branches out: numbers in JSON, one page of HTML; and the sheets from the film's result."""
    relax = write(tmp_path / "uniaxial_relax.csv", table("uniaxial", relaxation(hold=100.0), 4.0, 3e-3, 1))
    loops = write(tmp_path / "uniaxial_cycles.csv", table("uniaxial", cycles(count=1), 10.0, 3e-3, 2))
    shear = write(tmp_path / "pure_shear.csv", table("pure shear", relaxation(hold=20.0), 5.0, 3e-3, 3))
    out, page = tmp_path / "sheet.json", tmp_path / "sheet.html"
    words = ["fit-tests", str(relax), str(loops), "--predict", str(shear), "--branches", "auto", "--terms", "2"]
    done = CliRunner().invoke(main, [*words, "-o", str(out), "--report", str(page)])
    assert done.exit_code == 0, done.output
    found = json.loads(out.read_text())
    assert [one["verdict"] for one in found["spectrum"]["branches"]] == ["identified", "identified"], done.output
    for one, (ratio, time) in zip(found["spectrum"]["branches"], SHEET.branches, strict=True):
        assert one["ratio"] == pytest.approx(ratio, abs=3.0 * one["ratio_standard_uncertainty"])
        assert one["time_s"] == pytest.approx(time, rel=3.0 * one["time_relative_standard_uncertainty"])
    assert found["predicted"]["pure_shear"]["rms_residual_over_largest"] < 0.03
    assert found["provenance"]["settings"]["branches"] == "auto"
    text = page.read_text(encoding="utf-8")
    for words_there in ("Relaxation", "Stress against stretch", "Spectrum", "identified", "uniaxial_cycles"):
        assert words_there in text
    assert text.count("data:image/svg+xml") == 4

    without = CliRunner().invoke(main, ["fit-tests", str(relax), "--terms", "1"])
    assert without.exit_code == 0
    assert "--branches auto" in " ".join(without.output.split())
