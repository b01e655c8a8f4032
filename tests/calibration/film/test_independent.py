"""The fit judged by a cone that shares nothing with the model: coverage, and imperfections called by their names."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.film.identify import identify
from calibration.film.propagation import secant_modulus as model_secant_modulus
from calibration.film.result import Suspect
from tests.calibration.film.imperfections import FINE, IMPERFECTIONS, Imperfection, experiment
from tests.calibration.film.independent import ONE_TERM, measured, secant_modulus
from tests.calibration.film.independent import STATED as LOOSE
from tests.calibration.film.shooting import Cone
from tests.calibration.film.viscous_cone import ViscousCone

NUMERICS = [
    (4e-3, 10e-3, 0.0, 0.2156961965381),
    (4e-3, 10e-3, 1500.0, 0.1614257010326),
    (6e-3, 10e-3, 1500.0, 0.2521456747318),
]


@pytest.mark.parametrize(("a", "h", "voltage", "force"), NUMERICS)
def test_the_independent_cone_has_the_published_forces(a: float, h: float, voltage: float, force: float) -> None:
    assert Cone(a=a).forces(np.array([h]), voltage)[0] == pytest.approx(force, rel=1e-7)


def test_errors_of_dimensions_and_gains_are_within_what_is_stated(tmp_path: Path) -> None:
    """One experiment; `test_proofs` says how often."""
    _, errors = experiment(None, 0.0, 0, tmp_path, stated=LOOSE | {"force_gain": 0.005})
    assert all(abs(error) < 4.0 for error in errors.values())


@pytest.mark.slow
@pytest.mark.long  # twenty: `test_coverage_of_the_stated_intervals`
def test_coverage_in_thirty_experiments(tmp_path: Path) -> None:
    """The bounds are those of two hundred, widened by what chance does to thirty."""
    stated = LOOSE | {"force_gain": 0.005}
    found = [experiment(None, 0.0, seed, tmp_path, stated=stated)[1] for seed in range(30)]
    for name in ("eps_r", "stiffness"):
        values = np.array([one[name] for one in found])
        assert np.mean(np.abs(values) < 1.96) >= 0.83, name
        assert 0.65 <= np.sqrt(np.mean(values**2)) <= 1.35, name


EXACT = dict.fromkeys(("thickness_uncertainty", "prestretch_uncertainty", "disk_radius_uncertainty"), 0.01)
EXACT |= {"ring_radius_uncertainty": 0.002, "voltage_at_film": 0.002, "displacement_axis": 0.002, "force_gain": 1e-3}


@pytest.fixture(scope="module")
def suspects() -> dict[str, Suspect]:
    """Of a perfect experiment: from which size each would show."""
    found = identify(measured(np.random.default_rng(1), stated=EXACT, errors={}), terms=1, starts=1)
    assert found.likely == []
    return {one.name: one for one in found.suspects}


def fitted(imperfection: Imperfection, size: float, seed: int, **options: Any) -> Any:
    curves = measured(np.random.default_rng(seed), stated=EXACT, errors={}, **imperfection.make(size))
    return identify(curves, terms=1, starts=1, **options)


def called(name: str) -> Imperfection:
    (one,) = (one for one in IMPERFECTIONS if one.name == name)
    return one


NAMED = [
    pytest.param("film that softens from one curve to the next"),
    *(
        pytest.param(name, marks=pytest.mark.slow)
        for name in (
            "drift of the force zero, linear",
            "friction in the guide of the disk",
            "loss of voltage that grows with the voltage",
            "permittivity that falls with stretch",
        )
    ),
    pytest.param("viscous film with a relaxation time near 30 s", marks=pytest.mark.long),
]


@pytest.mark.parametrize("name", NAMED)
def test_an_imperfection_of_twice_the_size_that_shows_is_named(name: str, suspects: dict[str, Suspect]) -> None:
    """Named, about as large as it is, and the results covered."""
    size = 2.0 * suspects[name].shows_from
    found = fitted(called(name), size, seed=5)
    assert name in found.likely
    (mine,) = (one for one in found.suspects if one.name == name)
    assert 0.3 * size < mine.amplitude < 3.5 * size  # shapes are of first order
    assert any("the residuals look like" in words for words in found.warnings)
    for quantity_name, truth in (("eps_r", 1.7), ("stiffness", secant_modulus(Cone(**ONE_TERM), *found.stretch))):
        quantity = found.quantities[quantity_name]
        assert quantity.verdict != "identified"
        assert abs(quantity.value - truth) < 3.0 * quantity.uncertainty


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tau", "size"),
    [
        (30.0, 0.02),
        *(pytest.param(*case, marks=pytest.mark.long) for case in ((1.0, 0.02), (300.0, 0.1))),
    ],
)
def test_the_size_of_a_viscous_suspect_is_that_of_the_films_branch(tau: float, size: float) -> None:
    """A branch of finite elements that share nothing with the model, and a load cell that tells its time."""
    name = f"viscous film with a relaxation time near {tau:g} s"
    made = called(name).make(size)
    found = identify(measured(np.random.default_rng(3), stated=EXACT, errors={}, noise=FINE, **made), terms=1, starts=1)
    (mine,) = (one for one in found.suspects if one.name == name)
    assert found.likely[0] == name
    assert mine.uncertainty < 0.1 * size
    assert mine.amplitude == pytest.approx(size, abs=3.0 * mine.uncertainty + 0.1 * size)  # of the first order


@pytest.mark.slow
def test_a_viscous_suspect_knows_of_a_hold_between_moves_of_one_curve() -> None:
    """Up, held, down, and the same again, at one voltage: a branch of 10 s shows in the holds, as large as it is."""
    film = ViscousCone(branches=((0.05, 10.0),), **ONE_TERM)
    bends, way = (0.0, 5.0, 65.0, 70.0, 75.0, 135.0, 140.0), (2e-4, 1e-2, 1e-2, 2e-4, 1e-2, 1e-2, 2e-4)
    trace = film.history(bends, way, 7 * (0.0,), moves=100)
    time = np.arange(0.05, 140.0, 0.1)
    (like, *_) = measured(np.random.default_rng(3), stated=EXACT, errors={}, noise=FINE, voltages=(0.0,))
    noise = FINE[0] * np.random.default_rng(4).standard_normal(time.size)
    h = np.interp(time, bends, way)
    direction = np.select([time % 70.0 < 5.0, time % 70.0 > 65.0], [1, -1]).astype(np.int8)
    curve = replace(
        like,
        h=h,
        force=np.interp(time, trace.t, trace.force) + noise,
        voltage=np.zeros(time.size),
        direction=direction,
        time=time,
        flagged=None,
    )
    found = identify([curve], terms=1, starts=1)
    assert found.suspects[0].name == "viscous film with a relaxation time near 10 s"
    assert found.suspects[0].amplitude == pytest.approx(0.05, rel=0.05)


@pytest.mark.slow
def test_a_clean_experiment_raises_no_suspicion() -> None:
    """No suspect, no hint at one, and none of an impossible size counts."""
    for seed in range(3):
        found = identify(measured(np.random.default_rng(seed), stated=EXACT, errors={}), terms=1, starts=1)
        assert found.likely == []
        assert not any("look like" in words for words in found.warnings)


def test_what_is_impossible_is_not_proposed(suspects: dict[str, Suspect]) -> None:
    """Force that falls with time is no viscous film of negative stiffness."""
    drift = called("drift of the force zero, linear")
    found = fitted(drift, -2.0 * suspects[drift.name].shows_from, seed=7)
    assert drift.name in found.likely
    for one in found.suspects:
        if one.family in ("viscous film", "friction in the guide of the disk", "permittivity that falls with stretch"):
            assert one.amplitude >= 0.0 or not one.significant


def test_what_does_to_the_data_what_another_film_does_never_shows(suspects: dict[str, Suspect]) -> None:
    """Thickness and a constant loss of voltage; both are in the budget."""
    for name, part in (
        ("thickness other than stated", "thickness"),
        ("constant loss of voltage", "voltage at the film"),
    ):
        assert math.isinf(suspects[name].shows_from)
        assert suspects[name].part == part


@pytest.mark.parametrize(
    ("key", "which", "size"),
    [
        pytest.param("zero-drift", "drift of the force zero, linear", 4e-3, marks=pytest.mark.slow),
        ("softening", "film that softens from one curve to the next", 0.01),
        pytest.param("voltage-loss", "loss of voltage that grows with the voltage", 0.08, marks=pytest.mark.slow),
        pytest.param("eps-stretch", "permittivity that falls with stretch", 0.3, marks=pytest.mark.slow),
    ],
)
def test_what_is_fitted_along_is_found_and_takes_its_harm_with_it(key: str, which: str, size: float) -> None:
    curves = measured(np.random.default_rng(9), stated=EXACT, errors={}, **called(which).make(size))
    found = identify(curves, terms=1, starts=1, along=[key])
    ((name, shifts),) = found.along.items()
    one = found.nuisance[name]
    assert one.value == pytest.approx(size, abs=0.25 * size + 4.0 * one.uncertainty)
    assert found.likely == []
    assert set(shifts) == {"stiffness", "eps_r"} and all(shift != 0.0 for shift in shifts.values())
    truth = {"eps_r": 1.7, "stiffness": secant_modulus(Cone(**ONE_TERM), *found.stretch)}
    for quantity, value in truth.items():
        assert abs(found.quantities[quantity].value - value) < 3.0 * found.quantities[quantity].uncertainty
    plain = identify(curves, terms=1, starts=1).material
    before = {"eps_r": plain.eps_r, "stiffness": model_secant_modulus(plain, *found.stretch)}
    for quantity, shift in shifts.items():
        moved = found.quantities[quantity].value - before[quantity]
        assert moved == pytest.approx(shift, abs=0.3 * abs(shift) + 3e-3 * before[quantity])


def test_only_what_can_be_fitted_along_is() -> None:
    curves = measured(np.random.default_rng(9), stated=EXACT, errors={}, samples=60, voltages=(0.0,))
    with pytest.raises(ValueError, match="cannot fit friction along; what can be is eps-stretch, softening"):
        identify(curves, terms=1, starts=1, along=["friction"])
    with pytest.raises(ValueError, match="these data have nothing to do with it"):
        identify(curves, terms=1, starts=1, along=["voltage-loss"])


def test_a_film_with_another_law_is_called_so() -> None:
    """Gent's film, fitted with a single term of exponent 2."""
    film = Cone(mu=(5e4,), alpha=(2.0,), eps_r=2.5, jm=8.0)
    curves = measured(np.random.default_rng(4), truth=film, stated=EXACT, errors={}, voltages=(0.0, 1000.0))
    found = identify(curves, terms=1, starts=1, fixed={"alpha1": 2.0})
    assert any(name.startswith("law that stiffens") for name in found.likely)
    assert all(quantity.verdict != "identified" for quantity in found.quantities.values())
