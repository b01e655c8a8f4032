"""The fit judged by a cone that shares nothing with the model: coverage, and imperfections called by their names."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from calibration.film.curve import Curve
from calibration.film.identify import identify
from calibration.film.propagation import secant_modulus as model_secant_modulus
from calibration.film.result import Identification, Suspect
from tests.calibration.film.independent import ONE_TERM, Sweep, measured, secant_modulus
from tests.calibration.film.shooting import Array, Cone

NUMERICS = [
    (4e-3, 10e-3, 0.0, 0.2156961965381),
    (4e-3, 10e-3, 1500.0, 0.1614257010326),
    (6e-3, 10e-3, 1500.0, 0.2521456747318),
]


@pytest.mark.parametrize(("a", "h", "voltage", "force"), NUMERICS)
def test_the_independent_cone_has_the_published_forces(a: float, h: float, voltage: float, force: float) -> None:
    assert Cone(a=a).forces(np.array([h]), voltage)[0] == pytest.approx(force, rel=1e-7)


def deviations(seeds: range, **options: Any) -> dict[str, Array]:
    """Errors of permittivity and stiffness in combined standard uncertainties."""
    film, found = Cone(**ONE_TERM), {"eps_r": [], "stiffness": []}
    for seed in seeds:
        result = identify(measured(np.random.default_rng(seed), **options), terms=1, starts=1)
        truth = {"eps_r": film.eps_r, "stiffness": secant_modulus(film, *result.stretch)}
        for name, values in found.items():
            quantity = result.quantities[name]
            values.append((quantity.value - truth[name]) / quantity.uncertainty)
    return {name: np.array(values) for name, values in found.items()}


def test_errors_of_dimensions_and_gains_are_within_what_is_stated() -> None:
    """A few experiments; the two hundred of the slow test say how often."""
    for values in deviations(range(5)).values():
        assert np.abs(values).max() < 4.0
        assert np.sqrt(np.mean(values**2)) < 2.2


@pytest.mark.slow
def test_coverage_in_forty_experiments() -> None:
    """The bounds are those of two hundred, widened by what chance does to forty."""
    for name, values in deviations(range(40), samples=120).items():
        assert np.mean(np.abs(values) < 1.96) >= 0.85, name
        assert 0.7 <= np.sqrt(np.mean(values**2)) <= 1.3, name


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_coverage_in_two_hundred_experiments() -> None:
    for name, values in deviations(range(200), samples=120).items():
        assert 0.90 <= np.mean(np.abs(values) < 1.96) <= 0.99, name
        assert 0.8 <= np.sqrt(np.mean(values**2)) <= 1.2, name


# --- imperfections


@dataclass(frozen=True)
class Imperfection:
    """An imperfection of a given size: what it does to an experiment, and how the fit should call it."""

    name: str
    make: Callable[[float], dict[str, Any]]


def force_of(change: Callable[[Sweep, Array, float], Array]) -> Callable[[float], dict[str, Any]]:
    return lambda size: {"distortion": lambda sweep, force: change(sweep, force, size)}


def volts_of(loss: Callable[[Sweep], Array]) -> Callable[[float], dict[str, Any]]:
    return lambda size: {"voltage_of": lambda sweep: sweep.voltage * (1.0 - size * loss(sweep))}


def film_of(field: str) -> Callable[[float], dict[str, Any]]:
    return lambda size: {"truth": Cone(**ONE_TERM).changed(**{field: size})}


def viscous(tau: float) -> Callable[[float], dict[str, Any]]:
    """A Maxwell branch as stiff as ``size`` times the film at 0 V, worked out step by step through the run."""
    elastic = Cone(**ONE_TERM).curves((0.0,), 12e-3)[0]

    def make(size: float) -> dict[str, Any]:
        last = {"t": 0.0, "branch": 0.0, "elastic": 0.0}

        def distortion(sweep: Sweep, force: Array) -> Array:
            rest, extra = elastic(sweep.h), np.zeros(force.size)
            for k in range(force.size):
                last["branch"] = (
                    last["branch"] * math.exp(-(sweep.time[k] - last["t"]) / tau) + rest[k] - last["elastic"]
                )
                last["t"], last["elastic"], extra[k] = sweep.time[k], rest[k], last["branch"]
            return force + size * extra

        return {"distortion": distortion}

    return make


def reading(change: Callable[[Array, float], Array]) -> Callable[[float], dict[str, Any]]:
    return lambda size: {"reading_of": lambda h: change(h, size)}


def bowed(h: Array, size: float) -> Array:
    return h + size * 4.0 * h / 12e-3 * (1.0 - h / 12e-3)


LENGTH = 3 * 24.0 + 2 * 5.0  # s, of the run
IMPERFECTIONS = [
    Imperfection("drift of the force zero, linear", force_of(lambda s, f, a: f + a * s.time / LENGTH)),
    Imperfection(
        "drift of the force zero, thermal", force_of(lambda s, f, a: f - a * np.expm1(-4.0 * s.time / LENGTH))
    ),
    Imperfection("friction in the guide of the disk", force_of(lambda s, f, a: f + a * s.direction)),
    Imperfection("film that softens from one curve to the next", force_of(lambda s, f, a: f * (1.0 - a * s.number))),
    Imperfection("viscous film with a relaxation time near 1 s", viscous(1.0)),
    Imperfection("viscous film with a relaxation time near 30 s", viscous(30.0)),
    Imperfection("viscous film with a relaxation time near 300 s", viscous(300.0)),
    Imperfection("bowed characteristic of the displacement sensor", reading(bowed)),
    Imperfection("displacement gain", reading(lambda h, a: h * (1.0 + a))),
    Imperfection("loss of voltage that grows with the voltage", volts_of(lambda s: 0.0 * s.h + s.voltage / 1500.0)),
    Imperfection("loss of voltage that grows with stretch", volts_of(lambda s: s.h / 12e-3)),
    Imperfection("loss of voltage that grows with time", volts_of(lambda s: s.time / LENGTH)),
    Imperfection("permittivity that falls with stretch", film_of("stretch_loss")),
    Imperfection("permittivity that changes with the field", film_of("field_gain")),
]
EXACT = dict.fromkeys(("thickness_uncertainty", "prestretch_uncertainty", "disk_radius_uncertainty"), 0.01)
EXACT |= {"ring_radius_uncertainty": 0.002, "voltage_at_film": 0.002, "displacement_axis": 0.002, "force_gain": 1e-3}


@pytest.fixture(scope="module")
def suspects() -> dict[str, Suspect]:
    """Of a perfect experiment: from which size each would show."""
    found = identify(measured(np.random.default_rng(1), stated=EXACT, errors={}), terms=1, starts=1)
    return {one.name: one for one in found.suspects}


def fitted(imperfection: Imperfection, size: float, seed: int) -> Identification:
    curves: list[Curve] = measured(np.random.default_rng(seed), stated=EXACT, errors={}, **imperfection.make(size))
    return identify(curves, terms=1, starts=1)


def names(imperfection: Imperfection) -> str:
    return imperfection.name.replace(" ", "-")


@pytest.mark.parametrize("imperfection", [IMPERFECTIONS[k] for k in (0, 2, 5, 9, 12)], ids=names)
def test_an_imperfection_of_twice_the_size_that_shows_is_named(
    imperfection: Imperfection, suspects: dict[str, Suspect]
) -> None:
    judge(imperfection, suspects)


@pytest.mark.long
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("imperfection", IMPERFECTIONS, ids=names)
def test_every_imperfection_is_named_in_nine_of_ten_experiments(
    imperfection: Imperfection, suspects: dict[str, Suspect]
) -> None:
    size = 2.0 * suspects[imperfection.name].shows_from
    named = [imperfection.name in fitted(imperfection, size, seed).likely for seed in range(10)]
    assert sum(named) >= 9


def judge(imperfection: Imperfection, suspects: dict[str, Suspect]) -> None:
    """Named, about as large as it is, and the results covered."""
    size = 2.0 * suspects[imperfection.name].shows_from
    found = fitted(imperfection, size, seed=5)
    assert imperfection.name in found.likely
    (mine,) = (one for one in found.suspects if one.name == imperfection.name)
    assert 0.3 * size < mine.amplitude < 3.5 * size  # shapes are of first order
    assert any("the residuals look like" in words for words in found.warnings)
    for name, truth in (("eps_r", 1.7), ("stiffness", secant_modulus(Cone(**ONE_TERM), *found.stretch))):
        quantity = found.quantities[name]
        assert quantity.verdict != "identified"
        assert abs(quantity.value - truth) < 3.0 * quantity.uncertainty


def test_a_clean_experiment_raises_no_suspicion() -> None:
    """No suspect, no hint at one, and none of an impossible size counts."""
    for seed in range(3):
        found = identify(measured(np.random.default_rng(seed), stated=EXACT, errors={}), terms=1, starts=1)
        assert found.likely == []
        assert not any("look like" in words for words in found.warnings)


def test_what_is_impossible_is_not_proposed(suspects: dict[str, Suspect]) -> None:
    """Force that falls with time is no viscous film of negative stiffness."""
    drift = IMPERFECTIONS[0]
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
        pytest.param("zero-drift", 0, 4e-3, marks=pytest.mark.slow),
        ("softening", 3, 0.01),
        pytest.param("voltage-loss", 9, 0.08, marks=pytest.mark.slow),
        pytest.param("eps-stretch", 12, 0.3, marks=pytest.mark.slow),
    ],
)
def test_what_is_fitted_along_is_found_and_takes_its_harm_with_it(key: str, which: int, size: float) -> None:
    curves = measured(np.random.default_rng(9), stated=EXACT, errors={}, **IMPERFECTIONS[which].make(size))
    found = identify(curves, terms=1, starts=1, along=[key])
    ((name, shifts),) = found.along.items()
    one = found.nuisance[name]
    assert one.value == pytest.approx(size, abs=0.25 * size + 4.0 * one.uncertainty)
    assert found.likely == []
    assert set(shifts) == {"stiffness", "eps_r"} and all(shift != 0.0 for shift in shifts.values())
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
