"""A law's parameters from homogeneous tests, with uncertainties that allow for what least squares does not see."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.film.result import CONVENTION, Quantity, quantity_dict, verdict
from calibration.sheet.judgement import TestJudgement, inflation, judge_tests, warnings_of
from calibration.sheet.problem import (
    EXPONENT_BOUNDS,
    SHARE_BOUNDS,
    SheetProblem,
    Weighting,
    nominal_stress,
    r_squared,
)
from calibration.sheet.search import Minimum, distinct, minima
from calibration.sheet.sheet_tests import HomogeneousTest, TestsError
from model.material.law import Law
from model.material.ogden import Ogden

Array = NDArray[np.float64]

SAME_MINIMUM = 1.0  # chi-square, in units of the scatter about the best fit, by which minima count as equally good
VANISHED = 1e-6  # of the stress: a term that carries less is not there
BADLY_PREDICTED = 0.9  # R^2 below which a test counts as not predicted


@dataclass(frozen=True)
class TestsFit:
    """A law that was fitted to a set of tests.

    ``quantities`` holds the law's parameters (``mu1``, ``alpha1``, ...) and ``G``. The standard uncertainty has as
    parts the scatter about the fit, correlation allowed for; what another weighting would give instead, and for ``G``
    what the model misses at small strains (both as half-widths of uniform distributions: JCGM 100:2008, 4.3.7).
    ``r_squared`` is the share of each fitted test's variance that the model explains, ``prediction`` the same for tests
    that took no part. ``others`` are further minima that fit equally well, ``fixed``
    the parameters that were held, which have no quantity.
    """

    __test__ = False

    mu: tuple[float, ...]
    alpha: tuple[float, ...]
    quantities: dict[str, Quantity]
    r_squared: dict[str, float]
    prediction: dict[str, float]
    residuals: dict[str, tuple[float, ...]]
    others: list[Minimum]
    starts: int
    warnings: list[str]
    cost: float = 0.0
    aicc: float = math.nan
    weighting: Weighting = "balanced"
    law: type[Law] = Ogden
    tests: dict[str, TestJudgement] = field(default_factory=dict)
    fixed: dict[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings, lists and dictionaries."""
        return {
            "format": "dea-rig homogeneous tests 1",
            "convention": CONVENTION if self.law is Ogden else self.law.description,
            "law": self.law.name,
            "weighting": self.weighting,
            "fixed": self.fixed,
            "quantities": {name: quantity_dict(quantity) for name, quantity in self.quantities.items()},
            "r_squared": self.r_squared,
            "prediction_r_squared": {name: _finite(value) for name, value in self.prediction.items()},
            "residuals_Pa": {name: list(values) for name, values in self.residuals.items()},
            "tests": {name: one.to_dict() for name, one in self.tests.items()},
            "equally_good": [
                {"mu_Pa": list(other.mu), "alpha": list(other.alpha), "cost": other.cost} for other in self.others
            ],
            "cost": self.cost,
            "aicc": _finite(self.aicc),
            "starts": self.starts,
            "warnings": self.warnings,
        }

    def to_json(self) -> str:
        """`to_dict` as JSON text."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def fit_tests(
    tests: Sequence[HomogeneousTest],
    *,
    terms: int = 3,
    starts: int = 8,
    seed: int = 0,
    weighting: Weighting = "balanced",
    predict: Sequence[HomogeneousTest] = (),
    law: type[Law] = Ogden,
    fixed: Mapping[str, float] | None = None,
    negative_exponents: bool = True,
) -> TestsFit:
    """Fit a law to one or several tests at once.

    Parameters
    ----------
    terms : int
        Number of terms of a law that is a series, as Ogden's.
    starts : int
        How many of the best points of a grid of exponents are followed to their minimum (for other laws: random ones).
    weighting : {"balanced", "absolute", "relative", "noise"}
        "balanced" makes every test count alike, whatever its stresses and its number of points: it minimises the sum of
        ``1 - R^2``. "absolute" counts errors in pascal, "relative" relative ones, so that small stretches matter as
        much as large ones; stresses below a hundredth of the largest are weighted like that. "noise" counts in the
        scatter of each test about a smooth curve.
    predict : sequence of HomogeneousTest
        Tests that take no part in the fit and are held against it: a fit to one mode can fail badly in another.
    fixed : mapping of str to float, optional
        Shape parameters of the law (``alpha1``..., ``Jm``) that are known and not fitted; they have no quantity.
    negative_exponents : bool
        Whether an Ogden term may have ``alpha < 0`` (with ``mu < 0``).

    Raises
    ------
    TestsError
        When there are fewer data than parameters, or the stresses are no data of a sheet.
    """
    if not tests:
        raise TestsError("there are no tests to fit")
    used = [test.averaged() for test in tests]
    held: dict[str, Any] = {"fixed": fixed, "negative_exponents": negative_exponents}
    problem = SheetProblem(used, terms, weighting, law, **held)
    if problem.count <= problem.fitted:
        raise TestsError(f"{problem.count} stresses cannot determine {problem.fitted} parameters")
    found = minima(problem, starts, seed)
    best = found[0]
    judged = judge_tests(problem, best)
    others = [
        minima(SheetProblem(used, terms, weights, law, **held), max(2, starts // 2), seed)[0]
        for weights in _others(weighting, len(used))
    ]
    factor = inflation(problem, judged)
    quantities = _quantities(problem, best, others, judged, factor)
    equal = best.cost * (1.0 + SAME_MINIMUM * factor / (problem.count - problem.fitted))
    fit = TestsFit(
        mu=best.mu,
        alpha=best.alpha,
        quantities=quantities,
        r_squared={test.name: r_squared(best.mu, best.alpha, test, law) for test in tests},
        prediction={test.name: r_squared(best.mu, best.alpha, test, law) for test in predict},
        residuals={
            test.name: tuple(float(v) for v in test.measured - nominal_stress(best.mu, best.alpha, test, law))
            for test in tests
        },
        others=distinct([minimum for minimum in found if minimum.cost <= equal])[1:],
        starts=starts,
        warnings=[],
        cost=best.cost,
        aicc=_aicc(problem, best),
        weighting=weighting,
        law=law,
        tests=judged,
        fixed=problem.fixed,
    )
    fit.warnings.extend(warnings_of(problem, best, judged, quantities["G"].value))
    fit.warnings.extend(_warnings(fit, tests, predict))
    return fit


def _others(weighting: Weighting, tests: int) -> list[Weighting]:
    """The weightings beside which a result must stand; of one test "balanced" and "absolute" are the same."""
    wanted: list[Weighting] = ["relative", "absolute", "balanced"] if tests > 1 else ["relative", "absolute"]
    same = {weighting, "absolute"} if tests == 1 and weighting == "balanced" else {weighting}
    return [one for one in wanted if one not in same]


def _aicc(problem: SheetProblem, best: Minimum) -> float:
    """Akaike's criterion with the correction for few data. All laws count the same data, correlated or not."""
    n, k = problem.count, problem.fitted + 1  # the scatter is estimated too
    if not best.cost > 0.0 or n - k - 1 <= 0:
        return math.nan
    return n * math.log(best.cost / n) + 2.0 * k + 2.0 * k * (k + 1.0) / (n - k - 1.0)


def _quantities(
    problem: SheetProblem,
    best: Minimum,
    others: Sequence[Minimum],
    judged: dict[str, TestJudgement],
    factor: float,
) -> dict[str, Quantity]:
    """Values with standard uncertainties."""
    x = best.x
    free = problem.free
    jacobian = problem.jacobian(x)[:, free]
    scatter = math.sqrt(factor * best.cost / (problem.count - problem.fitted))
    norms = np.linalg.norm(jacobian, axis=0)
    norms[norms == 0.0] = 1e-30
    _, s, vt = np.linalg.svd(jacobian / norms, full_matrices=False)
    half = vt.T / np.maximum(s, 1e-13 * s[0]) / norms[:, None]

    def values(at: Array) -> Array:
        mu, alpha = problem.film(at)
        return np.array([*mu, *alpha, problem.law.shear_modulus(mu.tolist(), alpha.tolist())])

    gradient = np.empty((problem.size + 1, problem.fitted))
    for column, k in enumerate(np.flatnonzero(free).tolist()):
        step = np.zeros(problem.size)
        step[k] = 1e-6 * max(abs(x[k]), 1e-3)
        gradient[:, column] = (values(x + step) - values(x - step)) / (2.0 * step[k])
    law = problem.law
    elsewhere = np.array([[*one.mu, *one.alpha, law.shear_modulus(one.mu, one.alpha)] for one in others])
    shift = np.abs(elsewhere - values(x)).max(axis=0)
    small = max((abs(one.small_strain) for one in judged.values() if one.small_strain is not None), default=0.0)
    edge = _at_edge(problem, x)
    units = [p.unit for p in problem.law.parameters(problem.moduli, problem.shapes)] + ["Pa"]
    found = {}
    names = [*problem.names, "G"]
    for k, (name, value, unit) in enumerate(zip(names, values(x), units, strict=True)):
        if name in problem.fixed:
            continue
        budget = {
            "scatter": scatter * float(np.linalg.norm(gradient[k] @ half)),
            "weighting": float(shift[k]) / math.sqrt(3.0),
        }
        if name == "G":
            budget["small strains"] = small * abs(float(value)) / math.sqrt(3.0)
        uncertainty = math.hypot(*budget.values())
        relative = uncertainty / abs(value) if value else math.inf
        found[name] = Quantity(float(value), uncertainty, unit, budget, verdict(relative, edge[k]), edge[k])
    return found


def _at_edge(problem: SheetProblem, x: Array) -> list[bool]:
    """Parameters at the end of their range; of a term that has vanished, both."""
    m = problem.moduli
    if problem.law is not Ogden:
        lower, upper = problem.bounds(x)
        return [*((x <= lower * (1.0 + 1e-3)) | (x >= upper * (1.0 - 1e-3))).tolist(), False]
    exponent = np.abs(x[m:])
    carried = np.linalg.norm(problem.jacobian(x)[:, :m], axis=0) * np.abs(x[:m])
    whole = float(np.linalg.norm(problem.measured * problem.weight))
    vanished = (carried < VANISHED * whole) | (x[:m] > 0.999 * SHARE_BOUNDS[1])
    at_edge = (exponent < 1.01 * EXPONENT_BOUNDS[0]) | (exponent > 0.999 * EXPONENT_BOUNDS[1])
    return [*vanished.tolist(), *(vanished | at_edge).tolist(), False]


def _warnings(fit: TestsFit, tests: Sequence[HomogeneousTest], predict: Sequence[HomogeneousTest]) -> list[str]:
    words = []
    if fit.others:
        words.append(
            f"{len(fit.others)} other sets of parameters fit as well within the scatter, for instance alpha = "
            + ", ".join(f"{value:.3g}" for value in fit.others[0].alpha)
        )
    lost = [name for name, quantity in fit.quantities.items() if quantity.verdict.startswith("not")]
    if lost:
        words.append(f"not determined by these tests: {', '.join(lost)}")
    for test in predict:
        if fit.prediction[test.name] < BADLY_PREDICTED:
            words.append(
                f"{test.name} ({test.kind}) is not predicted: R^2 = {fit.prediction[test.name]:.3g}; "
                "do not use these parameters for that mode"
            )
    if len({test.kind for test in tests}) == 1 and tests[0].kind != "biaxial":
        words.append(f"only {tests[0].kind} data were fitted: the film in a cone is stretched in two directions")
    return words


def cross_prediction(tests: Sequence[HomogeneousTest], **options: Any) -> dict[str, TestsFit]:
    """A fit to each test alone, held against all the others; ``options`` as in `fit_tests`."""
    return {
        test.name: fit_tests([test], predict=[other for other in tests if other is not test], **options)
        for test in tests
    }


@dataclass(frozen=True)
class Compared:
    """One law with one number of terms: its fit to all tests, and how well each kind of test is predicted by the rest.

    ``predicted`` maps a kind of test to the R^2 with which a fit to the other kinds predicts it; nan where that fit
    failed. Empty where there is only one kind.
    """

    title: str
    terms: int
    fit: TestsFit
    predicted: dict[str, float]

    @property
    def worst(self) -> float:
        """The least of the predictions; nan where there is none."""
        return min(self.predicted.values(), default=math.nan)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings."""
        return {
            "law": self.fit.law.name,
            "terms": self.terms,
            "aicc": _finite(self.fit.aicc),
            "cost": self.fit.cost,
            "parameters": {name: quantity.value for name, quantity in self.fit.quantities.items()},
            "predicted_r_squared": {kind: _finite(value) for kind, value in self.predicted.items()},
        }


def compare_laws(
    tests: Sequence[HomogeneousTest], laws: Sequence[type[Law]], *, most_terms: int = 3, **options: Any
) -> list[Compared]:
    """Every law, a series with one to ``most_terms`` terms, by AICc and by prediction of the other modes."""
    kinds = sorted({test.kind for test in tests})
    found = []
    for law in laws:
        for terms in range(1, most_terms + 1) if law.series else (1,):
            settings = {**options, "law": law, "terms": terms}
            try:
                fit = fit_tests(tests, **settings)
            except TestsError:
                continue
            predicted = {}
            for kind in kinds if len(kinds) > 1 else ():
                held = [test for test in tests if test.kind == kind]
                rest = [test for test in tests if test.kind != kind]
                try:
                    values = fit_tests(rest, predict=held, **{**settings, "starts": 4}).prediction.values()
                    predicted[kind] = min(values)
                except TestsError:
                    predicted[kind] = math.nan
            title = law.title + (f", {terms} term{'s' if terms > 1 else ''}" if law.series else "")
            found.append(Compared(title, terms, replace(fit, prediction={}), predicted))
    return found
