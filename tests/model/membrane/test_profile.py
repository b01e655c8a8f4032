import math
from dataclasses import replace

import numpy as np
import pytest

from model.actuator.energy import stored
from model.material.materials import NAMED
from model.membrane.solve import profiles, solve
from model.specimen import Specimen

SPECIMEN = Specimen(4e-3, 20e-3, 40e-6, 1.2, NAMED["parker-cao2018"])
STATES = [(1e-3, 0.0), (6e-3, 0.0), (6e-3, 1500.0), (11e-3, 1000.0)]


def test_clamped_at_disk_and_ring():
    h, v = np.array(STATES).T
    shape = profiles(SPECIMEN, h, v, 25)
    np.testing.assert_allclose(shape.r[:, [0, -1]], [[4e-3, 20e-3]] * len(h), rtol=1e-12)
    np.testing.assert_allclose(shape.z[:, 0], h, rtol=1e-4)
    assert (shape.z[:, -1] == 0.0).all()


@pytest.mark.parametrize(("h", "voltage"), STATES)
def test_every_ring_carries_the_force(h, voltage):
    """Axial balance 2 pi r t s1 sin(phi) = F, with stretches by differences of the drawn shape and Ogden's stress."""
    shape = profiles(SPECIMEN, np.array([h]), np.array([voltage]), 401)
    r, z = shape.r[0], shape.z[0]
    flat = np.geomspace(4e-3, 20e-3, 401)
    dr, dz, middle = np.diff(r), np.diff(z), 0.5 * (r[1:] + r[:-1])
    l1 = 1.2 * np.hypot(dr, dz) / np.diff(flat)
    l2 = 1.2 * middle / (0.5 * (flat[1:] + flat[:-1]))
    material = SPECIMEN.material
    s1 = sum(mu * (l1**alpha - (l1 * l2) ** -alpha) for mu, alpha in zip(material.mu, material.alpha, strict=True))
    field = voltage * l1 * l2 / SPECIMEN.thickness
    s1 = s1 - 8.8541878128e-12 * material.eps_r * field**2
    force = 2 * math.pi * middle * (SPECIMEN.thickness / (l1 * l2)) * s1 * -dz / np.hypot(dr, dz)
    np.testing.assert_allclose(force, solve(SPECIMEN, h, voltage).force, rtol=2e-3)
    np.testing.assert_allclose(0.5 * (shape.field[0, 1:] + shape.field[0, :-1]), field, rtol=1e-3)


def test_without_an_answer_there_is_no_profile():
    shape = profiles(SPECIMEN, np.array([1e-3, math.nan, 6e-3]), np.array([50e3, 0.0, 0.0]), 9)
    assert np.isnan(shape.r[:2]).all()
    assert np.isfinite(shape.r[2]).all()
    assert profiles(SPECIMEN, np.array([]), np.array([]), 9).r.shape == (0, 9)


def test_pulled_and_pushed():
    shape = profiles(SPECIMEN, np.array([5e-3, -5e-3]), np.zeros(2), 9)
    np.testing.assert_allclose(shape.z[0], -shape.z[1])
    np.testing.assert_allclose(shape.r[0], shape.r[1])


@pytest.mark.parametrize("wrinkling", ["plain", "tension_field"])
def test_many_profiles_are_those_of_the_states(wrinkling):
    film = replace(SPECIMEN, prestretch=1.0)
    h, v = np.array([12e-3, 4e-3, 12e-3]), np.array([1000.0, 900.0, 1900.0])
    many = profiles(film, h, v, 41, tolerance=1e-9, wrinkling=wrinkling)
    for k in range(3):
        one = solve(film, h[k], v[k], tolerance=1e-9, wrinkling=wrinkling).profile(201)
        for name in ("r", "z", "slope", "stretch_1", "stretch_2", "field"):
            drawn = np.interp(many.R[k], one.R, getattr(one, name))
            np.testing.assert_allclose(getattr(many, name)[k], drawn, rtol=3e-3, atol=1e-7, err_msg=name)
        share = {"plain": (0.0, 0.0, 0.0), "tension_field": (0.0, 0.52, 1.0)}[wrinkling][k]
        assert many.wrinkled[k].mean() == pytest.approx(share, abs=0.05)


@pytest.mark.parametrize(
    ("h", "voltage", "wrinkling"),
    [(5e-8, 10.0, "plain"), (8e-3, 1500.0, "plain"), (12e-3, 1900.0, "tension_field"), (0.0, 900.0, "plain")],
)
def test_capacitance_is_the_charge_by_the_voltage(h, voltage, wrinkling):
    """The charge of `model.actuator.energy` is an integral over the drawn profile, and the energy's derivative."""
    charge = stored(SPECIMEN, h, voltage, wrinkling).charge
    assert solve(SPECIMEN, h, voltage, wrinkling=wrinkling).capacitance() == pytest.approx(charge / voltage, rel=1e-8)


def test_capacitance_of_the_flat_film():
    """A plate capacitor: the film is thinner by the pre-stretch squared."""
    area, thickness = math.pi * (20e-3**2 - 4e-3**2), 40e-6 / 1.2**2
    flat = 8.8541878128e-12 * SPECIMEN.material.eps_r * area / thickness
    assert solve(SPECIMEN, 0.0, 500.0).capacitance() == pytest.approx(flat, rel=1e-9)
    with pytest.raises(ValueError, match="no profile"):
        solve(SPECIMEN, 1e-3, 50e3).capacitance()
