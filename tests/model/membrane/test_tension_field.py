"""The relaxed energy: published values, an independent formulation, order of convergence, and what it costs."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from model.material.law import Evaluations, Film
from model.material.materials import EPSILON_0, NAMED, Material
from model.membrane import compiled, ritz, tension_field
from model.membrane.ritz import Grid, Problem
from model.membrane.solve import Status, solve, solve_many
from model.specimen import Specimen
from model.verification.reference import reference

PARKER = NAMED["parker-cao2018"]


def film(lp: float = 1.0, a_mm: float = 4.0, material: Material = PARKER) -> Specimen:
    return Specimen(a_mm * 1e-3, 20e-3, 40e-6, lp, material)


# Three independent codes agree on these; they took 8.85e-12 for the vacuum permittivity. h / mm, V / V, F / N
@pytest.mark.parametrize(("h", "v", "force"), [(12, 1500, 0.1055227), (12, 1900, 0.0698233), (14, 1900, 0.1269012)])
@pytest.mark.parametrize("tolerance", [1e-6, 1e-9])
def test_forces_on_which_three_codes_agree(h: float, v: float, force: float, tolerance: float) -> None:
    material = replace(PARKER, eps_r=1.7 * 8.85e-12 / EPSILON_0)
    answer = solve(film(material=material), h * 1e-3, v, tolerance=tolerance, wrinkling="tension_field")
    assert answer.status is Status.WRINKLED
    assert answer.force == pytest.approx(force, rel=1e-6)
    assert answer.min_hoop_stress >= 0.0


# From a fold of 0.5 % of the radius at the disk and another at the ring to a film that is folded all over.
@pytest.mark.parametrize(
    ("lp", "h", "voltage"),
    [
        (1.0, 12e-3, np.arange(1300.0, 2400.0, 200.0)),
        pytest.param(1.0, 4e-3, np.arange(700.0, 1250.0, 100.0), marks=pytest.mark.slow),
        pytest.param(1.2, 10e-3, np.arange(1700.0, 2650.0, 200.0), marks=pytest.mark.slow),
    ],
)
def test_independent_formulation(lp: float, h: float, voltage: np.ndarray) -> None:
    truth = reference(film(lp), h, voltage, wrinkling="tension_field")
    for tolerance in (1e-6, 1e-9):
        found = solve_many(film(lp), h, voltage, tolerance=tolerance, wrinkling="tension_field")
        np.testing.assert_array_equal(found.status, Status.WRINKLED)
        error = np.abs(found.force / truth.force - 1.0)
        assert np.all(error <= tolerance)
        assert np.all(error <= 3.0 * found.error_estimate)
    np.testing.assert_allclose(found.peak_field, truth.peak_field, rtol=1e-5)
    # Inside the film stresses err with the square root of the force's error.
    np.testing.assert_allclose(found.min_meridional_stress, truth.min_meridional_stress, rtol=3e-5)


# Folds at disk and ring, at the ring, at the disk, all over.
FOLDS = [(1.0, 12e-3, 1400.0, 2), (1.0, 4e-3, 900.0, 1), (1.2, 10e-3, 1900.0, 1), (1.0, 12e-3, 1900.0, 0)]


@pytest.mark.parametrize(("lp", "h", "v", "cuts"), FOLDS)
def test_the_kernel_finds_what_the_path_for_arrays_does(
    lp: float, h: float, v: float, cuts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = solve(film(lp), h, v, tolerance=1e-9, wrinkling="tension_field")
    monkeypatch.setattr(compiled, "_kernel", lambda: None)
    many = solve_many(film(lp), [h], v, tolerance=1e-9, wrinkling="tension_field")
    assert one.status == many.status[0] == Status.WRINKLED
    assert one.force == pytest.approx(many.force[0], rel=2e-9)
    for name in ("peak_field", "peak_field_radius", "min_meridional_stress", "max_stretch"):
        assert getattr(one, name) == pytest.approx(getattr(many, name)[0], rel=1e-6), name
    assert one.min_hoop_stress == pytest.approx(0.0, abs=1e-5 * one.min_meridional_stress)
    arrays = solve(film(lp), h, v, tolerance=5e-12, wrinkling="tension_field")
    assert arrays.quick is None
    mine, theirs = one.profile(33), arrays.profile(33)
    assert np.count_nonzero(np.diff(mine.wrinkled)) == cuts
    np.testing.assert_array_equal(mine.wrinkled, theirs.wrinkled)
    for name in ("R", "r", "z", "slope", "stretch_1", "stretch_2", "stress_1", "field"):
        np.testing.assert_allclose(getattr(mine, name), getattr(theirs, name), rtol=1e-3, atol=1e-8, err_msg=name)


@pytest.mark.parametrize(("lp", "h", "v", "cuts"), FOLDS)
def test_a_wrinkled_state_costs_no_more_than_six_taut_ones(lp: float, h: float, v: float, cuts: int) -> None:
    """Counted in points of the law, to an error of the force that is the same, alone and in a batch."""
    taut = solve(film(1.2), 12e-3, 1500.0, tolerance=1e-6).evaluations.mechanical
    folded = solve(film(lp), h, v, tolerance=1e-6, wrinkling="tension_field").evaluations
    assert 0 < folded.relaxed < folded.mechanical < 6 * taut
    heights = np.linspace(0.99, 1.01, 20)
    taut = solve_many(film(1.2), heights * 12e-3, 1500.0, tolerance=1e-6).evaluations.mechanical
    many = solve_many(film(lp), heights * h, v, tolerance=1e-6, wrinkling="tension_field").evaluations
    assert 0 < many.relaxed < many.mechanical < 7 * taut


def test_a_taut_film_pays_for_no_relaxed_energy() -> None:
    h, v = np.linspace(2e-3, 20e-3, 9), np.array([[0.0], [800.0]])
    plain = solve_many(film(1.2), h, v)
    relaxed = solve_many(film(1.2), h, v, wrinkling="tension_field")
    np.testing.assert_array_equal(relaxed.force, plain.force)
    assert relaxed.evaluations.relaxed == 0
    assert relaxed.evaluations.mechanical == plain.evaluations.mechanical
    assert solve_many(film(), 12e-3, [1900.0], wrinkling="tension_field").evaluations.relaxed > 0


def test_cut_at_the_kink_keeps_spectral_convergence() -> None:
    """The error falls by more than a decade with each mode; with the kink inside an element it does not."""
    h, v = 12e-3, 1400.0
    truth = reference(film(), h, v, wrinkling="tension_field").force[0]
    shear = PARKER.shear_modulus
    material = Film(
        PARKER.law(np.array(PARKER.mu)[:, None] / shear, np.array(PARKER.alpha)[:, None]),
        np.array([PARKER.permittivity * (v / 40e-6) ** 2 / shear]),
        Evaluations(),
    )
    problem = Problem(material, np.zeros(1), np.log([5.0]), np.array([h / 20e-3]))
    unit = 2.0 * np.pi * 20e-3 * 40e-6 * shear

    def whole(modes: int) -> float:
        grid = Grid.lay(modes, problem.cut())
        found = tension_field.search(problem, grid, tension_field.guess(problem, grid), 1e-10, 60)
        return abs(float(unit * found.lam[0]) / truth - 1.0)

    grid = Grid.lay(12, problem.cut())
    begun = tension_field.search(problem, grid, tension_field.guess(problem, grid))
    at = ritz.evaluate(problem, grid, begun.state)
    zone = tension_field.zones(grid, begun.state, at)
    changes = int(zone.changes[0])
    breaks = np.concatenate((problem.cut()[:1], zone.where[:changes], problem.cut()[1:]))
    kinds = (np.arange(changes + 1) % 2 == 0) == bool(zone.first[0])

    def cut(modes: int) -> float:
        start = tension_field.remap(grid, begun.state, at.log[1], breaks, modes, kinds)
        found = tension_field.settle(problem, start.grid, start.state, 1e-10)
        return abs(float(unit * found.lam[0]) / truth - 1.0)

    errors = [cut(modes) for modes in (2, 4, 6, 8)]
    assert all(after < before / 100.0 for before, after in pairwise(errors) if before > 1e-11)
    assert errors[-1] < 1e-11
    assert whole(24) > 1e3 * errors[-1]


@pytest.mark.parametrize(("v", "h"), [(1500.0, 12e-3), (1900.0, -12e-3)])
def test_sensitivities_are_the_differences_of_the_force(v: float, h: float) -> None:
    def force(specimen: Specimen, h: float, v: float) -> float:
        return solve(specimen, h, v, tolerance=1e-12, wrinkling="tension_field").force

    base = film()
    answer = solve(base, h, v, tolerance=1e-12, wrinkling="tension_field", sensitivities=True)
    assert answer.dforce is not None

    def stretched(name: str, factor: float, term: int = 0) -> tuple[Specimen, float, float]:
        m = base.material
        if name == "h":
            return base, h * factor, v
        if name == "voltage":
            return base, h, v * factor
        if name in ("mu", "alpha"):
            values = list(getattr(m, name))
            values[term] *= factor
            return base.with_material(replace(m, **{name: tuple(values)})), h, v
        if name == "eps_r":
            return base.with_material(replace(m, eps_r=m.eps_r * factor)), h, v
        return replace(base, **{name: getattr(base, name) * factor}), h, v

    d = 1e-4
    for name, analytic in answer.dforce.items():
        for term in range(2 if name in ("mu", "alpha") else 1):
            slope = sum(
                w * force(*stretched(name, 1.0 + k * d, term))
                for k, w in {-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12}.items()
            )
            holder = {"h": h, "voltage": v, "eps_r": PARKER.eps_r}.get(name)
            if holder is None:
                source = base.material if name in ("mu", "alpha") else base
                holder = getattr(source, name)
                holder = holder[term] if name in ("mu", "alpha") else holder
            value = (analytic[term] if name in ("mu", "alpha") else analytic) * holder
            assert value == pytest.approx(slope / d, rel=1e-6, abs=1e-8 * abs(answer.force)), (name, term)


def test_exact_scalings() -> None:
    base = solve(film(), 12e-3, 1700.0, wrinkling="tension_field").force
    thick = solve(replace(film(), thickness=120e-6), 12e-3, 5100.0, wrinkling="tension_field").force
    large = solve(
        replace(film(), disk_radius=28e-3, ring_radius=140e-3), 84e-3, 1700.0, wrinkling="tension_field"
    ).force
    halves = replace(PARKER, mu=(5e3, 1.75e4, 1.75e4), alpha=(2.5, 5.6, 5.6))
    split = solve(film(material=halves), 12e-3, 1700.0, wrinkling="tension_field").force
    np.testing.assert_allclose([thick / base, large / base, split / base], [3.0, 7.0, 1.0], rtol=1e-12)


def test_wrinkling_starts_where_tension_is_lost_and_ends_where_the_film_is_slack() -> None:
    """Plain and relaxed forces leave each other smoothly; at last no force is left and the status says slack."""
    v = np.linspace(1200.0, 2500.0, 27)
    plain = solve_many(film(), 12e-3, v)
    relaxed = solve_many(film(), 12e-3, v, wrinkling="tension_field")
    taut = plain.status == Status.TAUT
    np.testing.assert_array_equal(relaxed.status[taut], Status.TAUT)
    first = np.flatnonzero(relaxed.status == Status.WRINKLED)[:1]
    assert relaxed.force[first] == pytest.approx(plain.force[first], rel=1e-3)
    answered = relaxed.answered
    assert np.all(np.diff(relaxed.force[answered]) < 0.0)
    np.testing.assert_array_equal(relaxed.status[~answered], Status.SLACK)
    assert relaxed.force[answered][-1] < 0.1 * relaxed.force[0]


@pytest.mark.slow
def test_small_disk() -> None:
    small = Specimen(1e-4, 20e-3, 40e-6, 1.0, PARKER)
    v = np.array([1000.0])
    found = solve_many(small, 10e-3, v, wrinkling="tension_field", tolerance=1e-7)
    truth = reference(small, 10e-3, v, wrinkling="tension_field")
    assert found.answered.all()
    np.testing.assert_allclose(found.force, truth.force, rtol=1e-7)


def test_folds_of_a_film_raised_by_a_nanometre() -> None:
    """Its stresses are 1e-15 of the modulus; whether they are tension is a question of their sign all the same."""
    h = 1e-9
    taut = solve(film(), h)
    v = np.sqrt(taut.min_hoop_stress / PARKER.permittivity) * 40e-6 * np.array([0.5, 0.9, 1.1])
    found = solve_many(film(), h, v, wrinkling="tension_field")
    truth = reference(film(), h, v, wrinkling="tension_field")
    np.testing.assert_array_equal(found.status == Status.WRINKLED, truth.wrinkled)
    assert truth.wrinkled.any()
    np.testing.assert_allclose(found.force, truth.force, rtol=1e-8)
    plain = solve_many(film(), h, v)
    np.testing.assert_array_equal(plain.status, found.status)
