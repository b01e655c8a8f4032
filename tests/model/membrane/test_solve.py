"""The membrane solver against published-grade reference forces, exact scalings and differences of its own force."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import scipy.constants

from model.material.materials import EPSILON_0, NAMED, Material
from model.membrane.solve import Status, Wrinkling, solve, solve_many
from model.specimen import Specimen
from model.verification.reference import reference

PARKER = NAMED["parker-cao2018"]
# The reference forces were computed with the CODATA 2018 vacuum permittivity.
PARKER_2018 = replace(PARKER, eps_r=1.7 * 8.8541878128e-12 / EPSILON_0)

# a (mm), lp, h (mm), V (V), F (N): three formulations agree on these to 1e-13.
REFERENCE = [
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


def film(a_mm: float = 4.0, lp: float = 1.2, material: Material = PARKER, **geometry: float) -> Specimen:
    numbers = {"ring_radius": 0.02, "thickness": 40e-6} | geometry
    return Specimen(disk_radius=a_mm * 1e-3, prestretch=lp, material=material, **numbers)


def test_vacuum_permittivity_is_scipys() -> None:
    assert math.isclose(EPSILON_0, scipy.constants.epsilon_0, rel_tol=1e-9)


def test_hot_path_needs_numpy_only() -> None:
    code = "import sys, model.membrane.solve; assert not [m for m in sys.modules if m.split('.')[0] == 'scipy']"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(("a", "lp", "h", "v", "force"), REFERENCE)
@pytest.mark.parametrize(("tolerance", "error"), [(1e-6, 1e-6), (1e-8, 1e-8), (1e-11, 1e-10)])
def test_reference_forces(
    a: float, lp: float, h: float, v: float, force: float, tolerance: float, error: float
) -> None:
    answer = solve(film(a, lp, PARKER_2018), h * 1e-3, v, tolerance=tolerance)
    assert answer.status is Status.TAUT
    assert answer.stable
    assert abs(answer.force / force - 1.0) < error
    assert 0.0 <= answer.error_estimate <= tolerance


def test_many_states_are_the_single_states() -> None:
    h = np.linspace(1e-3, 20e-3, 7)
    v = np.array([0.0, 800.0, 1500.0])
    many = solve_many(film(), h[:, None], v, tolerance=1e-10)
    assert many.force.shape == (7, 3)
    for i, j in np.ndindex(7, 3):
        one = solve(film(), h[i], v[j], tolerance=1e-10)
        assert one.status == many.status[i, j]
        assert one.force == pytest.approx(many.force[i, j], rel=1e-10)
        assert one.peak_field == pytest.approx(many.peak_field[i, j], rel=1e-7)


def test_films_broadcast_with_states() -> None:
    one_term = Material("one", (4e4,), (4.0,), 2.5)
    films = [film(a, lp, m) for a, lp, m in ((2, 1.2, PARKER), (4, 1.1, one_term), (8, 1.3, PARKER))]
    h = np.array([4e-3, 8e-3])
    many = solve_many(films, h[:, None], 500.0, tolerance=1e-10, sensitivities=True)
    assert many.force.shape == (2, 3)
    assert many.dforce is not None
    assert many.dforce["mu"].shape == (2, 3, 2)
    assert np.isnan(many.dforce["mu"][:, 1, 1]).all()
    for i, j in np.ndindex(2, 3):
        assert solve(films[j], h[i], 500.0, tolerance=1e-10).force == pytest.approx(many.force[i, j], rel=1e-10)


def test_figure_6_peak_fields() -> None:
    """Cao & Conn 2018, figure 6: at 1.5 kV and h = 10 mm the peak field is lowest near a = 5 mm, at the disk."""
    radii = np.arange(2, 9)
    many = solve_many([film(a) for a in radii], 0.01, 1500.0)
    peak = many.peak_field / 1e6
    assert radii[peak.argmin()] == 5
    np.testing.assert_allclose(peak[[0, 3, 6]], [78.0, 74.2, 77.2], atol=0.05)
    np.testing.assert_allclose(many.peak_field_radius, radii * 1e-3, rtol=1e-12)


# Each line: what changes, how the force must change. They hold to round-off, whatever the resolution.
SCALINGS = {
    "thickness and voltage x3": ({"thickness": 3.0, "v": 3.0}, 3.0),
    "lengths x7": ({"a": 7.0, "b": 7.0, "h": 7.0}, 7.0),
    "moduli x11, voltage x sqrt(11)": ({"mu": 11.0, "v": math.sqrt(11.0)}, 11.0),
    "permittivity x4, voltage / 2": ({"eps": 4.0, "v": 0.5}, 1.0),
}


@pytest.mark.parametrize("name", SCALINGS)
@pytest.mark.parametrize(("h", "v"), [(2e-3, 300.0), (10e-3, 1500.0), (20e-3, 900.0)])
def test_exact_scalings(name: str, h: float, v: float) -> None:
    factors, expected = SCALINGS[name]
    f = dict.fromkeys(("a", "b", "thickness", "h", "v", "mu", "eps"), 1.0) | factors
    base = solve(film(), h, v)
    material = replace(PARKER, mu=tuple(m * f["mu"] for m in PARKER.mu), eps_r=PARKER.eps_r * f["eps"])
    scaled = film(4.0 * f["a"], 1.2, material, ring_radius=0.02 * f["b"], thickness=40e-6 * f["thickness"])
    answer = solve(scaled, h * f["h"], v * f["v"])
    assert answer.force / base.force == pytest.approx(expected, rel=1e-12)


def test_splitting_a_term_changes_nothing() -> None:
    halves = replace(PARKER, mu=(5e3, 1.75e4, 1.75e4), alpha=(2.5, 5.6, 5.6))
    assert solve(film(material=halves), 0.01, 1500.0).force == pytest.approx(
        solve(film(), 0.01, 1500.0).force, rel=1e-12
    )


def test_force_is_odd_in_displacement_and_even_in_voltage() -> None:
    many = solve_many(film(), [0.01, -0.01, 0.01], [1200.0, 1200.0, -1200.0], sensitivities=True)
    np.testing.assert_allclose(many.force, many.force[0] * np.array([1, -1, 1]), rtol=1e-14)
    assert many.dforce is not None
    np.testing.assert_allclose(many.dforce["h"], many.dforce["h"][0], rtol=1e-12)
    np.testing.assert_allclose(many.dforce["voltage"], many.dforce["voltage"][0] * np.array([1, -1, -1]), rtol=1e-12)
    assert np.all(many.peak_field > 0.0)


def test_flat_film() -> None:
    flat = solve(film(), 0.0, 1000.0, sensitivities=True)
    assert flat.force == 0.0
    assert flat.status is Status.TAUT
    assert flat.peak_field == pytest.approx(1000.0 * 1.2**2 / 40e-6, rel=1e-10)
    assert flat.dforce is not None
    slope = solve(film(), 1e-7, 1000.0).force / 1e-7
    assert flat.dforce["h"] == pytest.approx(slope, rel=1e-8)


def test_force_of_a_film_without_prestretch_is_cubic() -> None:
    h = np.logspace(-9, -5, 9)
    many = solve_many(film(4, 1.0), h)
    np.testing.assert_array_equal(many.status, Status.TAUT)
    np.testing.assert_allclose(many.force / h**3, many.force[0] / h[0] ** 3, rtol=1e-6)
    assert many.force[-1] == pytest.approx(1.348e-10, rel=5e-4)
    assert solve(film(4, 1.0), 1e-3).force == pytest.approx(1.340e-4, rel=5e-4)


def moved(specimen: Specimen, h: float, v: float, name: str, term: int, factor: float) -> tuple[Specimen, float, float]:
    """The state with one parameter multiplied by ``factor``."""
    m = specimen.material
    if name == "h":
        return specimen, h * factor, v
    if name == "voltage":
        return specimen, h, v * factor
    if name in ("mu", "alpha"):
        values = list(getattr(m, name))
        values[term] *= factor
        return specimen.with_material(replace(m, **{name: tuple(values)})), h, v
    if name == "eps_r":
        return specimen.with_material(replace(m, eps_r=m.eps_r * factor)), h, v
    return replace(specimen, **{name: getattr(specimen, name) * factor}), h, v


@pytest.mark.parametrize(
    ("specimen", "h", "v"),
    [
        (film(), 10e-3, 1500.0),
        (film(2, 1.05), 4e-3, 0.0),
        (film(8, 1.4, Material("m", (5e4, -2e3, 1e3), (1.3, -2.0, 6.0), 3.0)), -15e-3, 700.0),
    ],
)
def test_sensitivities_are_the_differences_of_the_force(specimen: Specimen, h: float, v: float) -> None:
    answer = solve(specimen, h, v, tolerance=1e-12, sensitivities=True)
    assert answer.dforce is not None
    d = 1e-4
    weights = {-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12}
    for name, value in answer.dforce.items():
        for term in range(len(specimen.material.mu) if name in ("mu", "alpha") else 1):
            slope = sum(
                w * solve(*moved(specimen, h, v, name, term, 1 + k * d), tolerance=1e-12).force
                for k, w in weights.items()
            )
            parameter = {"h": h, "voltage": v, "eps_r": specimen.material.eps_r}.get(name)
            if parameter is None:
                holder = specimen.material if name in ("mu", "alpha") else specimen
                parameter = getattr(holder, name)
                parameter = parameter[term] if name in ("mu", "alpha") else parameter
            analytic = (value[term] if name in ("mu", "alpha") else value) * parameter
            assert analytic == pytest.approx(slope / d, rel=1e-6, abs=1e-8 * abs(answer.force)), (name, term)


def test_no_voltage_no_electrostatics() -> None:
    assert solve(film(), 0.01, 0.0, sensitivities=True).evaluations.electric == 0
    assert solve(film(), 0.01, 100.0).evaluations.electric > 0
    assert solve(film(), 0.01, 100.0).evaluations.relaxed == 0


def test_statuses_without_an_answer_carry_no_number() -> None:
    many = solve_many(film(4, 1.0), [math.nan, 0.01, 0.01, 0.001, 0.01], [0.0, math.inf, 0.0, 2500.0, 300.0])
    expected = [Status.INVALID, Status.INVALID, Status.TAUT, Status.SLACK, Status.TAUT]
    np.testing.assert_array_equal(many.status, expected)
    np.testing.assert_array_equal(np.isnan(many.force), [True, True, False, True, False])
    for status in Status:
        assert status.message.endswith(".")


def test_loss_of_hoop_tension_is_told() -> None:
    answer = solve(film(4, 1.0), 10e-3, 1300.0)
    assert answer.status is Status.WRINKLED
    assert answer.min_hoop_stress < 0.0 < answer.min_meridional_stress
    assert answer.tension_margin == answer.min_hoop_stress


def test_limits_of_the_material_are_flagged() -> None:
    many = solve_many(film(), [10e-3, 10e-3, 22e-3], [1500.0, 1700.0, 0.0])
    np.testing.assert_array_equal(many.field_exceeded, [False, True, False])
    np.testing.assert_array_equal(many.stretch_exceeded, [False, False, True])


@pytest.mark.parametrize("tolerance", [0.0, -1.0, 1.0, math.nan])
def test_tolerance_out_of_range_is_refused(tolerance: float) -> None:
    with pytest.raises(ValueError, match="tolerance"):
        solve(film(), 0.01, tolerance=tolerance)


@pytest.mark.parametrize(
    "bad",
    [
        {"disk_radius": 0.02},
        {"disk_radius": -1.0},
        {"thickness": math.nan},
        {"prestretch": 0.0},
        {"ring_radius": math.inf},
    ],
)
def test_impossible_specimens_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        replace(film(), **bad)


@pytest.mark.parametrize(
    ("bad", "text"),
    [
        ({"mu": (1.0,)}, "one of each"),
        ({"mu": (1.0, math.nan)}, "mu"),
        ({"alpha": (0.0, 1.0)}, "alpha"),
        ({"mu": (-1e4, 1e3)}, "shear modulus"),
        ({"eps_r": 0.0}, "eps_r"),
        ({"max_stretch": 0.9}, "max_stretch"),
    ],
)
def test_impossible_materials_are_refused(bad: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        replace(PARKER, **bad)


@pytest.mark.parametrize(
    ("specimen", "h", "v", "wrinkling"),
    [
        (film(), 10e-3, 1500.0, "plain"),
        (film(4, 1.0), -12e-3, 1900.0, "tension_field"),
        (film(4, 1.0), 12e-3, 1300.0, "tension_field"),
        (film(8, 1.3, NAMED["treloar-ogden1972"]), 40e-3, 0.0, "plain"),
    ],
)
def test_profile_obeys_the_equations(specimen: Specimen, h: float, v: float, wrinkling: Wrinkling) -> None:
    """Edges, vertical balance at every radius, strain from the shape, and the extremes that the solution states."""
    answer = solve(specimen, h, v, tolerance=1e-12, wrinkling=wrinkling)
    p = answer.profile(201)
    lp, t = specimen.prestretch, specimen.thickness
    assert np.all(np.diff(p.R) > 0.0)
    np.testing.assert_allclose(p.r[[0, -1]], [specimen.disk_radius, specimen.ring_radius], rtol=1e-12)
    np.testing.assert_allclose(p.z[[0, -1]], [h, 0.0], rtol=1e-10, atol=1e-15)
    force = 2.0 * np.pi * p.R * t / lp * p.stress_1 / p.stretch_1 * np.sin(p.slope)
    np.testing.assert_allclose(force, answer.force, rtol=2e-6)
    # The shape errs with the root of what the force does.
    np.testing.assert_allclose(p.stretch_2[~p.wrinkled], (lp * p.r / p.R)[~p.wrinkled], rtol=1e-7)
    length = np.hypot(np.gradient(p.r, p.R, edge_order=2), np.gradient(p.z, p.R, edge_order=2))
    inside = ~np.isin(np.arange(len(p.R)), np.flatnonzero(np.diff(p.wrinkled.astype(int)))[:, None] + [-1, 0, 1, 2])
    np.testing.assert_allclose((lp * length)[inside], p.stretch_1[inside], rtol=3e-3)
    assert p.field.max() == pytest.approx(answer.peak_field, rel=1e-4, abs=1e-300)
    assert p.stress_1.min() == pytest.approx(answer.min_meridional_stress, rel=1e-4)
    assert p.stress_2.min() == pytest.approx(answer.min_hoop_stress, rel=1e-3, abs=1e-6 * p.stress_1.max())
    assert p.wrinkled.any() == (wrinkling == "tension_field")


def test_no_profile_without_an_answer() -> None:
    with pytest.raises(ValueError, match="slack"):
        solve(film(4, 1.0), 1e-3, 2500.0).profile()


@pytest.mark.slow
def test_the_least_hoop_stress_inside_the_film_converges_with_the_tolerance() -> None:
    """Its minimum is the polynomial's own, not that of a sample: the error falls to round-off, as the force's does."""
    treloar = NAMED["treloar-ogden1972"]
    films = [film(0.4, 1.0, PARKER), film(0.4, 1.2, treloar), film(10.0, 1.0, treloar), film(10.0, 1.2, PARKER)]
    specimens = [f for f in films for _ in range(2)]
    h = np.tile([2e-3, 20e-3], len(films))
    truth = reference(specimens, h, np.zeros(len(h)))
    shear = np.array([f.material.shear_modulus for f in specimens])
    errors = []
    for tolerance in (1e-4, 1e-8, 1e-12):
        found = solve_many(specimens, h, tolerance=tolerance)
        errors.append(np.abs(found.min_hoop_stress - truth.min_hoop_stress) / shear)
        assert np.all(errors[-1] < 3.0 * np.sqrt(tolerance))
    assert errors[0].max() > 1e-4  # it is found inside the film: at an edge it is as good as the force
    assert errors[2].max() < 1e-8


@pytest.mark.slow
def test_plain_equations_are_answered_beyond_slack_while_they_hold_tension_along_the_film() -> None:
    """Compression around, tension along: no film, but what the paper's equations say."""
    film = Specimen(4e-3, 20e-3, 40e-6, 1.0, NAMED["parker-cao2018"])
    voltage = np.array([2330.0, 2380.0, 2430.0])
    plain = solve_many(film, 10e-3, voltage, tolerance=1e-8)
    assert np.all(solve_many(film, 10e-3, voltage, wrinkling="tension_field").status == Status.SLACK)
    truth = reference(film, 10e-3, voltage)
    told = truth.converged
    np.testing.assert_array_equal(plain.status[told], Status.WRINKLED)
    assert told.any()
    np.testing.assert_allclose(plain.force[told], truth.force[told], rtol=1e-7)
    assert np.all(plain.min_meridional_stress[told] > 0.0)
    assert np.all(plain.min_hoop_stress[told] < 0.0)
