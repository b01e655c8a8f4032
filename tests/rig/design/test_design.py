"""Design studies: figures 5 to 8 and S2 of Cao & Conn 2018, and the claims that the paper makes."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.integrate import solve_ivp

from model.actuator import design
from model.actuator.design import Point, Row, Swept, Treatment, sweep
from model.verification.baselines import explicit_shooting
from model.verification.baselines.common import Film
from model.verification.baselines.shooting import Equations
from model.verification.reference import reference
from rig.base.errors import ConfigError
from rig.cli.app import main
from rig.design import compare as shooting
from rig.design.best import task_of
from rig.design.claims import EVERY, FLAT, HYPOTHESIS, Claims, judge
from rig.design.compare import Shot, sample, shoot
from rig.design.hypothesis import hypothesis_rows
from rig.design.run import Curve, boundary, map_points, profile_curves, run_study
from rig.design.study import BoundaryStudy, MapStudy, OptimiseStudy, ProfilesStudy, load_study

STUDIES = Path(__file__).parents[3] / "sim_fixtures" / "studies"


def profiles(name: str) -> list[Curve]:
    study = load_study(STUDIES / f"{name}.toml")
    assert isinstance(study, ProfilesStudy)
    return profile_curves(study)


def map_study(name: str) -> MapStudy:
    study = load_study(STUDIES / f"{name}.toml")
    assert isinstance(study, MapStudy)
    return study


# ---- figures 5 and 6


@pytest.fixture(scope="module")
def curves() -> list[Curve]:
    return profiles("figure5") + profiles("figure6")


def test_extremes_of_figures_5_and_6_are_the_reference_s(curves: list[Curve]) -> None:
    films = [curve.solution.specimen for curve in curves]
    truth = reference(films, [c.solution.h for c in curves], [c.solution.voltage for c in curves])
    assert truth.converged.all()
    for i, curve in enumerate(curves):
        found, p = curve.solution, curve.profile
        assert found.force == pytest.approx(truth.force[i], rel=1e-6)
        assert found.peak_field == pytest.approx(truth.peak_field[i], rel=1e-6)
        assert p.field.max() == pytest.approx(truth.peak_field[i], rel=1e-6)
        # Least inside the film: the reference knows it at its own samples only; the next test is the sharper one.
        assert found.min_hoop_stress == pytest.approx(truth.min_hoop_stress[i], rel=1e-5)
        assert p.stress_1.min() == pytest.approx(truth.min_meridional_stress[i], rel=1e-6)


def test_every_point_of_figures_5_and_6_is_on_the_integrated_curve(curves: list[Curve]) -> None:
    """The paper's equations in explicit form, integrated to 1e-13 through the points of the figure."""
    for curve in curves:
        s, p = curve.solution, curve.profile
        start = explicit_shooting(s.specimen, s.h, s.voltage, 1e-12).start
        assert start is not None
        film = Film(s.specimen, s.h, s.voltage)
        at = np.log(p.R / s.specimen.ring_radius)
        path = solve_ivp(
            Equations(film).explicit,
            (at[0], 0.0),
            [math.log(start[0]), math.log(film.lp), start[1], 0.0],
            "DOP853",
            t_eval=np.clip(at, at[0], 0.0),
            rtol=1e-13,
            atol=1e-14,
        )
        l1, l2 = np.exp(path.y[:2])
        shear = s.specimen.material.shear_modulus
        radial, hoop = film.stresses(l1, l2)
        field = s.voltage / s.specimen.thickness * l1 * l2
        for mine, theirs in ((p.stress_1, shear * radial), (p.stress_2, shear * hoop), (p.field, field)):
            assert np.abs(mine - theirs).max() <= 1e-6 * max(float(np.abs(theirs).max()), 1e-300)


def test_peak_field_of_figure_6_is_lowest_for_a_disk_of_5_mm() -> None:
    peaks = {round(1e3 * c.solution.specimen.disk_radius): c.solution.peak_field for c in profiles("figure6")}
    assert min(peaks, key=lambda a: peaks[a]) == 5
    order = [peaks[a] for a in sorted(peaks)]
    assert order[:4] == sorted(order[:4], reverse=True)
    assert order[3:] == sorted(order[3:])


# ---- figure S2


@pytest.mark.slow
def test_the_bias_line_meets_the_breakdown_boundary_where_the_stroke_ends() -> None:
    study = load_study(STUDIES / "figureS2.toml")
    assert isinstance(study, BoundaryStudy)
    found = boundary(study)
    gap = found.breakdown_force - found.bias
    i = int(np.flatnonzero(gap > 0.0)[0])
    crossing = found.h[i - 1] + (found.h[i] - found.h[i - 1]) * gap[i - 1] / (gap[i - 1] - gap[i])
    assert found.found.reached[0] == pytest.approx(crossing, abs=0.01 * (found.h[i] - found.h[i - 1]))
    assert len(found.stars) >= 3
    for h, force in found.stars:
        assert force == pytest.approx(np.interp(h, found.h, found.breakdown_force), rel=1e-2)


# ---- figures 7 and 8


@pytest.fixture(scope="module")
def swept() -> tuple[list[Point], Swept]:
    points = map_points(map_study("figure7"))
    return points, sweep(points)


@pytest.fixture(scope="module")
def claims(swept: tuple[list[Point], Swept]) -> Claims:
    return judge([*swept[1].rows, *hypothesis_rows(swept[0])])


@pytest.mark.slow
def test_every_state_of_figure_7_has_a_status_and_its_energy_adds_up(swept: tuple[list[Point], Swept]) -> None:
    points, found = swept
    assert len(found.rows) == 3 * 3 * 4 * 9 == len(points)
    for row in found.rows:
        assert row.limit in ("BREAKDOWN", "TENSION")
        assert row.status in ("TAUT", "WRINKLED")
        assert row.status_at_work in ("TAUT", "WRINKLED")
        assert row.work_by_energy == pytest.approx(row.work, rel=5e-6)
        assert 0.0 < row.stroke_error < 1e-3 * row.stroke
        assert row.max_stretch < 2.4
        if row.treatment == "tension":
            assert row.status == "TAUT"
            assert row.min_hoop_stress >= 0.0
        if row.limit == "BREAKDOWN":
            assert row.peak_field == pytest.approx(80e6, rel=1e-6)


# Largest values without pre-stretch: (d* or J, a/b), as first computed. Tolerance 1e-4: solver 1e-8, peak field inside
# the film 1e-5. The paper's own method agrees with such numbers within 2e-4: the test after this one.
STORED = {
    ("I", "stroke", "plain"): (0.0563341, 0.25),
    ("II", "stroke", "plain"): (0.0918251, 0.25),
    ("III", "stroke", "plain"): (0.1109304, 0.10),
    ("I", "work", "plain"): (6.91043e-5, 0.45),
    ("II", "work", "plain"): (1.102589e-4, 0.45),
    ("III", "work", "plain"): (7.15847e-5, 0.30),
    ("I", "stroke", "tension"): (0.0206948, 0.25),
    ("II", "stroke", "tension"): (0.0369563, 0.25),
    ("III", "stroke", "tension"): (0.0285552, 0.10),
    ("I", "work", "tension"): (9.46533e-6, 0.45),
    ("II", "work", "tension"): (1.589656e-5, 0.40),
    ("III", "work", "tension"): (9.02654e-6, 0.35),
    ("I", "stroke", "tension_field"): (0.0470709, 0.30),
    ("II", "stroke", "tension_field"): (0.0769425, 0.35),
    ("III", "stroke", "tension_field"): (0.0929068, 0.10),
    ("I", "work", "tension_field"): (5.25111e-5, 0.50),
    ("II", "work", "tension_field"): (8.33424e-5, 0.50),
    ("III", "work", "tension_field"): (5.56145e-5, 0.25),
    ("I", "stroke", "hypothesis"): (0.0628489, 0.20),
    ("II", "stroke", "hypothesis"): (0.1049251, 0.20),
    ("III", "stroke", "hypothesis"): (0.1281569, 0.10),
    ("I", "work", "hypothesis"): (7.52953e-5, 0.40),
    ("II", "work", "hypothesis"): (1.192928e-4, 0.40),
    ("III", "work", "hypothesis"): (8.20320e-5, 0.30),
}


@pytest.mark.slow
def test_claim_table_has_the_stored_numbers(claims: Claims) -> None:
    seen = 0
    for one in claims.compared:
        key = (one.printed.case, one.printed.quantity, one.treatment)
        if key not in STORED:
            continue
        value, radius_ratio = STORED[key]
        assert one.value == pytest.approx(one.printed.times * value, rel=1e-4), key
        assert one.radius_ratio == pytest.approx(radius_ratio), key
        if one.printed.value is not None:
            assert one.deviation == pytest.approx(one.value / one.printed.value - 1.0)
        seen += 1
    assert seen == len(STORED) + 8  # the double cone with both films driven is there twice
    found = {(v.claim.split(":")[0], v.films, v.treatment): v.holds for v in claims.verdicts}
    treatments = [*(t.value for t in Treatment), HYPOTHESIS]
    fails = {("b (bound)", FLAT, t) for t in treatments}
    fails |= {("a", EVERY, "tension"), ("f", FLAT, "tension")}
    fails |= {("c (stroke)", films, "tension") for films in (FLAT, EVERY)}
    flat = ("b (order)", "b (bound)", "c (stroke)", "c (work)", "d", "e", "f")
    asked = {(claim, FLAT, t) for claim in flat for t in treatments}
    asked |= {(claim, EVERY, t.value) for claim in ("a", "c (stroke)", "c (work)", "d") for t in Treatment}
    assert found == {key: key not in fails for key in asked}
    text = "\n".join(claims.reading())
    assert "case I with its peak at a/b = 0.35" in text
    assert "lost at the end of 54 of 108 strokes" in text


@pytest.mark.slow
def test_the_readme_says_what_the_claims_say(claims: Claims) -> None:
    text = " ".join((Path(__file__).parents[3] / "rig" / "design" / "README.md").read_text(encoding="utf-8").split())

    def off(treatment: str, name: str) -> str:
        values = [getattr(c, name) for c in claims.compared if c.treatment == treatment and c.printed.times == 1]
        low, high = (round(-100 * end(v for v in values if v is not None)) for end in (max, min))
        return f"{low} to {high} %"

    assert f"peaks are {off('plain', 'deviation')} below the printed ones, peak against peak" in text
    assert f"and {off('plain', 'deviation_at_printed')} at the a/b that the paper prints" in text
    assert f"with peaks {off('tension_field', 'deviation')} below the printed ones" in text
    works = [c for c in claims.compared if c.treatment == "tension_field" and c.printed.quantity == "work"]
    assert sum(c.edge for c in works if c.printed.times == 1) == 2
    assert "two of the three peaks of the work stand at the map's edge" in text

    def signed(name: str) -> str:
        values = [getattr(c, name) for c in claims.compared if c.treatment == HYPOTHESIS and c.printed.times == 1]
        return " to ".join(f"{round(100 * end(v for v in values if v is not None)):+d}" for end in (min, max)) + " %"

    assert f"with deviations of {signed('deviation')}, peak against peak" in text
    assert f"and {signed('deviation_at_printed')} at the a/b that the paper prints" in text
    slipped, plain = (claims.peak("II", "stroke", t) for t in (HYPOTHESIS, "plain"))
    assert f"is {slipped.value:.3f} at a/b {slipped.radius_ratio:.2f} there" in text
    assert f"and {plain.value:.3f} at {plain.radius_ratio:.2f} in the plain equations" in text


@pytest.mark.slow
def test_the_paper_s_method_gives_the_same_numbers_and_takes_fifty_times_as_long(
    swept: tuple[list[Point], Swept],
) -> None:
    """Ratio of processor times in one run; the sample has a taut and a wrinkled film, a line and a cone as bias."""
    points, found = swept
    chosen = [
        (point, row)
        for point, row in zip(points, found.rows, strict=True)
        if (row.case, row.treatment, round(1e3 * row.disk_radius), row.prestretch)
        in {("II", "plain", 5, 1.0), ("III", "plain", 6, 1.2)}
    ]
    assert len(chosen) == 2
    shots = [shoot(point, row) for point, row in chosen]
    for shot in shots:
        assert shot.message == ""
        assert shot.stroke == pytest.approx(shot.row.stroke, rel=2e-4)
        assert shot.work == pytest.approx(shot.row.work, rel=4e-4)
    each = sum(shot.seconds for shot in shots) / len(shots)
    assert each * len(found.rows) >= 50.0 * found.seconds


def small() -> list[Point]:
    changed = {"disk_radii_mm": [4.0], "cases": ["I", "II"], "treatments": ["plain", "tension"]}
    return map_points(map_study("figure8").model_copy(update=changed))


def same(one: Sequence[Row], other: Sequence[Row]) -> bool:
    return repr(list(one)) == repr(list(other))


@pytest.mark.slow
def test_any_executor_gives_the_same_table() -> None:
    told: list[tuple[int, int]] = []
    alone = sweep(small(), progress=lambda done, total: told.append((done, total)))
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]  # a block a treatment and case
    with ThreadPoolExecutor(2) as pool:
        assert same(alone.rows, sweep(small(), executor=pool).rows)
    chosen = [small()[i] for i in sample(small(), [row.limit for row in alone.rows])]
    assert [(point.case, point.treatment) for point in chosen] == [("I", Treatment.PLAIN), ("II", Treatment.PLAIN)]


@pytest.mark.slow
def test_processes_give_the_same_table() -> None:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        assert same(sweep(small()).rows, sweep(small(), executor=pool).rows)


# ---- files and the command


@pytest.mark.slow
def test_a_map_that_is_there_is_compared_without_computing_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study, out = tmp_path / "small.toml", tmp_path / "out"
    text = (
        'study = "map"\ndisk_radii_mm = [4.0, 5.0]\nprestretches = [1.0]\ncases = ["I"]\n'
        'treatments = ["plain", "tension"]\n'
    )
    study.write_text(text)
    asked: list[int] = []
    computed = design.sweep

    def counted(wanted: Sequence[Point], **options: Any) -> Swept:
        asked.append(len(wanted))
        return computed(wanted, **options)

    def stopped(point: Point, row: Row) -> Shot:
        raise KeyboardInterrupt

    monkeypatch.setattr(design, "sweep", counted)
    monkeypatch.setattr(shooting, "shoot", stopped)
    command = ["design", str(study), "--out", str(out), "--compare"]
    assert CliRunner().invoke(main, command).exit_code != 0  # broken off in the comparison; the map is there
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert set(before) == {"small.csv", "small.png", "small.svg"}
    monkeypatch.setattr(shooting, "shoot", lambda point, row: Shot(row, row.stroke, row.work, 7, 50.0, ""))
    again = CliRunner().invoke(main, command)
    assert again.exit_code == 0, again.output
    assert asked == [4, 2]  # the whole map once, then the two plain actuators of the sample
    assert "A sample by the paper's method" in again.output and "2 actuators here" in again.output
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    study.write_text(text.replace("5.0", "6.0"))
    other = CliRunner().invoke(main, command)
    assert other.exit_code == 2 and "not the map of this study" in " ".join(other.output.split())
    study.write_text(text)
    (out / "small.csv").write_bytes(before["small.csv"][:-40])
    torn = CliRunner().invoke(main, command)
    assert torn.exit_code == 2 and "not the map of this study" in " ".join(torn.output.split())


@pytest.mark.slow
def test_command_writes_pictures_and_a_table_and_overwrites_nothing(tmp_path: Path) -> None:
    study = tmp_path / "small.toml"
    study.write_text(
        'study = "map"\ndisk_radii_mm = [4.0]\nprestretches = [1.0]\ncases = ["I", "II", "III"]\n'
        'treatments = ["plain", "tension"]\nclaims = "cao2018"\n'
    )
    out = tmp_path / "out"
    result = CliRunner().invoke(main, ["design", str(study), "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert "The paper against itself" in result.output
    for name in ("small.csv", "small_claims.csv", "small.png", "small.svg"):
        assert (out / name).stat().st_size > 300
    with (out / "small.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6
    assert all(row["status"] and row["limit"] and float(row["stroke_error_mm"]) > 0.0 for row in rows)
    again = CliRunner().invoke(main, ["design", str(study), "--out", str(out)])
    assert again.exit_code == 2
    assert "nothing is overwritten" in again.output


@pytest.mark.slow
def test_csv_has_every_digit_and_no_nan(tmp_path: Path) -> None:
    study = map_study("figure8").model_copy(update={"disk_radii_mm": [4.0], "claims": None})
    heavy = study.model_copy(
        update={"bias": study.bias.model_copy(update={"mass": type(study.bias.mass)(weight_N=60.0)})}
    )
    run_study(heavy, "heavy", tmp_path, None, lambda done, total, label: None)
    with (tmp_path / "heavy.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        assert (row["limit"] == "NO_REST") == (row["case"] == "II") == (row["stroke_mm"] == "")
    points = map_points(heavy)
    assert [float(row["disk_radius_mm"]) for row in rows] == [1e3 * point.film.disk_radius for point in points]
    assert not math.isnan(float(rows[0]["work_mJ"]))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ('study = "maps"\n', 'allowed are "profiles", "map"'),
        ('study = "map"\ndisk_radii_mm = [4.0]\nprestretches = [0.5]\n', "prestretches"),
        ('study = "map"\ndisk_radii_mm = [4.0]\nprestretches = [1.1]\nclaims = "cao2018"\n', "pre-stretch of 1"),
        (
            'study = "map"\ndisk_radii_mm = [4.0]\nprestretches = [1.0]\ntreatment = ["plain"]\n',
            "did you mean treatments",
        ),
        ('study = "map"\ndisk_radii_mm = [30.0]\nprestretches = [1.0]\n', "does not fit into a ring"),
        ('study = "boundary"\nvoltages_V = [0.0]\n[film]\nmaterial = "treloar-ogden1972"\n', "limits.field_V_per_um"),
        ("study = \n", "not valid TOML"),
    ],
)
def test_bad_studies_are_refused_by_name(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        run_study(load_study(path), "bad", tmp_path / "out", None, lambda done, total, label: None)
    assert complaint in str(caught.value)


def test_an_optimum_takes_film_and_covariance_from_a_fit(tmp_path: Path) -> None:
    """The keys are those that `dea-rig fit -o` writes."""
    fit = {
        "terms": 1,
        "parameters": ["mu1", "alpha1", "eps_r"],
        "covariance": [
            [900.0**2, -0.9 * 900 * 0.05, 0.1 * 900 * 0.04],
            [-0.9 * 900 * 0.05, 0.05**2, 0.0],
            [3.6, 0.0, 0.04**2],
        ],
        "quantities": {
            "mu1": {"value": 4.2e4, "standard_uncertainty": 900.0},
            "alpha1": {"value": 5.4, "standard_uncertainty": 0.05},
            "eps_r": {"value": 1.72, "standard_uncertainty": 0.04},
        },
    }
    (tmp_path / "fit.json").write_text(json.dumps(fit))
    (tmp_path / "best.toml").write_text(
        'study = "optimise"\ncase = "II"\nfit = "fit.json"\n[vary]\nprestretch = [1.0, 1.3]\nweight_N = [0.1, 0.5]\n'
    )
    study = load_study(tmp_path / "best.toml")
    assert isinstance(study, OptimiseStudy)
    task = task_of(study)
    film = task.point.film.material
    assert (film.mu, film.alpha, film.eps_r, film.breakdown_field) == ((4.2e4,), (5.4,), 1.72, 80e6)
    assert task.bounds == {"prestretch": (1.0, 1.3), "weight": (0.1, 0.5)}
    assert task.uncertain is not None
    assert task.uncertain.deviation({"mu1": 1.0, "alpha1": 0.0, "eps_r": 0.0}) == pytest.approx(900.0)
    both = task.uncertain.deviation({"mu1": 1.0, "alpha1": 900.0 / 0.05, "eps_r": 0.0})
    assert both == pytest.approx(900.0 * math.sqrt(0.2))
    with pytest.raises(ConfigError, match="preload is no quantity of a mass"):
        task_of(study.model_copy(update={"vary": type(study.vary)(preload_N=[0.1, 1.0])}))
    del fit["covariance"]
    (tmp_path / "fit.json").write_text(json.dumps(fit))
    with pytest.raises(ConfigError, match="covariance"):
        task_of(study)


@pytest.mark.slow
def test_optimum_from_its_file(tmp_path: Path) -> None:
    study = tmp_path / "best.toml"
    study.write_text('study = "optimise"\ncase = "II"\nstart = 4\nfront = 0\n[vary]\nprestretch = [1.0, 1.3]\n')
    result = CliRunner().invoke(main, ["design", str(study), "--out", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    with (tmp_path / "out" / "best.csv").open() as file:
        rows = list(csv.DictReader(file))
    top = {row["kind"]: row for row in rows}["largest stroke"]
    assert float(top["stroke_mm"]) >= max(float(row["stroke_mm"]) for row in rows)
    assert all(row["limit"] for row in rows)
    assert (tmp_path / "out" / "best.png").stat().st_size > 1000
