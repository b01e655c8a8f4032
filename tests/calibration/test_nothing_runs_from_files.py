"""Nothing executable is read from a file, and lmfit's measured traps are not stepped into."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import lmfit
import numpy as np
import pytest

from calibration.film.curve import Curve
from calibration.film.identify import identify
from calibration.film.problem import Problem
from calibration.film.reduction import select
from model.material.materials import Material
from model.material.ogden import Ogden

Experiment = Callable[..., list[Curve]]

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("calibration", "drivers", "model", "rig", "sim_fixtures")
ONE_TERM = Material(name="one term", mu=(37_834.0,), alpha=(5.4985,), eps_r=1.7)

FORBIDDEN = {
    "pickle and its kin": r"\b(pickle|cPickle|dill|joblib|shelve|marshal|cloudpickle)\b",
    "eval, exec, compile": r"(?<![\w.])(eval|exec|compile)\s*\(",
    "arrays of objects from files": r"allow_pickle",
    "YAML": r"\byaml\b",
    "lmfit's own files": r"\b(load_model|load_modelresult|save_model|save_modelresult)\b|lmfit\.jsonutils",
    "lmfit's dumps and loads": r"(?:[Pp]arameters?|params|result|model|minimi[sz]er)\.(?:dumps?|loads?)\(",
    "expressions": r"\bexpr\s*=|asteval",
}


@pytest.mark.parametrize("what", FORBIDDEN)
def test_no_source_reads_code_from_files(what: str) -> None:
    sources = [path for room in ROOMS for path in (ROOT / room).rglob("*.py")]
    assert len(sources) > 100
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in sources
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if re.search(FORBIDDEN[what], line)
    ]
    assert not found


def test_the_patterns_find_what_they_forbid() -> None:
    examples = (
        "import pickle",
        "x = eval(text)",
        "np.load(f, allow_pickle=True)",
        "yaml.load(f)",
        "lmfit.model.load_model(p)",
        "parameters.loads(text)",
        "parameters.add('a', expr='b')",
    )
    for pattern, example in zip(FORBIDDEN.values(), examples, strict=True):
        assert re.search(pattern, example), example


def test_the_installed_evaluator_is_one_without_known_holes() -> None:
    import asteval

    assert tuple(int(part) for part in asteval.__version__.split(".")[:3]) >= (1, 0, 10)


# --- lmfit


def test_a_one_sided_bound_stops_lmfit_on_small_numbers_and_our_parameters_are_of_order_one(
    experiment: Experiment,
) -> None:
    """lmfit's transform of a one-sided bound has a scale of 1: a parameter of 5e-12 stays where it started."""
    x = np.linspace(1.0, 2.0, 20)

    def residual(p: lmfit.Parameters) -> np.ndarray:
        return (p["c"].value * x - 5e-12 * x) / 1e-14

    start = lmfit.Parameters()
    start.add("c", value=3e-12, min=0.0)
    stuck = lmfit.minimize(residual, start)
    assert stuck.success
    assert stuck.params["c"].value == pytest.approx(3e-12, rel=0.01)  # the trap is still there
    curves: list[Curve] = experiment(samples=100)
    problem = Problem(curves, select(curves, ONE_TERM), 1, ONE_TERM)
    size = np.abs(problem.vector(ONE_TERM)[: problem.film_parameters])
    assert ((size > 0.1) & (size < 100.0)).all()
    low, high = problem.bounds(problem.vector(ONE_TERM))
    one_sided = np.isfinite(low) ^ np.isfinite(high)
    assert not one_sided.any()
    assert all(p.search[0] > 0.0 for p in (*Ogden.moduli, *Ogden.shapes))


def test_wrong_noise_shows_because_the_covariance_is_not_scaled_by_it(experiment: Experiment) -> None:
    """lmfit's default divides a wrong noise out of the uncertainties; ours states it as a ratio and as chi-square."""
    curves: list[Curve] = experiment(samples=400, guess=ONE_TERM, truth=ONE_TERM)
    right = identify(curves, terms=1, starts=1)
    cautious = identify([replace(c, force_noise=2 * c.force_noise) for c in curves], terms=1, starts=1)
    assert cautious.reduced_chi_square == pytest.approx(right.reduced_chi_square / 4, rel=0.02)
    assert cautious.quantities["eps_r"].budget["noise"] > 1.8 * right.quantities["eps_r"].budget["noise"]


def test_a_wrong_jacobian_would_be_believed_by_lmfit() -> None:
    """Why `test_identify` holds ours against finite differences: lmfit calls wrong numbers a success."""
    x = np.linspace(0.0, 1.0, 30)
    y = np.exp(-0.7 * x)

    def residual(p: lmfit.Parameters) -> np.ndarray:
        return np.exp(-p["k"].value * x) - y

    def wrong(p: lmfit.Parameters) -> np.ndarray:
        return (x * np.exp(-p["k"].value * x))[:, None]  # the sign is wrong

    start = lmfit.Parameters()
    start.add("k", value=0.49, min=0.0, max=10.0)
    found = lmfit.minimize(residual, start, method="least_squares", jac=wrong)
    assert found.success
    assert abs(found.params["k"].value - 0.7) > 0.1
