"""Wrinkled films that take time: the relaxed energy with branches, against elements of the simulated bench."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from model.arrays import Array
from model.material.materials import NAMED, Branch
from model.membrane.history import History, solve_histories, solve_history
from model.membrane.solve import Status, solve
from model.specimen import Specimen
from rig.sim.viscous_film import ViscousFilm

BRANCHES = (Branch(0.3, 1.0), Branch(0.2, 10.0))
LOOSE = Specimen(4e-3, 20e-3, 40e-6, 1.0, replace(NAMED["parker-cao2018"], branches=BRANCHES))
T, H = np.array([0.0, 4.0, 6.0, 7.0, 30.0, 300.0]), np.array([0.0, *[12e-3] * 5])
VOLTAGE = np.array([0.0, 0.0, 0.0, 1500.0, 1500.0, 1500.0])


def simulated(elements: int, steps: int) -> Array:
    film = ViscousFilm(LOOSE, [(one.ratio, one.time) for one in BRANCHES], 0.0, elements=elements)
    moment, found = film.rested, [0.0]
    for k in range(1, len(T)):
        for before, after in pairwise(np.linspace(0.0, 1.0, steps + 1) ** 2):
            h, volts = (one[k - 1] + after * (one[k] - one[k - 1]) for one in (H, VOLTAGE))
            moment = film.step(moment, float((after - before) * (T[k] - T[k - 1])), float(h), float(volts))
        found.append(moment.force)
    assert moment.wrinkled.any()
    return np.array(found)


@pytest.mark.slow
def test_force_of_a_folded_film_agrees_with_the_simulated_one() -> None:
    coarse, fine = (simulated(6, steps) for steps in (8, 16))
    exact = fine + (fine - coarse) / 3.0  # of the second order in time
    found = solve_history(LOOSE, T, H, VOLTAGE, tolerance=1e-4, wrinkling="tension_field")
    assert list(found.status) == [Status.TAUT] * 3 + [Status.WRINKLED] * 3
    assert np.abs(found.force - exact).max() < 1e-4 * exact.max()
    assert (found.error_estimate < 1e-4).all()
    assert (found.min_hoop_stress[3:] == 0.0).all() and (found.min_meridional_stress[3:] > 0.0).all()
    elastic = solve(LOOSE, 12e-3, 1500.0, wrinkling="tension_field")
    assert found.force[-1] == pytest.approx(elastic.force, rel=3e-5)
    assert found.peak_field[-1] == pytest.approx(elastic.peak_field, rel=1e-2)


def test_a_taut_film_is_the_same_whatever_folds_would_do() -> None:
    both: list[History] = [
        solve_history(LOOSE, T[:3], H[:3], 0.0, tolerance=1e-3, wrinkling=kind) for kind in ("plain", "tension_field")
    ]
    np.testing.assert_array_equal(both[0].force, both[1].force)
    np.testing.assert_array_equal(both[0].error_estimate, both[1].error_estimate)


@pytest.mark.slow
def test_a_film_that_hangs_is_slack() -> None:
    """Pulled back faster than it relaxes, and under a voltage that takes all tension."""
    back = solve_history(LOOSE, [0, 5, 5.3, 8], [0, 10e-3, 1e-3, 1e-3], 0.0, tolerance=1e-3, wrinkling="tension_field")
    assert (back.status[:2] <= Status.WRINKLED).all() and (back.status[2:] == Status.SLACK).all()
    assert np.isnan(back.force[2:]).all()
    high = solve_history(LOOSE, [0, 5, 25], [0, 6e-3, 6e-3], [0, 0, 6000.0], tolerance=1e-3, wrinkling="tension_field")
    assert high.status[1] == Status.TAUT and high.status[2] == Status.SLACK


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_derivatives_of_a_folded_film() -> None:
    course, times = (T[:5], H[:5], VOLTAGE[:5]), [7.0, 20.0]
    how = {"tolerance": 1e-4, "wrinkling": "tension_field"}
    nearly = replace(LOOSE, prestretch=1.01)
    found = solve_history(nearly, *course, times, sensitivities=True, **how)  # type: ignore[arg-type]
    assert found.dforce is not None and (found.status == Status.WRINKLED).all()
    m = nearly.material
    films = [nearly.with_material(replace(m, eps_r=1.7 * s)) for s in (1.005, 0.995)]
    films += [replace(nearly, prestretch=1.01 * s) for s in (1.005, 0.995)]
    forces = [one.force for one in solve_histories(films, [(*course, times)] * 4, **how)]  # type: ignore[arg-type]
    for number, (name, value) in enumerate((("eps_r", 1.7), ("prestretch", 1.01))):
        central = (forces[2 * number] - forces[2 * number + 1]) / 0.01
        np.testing.assert_allclose(found.dforce[name] * value, central, rtol=1e-2, err_msg=name)
