"""The finite elements that judge the solver: their law, their gradient and Hessian, and a state followed from rest."""

from __future__ import annotations

import numpy as np
import pytest

from model.material.gent import Gent
from model.material.law import stack
from model.material.materials import NAMED, Material
from model.membrane.solve import solve
from model.specimen import Specimen
from model.verification import continuation
from model.verification.continuation import Array, _Path, follow
from model.verification.other_reading import Films

PARKER = NAMED["parker-cao2018"]
GENT = Material("gent", (4e4,), (20.0,), 3.0, law=Gent)
LOGS = np.random.default_rng(2).uniform(-0.2, 0.6, (2, 9))
FIELD = 3e3  # eps (V/T)^2, Pa


def film(material: Material, lp: float = 1.2) -> Specimen:
    return Specimen(4e-3, 20e-3, 40e-6, lp, material)


def energy(material: Material, log1: Array, log2: Array) -> Array:
    """Written out: of Ogden's terms or Gent's, less the energy of the field at constant voltage."""
    l1, l2, l3 = np.exp(log1), np.exp(log2), np.exp(-log1 - log2)
    field = 0.5 * FIELD * (l1 * l2) ** 2
    if material.law is Gent:
        (mu,), (limit,) = material.mu, material.alpha
        return -0.5 * mu * limit * np.log(1.0 - (l1**2 + l2**2 + l3**2 - 3.0) / limit) - field
    terms = zip(material.mu, material.alpha, strict=True)
    return sum(mu / al * (l1**al + l2**al + l3**al - 3.0) for mu, al in terms) - field


@pytest.mark.parametrize("material", [PARKER, GENT], ids=["ogden", "gent"])
def test_stresses_and_tangents_are_differences_of_the_energy(material: Material) -> None:
    found = _Path(film(material), 9, False).stress(*LOGS, FIELD)
    d, (x, y) = 1e-4, LOGS

    def w(i: int, j: int) -> Array:
        return energy(material, x + i * d, y + j * d)

    wanted = (
        (w(1, 0) - w(-1, 0)) / (2.0 * d),
        (w(0, 1) - w(0, -1)) / (2.0 * d),
        (w(1, 0) - 2.0 * w(0, 0) + w(-1, 0)) / d**2,
        (w(1, 1) - w(1, -1) - w(-1, 1) + w(-1, -1)) / (4.0 * d**2),
        (w(0, 1) - 2.0 * w(0, 0) + w(0, -1)) / d**2,
    )
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=2e-6, atol=1.0)


def test_beyond_its_longest_chains_a_gent_film_has_no_stress() -> None:
    found = _Path(film(GENT), 2, False).stress(np.array([0.1, 1.6]), np.array([0.1, 0.1]), 0.0)
    assert np.isfinite(found[0][0]) and np.isnan(found[0][1])


def test_a_natural_width_makes_no_hoop_stress() -> None:
    """Of a neo-Hookean strip ``l2 = l1^-1/2``; where the film is wider already it stays as wide."""
    path = _Path(film(Material("neo", (3e4,), (2.0,), 3.0)), 3, True)
    log1 = np.array([0.2, 0.6, 0.4])
    got = path.widths(log1, np.array([-0.5, -0.4, 0.1]), 0.0)
    np.testing.assert_allclose(got, [-0.1, -0.3, 0.1], atol=1e-12)
    soft = _Path(film(Material("soft", (3e4,), (1.3,), 3.0)), 1, True)
    assert np.isnan(soft.widths(np.array([0.1]), np.array([0.0]), 3e5)).all()  # the field widens it without end


@pytest.mark.parametrize("material", [PARKER, GENT], ids=["ogden", "gent"])
def test_gradient_and_hessian_are_differences_of_the_energy_of_the_mesh(material: Material) -> None:
    path = _Path(film(material), 6, False)
    rng = np.random.default_rng(4)
    r = path.node * (1.0 + 0.05 * rng.random(7))
    z = -6e-3 * np.linspace(0.0, 1.0, 7) ** 2 + 1e-4 * rng.random(7)

    def whole(at: Array) -> float:
        x, y = at[::2], at[1::2]
        log1 = np.log(1.2 * np.hypot(np.diff(x), np.diff(y)) / np.diff(path.node))
        log2 = np.log(1.2 * (x[1:] + x[:-1]) / (path.node[1:] + path.node[:-1]))
        area = np.pi * np.diff(path.node**2) * 40e-6 / 1.2**2
        return float((area * energy(material, log1, log2)).sum())

    at = np.column_stack((r, z)).ravel()
    gradient, band, good = path.system(r, z, FIELD)
    assert good and not path.slack and not path.wrinkled.any()
    hessian = np.zeros((14, 14))
    for i in range(4):
        for j in range(14 - i):
            hessian[j + i, j] = hessian[j, j + i] = band[i, j]
    step = 1e-7
    for k in range(14):
        unit = step * np.eye(14)[k]
        wanted = (whole(at + unit) - whole(at - unit)) / (2.0 * step)
        assert gradient[k] == pytest.approx(wanted, rel=1e-5, abs=1e-6 * np.abs(gradient).max())
        up, down = (path.system(*(at + s * unit).reshape(-1, 2).T, FIELD)[0] for s in (1.0, -1.0))
        np.testing.assert_allclose(hessian[k], (up - down) / (2.0 * step), atol=1e-5 * np.abs(hessian).max())


def test_a_folded_element_carries_no_hoop_stress_and_gives_way_at_constant_stress() -> None:
    """Neo-Hookean: with ``l2 = l1^-1/2`` the energy is ``mu/2 (l^2 + 2/l - 3)``, its stress ``mu (l^2 - 1/l)``."""
    path = _Path(film(Material("neo", (3e4,), (2.0,), 3.0), 1.0), 1, True)
    r = path.node * np.array([0.5, 0.7])  # narrower than it wants to be
    z = np.array([0.0, -20e-3])
    gradient, _, good = path.system(r, z, 0.0)
    assert good and path.wrinkled.all()
    length = float(np.hypot(np.diff(r), np.diff(z))[0])
    stretch = length / 16e-3
    pull = np.pi * (20e-3**2 - 4e-3**2) * 40e-6 * 3e4 * (stretch**2 - 1.0 / stretch) / length
    assert gradient[3] == pytest.approx(-pull * 20e-3 / length, rel=1e-9)
    # Over the stiffness at fixed width, which is ``mu (l^2 + 3/l)``: that of the fold is ``mu (l^2 + 2/l)``.
    assert path.softest == pytest.approx((stretch**3 + 2.0) / (stretch**3 + 3.0))


@pytest.fixture
def longer_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(continuation, "FIRST", 0.2)
    monkeypatch.setattr(continuation, "LEAST", 4e-3)


@pytest.mark.parametrize(("voltage", "sign"), [(0.0, 1.0), (1500.0, -1.0)])
def test_a_state_followed_from_rest_has_the_solver_s_force(voltage: float, sign: float, longer_steps: None) -> None:
    end = follow(film(PARKER), sign * 5e-3, sign * voltage, elements=16)
    assert end.reached and end.voltage == voltage and not end.wrinkled and not end.slack
    assert end.error < 2e-3
    assert end.force == pytest.approx(solve(film(PARKER), sign * 5e-3, voltage).force, rel=end.error)
    assert (end.softest < 1.0) is (voltage > 0.0)


def test_a_branch_that_ends_has_no_force_and_says_where(longer_steps: None) -> None:
    soft = Specimen(4e-3, 20e-3, 100e-6, 3.0, Material("soft", (1e5,), (1.3,), 3.0))
    end = follow(soft, 10e-3, 400.0, elements=8)  # it pulls in at 335 V
    assert not end.reached and np.isnan(end.force) and np.isnan(end.error)
    assert end.voltage == pytest.approx(335.0, rel=0.03)


def test_the_other_reading_has_ogden_s_stresses() -> None:
    l1, l2 = np.exp(LOGS)
    films = Films([film(PARKER)])
    s1, s2, s11, s12 = films._law(l1, l2, np.full(9, FIELD / films.shear))
    law = PARKER.law(np.array(PARKER.mu)[:, None], np.array(PARKER.alpha)[:, None])
    t1, t2, h11, h12, _ = law.derivatives(stack(*LOGS))
    maxwell = FIELD * (l1 * l2) ** 2
    wanted = (t1 - maxwell, t2 - maxwell, h11 - 2.0 * maxwell, h12 - 2.0 * maxwell)
    for one, other in zip((s1, s2, s11, s12), wanted, strict=True):
        np.testing.assert_allclose(films.shear * one, other, rtol=1e-12, atol=1e-6)
