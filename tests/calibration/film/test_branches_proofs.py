"""Many experiments on the independent cone that takes time: what is stated of it holds as often as it should.

They take hours: `pytest -m long tests/calibration/film/test_branches_proofs.py`; `test_branches` has a few.
"""

import math

import numpy as np
import pytest

from calibration.film.branches.identify import identify_branches
from calibration.film.propagation import secant_modulus
from model.material.materials import Material
from tests.calibration.film.viscous_cone import ViscousCone
from tests.calibration.film.viscous_runs import ONE_TERM, paper, records, run

pytestmark = [pytest.mark.long, pytest.mark.timeout(36_000)]
EXPERIMENTS, COVERED = 200, 1.96


def drawn(seed: int) -> ViscousCone:
    """A film with one to three branches of 0.05 to 300 s, at least a factor of five apart, and ratios of 0.02 to 2."""
    random = np.random.default_rng(1000 + seed)
    count = 1 + seed % 3
    while True:
        times = np.sort(np.exp(random.uniform(math.log(0.05), math.log(300.0), count)))
        if count == 1 or (np.diff(np.log(times)) > math.log(5.0)).all():
            break
    ratios = np.exp(random.uniform(math.log(0.02), math.log(2.0), count))
    return ViscousCone(branches=tuple(zip(ratios.tolist(), times.tolist(), strict=True)), **ONE_TERM)


def test_coverage_of_films_with_one_to_three_branches() -> None:
    errors: dict[str, list[float]] = {"eps_r": [], "stiffness_fixed": [], "ratio": [], "time": []}
    for seed in range(EXPERIMENTS):
        cone = drawn(seed)
        curves = run(cone, paper(hold=60.0, speed=3e-3), seed)
        found, _ = identify_branches(records(curves), curves, terms=1)
        truth = Material("truth", cone.mu, cone.alpha, cone.eps_r)
        known = {"eps_r": cone.eps_r, "stiffness_fixed": secant_modulus(truth, *found.fixed_stretch)}
        for name, value in known.items():
            quantity = found.quantities[name]
            errors[name].append((quantity.value - value) / quantity.uncertainty)
        assert found.spectrum is not None
        for one in found.spectrum.branches:
            if one.verdict == "identified":
                ratio, time = min(cone.branches, key=lambda branch: abs(math.log(branch[1] / one.time)))
                errors["ratio"].append((one.ratio - ratio) / one.ratio_uncertainty)
                errors["time"].append(math.log(one.time / time) / one.time_relative)
    for name, values in errors.items():
        covered = float(np.mean(np.abs(values) < COVERED))
        print(f"{name}: {len(values)} values, coverage {covered:.3f}")
        assert 0.90 <= covered <= 0.99, name


def test_branches_are_rare_in_elastic_films() -> None:
    cone = ViscousCone(branches=(), **ONE_TERM)
    found = 0
    for seed in range(EXPERIMENTS):
        curves = run(cone, paper(), seed)
        spectrum = identify_branches(records(curves), curves, terms=1)[0].spectrum
        assert spectrum is not None
        found += bool(spectrum.branches)
    assert found <= 0.05 * EXPERIMENTS
