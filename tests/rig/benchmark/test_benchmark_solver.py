"""The benchmarks on a handful of states: files, finite numbers, honest counting. Speeds are measured, never tested."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from model.kernel import library
from model.material.materials import NAMED
from model.membrane import solve as membrane
from model.specimen import Specimen
from model.verification import baselines
from rig.benchmark import cases, extremes, ratios, solver

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "rig" / "benchmark" / "README.md").read_text(encoding="utf-8")
PICTURES = ROOT / "sim_fixtures" / "pictures"
QUOTED = re.compile(r"one film alone, against solve_bvp in ln R +([0-9.]+) \(")


@pytest.fixture(scope="module")
def report() -> solver.Report:
    seen: list[tuple[float, str]] = []
    found = solver.measure(
        cases=3,
        methods=["DOP853 shooting", "solve_bvp in ln R", "Chebyshev in ln R"],
        batch=20,
        rounds=1,
        details=False,
        progress=lambda share, what: seen.append((share, what)),
    )
    assert [share for share, _ in seen] == sorted(share for share, _ in seen)
    assert seen[-1][0] <= 1
    return found


@pytest.mark.slow
def test_every_method_has_a_point_for_every_tolerance(report: solver.Report) -> None:
    methods = {point.method for point in report.points}
    assert methods == {solver.OURS, solver.BATCH, "DOP853 shooting", "solve_bvp in ln R", "Chebyshev in ln R"}
    for point in report.points:
        assert point.failures == 0
        assert 0 < point.seconds.median < 10
        assert 0 <= point.force.median <= point.force.nine_of_ten <= point.force.largest < solver.WRONG
        assert math.isfinite(point.field.median)
        assert math.isfinite(point.hoop.median)


@pytest.mark.slow
def test_the_solver_keeps_to_its_tolerance_on_the_paper_s_states(report: solver.Report) -> None:
    for point in report.points:
        if point.method in (solver.OURS, solver.BATCH):
            assert point.force.largest <= point.tolerance


@pytest.mark.slow
def test_files_are_written_and_hold_the_same_numbers(report: solver.Report, tmp_path: Path) -> None:
    solver.save(report, tmp_path)
    saved = json.loads((tmp_path / "solver.json").read_text(encoding="utf-8"))
    assert saved["cases"] == 3
    with (tmp_path / "solver.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(report.points) == len(saved["points"])
    assert float(rows[0]["force_median"]) == report.points[0].force.median == saved["points"][0]["force"]["median"]
    for name in ("solver.png", "solver_speed.png"):
        assert (tmp_path / name).read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.mark.slow
def test_the_tables_name_methods_and_ratios(report: solver.Report) -> None:
    console = Console(width=160, record=True, file=io.StringIO())
    console.print(solver.render(report))
    text = console.export_text()
    for wanted in ("DOP853 shooting", "one film alone, against solve_bvp in ln R", "load before", "numpy"):
        assert wanted in text


@pytest.mark.slow
@pytest.mark.long
def test_curves_wrinkled_films_and_one_off_costs_are_measured_too() -> None:
    report = solver.measure(cases=3, methods=["DOP853 shooting"], batch=50, rounds=1)
    assert {speed.mode for speed in report.speeds} == {"cold single", "batch", "sweep"}
    assert sum(ratio.what.startswith("wrinkled film over taut one") for ratio in report.ratios) == 2
    assert all(0 < ratio.low <= ratio.median <= ratio.high < math.inf for ratio in report.ratios)
    assert [row.states for row in report.scaling] == [10, 100, 1000, 10_000]
    assert max(row.peak_memory_MB for row in report.scaling) < 500
    assert all(seconds > 0 for seconds in report.one_off.values())


def test_a_ratio_is_the_median_of_rounds_between_their_quartiles(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = 0.0

    def busy(durations: list[float]) -> Callable[[], None]:
        def job() -> None:
            nonlocal clock
            clock += durations.pop(0)

        return job

    monkeypatch.setattr(ratios, "process_time", lambda: clock)
    dear = [busy([2.0, 9.0, 3.0, 9.0, 4.0, 9.0, 5.0, 9.0, 60.0, 70.0]), busy([4.0] * 10), busy([1.0] * 10)]
    found = ratios.measured("it", dear, [busy([1.0] * 10) for _ in range(3)], 5)
    assert (found.low, found.median, found.high, found.rounds) == (3.0, 4.0, 4.0, 5)
    together = ratios.measured("it", [busy([2.0] * 3), busy([4.0] * 3)], [busy([0.5] * 3)], 3, states=10, repeats=1)
    assert together.median == 60.0
    assert "it" in ratios.lines([found], ["On: a desk."]) and "5 rounds" in ratios.lines([found], [])


def test_the_page_quotes_what_the_command_printed() -> None:
    printed = (PICTURES / "solver_ratios.txt").read_text(encoding="utf-8")
    assert printed in PAGE
    assert QUOTED.search(printed) and "load before" in printed and "membrane solver" in printed


@pytest.mark.slow
def test_the_quoted_ratio_is_what_one_finds() -> None:
    """On any machine, within a factor of two: ratios are measured side by side."""
    if library.load() is None:
        pytest.skip("the quoted ratios are those of the compiled kernel")
    found = solver.measure(cases=8, methods=["solve_bvp in ln R"], batch=100, rounds=1, details=False)
    quoted = QUOTED.search(PAGE)
    assert quoted is not None
    assert found.ratios[0].what == "one film alone, against solve_bvp in ln R"
    assert 0.5 < found.ratios[0].median / float(quoted[1]) < 2.0


def test_a_method_that_fails_is_counted_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any) -> baselines.Result:
        return baselines.Result(1.0, 1.0, 1.0, True, "a force out of thin air", 1)

    monkeypatch.setitem(baselines.BASELINES, "DOP853 shooting", broken)
    states, truth = cases.taut_cases(2)
    cells = solver._cold(states, ["DOP853 shooting"], False, 1, lambda share, what: None)
    points = [solver._point(method, tol, found, states, truth) for (method, tol), found in cells.items()]
    assert all(point.failures == point.cases == 2 for point in points)


def test_cases_are_taut_and_the_same_every_time() -> None:
    first, truth = cases.taut_cases(3)
    again, _ = cases.taut_cases(3)
    assert first == again
    assert (truth.min_hoop_stress > 0).all()
    assert truth.converged.all()


@pytest.mark.slow
def test_extremes_count_every_state_and_write_files(tmp_path: Path) -> None:
    families = ["no pre-stretch, h from 1 nm to 3 b", "shear modulus from 100 Pa to 1 GPa"]
    report = extremes.measure(4, families=families)
    for row in report.rows:
        assert sum(row.counts.values()) == row.states == 4
        assert row.checked + row.missed + row.unverified <= 4
    unstretched = report.rows[0]
    assert unstretched.counts == {"TAUT": 4}
    assert unstretched.checked == 4
    assert not unstretched.faults
    extremes.save(report, tmp_path)
    saved = json.loads((tmp_path / "extremes.json").read_text(encoding="utf-8"))
    assert [row["family"] for row in saved["rows"]] == families
    assert (tmp_path / "extremes.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    with (tmp_path / "extremes.csv").open(encoding="utf-8") as file:
        assert [row["family"] for row in csv.DictReader(file)] == families


def test_a_dishonest_estimate_a_silent_nan_and_an_exception_are_faults(monkeypatch: pytest.MonkeyPatch) -> None:
    film = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"])
    states = [cases.Case(film, 5e-3, 0.0), cases.Case(film, 10e-3, 0.0)]
    honest = membrane.solve_many

    def spoiled(*args: Any, **options: Any) -> membrane.Solutions:
        found = honest(*args, **options)
        found.force[0] *= 1 + 1e-5
        found.peak_field[1] = np.nan
        return found

    monkeypatch.setattr(membrane, "solve_many", spoiled)
    row = extremes._row("spoiled", states)
    assert any("force off by 1.0e-05" in fault for fault in row.faults)
    assert any("missing without a status" in fault for fault in row.faults)

    def raises(*args: Any, **options: Any) -> membrane.Solutions:
        raise FloatingPointError("underflow")

    monkeypatch.setattr(membrane, "solve_many", raises)
    assert any("FloatingPointError" in fault for fault in extremes._row("broken", states).faults)


@pytest.mark.parametrize("family", extremes.FAMILIES)
def test_every_family_draws_films_that_exist(family: str) -> None:
    rng = np.random.default_rng(5)
    for u in (0.0, 0.3, 1.0):
        case = extremes.FAMILIES[family](rng, u)
        assert case.h > 0
        assert case.voltage >= 0
        assert math.isfinite(case.voltage)
