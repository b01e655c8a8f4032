r"""Ogden parameters from homogeneous tests: uniaxial, equibiaxial, pure shear, general biaxial.

In the plane of the sheet, incompressible and free on its faces, the nominal stress along direction i is

.. math:: P_i = \frac{1}{l_i} \sum_n \mu_n (l_i^{\alpha_n} - (l_1 l_2)^{-\alpha_n})

with ``l2 = l1**-0.5`` in a uniaxial test, ``l2 = l1`` in an equibiaxial one and ``l2 = 1`` in pure shear.

Convention of the Ogden terms: `model.material.materials.Material`.
"""

from __future__ import annotations

import json
import math
import warnings as python_warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calibration.film.propagation import shear_slopes
from calibration.film.result import Quantity, quantity_dict, verdict
from model.material.law import Law, stack
from model.material.materials import Material
from model.material.neo_hooke import NeoHooke
from model.material.ogden import Ogden

Array = NDArray[np.float64]

Weighting = Literal["balanced", "relative"]

NO_STRESS = 1e3  # weighted residual where the law has no stress: far above any real one
SHARE_BOUNDS = (1e-8, 10.0)
EXPONENT_BOUNDS = (0.05, 30.0)  # of |alpha|
SAME_MINIMUM = 1.0  # chi-square, in units of the scatter about the best fit, by which minima count as equally good


class TestsError(ValueError):
    """A test that cannot be fitted; the message names it and what is wrong."""

    __test__ = False  # not a test class, whatever its name suggests to pytest


@dataclass(frozen=True, eq=False)
class HomogeneousTest:
    """Stretches and nominal stresses (Pa) of one test; ``stress2`` is nan where only the first was measured."""

    name: str
    kind: str
    stretch1: Array
    stretch2: Array
    stress1: Array
    stress2: Array

    @property
    def measured(self) -> Array:
        """All measured stresses, those along the first direction first."""
        both = np.concatenate((self.stress1, self.stress2))
        return both[np.isfinite(both)]


@dataclass(frozen=True)
class Minimum:
    """A law's moduli and shape parameters, terms sorted by exponent, and the weighted sum of squares they leave."""

    mu: tuple[float, ...]
    alpha: tuple[float, ...]
    cost: float


@dataclass(frozen=True)
class TestsFit:
    """A law's parameters that fit a set of tests.

    ``mu`` are its moduli, ``alpha`` its shape parameters. ``quantities`` holds them by the law's names (``mu1``,
    ``alpha1``, ...) and ``G``, with standard uncertainties from the scatter about the fit.
    ``r_squared`` is the share of each fitted test's variance that the model explains, ``prediction`` the same for tests
    that took no part. ``others`` are further minima that fit equally well.
    """

    __test__ = False

    law: type[Law]
    mu: tuple[float, ...]
    alpha: tuple[float, ...]
    quantities: dict[str, Quantity]
    r_squared: dict[str, float]
    prediction: dict[str, float]
    residuals: dict[str, tuple[float, ...]]
    others: list[Minimum]
    starts: int
    warnings: list[str]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings, lists and dictionaries."""
        return {
            "format": "dea-rig homogeneous tests 1",
            "law": self.law.name,
            "convention": self.law.description,
            "quantities": {name: quantity_dict(quantity) for name, quantity in self.quantities.items()},
            "r_squared": self.r_squared,
            "prediction_r_squared": self.prediction,
            "residuals_Pa": {name: list(values) for name, values in self.residuals.items()},
            "equally_good": [
                {"mu_Pa": list(other.mu), "alpha": list(other.alpha), "cost": other.cost} for other in self.others
            ],
            "starts": self.starts,
            "warnings": self.warnings,
        }

    def to_json(self) -> str:
        """`to_dict` as JSON text."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n"


def nominal_stress(mu: Sequence[float], alpha: Sequence[float], test: HomogeneousTest, law: type[Law] = Ogden) -> Array:
    """The model's stresses (Pa), in the order of ``test.measured``."""
    return _stress(law, np.array(mu), np.array(alpha), test)[0]


def _stress(law: type[Law], mu: Array, alpha: Array, test: HomogeneousTest) -> tuple[Array, Array, Array]:
    """Stresses, and their derivatives by mu and by alpha; shapes (k,), (k, moduli), (k, shape parameters)."""
    along = np.concatenate((test.stretch1, test.stretch2))
    rows = np.isfinite(np.concatenate((test.stress1, test.stress2)))
    film = law(mu[:, None], alpha.reshape(-1, 1))
    log = stack(np.log(test.stretch1), np.log(test.stretch2))
    stress = np.concatenate(film.derivatives(log)[:2]) / along
    by_mu, by_alpha = (by.reshape(len(by), along.size).T / along[:, None] for by in film.by_parameters(log))
    return stress[rows], by_mu[rows], by_alpha[rows]


def r_squared(mu: Sequence[float], alpha: Sequence[float], test: HomogeneousTest, law: type[Law] = Ogden) -> float:
    """Share of the variance of the measured stresses that the model explains; negative if a constant does better."""
    measured = test.measured
    residual = measured - nominal_stress(mu, alpha, test, law)
    return float(1.0 - residual @ residual / ((measured - measured.mean()) @ (measured - measured.mean())))


def fit_tests(
    tests: Sequence[HomogeneousTest],
    *,
    law: type[Law] = Ogden,
    terms: int = 3,
    starts: int = 24,
    seed: int = 0,
    weighting: Weighting = "balanced",
    predict: Sequence[HomogeneousTest] = (),
) -> TestsFit:
    """Fit a law to one or several tests at once.

    Parameters
    ----------
    law, terms : type[Law], int
        The law; how many terms, where it is a series.
    weighting : {"balanced", "relative"}
        "balanced" makes every test count alike, whatever its stresses and its number of points: it minimises the sum of
        ``1 - R^2``. "relative" counts relative errors, so that small stretches matter as much as large ones; stresses
        below a hundredth of the largest are weighted like that.
    predict : sequence of HomogeneousTest
        Tests that take no part in the fit and are held against it: a fit to one mode can fail badly in another.

    Raises
    ------
    TestsError
        When there are fewer data than parameters, or no fit converges.
    """
    if not tests:
        raise TestsError("there are no tests to fit")
    problem = _TestsProblem(tests, law, terms, weighting)
    count = problem.moduli + problem.shapes
    if problem.measured.size <= count:
        raise TestsError(f"{problem.measured.size} stresses cannot determine {count} parameters")
    found = sorted((problem.minimise(x) for x in problem.starting_points(starts, seed)), key=lambda pair: pair[1].cost)
    x, best = found[0]
    equal = best.cost * (1.0 + SAME_MINIMUM / (problem.measured.size - count))
    others = _distinct([minimum for _, minimum in found if minimum.cost <= equal])[1:]
    fit = TestsFit(
        law=law,
        mu=best.mu,
        alpha=best.alpha,
        quantities=problem.quantities(x, best),
        r_squared={test.name: r_squared(best.mu, best.alpha, test, law) for test in tests},
        prediction={test.name: r_squared(best.mu, best.alpha, test, law) for test in predict},
        residuals={
            test.name: tuple(float(v) for v in test.measured - nominal_stress(best.mu, best.alpha, test, law))
            for test in tests
        },
        others=others,
        starts=starts,
        warnings=[],
    )
    fit.warnings.extend(_warnings(fit, tests, predict))
    return fit


def cross_prediction(tests: Sequence[HomogeneousTest], **options: Any) -> dict[str, TestsFit]:
    """A fit to each test alone, held against all the others; ``options`` as in `fit_tests`."""
    return {
        test.name: fit_tests([test], predict=[other for other in tests if other is not test], **options)
        for test in tests
    }


class _TestsProblem:
    """Weighted residuals over ``x``: moduli made of order one (`model.material.law.Law.weights`), shape parameters.

    Of Ogden terms the former are ``g_n = mu_n alpha_n / (2 G_0)``.
    """

    def __init__(self, tests: Sequence[HomogeneousTest], law: type[Law], terms: int, weighting: Weighting) -> None:
        self.tests = tests
        self.law = law
        self.moduli, self.shapes = law.counts(terms)
        self.names = law.names(self.moduli, self.shapes)
        self.terms = terms
        self.measured = np.concatenate([test.measured for test in tests])
        size = np.abs(self.measured)
        for test in tests:
            if not np.ptp(test.measured) > 0.0:
                raise TestsError(
                    f"{test.name}: all stresses are {test.measured[0]:g} Pa; nothing can be fitted to that"
                )
        if weighting == "relative":
            self.weight = 1.0 / np.maximum(size, 0.01 * size.max())
        else:
            spread = [float(np.linalg.norm(test.measured - test.measured.mean())) for test in tests]
            self.weight = np.repeat(1.0 / np.array(spread), [test.measured.size for test in tests])
        # The neo-Hookean modulus that fits best sets the scale.
        unit = np.concatenate([nominal_stress((1.0,), (), test, NeoHooke) for test in tests])
        scale = float((self.weight**2 * self.measured) @ unit / ((self.weight**2 * unit) @ unit))
        if not scale > 0.0:
            names = ", ".join(test.name for test in tests)
            raise TestsError(f"{names}: the stresses do not rise with the stretch; tension has to be positive")
        self.scale = scale

    def _model(self, mu: Array, alpha: Array) -> tuple[Array, Array, Array]:
        parts = [_stress(self.law, mu, alpha, test) for test in self.tests]
        stress, by_mu, by_alpha = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        return stress, by_mu, by_alpha

    def residual(self, x: Array) -> Array:
        mu, alpha = self.film(x)
        residual: Array = (self._model(mu, alpha)[0] - self.measured) * self.weight
        return np.where(np.isfinite(residual), residual, NO_STRESS)

    def jacobian(self, x: Array) -> Array:
        mu, alpha = self.film(x)
        _, by_mu, by_alpha = self._model(mu, alpha)
        columns: Array = np.concatenate((by_mu, by_alpha), axis=1) @ self.by_x(x)
        columns *= self.weight[:, None]
        return np.where(np.isfinite(columns), columns, 0.0)

    def film(self, x: Array) -> tuple[Array, Array]:
        """Moduli (Pa) and shape parameters."""
        share, alpha = x[: self.moduli], x[self.moduli :]
        mu: Array = self.scale * share / self.law.weights(alpha)[0]
        return mu, alpha

    def by_x(self, x: Array) -> Array:
        """Derivatives of moduli and shape parameters, rows, by ``x``, columns."""
        n = self.moduli
        mu, alpha = self.film(x)
        weight, slope = self.law.weights(alpha)
        by = np.eye(x.size)
        by[:n, :n] = np.diag(self.scale / weight)
        by[:n, n:] = -(mu / weight)[:, None] * slope
        return by

    def starting_points(self, count: int, seed: int) -> list[Array]:
        """Random sets; in every other one of two Ogden terms or more an exponent is negative, as in Ogden's own."""
        random = np.random.default_rng(seed)
        points = []
        if not self.law.series:
            return [np.concatenate(self.law.draw(random, self.terms)) for _ in range(count)]
        for number in range(count):
            alpha = np.sort(np.exp(random.uniform(math.log(0.8), math.log(9.0), self.terms)))
            if self.terms > 1 and number % 2 == 0:
                alpha[random.integers(self.terms)] *= -1.0
            points.append(np.concatenate((random.dirichlet(np.ones(self.terms)), alpha)))
        return points

    def minimise(self, start: Array) -> tuple[Array, Minimum]:
        import lmfit

        parameters = lmfit.Parameters()
        names = [f"g{n + 1}" for n in range(self.moduli)] + list(self.names[self.moduli :])
        for name, value, (low, high) in zip(names, start, self.bounds(start), strict=True):
            parameters.add(name, value=float(np.clip(value, low + 1e-6, high - 1e-6)), min=low, max=high)

        def vector(values: Mapping[str, Any]) -> Array:
            return np.array([values[name].value for name in names])

        with python_warnings.catch_warnings(), np.errstate(all="ignore"):
            # lmfit takes square roots of a covariance that need not be positive definite; ours is used instead.
            python_warnings.simplefilter("ignore")
            out = lmfit.Minimizer(lambda p: self.residual(vector(p)), parameters, nan_policy="raise").minimize(
                method="least_squares", jac=lambda p: self.jacobian(vector(p)), x_scale="jac", max_nfev=400
            )
        x = vector(out.params)
        if self.law.series:
            order = np.argsort(x[self.terms :])
            x = np.concatenate((x[: self.terms][order], x[self.terms :][order]))
        mu, alpha = self.film(x)
        residual = self.residual(x)
        return x, Minimum(tuple(map(float, mu)), tuple(map(float, alpha)), float(residual @ residual))

    def bounds(self, x: Array) -> list[tuple[float, float]]:
        """Where each entry of ``x`` may be; exponents of a series keep their sign."""
        if not self.law.series:
            return [p.search for p in self.law.parameters(self.moduli, self.shapes)]
        found = [SHARE_BOUNDS] * self.moduli
        for value in x[self.moduli :]:
            low, high = EXPONENT_BOUNDS
            found.append((-high, -low) if value < 0.0 else (low, high))
        return found

    def quantities(self, x: Array, best: Minimum) -> dict[str, Quantity]:
        """Values with standard uncertainties from the scatter about the fit."""
        n = self.moduli
        mu, alpha = self.film(x)
        jacobian = self.jacobian(x)
        scatter = best.cost / (self.measured.size - x.size)
        norms = np.linalg.norm(jacobian, axis=0)
        norms[norms == 0.0] = 1e-30
        _, s, vt = np.linalg.svd(jacobian / norms, full_matrices=False)
        half = vt.T / np.maximum(s, 1e-13 * s[0]) / norms[:, None]
        low, high = np.array(self.bounds(x)).T
        edge = (np.abs(x - low) < 0.01 * np.minimum(np.abs(low), 1.0)) | (x > high - 1e-3 * np.abs(high))
        if self.law.series:
            edge[:n] = (x[:n] < 100 * SHARE_BOUNDS[0]) | (x[:n] > 0.999 * SHARE_BOUNDS[1])
            size = np.abs(x[n:])
            edge[n:] = (size < 1.01 * EXPONENT_BOUNDS[0]) | (size > 0.999 * EXPONENT_BOUNDS[1]) | edge[:n]
        by = self.by_x(x)
        rows: dict[str, tuple[float, Array, str, bool]] = {}
        order = range(x.size) if not self.law.series else [k + part for k in range(n) for part in (0, n)]
        for k in order:
            value = float(mu[k] if k < n else alpha[k - n])
            rows[self.names[k]] = (value, by[k], "Pa" if k < n else "1", bool(edge[k]))
        material = Material("sheet", tuple(mu), tuple(alpha), 1.0, law=self.law)
        slopes = np.concatenate(shear_slopes(material)) @ by
        rows["G"] = (material.shear_modulus, slopes, "Pa", False)
        quantities = {}
        for name, (value, gradient, unit, at_edge) in rows.items():
            uncertainty = math.sqrt(scatter) * float(np.linalg.norm(gradient @ half))
            words = verdict(uncertainty / abs(value), at_edge)
            quantities[name] = Quantity(float(value), uncertainty, unit, {"scatter": uncertainty}, words, at_edge)
        return quantities


def _distinct(minima: Sequence[Minimum]) -> list[Minimum]:
    """Those that differ from all before them by more than 5 % in some parameter."""
    kept: list[Minimum] = []
    for minimum in minima:
        here = np.array(minimum.mu + minimum.alpha)
        if all((np.abs(np.array(k.mu + k.alpha) - here) > 0.05 * np.abs(here)).any() for k in kept):
            kept.append(minimum)
    return kept


def _warnings(fit: TestsFit, tests: Sequence[HomogeneousTest], predict: Sequence[HomogeneousTest]) -> list[str]:
    words = []
    if fit.others:
        words.append(
            f"{len(fit.others)} other sets of parameters fit as well within the scatter, for instance "
            + ", ".join(f"{value:.3g}" for value in (fit.others[0].alpha or fit.others[0].mu))
        )
    lost = [name for name, quantity in fit.quantities.items() if quantity.verdict.startswith("not")]
    if lost:
        words.append(f"not determined by these tests: {', '.join(lost)}")
    for test in predict:
        if fit.prediction[test.name] < 0.9:
            words.append(
                f"{test.name} ({test.kind}) is not predicted: R^2 = {fit.prediction[test.name]:.3g}; "
                "do not use these parameters for that mode"
            )
    if len({test.kind for test in tests}) == 1 and tests[0].kind != "biaxial":
        words.append(f"only {tests[0].kind} data were fitted: the film in a cone is stretched in two directions")
    return words
