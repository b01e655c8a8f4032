"""Law and Maxwell branches of a sheet from relaxation and cyclic tests, with uncertainties and verdicts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.film.branches.counting import Count, free_columns, misfit, shifted, unknown_columns
from calibration.film.branches.result import HOLD, BranchCount, FoundBranch, Known, Spectrum, blind_times
from calibration.film.propagation import Covariance
from calibration.film.result import Quantity, verdict
from calibration.sheet.search import minima
from calibration.sheet.sheet_tests import HomogeneousTest, TestsError
from calibration.sheet.timed.count import beside, count_branches, unseen
from calibration.sheet.timed.predict import predict_sheets, trace_of
from calibration.sheet.timed.problem import ZERO, Point, TimedProblem
from calibration.sheet.timed.result import SheetTrace, TimedFit
from calibration.sheet.timed.warnings import warnings_of
from model.material.law import Law
from model.material.ogden import Ogden

Array = NDArray[np.float64]


def fit_timed(
    tests: Sequence[HomogeneousTest],
    *,
    branches: int | None = None,
    terms: int = 2,
    predict: Sequence[HomogeneousTest] = (),
    law: type[Law] = Ogden,
    fixed: Mapping[str, float] | None = None,
    negative_exponents: bool = False,
    starts: int = 4,
) -> TimedFit:
    """Fit a law with Maxwell branches to one or several tests over time, all rows at once.

    Parameters
    ----------
    branches : int, optional
        How many; as many as pay when not given.
    terms, law, fixed, negative_exponents, starts : as `calibration.sheet.fit.fit_tests`
    predict : sequence of HomogeneousTest
        Tests over time that take no part in the fit and are held against it.

    Raises
    ------
    TestsError
        When a test has no time, or the tests cannot be fitted.
    """
    problem = TimedProblem(tests, terms, law, fixed=fixed, negative_exponents=negative_exponents)
    if problem.measured.size <= problem.elastic.fitted + 2:
        raise TestsError(f"{problem.measured.size} means of stresses cannot determine a law with branches")
    first = minima(problem.elastic, starts, 0)[0].x
    nothing = np.zeros(0)
    start = problem.vector(problem.elastic.held(first), nothing, nothing)
    tried = count_branches(problem, start, branches)
    if branches is not None and tried[-1].branches != branches:
        raise TestsError(
            f"{branches} branches explain no more of these tests than chance would, or would have to push where the "
            "sheet pulls; give --branches auto"
        )
    point = tried[-1].point
    numerical = problem.refine(point.x)
    point = problem.minimise(point.x, last=True)
    tried = [*tried[:-1], replace(tried[-1], point=point)]
    return _Found(problem, tried, numerical).result(predict)


class _Found:
    """A fit at its end, and what follows from it."""

    def __init__(self, problem: TimedProblem, tried: Sequence[Count[Point]], numerical: float) -> None:
        self.problem, self.tried, self.numerical = problem, tried, numerical
        self.point = tried[-1].point
        self.scale = misfit(problem, self.point)
        self.covariance = Covariance(self.point.jacobian, unknown_columns(problem, self.point))

    def budget(self, gradient: Array) -> dict[str, float]:
        """Independent parts of the standard uncertainty of a function of x with this gradient."""
        rows = gradient @ self.covariance.response
        data = self.problem.measured.size
        parts = {"noise": float(np.linalg.norm(rows[:data]))}
        if self.scale > 1.0:
            parts["lack of fit"] = parts["noise"] * math.sqrt(self.scale - 1.0)
        parts["zero of the stress"] = float(np.linalg.norm(rows[data:]))
        steps = np.repeat(self.numerical * self.problem.largest, [one.stress.size for one in self.problem.bins])
        parts["steps of time"] = float(np.abs(rows[:data]) @ (steps / self.problem.sigma)) / math.sqrt(data)
        return parts

    def quantity(self, value: float, gradient: Array, unit: str, edge: bool = False) -> Quantity:
        """A function of x with its uncertainty."""
        parts = self.budget(gradient)
        total = math.hypot(*parts.values())
        relative = total / abs(value) if value else math.inf
        return Quantity(value, total, unit, parts, verdict(relative, edge), edge)

    def quantities(self) -> dict[str, Quantity]:
        """Of the relaxed law."""
        problem, x = self.problem, self.point.x
        elastic, n = problem.elastic, problem.numbers

        def values(at: Array) -> Array:
            mu, alpha = elastic.film(at[:n])
            return np.array([*mu, *alpha, problem.law.shear_modulus(mu.tolist(), alpha.tolist())])

        slopes = np.zeros((n + 1, x.size))
        for k in np.flatnonzero(elastic.free):
            step = np.zeros(x.size)
            step[k] = 1e-6 * max(abs(float(x[k])), 1e-3)
            slopes[:, k] = (values(x + step) - values(x - step)) / (2.0 * step[k])
        low, high = (one[:n] for one in problem.bounds(x))
        edge = (x[:n] <= low + 1e-6 * np.abs(low)) | (x[:n] >= high - 1e-6 * np.abs(high))
        units = [one.unit for one in problem.law.parameters(elastic.moduli, elastic.shapes)] + ["Pa"]
        names, edges = [*elastic.names, "G"], [*edge.tolist(), False]
        self.shear = values(x)[-1], slopes[-1]
        rows = slopes[:-1] @ self.covariance.response
        self.matrix = rows @ rows.T * self.scale
        return {
            name: self.quantity(float(value), slope, unit, at_edge)
            for name, value, slope, unit, at_edge in zip(names, values(x), slopes, units, edges, strict=True)
            if name not in problem.elastic.fixed
        }

    def known(self, k: int, value: float, hidden: tuple[Array, Array]) -> Known:
        """The k-th entry of x, with what branches that may hide make of it."""
        unit = np.eye(self.point.x.size)[k]
        shift = shifted(unit @ self.covariance.response, *hidden)
        return Known(value, math.hypot(*self.budget(unit).values()), *shift)

    def branches(self, last: float) -> tuple[FoundBranch, ...]:
        """Each with its verdict, the quickest first; what takes longer than ``last`` (s) counts as stiffness."""
        problem, n = self.problem, self.problem.numbers
        _, ratio, time, _ = problem.split(self.point.x)
        hidden = beside(problem, self.point, self.scale, last)
        found = []
        for k, (one, tau) in enumerate(zip(ratio.tolist(), time.tolist(), strict=True)):
            both = self.known(n + k, one, hidden), self.known(n + ratio.size + k, math.log(tau), hidden)
            found.append(FoundBranch.judged(*both, problem.window, explained=self.tried[-1].left_out.explained))
        return tuple(sorted(found, key=lambda one: one.time))

    def spectrum(self) -> Spectrum:
        """What the tests tell of the branches, and what they cannot."""
        problem, x = self.problem, self.point.x
        _, ratio, _, _ = problem.split(x)
        shear, slope = self.shear
        at_once = (1.0 + float(ratio.sum())) * slope
        at_once[problem.numbers : problem.numbers + ratio.size] += shear
        slow, quick = blind_times(unseen(problem, self.point, self.scale), problem.window[1])
        return Spectrum(
            branches=self.branches(slow),
            window=problem.window,
            instant=self.quantity((1.0 + float(ratio.sum())) * float(shear), at_once, "Pa"),
            counts=tuple(BranchCount(one.branches, one.aicc, one.left_out) for one in self.tried),
            slow=slow,
            hold=HOLD * slow,
            quick=quick,
        )

    def traces(self) -> list[SheetTrace]:
        """For pictures and judgements: what was fitted, over time."""
        problem, x = self.problem, self.point.x
        film, *_ = problem.split(x)
        ends = np.cumsum([one.stress.size for one in problem.bins])[:-1]
        sides = [problem.measured, problem.sigma, problem.stress(x), problem.of_one(film, np.zeros(0))[0]]
        columns = zip(*(np.split(one, ends) for one in sides), strict=True)
        return [trace_of(one, *four) for one, four in zip(problem.bins, columns, strict=True)]

    def result(self, predict: Sequence[HomogeneousTest]) -> TimedFit:
        """The whole result."""
        problem, point = self.problem, self.point
        quantities = self.quantities()
        mu, alpha = problem.elastic.film(point.x[: problem.numbers])
        zeros = problem.split(point.x)[3] * ZERO * problem.largest
        data = point.residual[: problem.measured.size]
        freedom = max(1, data.size - int(free_columns(problem, point).sum()))
        spectrum = self.spectrum()
        found = TimedFit(
            law=problem.law,
            mu=tuple(map(float, mu)),
            alpha=tuple(map(float, alpha)),
            quantities=quantities,
            spectrum=spectrum,
            tests=self.traces(),
            predicted=[],
            zeros={one.name: float(v) for one, v in zip(problem.records, zeros, strict=True)},
            numerical=self.numerical,
            misfit=self.scale,
            reduced_chi_square=float(data @ data) / freedom,
            covariance=self.matrix,
            fixed=problem.elastic.fixed,
        )
        predicted = predict_sheets(found.material, predict)
        words = [*spectrum.sentences, *warnings_of(found, problem.records, predicted)]
        return replace(found, predicted=predicted, warnings=words)
