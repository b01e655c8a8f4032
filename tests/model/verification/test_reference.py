"""The reference formulation against published and independently computed values, and against exact laws."""

from dataclasses import replace

import numpy as np
import pytest

from model.material.materials import EPSILON_0, Material
from model.specimen import Specimen
from model.verification import taylor_series as series
from model.verification.reference import natural_hoop, reference

# Three formulations (shooting, collocation, energy) agreed on these to 1e-13, with the CODATA 2018 value of eps_0.
# a / mm, lp, h / mm, V / V, F / N
FORCES = [
    (4, 1.2, 10, 0, 0.2156961965381),
    (4, 1.2, 10, 1500, 0.1614257010326),
    (2, 1.2, 10, 0, 0.1461287918486),
    (6, 1.2, 10, 0, 0.3219698581183),
    (8, 1.2, 10, 0, 0.5078728595101),
    (4, 1.0, 10, 0, 0.09407806340927),
    (4, 1.2, 2, 0, 0.02240130840361),
    (4, 1.2, 5, 0, 0.067973294781),
    (4, 1.2, 20, 0, 1.268814921388),
    (2, 1.2, 10, 1500, 0.1051774777934),
    (6, 1.2, 10, 1500, 0.2521456747318),
]
# a = 4 mm, lp = 1, eps_0 = 8.85e-12: three independent tension-field codes. h / mm, V / V, F / N
WRINKLED = [(12, 1500, 0.1055227), (12, 1900, 0.0698233), (14, 1900, 0.1269012)]


def parker(eps_0: float = EPSILON_0) -> Material:
    """Cao & Conn 2018; the permittivity as if the vacuum's were ``eps_0``."""
    return Material("parker", (5e3, 3.5e4), (2.5, 5.6), 1.7 * eps_0 / EPSILON_0)


def film(a_mm: float = 4, prestretch: float = 1.2, material: Material | None = None) -> Specimen:
    return Specimen(a_mm * 1e-3, 20e-3, 40e-6, prestretch, material or parker())


def test_forces_on_which_three_formulations_agree() -> None:
    material = parker(8.8541878128e-12)
    films = [film(a, lp, material) for a, lp, *_ in FORCES]
    found = reference(films, [row[2] * 1e-3 for row in FORCES], [row[3] for row in FORCES])
    np.testing.assert_allclose(found.force, [row[4] for row in FORCES], rtol=1e-12)
    assert found.converged.all()
    assert found.closure.max() < 1e-14
    assert not found.wrinkled.any()


def test_tension_field_forces_on_which_three_codes_agree() -> None:
    h, voltage, force = (np.array(column) for column in zip(*WRINKLED, strict=True))
    found = reference(film(4, 1.0, parker(8.85e-12)), h * 1e-3, voltage, wrinkling="tension_field")
    np.testing.assert_allclose(found.force, force, rtol=5e-7)  # the values have seven digits
    assert found.wrinkled.all()
    assert (found.min_hoop_stress == 0).all()


def test_figure_6_of_cao_and_conn_peak_field() -> None:
    found = reference([film(a) for a in (2, 5, 8)], 10e-3, 1500.0)
    np.testing.assert_allclose(found.peak_field / 1e6, [78.0, 74.2, 77.2], atol=0.05)


def test_a_taut_film_does_not_care_how_wrinkles_would_be_treated() -> None:
    films = [film(4, 1.2), film(2, 1.3)]
    plain = reference(films, 8e-3, 900.0)
    relaxed = reference(films, 8e-3, 900.0, wrinkling="tension_field")
    np.testing.assert_allclose(relaxed.force, plain.force, rtol=1e-13)
    np.testing.assert_allclose(relaxed.min_hoop_stress, plain.min_hoop_stress, rtol=1e-12)


def test_exact_scalings() -> None:
    base, h, v = film(), 10e-3, 1500.0
    m = base.material
    stiffer = base.with_material(Material("", tuple(11 * x for x in m.mu), m.alpha, m.eps_r))
    charged = base.with_material(Material("", m.mu, m.alpha, 4 * m.eps_r))
    split = base.with_material(Material("", (2.5e3, 2.5e3, 3.5e4), (2.5, 2.5, 5.6), m.eps_r))
    films = [
        base,
        replace(base, thickness=3 * base.thickness),
        replace(base, disk_radius=7 * base.disk_radius, ring_radius=7 * base.ring_radius),
        stiffer,
        charged,
        split,
    ]
    found = reference(films, [h, h, 7 * h, h, h, h], [v, 3 * v, v, v * 11**0.5, v / 2, v])
    np.testing.assert_allclose(found.force / found.force[0], [1, 3, 7, 11, 1, 1], rtol=1e-13)


def test_an_unstretched_film_pulls_with_the_cube_of_a_small_displacement() -> None:
    h = np.array([1e-3, 1e-5, 1e-7, 1e-9])
    found = reference(film(4, 1.0), h)
    np.testing.assert_allclose(found.force[:2], [1.340e-4, 1.348e-10], rtol=4e-4)  # values of four digits
    cubic = found.force / h**3
    # The next term is of the order (h/b)^2.
    np.testing.assert_allclose(cubic[1:], cubic[-1], rtol=1e-6)
    np.testing.assert_allclose(cubic[2:], cubic[-1], rtol=1e-10)


def test_a_prestretched_film_begins_as_a_soap_film() -> None:
    # F = 2 pi (T/lp^2) s h / ln(b/a) for small h, with s the stress of the flat film.
    specimen = film(4, 1.2)
    m, lp = specimen.material, 1.2
    stress = sum(u * (lp**al - lp ** (-2 * al)) for u, al in zip(m.mu, m.alpha, strict=True))
    h = 1e-7
    expected = 2 * np.pi * specimen.thickness / lp**2 * stress * h / np.log(5.0)
    np.testing.assert_allclose(reference(specimen, h).force, expected, rtol=1e-9)


@pytest.mark.parametrize("ratio", [1e-2, pytest.param(1e-5, marks=pytest.mark.slow)])
def test_a_disk_small_as_a_needle_still_balances(ratio: float) -> None:
    found = reference(Specimen(20e-3 * ratio, 20e-3, 40e-6, 1.2, parker()), 10e-3)
    assert found.converged.all()
    assert found.closure.max() < 1e-13


def test_a_state_without_tension_is_not_given_a_number() -> None:
    found = reference(film(), 10e-3, [0.0, 3e3, 1e5], wrinkling="tension_field")
    assert found.converged.tolist() == [True, False, False]
    assert np.isnan(found.force[1:]).all()
    assert np.isfinite(found.force[0])


def test_the_neighbours_of_a_state_in_a_call_do_not_change_it() -> None:
    alone = reference(film(2), 8e-3, 900.0)
    among = reference([film(4, 1.0), film(2), film(8, 1.3)], [1e-3, 8e-3, 20e-3], [0.0, 900.0, 3e3])
    np.testing.assert_allclose(among.force[1], alone.force[0], rtol=1e-14)


@pytest.mark.parametrize("wrinkled", [False, True])
def test_the_series_have_the_order_that_they_claim(wrinkled: bool) -> None:
    specimen = film(4, 1.0)
    m = specimen.material
    shear = m.shear_modulus
    states = series.States(
        np.array(m.mu)[:, None] / shear,
        np.array(m.alpha)[:, None],
        np.array([shear]),
        np.array([m.permittivity * (1500.0 / specimen.thickness) ** 2 / shear]),
        np.zeros(1),
        np.log([0.2]),
        np.array([0.6]),
        wrinkled,
    )
    e1, e2 = np.array([0.38]), np.array([0.0])
    natural = natural_hoop(states, e1, e2) if wrinkled else e2
    start = np.stack([e1, e2, natural, np.array([0.65]), np.zeros(1)])
    build = series.wrinkled_series if wrinkled else series.taut_series
    full = build(states, states.log_disk, start, 28)
    short = full[:7]  # up to the sixth power
    step = np.array([0.2])
    error = [np.abs(series.evaluate(short, s) - series.evaluate(full, s)) for s in (step, step / 2)]
    moving = error[0] > 1e-13
    assert moving.sum() == (4 if wrinkled else 5)  # the slope of a pleated zone stays
    np.testing.assert_allclose(np.log2(error[0][moving] / error[1][moving]), 7.0, atol=0.4)
    # and the coefficients solve the equations: the exact one for the circle, e2' = exp(e1 - e2) cos(theta) - 1
    h = 1e-4
    plus, minus = series.evaluate(full, np.array([h])), series.evaluate(full, np.array([-h]))
    np.testing.assert_allclose((plus[1] - minus[1]) / (2 * h), np.exp(0.38) * np.cos(0.65) - 1, rtol=1e-6)


def test_unknown_treatment_is_refused() -> None:
    with pytest.raises(ValueError, match="tension_field"):
        reference(film(), 1e-3, wrinkling="relaxed")
