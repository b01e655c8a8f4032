"""What a state costs, counted: order of convergence, linear growth, bounded memory."""

from __future__ import annotations

import tracemalloc
from itertools import pairwise

import numpy as np
import pytest

from model.material.law import Evaluations, Film
from model.material.materials import NAMED
from model.membrane import refinement, ritz
from model.membrane.ritz import Grid, Problem
from model.membrane.solve import solve_many
from model.specimen import Specimen
from model.verification.reference import reference

PARKER = NAMED["parker-cao2018"]
FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, PARKER)


@pytest.mark.parametrize(("disk", "lp", "h", "v"), [(4e-3, 1.2, 10e-3, 1500.0), (1e-3, 1.0, 20e-3, 0.0)])
def test_error_falls_exponentially_with_the_modes(disk: float, lp: float, h: float, v: float) -> None:
    specimen = Specimen(disk, 20e-3, 40e-6, lp, PARKER)
    truth = reference(specimen, h, v).force[0]
    shear = PARKER.shear_modulus
    field = PARKER.permittivity * (v / 40e-6) ** 2 / shear
    film = Film(
        PARKER.law(np.array(PARKER.mu)[:, None] / shear, np.array(PARKER.alpha)[:, None]),
        np.array([field]) if v else None,
        Evaluations(),
    )
    problem = Problem(film, np.log([lp]), np.log([20e-3 / disk]), np.array([h / 20e-3]))
    unit = 2.0 * np.pi * 20e-3 * 40e-6 * shear / lp**2
    errors = []
    for modes in (2, 4, 6, 8):
        grid = Grid.lay(modes, problem.cut())
        found = refinement.newton(problem, grid, ritz.guess(problem, grid), 1e-10)
        errors.append(abs(float(unit * found.lam[0]) / truth - 1.0))
    assert all(after < before / 20.0 for before, after in pairwise(errors) if before > 1e-11)


def test_newton_converges_with_the_square() -> None:
    """Each step's largest change is of the order of the square of the last one's."""
    shear = PARKER.shear_modulus
    film = Film(PARKER.law(np.array(PARKER.mu)[:, None] / shear, np.array(PARKER.alpha)[:, None]), None, Evaluations())
    problem = Problem(film, np.log([1.2]), np.log([10.0]), np.array([0.5]))
    grid = Grid.lay(8, problem.cut())
    state = ritz.guess(problem, grid)
    changes = []
    for _ in range(5):
        at = ritz.evaluate(problem, grid, state)
        state, change = refinement.advance(state, ritz.newton(problem, grid, state, at), at, grid)
        changes.append(float(change[0]))
    assert all(after < 10.0 * before**2 for before, after in pairwise(changes[1:]) if after > 1e-12)
    assert changes[-1] < 1e-9


def test_evaluations_grow_with_the_states_only() -> None:
    counts = []
    for states in (10, 1000, 10000):
        found = solve_many(FILM, np.linspace(2e-3, 15e-3, states), 1000.0, tolerance=1e-6)
        assert found.answered.all()
        counts.append(found.evaluations.mechanical / states)
    assert max(counts) < 1.2 * min(counts)
    assert max(counts) < 100.0


def test_states_without_voltage_pay_no_electrostatics_beside_charged_ones() -> None:
    h = np.linspace(2e-3, 15e-3, 20)
    mixed = solve_many(FILM, h[:, None], [0.0, 1000.0]).evaluations
    charged = solve_many(FILM, h, 1000.0).evaluations
    bare = solve_many(FILM, h, 0.0).evaluations
    assert bare.electric == 0
    assert mixed.electric == charged.electric
    assert mixed.mechanical == charged.mechanical + bare.mechanical


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_hundred_thousand_states_cost_as_much_each_as_ten_and_no_more_memory_than_a_block() -> None:
    few = solve_many(FILM, np.linspace(2e-3, 15e-3, 10), 1000.0, tolerance=1e-6, sensitivities=True)
    h = np.linspace(2e-3, 15e-3, 100_000)
    tracemalloc.start()
    try:
        found = solve_many(FILM, h, 1000.0, tolerance=1e-6, sensitivities=True)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert found.answered.all()
    assert peak < 200e6
    each, of_few = found.evaluations.mechanical / h.size, few.evaluations.mechanical / 10
    assert 1 / 1.2 < each / of_few < 1.2
