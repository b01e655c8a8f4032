"""Films of other laws than Ogden's: identified from cones and sheets, told apart from what they are not."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from calibration.film.curve import Curve
from calibration.film.identifiability import expected_uncertainties
from calibration.film.identify import IdentificationError, identify
from calibration.film.propagation import secant_modulus, shear_slopes
from calibration.sheet.fit import fit_tests
from calibration.sheet.problem import nominal_stress
from calibration.sheet.sheet_tests import HomogeneousTest
from model.material.gent import Gent
from model.material.laws import find_law
from model.material.materials import Material
from model.material.ogden import Ogden

TRUTHS = {
    "neo_hooke": Material("t", (9e4,), (), 2.4, law=find_law("neo_hooke")),
    "mooney_rivlin": Material("t", (4e4, 1e4), (), 2.4, law=find_law("mooney_rivlin")),
    "yeoh": Material("t", (5e4, -1.5e3, 4e2), (), 2.4, law=find_law("yeoh")),
    "gent": Material("t", (8e4,), (14.0,), 2.4, law=Gent),
}
GUESS = Material("guess", (2e4,), (3.0,), 3.5)  # Ogden: of another law than the film


@pytest.mark.parametrize("name", sorted(TRUTHS))
def test_a_film_of_each_law_is_identified(name: str, experiment) -> None:  # type: ignore[no-untyped-def]
    truth = TRUTHS[name]
    curves: list[Curve] = experiment(
        seed=3, truth=truth, guess=GUESS, voltages=(0.0, 1300.0), samples=400, noise=5e-4, disks=(4e-3,)
    )
    found = identify(curves, law=truth.law, starts=2)
    assert found.material.law is truth.law
    assert found.lack_of_fit_probability > 1e-3
    names = list(found.quantities)
    assert names[: len(truth.values)] == list(truth.values)
    for key, value in {**truth.values, "eps_r": truth.eps_r, "G": truth.shear_modulus}.items():
        quantity = found.quantities[key]
        assert abs(quantity.value - value) < 4.0 * quantity.uncertainty, (key, quantity)
    for key, least in (("stiffness", 0.01), ("eps_r", 0.02)):
        assert found.quantities[key].relative < least
    assert found.quantities["stiffness"].value == pytest.approx(secant_modulus(truth, *found.stretch), rel=0.01)
    told = json.loads(found.to_json())
    assert (told["law"], told["terms"]) == (name, 1)
    assert told["convention"] == truth.law.description


def test_the_law_is_that_of_the_specimen_unless_another_is_asked_for(experiment) -> None:  # type: ignore[no-untyped-def]
    truth = TRUTHS["gent"]
    curves = experiment(
        seed=5, truth=truth, guess=replace(truth, mu=(5e4,)), voltages=(0.0,), samples=200, noise=5e-4, disks=(4e-3,)
    )
    assert identify(curves, starts=2).material.law is Gent
    ogden = identify(curves, law=Ogden, terms=1, starts=2)
    assert ogden.material.law is Ogden and list(ogden.quantities)[:2] == ["mu1", "alpha1"]
    held = identify(curves, fixed={"Jm": 14.0}, starts=2)
    assert held.material.alpha == (14.0,) and "Jm" not in held.quantities
    with pytest.raises(IdentificationError, match="cannot fix alpha1; what can be fixed is Jm, eps_r"):
        identify(curves, fixed={"alpha1": 2.0})
    expected = expected_uncertainties(curves, truth)
    assert expected["Jm"].relative == pytest.approx(identify(curves, starts=2).quantities["Jm"].relative, rel=0.5)


@pytest.mark.parametrize("name", sorted(TRUTHS))
def test_slopes_of_the_shear_modulus(name: str) -> None:
    truth = TRUTHS[name]
    by_mu, by_alpha = shear_slopes(truth)
    assert float(by_mu @ truth.mu) == pytest.approx(truth.shear_modulus)  # linear in its moduli
    assert by_alpha == pytest.approx(np.zeros(len(truth.alpha)), abs=1e-6 * truth.shear_modulus)
    by_mu, by_alpha = shear_slopes(Material("o", (5e3, 3.5e4), (2.5, 5.6), 1.7))
    assert by_mu == pytest.approx([1.25, 2.8]) and by_alpha == pytest.approx([2.5e3, 1.75e4])


@pytest.mark.parametrize("name", sorted(TRUTHS))
def test_a_sheet_of_each_law_is_identified(name: str) -> None:
    truth = TRUTHS[name]
    stretch = np.linspace(1.05, 2.6, 25)
    none = np.full_like(stretch, np.nan)
    tests = []
    for kind, other in (("uniaxial", stretch**-0.5), ("equibiaxial", stretch)):
        empty = HomogeneousTest(kind, kind, stretch, other, np.zeros_like(stretch), none)
        exact = nominal_stress(truth.mu, truth.alpha, empty, truth.law)
        noise = 20.0 * np.random.default_rng(1).standard_normal(stretch.size)
        tests.append(replace(empty, stress1=exact + noise))
    fit = fit_tests(tests, law=truth.law, starts=6)
    assert fit.law is truth.law and min(fit.r_squared.values()) > 0.9999
    for key, value in {**truth.values, "G": truth.shear_modulus}.items():
        assert abs(fit.quantities[key].value - value) < 4.0 * fit.quantities[key].uncertainty, key
        assert fit.quantities[key].uncertainty < 0.05 * abs(value)
