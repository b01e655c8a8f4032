"""Methods of comparison: each meets the reference within what its tolerance promises, and converges at its order."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from model.material.materials import NAMED, Material
from model.specimen import Specimen
from model.verification import baselines
from model.verification.baselines.collocation import _mapped, _read, _solve
from model.verification.baselines.common import Film, largest
from model.verification.baselines.explicit import Explicit
from model.verification.baselines.shooting import Equations
from model.verification.reference import reference

PARKER = NAMED["parker-cao2018"]
SOFT = Material("one term, negative pair", (1e5, -2e3), (1.6, -3.0), 3.0)
CASES = [  # specimen, h, V
    (Specimen(4e-3, 20e-3, 40e-6, 1.2, PARKER), 10e-3, 1500.0),
    (Specimen(4e-3, 20e-3, 40e-6, 1.2, PARKER), 10e-3, 0.0),  # least hoop stress inside the film, not at its edge
    (Specimen(8e-3, 20e-3, 40e-6, 1.0, PARKER), 5e-3, 300.0),
    (Specimen(2e-3, 15e-3, 100e-6, 1.3, SOFT), 12e-3, 1000.0),
]
TOLERANCE = 1e-6
# Error allowed at that tolerance: integrators control the local error, BDF and ode15s loosely (measured 1e-6 to 1e-5).
ALLOWED = {"BDF shooting": 1e-4, "Octave ode15s shooting": 1e-4, "LSODA shooting": 1e-5}


@pytest.fixture(scope="module")
def truth() -> Any:
    specimens, h, voltage = zip(*CASES, strict=True)
    found = reference(specimens, h, voltage)
    assert found.converged.all()
    return found


@pytest.mark.parametrize("name", baselines.BASELINES)
def test_each_method_meets_the_reference(name: str, truth: Any) -> None:
    if name.startswith("Octave") and baselines.octave_available() is None:
        pytest.skip("octave-cli is not on PATH")
    allowed = ALLOWED.get(name, 3e-6)
    cases = CASES[:1] if name.startswith(("Octave", "BDF", "Radau")) else CASES
    for i, (specimen, h, voltage) in enumerate(cases):
        found = baselines.BASELINES[name](specimen, h, voltage, TOLERANCE)
        assert found.ok, found.message
        assert found.evaluations > 0
        assert abs(found.force / truth.force[i] - 1) < allowed
        assert abs(found.peak_field - truth.peak_field[i]) <= allowed * truth.peak_field[i]
        # The least hoop stress is a small difference of large ones, or sits between points.
        assert abs(found.min_hoop_stress / truth.min_hoop_stress[i] - 1) < 30 * allowed


@pytest.mark.parametrize("name", ["DOP853 shooting", "RK45 shooting", "solve_bvp in ln R", "Chebyshev in ln R"])
def test_a_tighter_tolerance_gives_a_smaller_error(name: str, truth: Any) -> None:
    specimen, h, voltage = CASES[0]
    errors = [
        abs(baselines.BASELINES[name](specimen, h, voltage, tolerance).force / truth.force[0] - 1)
        for tolerance in (1e-3, 1e-6, 1e-9)
    ]
    assert errors[1] < 0.1 * errors[0]
    assert errors[2] < max(0.1 * errors[1], 5e-11)
    assert errors[2] < 1e-9


@pytest.mark.parametrize(("integrator", "order"), [("RK45", 5), ("DOP853", 8), ("Radau", 5)])
@pytest.mark.parametrize("form", ["explicit", "paper"])
def test_the_integrators_reach_their_order_on_these_equations(integrator: str, order: int, form: str) -> None:
    import scipy.integrate

    solve_ivp: Any = scipy.integrate.solve_ivp
    film = Film(*CASES[0])
    equations = Equations(film)
    l1, theta = 1.62, 0.75
    n1, _, _ = equations.nominal(l1, film.lp)
    equations.pull, equations.stretch = film.disk * n1 * math.sin(theta), l1
    if form == "explicit":
        rhs, span, start = equations.explicit, (math.log(film.disk), 0.0), [math.log(l1), math.log(film.lp), theta, 0.0]
        steps = (4, 8) if order == 8 else (16, 32)
    else:
        rhs, span, start = equations.paper, (film.disk, 1.0), [film.disk, 0.0, theta]
        steps = (12, 24) if order == 8 else (64, 128)
    exact = solve_ivp(rhs, span, start, method="DOP853", rtol=3e-14, atol=1e-15).y[:, -1]
    errors = []
    for n in steps:
        length = (span[1] - span[0]) / n  # tolerances of 1 leave the step at this length
        end = solve_ivp(rhs, span, start, method=integrator, rtol=1.0, atol=1.0, first_step=length, max_step=length)
        errors.append(np.linalg.norm(end.y[:, -1] - exact))
    assert order - 0.9 < math.log2(errors[0] / errors[1]) < order + 1.2


@pytest.mark.parametrize("case", CASES)
def test_analytic_derivatives_are_those_of_the_slopes(case: tuple[Specimen, float, float]) -> None:
    film = Film(*case)
    whole, single = Explicit(film), Equations(film)
    x = np.log(np.geomspace(film.disk, 1.0, 5))
    y = film.power_law(np.exp(x)) + 0.03 * np.random.default_rng(3).standard_normal((4, 5))
    found, step = whole.jacobian(x, y), 1e-6
    for k in range(4):
        change = step * np.eye(4)[k][:, None]
        differences = (whole.slopes(x, y + change) - whole.slopes(x, y - change)) / (2 * step)
        np.testing.assert_allclose(found[:, k], differences, rtol=1e-7, atol=1e-7)
    for i in range(5):  # the same in plain numbers, and the variational equations
        varied = np.array(single.varied(x[i], np.concatenate([y[:, i], *np.eye(4)[:2]])))
        np.testing.assert_allclose(single.explicit(x[i], y[:, i]), whole.slopes(x, y)[:, i], rtol=1e-12)
        np.testing.assert_allclose(varied[:4], whole.slopes(x, y)[:, i], rtol=1e-12)
        np.testing.assert_allclose(varied[4:].reshape(2, 4), found[:, :2, i].T, rtol=1e-10, atol=1e-12)


def test_the_power_law_meets_both_ends() -> None:
    for case in CASES:
        film = Film(*case)
        log1, log2, theta, z = film.power_law(np.array([film.disk, 1.0]))
        assert z == pytest.approx([0.0, film.height], abs=1e-14)
        assert log2 == pytest.approx(math.log(film.lp))
        assert log1 == pytest.approx(np.log(film.lp / np.cos(theta)))


@pytest.mark.parametrize("coordinate", ["R", "ln R"])
def test_collocation_converges_geometrically(coordinate: str, truth: Any) -> None:
    specimen, h, voltage = CASES[0]
    film = Film(specimen, h, voltage)
    unit = 2 * math.pi * specimen.ring_radius * specimen.thickness / film.lp * specimen.material.shear_modulus
    errors = []
    for n in (6, 10, 14):
        radius, _ = _mapped(film, n, coordinate)
        cone = np.stack([radius, film.height * (radius - film.disk) / (1 - film.disk)])
        shape, _, good = _solve(film, cone, n, coordinate)
        assert good
        errors.append(abs(_read(film, shape, n, coordinate)[0] * unit / truth.force[0] - 1))
    # Four points more gain a constant factor, not a power: the second gain is no smaller than a third of the first.
    assert errors[1] < 0.02 * errors[0]
    assert errors[2] < max(0.02 * errors[1], 2e-12)


@pytest.mark.slow
def test_a_hard_case_gives_a_reason_not_an_exception() -> None:
    specimen = Specimen(4e-3, 20e-3, 40e-6, 1.0, PARKER)
    for name in ("DOP853 shooting", "solve_bvp in ln R", "Chebyshev in ln R"):
        found = baselines.BASELINES[name](specimen, 10e-3, 20e3, 1e-6)  # far beyond pull-in
        assert not found.ok
        assert found.message
        assert math.isnan(found.force)


def test_a_shooting_solve_can_begin_where_the_last_one_ended(truth: Any) -> None:
    specimen, h, voltage = CASES[0]
    cold = baselines.explicit_shooting(specimen, h, voltage, 1e-8)
    near = baselines.explicit_shooting(specimen, 1.02 * h, voltage, 1e-8, start=cold.start)
    far = baselines.explicit_shooting(specimen, 1.02 * h, voltage, 1e-8)
    assert near.force == pytest.approx(far.force, rel=1e-7)
    assert near.evaluations < far.evaluations


def test_without_octave_its_method_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    found = baselines.octave_shooting(*CASES[0], 1e-4)
    assert not found.ok
    assert "octave-cli is not on PATH" in found.message


def test_largest_of_smooth_values_between_points() -> None:
    x = np.linspace(0, 1, 41)
    assert largest(np.sin(2.5 * x)) == pytest.approx(1.0, abs=1e-10)
    assert largest(x) == 1.0
    assert largest(-x) == 0.0
