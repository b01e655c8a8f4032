"""Markov chains against the covariance of the fit, where both should say the same."""

import subprocess
import sys

import numpy as np
import pytest

from calibration.film.identify import identify
from calibration.film.posterior import posterior


@pytest.mark.slow
def test_one_term_has_the_posterior_that_its_covariance_says(experiment):
    curves = experiment(1, samples=200, disks=(4e-3,), voltages=(0.0, 1500.0))
    found = identify(curves, terms=1)
    told: list[tuple[float, float, str]] = []
    chains = posterior(curves, found, progress=lambda *what: told.append(what))
    assert chains.converged and chains.steps >= 50 * chains.autocorrelation
    assert told[-1][:2] == (chains.steps, chains.steps)
    assert 0.2 < chains.acceptance < 0.8
    for name in ("eps_r", "stiffness", "alpha1"):
        quantity, sampled = found.quantities[name], chains.quantities[name]
        fitted = [
            quantity.budget[part] for part in ("noise", "force zero", "displacement zero") if part in quantity.budget
        ]
        assert sampled.deviation == pytest.approx(float(np.linalg.norm(fitted)), rel=0.2), name
        assert abs(sampled.mean - quantity.value) < 0.5 * sampled.deviation
        assert sampled.high - sampled.low == pytest.approx(2 * 1.96 * sampled.deviation, rel=0.15)


@pytest.mark.slow
def test_a_chain_that_is_too_short_says_so(experiment):
    curves = experiment(1, samples=200, disks=(4e-3,), voltages=(0.0, 1500.0))
    assert not posterior(curves, identify(curves, terms=1), steps=60).converged


@pytest.mark.slow
def test_what_the_fit_held_is_held(experiment):
    """A given exponent leaves the modulus several times less uncertain than one that may follow it."""
    curves = experiment(1, samples=200, disks=(4e-3,), voltages=(0.0, 1500.0))
    found = identify(curves, terms=1, fixed={"alpha1": 5.4985})
    chains = posterior(curves, found, steps=400)
    assert "alpha1" not in chains.quantities
    for name in ("mu1", "G", "eps_r"):
        budget = found.quantities[name].budget
        fitted = [budget[part] for part in ("noise", "force zero", "displacement zero")]
        assert chains.quantities[name].deviation == pytest.approx(float(np.linalg.norm(fitted)), rel=0.3), name


@pytest.mark.slow
def test_emcee_is_imported_only_when_asked_for():
    code = "import sys, calibration.film.posterior, rig.analysis.film; sys.exit('emcee' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
