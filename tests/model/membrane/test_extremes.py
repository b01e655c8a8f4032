"""States at the edge of sense: each extreme against the reference, and a grid where nothing may go unsaid."""

from __future__ import annotations

import itertools
import warnings

import numpy as np
import pytest

from model.material.materials import NAMED, Material
from model.membrane.solve import Status, solve, solve_many
from model.specimen import Specimen
from model.stability.limits import slack_voltage
from model.verification.reference import reference

PARKER = NAMED["parker-cao2018"]
RUBBER = NAMED["treloar-ogden1972"]
B = 20e-3


def film(ratio: float = 0.2, lp: float = 1.2, material: Material = PARKER, thickness: float = 40e-6) -> Specimen:
    return Specimen(ratio * B, B, thickness, lp, material)


def material(mu: tuple[float, ...], alpha: tuple[float, ...]) -> Material:
    return Material("extreme", mu, alpha, 3.0)


EXTREMES = {
    "disk of a hundred-thousandth": (film(1e-5), 0.5 * B),
    "disk of a hundred-thousandth, little raised": (film(1e-5, 2.0), 1e-3 * B),
    "disk nearly as large as the ring": (film(0.99), 0.3 * B),
    "exponent 20": (film(0.2, 1.2, material((1e4,), (20.0,))), 3.0 * B),
    "exponent 20, small disk": (film(1e-4, 1.2, material((1e4,), (20.0,))), 0.3 * B),
    "exponent -20": (film(0.3, 1.0, material((-1e4,), (-20.0,))), 0.3 * B),
    "exponents 20 and -20": (film(0.3, 1.2, material((1e3, -1e3), (20.0, -20.0))), 0.3 * B),
    "exponents that nearly agree": (film(0.1, 1.2, material((1e4, 1e4), (3.0, 3.0 + 1e-9))), B),
    "rubber past 90 degrees": (film(0.05, 1.2, RUBBER), 3.0 * B),
    "softest": (film(0.2, 1.2, material((50.0,), (4.0,))), B),
    "hardest": (film(0.2, 1.2, material((5e8,), (4.0,))), B),
    "thinnest": (film(0.2, 1.2, PARKER, 1e-6), B),
    "thickest": (film(0.2, 1.2, PARKER, 1e-3), B),
    "high": (film(0.2, 1.0), 20.0 * B),
}


# The others take the reference seconds each.
QUICK = ("disk nearly as large as the ring", "disk of a hundred-thousandth, little raised", "exponent -20", "thinnest")


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in EXTREMES]
)
def test_extreme(name: str) -> None:
    specimen, h = EXTREMES[name]
    answer = solve(specimen, h, tolerance=1e-8)
    truth = reference(specimen, h).force[0]
    assert answer.status is Status.TAUT
    error = abs(answer.force / truth - 1.0)
    assert error < 1e-8
    assert error < 3.0 * answer.error_estimate


def test_meridian_past_90_degrees() -> None:
    profile = solve(film(0.05, 1.2, RUBBER), 3.0 * B).profile()
    assert profile.slope[0] > np.pi / 2
    assert profile.r.min() < profile.r[0] * (1 - 1e-6)


@pytest.mark.parametrize(
    "specimen", [film(0.2, 1.0), film(0.02, 1.0, RUBBER), film(0.5, 1.0, material((-1e4,), (-3.0,)))]
)
def test_cubic_law_from_a_nanometre(specimen: Specimen) -> None:
    h = np.array([1e-9, 1e-8, 1e-7, 1e-6])
    found = solve_many(specimen, h)
    np.testing.assert_array_equal(found.status, Status.TAUT)
    np.testing.assert_allclose(found.force / h**3, found.force[0] / h[0] ** 3, rtol=1e-6)


def test_cubic_law_goes_over_into_large_deflections() -> None:
    h = B * np.logspace(-7, np.log10(3.0), 25)
    found = solve_many(film(0.2, 1.0), h, tolerance=1e-9)
    np.testing.assert_array_equal(found.status, Status.TAUT)
    power = np.diff(np.log(found.force)) / np.diff(np.log(h))
    assert power[0] == pytest.approx(3.0, abs=1e-6)
    assert np.all(power > 2.0)


def check(
    specimens: list[Specimen], h: np.ndarray, voltage: np.ndarray, wrinkling: str, compare: int | None = None
) -> tuple[int, int]:
    """Statuses and numbers belong together, no warning, none wrong by more than ten estimates; answers, comparisons.

    The reference is a hundred times slower than what it judges: ``compare`` has it judge that many of the answers,
    drawn at random, in place of all.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = solve_many(specimens, h, voltage, tolerance=1e-6, wrinkling=wrinkling)
    answered = found.answered
    for name in ("force", "peak_field", "min_hoop_stress", "max_stretch", "error_estimate"):
        assert np.array_equal(np.isfinite(getattr(found, name)), answered), name
    assert np.all(found.error_estimate[answered] <= 1e-6)
    assert np.all(found.min_meridional_stress[answered] > 0.0)
    judged = np.flatnonzero(answered)
    if compare is not None:
        judged = np.sort(np.random.default_rng(3).choice(judged, compare, replace=False))
    truth = reference([specimens[k] for k in judged], h[judged], voltage[judged], wrinkling=wrinkling)
    wrong = np.abs(found.force[judged] / truth.force - 1.0) > 10.0 * found.error_estimate[judged]
    assert not np.any(wrong & truth.converged), judged[wrong & truth.converged]
    return int(answered.sum()), int(truth.converged.sum())


def grid(ratios: list[float], prestretches: list[float], heights: list[float], voltages: list[float]) -> tuple:
    """Films, heights and voltages (as shares of the loss of tension; 3 is beyond any pull-in of these films)."""
    materials = [
        PARKER,
        RUBBER,
        material((1e4,), (20.0,)),
        material((1e3, -1e3), (20.0, -20.0)),
        material((1e5, -1e4), (2.0, -2.0)),
        material((1e9 / 3.0,), (6.0,)),
        material((1e2 / 2.0, 1e2 / 2.0), (2.0, 2.0 + 1e-7)),
    ]
    made = []
    for number, (ratio, lp, m) in enumerate(itertools.product(ratios, prestretches, materials)):
        specimen = film(ratio, lp, m, (1e-6, 40e-6, 1e-3)[number % 3])
        made += [(specimen, height * B) for height in heights]
    films, h = [specimen for specimen, _ in made], np.array([height for _, height in made])
    low, high = np.zeros(len(made)), np.array([float(slack_voltage(*one)) for one in made])
    for _ in range(10):
        middle = 0.5 * (low + high)
        taut = solve_many(films, h, middle, tolerance=1e-4).status == Status.TAUT
        low, high = np.where(taut, middle, low), np.where(taut, high, middle)
    limit = np.where(low > 0.0, low, 1e3)
    rows = [(specimen, h, share * volt) for (specimen, h), volt in zip(made, limit, strict=True) for share in voltages]
    return [row[0] for row in rows], np.array([row[1] for row in rows]), np.array([row[2] for row in rows])


@pytest.mark.slow
def test_nothing_goes_unsaid() -> None:
    films, h, v = grid([0.1], [1.0, 1.5], [1e-3, 0.3], [0.0, 0.9, 1.3])
    answered, compared = check(films, h, v, "plain")
    assert answered > 0.6 * len(films)
    assert compared > 0.5 * len(films)


@pytest.mark.long
@pytest.mark.timeout(900)
def test_nothing_goes_unsaid_on_five_thousand_states() -> None:
    films, h, v = grid(
        [1e-5, 1e-3, 0.02, 0.3, 0.9],
        [1.0, 1.2, 2.0],
        [5e-8, 1e-3, 0.03, 0.3, 1.0, 3.0],
        [0, 0.5, 0.9, 1.0, 1.1, 1.5, 2, 3],
    )
    assert len(films) >= 5000
    for wrinkling in ("plain", "tension_field"):
        answered, compared = check(films, h, v, wrinkling, compare=240)
        assert answered > 0.4 * len(films)
        assert compared > 0.8 * 240, wrinkling
