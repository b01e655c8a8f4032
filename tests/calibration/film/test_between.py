"""Statistics between specimens: the random-effects mean against simulation and against cases worked by hand."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calibration.film.between import between, identify_each, paule_mandel
from calibration.film.curve import Curve
from model.material.materials import Material

Experiment = Callable[..., list[Curve]]
ONE_TERM = Material(name="one term", mu=(37_834.0,), alpha=(5.4985,), eps_r=1.7)


def test_equal_uncertainties_by_hand() -> None:
    """With equal u the scatter is s^2 = u^2 + t^2."""
    values, own = np.array([9.0, 10.0, 14.0]), np.full(3, 1.5)
    assert paule_mandel(values, own) == pytest.approx(np.var(values, ddof=1) - 2.25)
    assert paule_mandel(values, np.full(3, 5.0)) == 0.0


def test_the_scatter_between_specimens_is_found_on_average() -> None:
    random = np.random.default_rng(4)
    own = np.tile((0.5, 1.0, 2.0, 4.0), 5)
    found = [
        paule_mandel(10.0 + 3.0 * random.standard_normal(20) + own * random.standard_normal(20), own)
        for _ in range(400)
    ]
    assert np.mean(found) == pytest.approx(9.0, rel=0.08)


@pytest.mark.slow
def test_specimens_are_fitted_alone_and_their_scatter_is_told_from_their_uncertainty(experiment: Experiment) -> None:
    """Three films whose permittivities are 1.6, 1.7 and 1.9; the dimensions exact, so that nothing else scatters."""
    curves = []
    for number, eps_r in enumerate((1.6, 1.7, 1.9)):
        for curve in experiment(
            seed=number, truth=replace(ONE_TERM, eps_r=eps_r), guess=ONE_TERM, samples=200, disks=(4e-3,), noise=1e-3
        ):
            specimen = replace(curve.specimen, name=f"film-{number}")
            curves.append(replace(curve, specimen=specimen, run=f"run-{number}"))
    each, failed = identify_each(curves, terms=1, starts=1)
    assert list(each) == ["film-0", "film-1", "film-2"] and not failed
    spread = between(each, one_batch=False)["eps_r"]
    assert spread.mean == pytest.approx(np.mean((1.6, 1.7, 1.9)), abs=0.02)
    assert spread.between == pytest.approx(np.std((1.6, 1.7, 1.9), ddof=1), rel=0.2)
    assert spread.within < 0.05 and spread.probability < 1e-3
    assert spread.uncertainty == pytest.approx(np.hypot(spread.between / np.sqrt(3.0), spread.shared), rel=0.15)
    stiffness = between(each, one_batch=False)["stiffness_fixed"]
    assert stiffness.probability > 1e-3  # they have one stiffness
    assert between({"one": each["film-0"]}, one_batch=False) == {}


@pytest.mark.slow
def test_what_all_share_does_not_average(experiment: Experiment) -> None:
    curves = []
    for number in range(2):
        for curve in experiment(seed=number, truth=ONE_TERM, guess=ONE_TERM, samples=200, disks=(4e-3,)):
            specimen = replace(curve.specimen, name=f"film-{number}")
            changed = replace(curve, specimen=specimen, run=f"run-{number}", thickness_uncertainty=0.05)
            curves.append(changed)
    each, _ = identify_each(curves, terms=1, starts=1)
    apart, together = (between(each, one_batch=one)["eps_r"] for one in (False, True))
    assert together.uncertainty / together.mean == pytest.approx(0.05, rel=0.05)
    assert apart.uncertainty / apart.mean == pytest.approx(0.05 / np.sqrt(2.0), rel=0.05)
