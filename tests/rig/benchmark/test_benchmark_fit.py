"""The benchmark of the fit on a handful of points: files, counts of states, honest errors. Speeds are never tested."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from rig.benchmark import fit

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def report() -> fit.Report:
    shares: list[float] = []
    found = fit.measure(
        samples=(100, 1000),
        every=(100,),
        repeats=1,
        minutes=(3.0,),
        runs=2,
        histories=((1e-3,), (1e-3,), ()),
        tolerances=(1e-3, 1e-7),
        progress=lambda share, what: shares.append(share),
    )
    assert shares == sorted(shares)
    return found


def test_finer_tolerances_and_all_methods_end_at_the_reference(report: fit.Report) -> None:
    for point in report.points:
        for name in fit.QUANTITIES:
            assert point.error[name] < (1e-4 if point.tolerance > 1e-4 else 3e-6), (point, name)


def test_the_analytic_jacobian_saves_five_of_six_states(report: fit.Report) -> None:
    states = {(point.method, point.tolerance): point.states for point in report.points if point.samples == fit.SWEPT}
    assert states[fit.DIFFERENCES, 1e-7] > 5 * states[fit.REDUCED, 1e-7]


def test_states_do_not_grow_with_the_samples(report: fit.Report) -> None:
    states = {(point.method, point.samples): point.states for point in report.points if point.samples != fit.SWEPT}
    assert states[fit.REDUCED, 1000] <= 1.5 * states[fit.REDUCED, 100]
    assert states[fit.EVERY, 100] > 5 * states[fit.REDUCED, 100]


def test_fits_of_histories_end_at_the_reference_with_few_solutions(report: fit.Report) -> None:
    """What is left is far below the noise of the run, and ours solves the history a few times only."""
    ours, every = report.histories.rows
    for row in (ours, every):
        for name, error in row.error.items():
            assert error < 0.2 * report.histories.stated[name], (row, name)
    assert 2 * ours.histories <= every.histories
    assert 1e-4 < report.histories.stated["eps_r"] < 0.02


def test_files_and_tables_hold_the_same_numbers(report: fit.Report, tmp_path: Path) -> None:
    fit.save(report, tmp_path)
    saved = json.loads((tmp_path / "fit.json").read_text(encoding="utf-8"))
    assert saved["points"][0]["states"] == report.points[0].states
    with (tmp_path / "fit.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(report.points) + len(report.rig) + len(report.histories.rows)
    assert float(rows[-1]["relative_error_eps_r"]) == report.histories.rows[-1].error["eps_r"]
    assert (tmp_path / "fit.png").stat().st_size > 10_000
    console = Console(width=160, record=True, file=io.StringIO())
    console.print(fit.render(report))
    text = console.export_text()
    assert "planned" in text
    assert "uniform sweep" in text
    assert "exact at the ends" in text
