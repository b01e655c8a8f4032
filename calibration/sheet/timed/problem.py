"""Law, branches and zeros of the stress from tests of a sheet over time: residuals and their derivatives.

``x`` is ``[shares, shape parameters, ratios, logarithms of the times, zeros]``; shares and shape parameters as in
`calibration.sheet.problem`, zeros in units of `ZERO` of the largest stress of each test.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.film.branches.counting import searched
from calibration.sheet.problem import SheetProblem
from calibration.sheet.sheet_tests import HomogeneousTest
from calibration.sheet.timed.record import Bins, SheetRecord, steps_of
from calibration.sheet.timed.stress import elastic_parts, nominal
from model.material.law import Law

Array = NDArray[np.float64]

ZERO = 3e-3  # of the largest stress: standard uncertainty that is assumed of a load cell's zero
MOST_RATIO = 20.0
STEP = 1e-4  # relative change of a number for a slope
FINE = (1, 2, 4, 8)  # steps of time from bin to bin, the first that is good enough
GOOD = 0.1  # of the deviations: error of the steps of time
MOST_STEPS, MOST_LAST = 20, 200  # of a search; the last one goes to its end however flat the valley is
COARSE = 1e-3  # of the largest stress: an error of the steps of time that is told


@dataclass(eq=False)
class Point:
    """Residuals (rows and zeros) and their derivatives by x."""

    x: Array
    residual: Array
    jacobian: Array

    @property
    def cost(self) -> float:
        """Chi-square."""
        return float(self.residual @ self.residual)


class TimedProblem:
    """All tests of a sheet, with a number of branches that ``x`` tells."""

    def __init__(
        self,
        tests: Sequence[HomogeneousTest],
        terms: int,
        law: type[Law],
        *,
        fixed: Mapping[str, float] | None = None,
        negative_exponents: bool,
    ) -> None:
        self.records = [SheetRecord.of(test) for test in tests]
        self.bins = [record.bins for record in self.records]
        held = [_at_bins(test, one) for test, one in zip(tests, self.bins, strict=True)]
        options = {"fixed": fixed, "negative_exponents": negative_exponents}
        self.elastic = SheetProblem(held, terms, "balanced", law, **options)  # type: ignore[arg-type]
        self.law = law
        self.numbers = self.elastic.size
        self.largest = np.array([float(np.abs(one.stress).max()) for one in self.bins])
        self.sigma = np.concatenate([np.tile(one.sigma, len(one.directions)) for one in self.bins])
        self.independent = sum(one.noise.size / one.correlated for one in self.bins)
        parts = [np.tile(one.segment, len(one.directions)) + 10_000 * k for k, one in enumerate(self.bins)]
        self.stretches: NDArray[np.intp] = np.concatenate(parts)
        self.fine = FINE[0]
        self._lay()
        self.measured = np.concatenate([one.stress.ravel() for one in self.bins])

    # --- times

    def _lay(self) -> None:
        """Times of the steps of every test, and where the bins are among them."""
        self.times = [steps_of(one, self.fine) for one in self.bins]
        self.means = [one.averaging(times) for times, one in zip(self.times, self.bins, strict=True)]
        self.u = [record.logs(times) for record, times in zip(self.records, self.times, strict=True)]

    def refine(self, x: Array) -> float:
        """Take steps so fine that halving them changes the stresses by less than `GOOD` of their deviations.

        And none of them by more than `COARSE`, where the finest steps reach that.

        The error that is left, over the largest stress: four thirds of the change (second order).
        """
        error = math.inf
        before = self.stress(x)
        for fine in FINE:
            self.fine = 2 * fine
            self._lay()
            now = self.stress(x)
            change = np.abs(now - before)
            error = float((change / np.repeat(self.largest, self._rows)).max()) * 4.0 / 3.0
            if float(np.sqrt(np.mean((change / self.sigma) ** 2))) < GOOD and error < COARSE:
                self.fine = fine
                self._lay()
                break
            before = now
        return error

    @property
    def _rows(self) -> list[int]:
        return [one.stress.size for one in self.bins]

    # --- x

    def count(self, x: Array) -> int:
        """How many branches ``x`` has."""
        return (x.size - self.numbers - len(self.records)) // 2

    def vector(self, film: Array, ratio: Array, time: Array, zeros: Array | None = None) -> Array:
        """``x`` of these parts."""
        return np.concatenate((film, ratio, np.log(time), np.zeros(len(self.records)) if zeros is None else zeros))

    def split(self, x: Array) -> tuple[Array, Array, Array, Array]:
        """Shares and shape parameters, ratios, times (s), zeros."""
        n, k = self.numbers, self.count(x)
        return x[:n], x[n : n + k], np.exp(x[n + k : n + 2 * k]), x[n + 2 * k :]

    @property
    def window(self) -> tuple[float, float]:
        """Shortest and longest relaxation time (s) that is looked for: two rows, and the longest test."""
        return 2.0 * min(one.period for one in self.records), max(one.span for one in self.records)

    def bounds(self, x: Array) -> tuple[Array, Array]:
        """Limits of a search from ``x``."""
        low, high = self.elastic.bounds(x[: self.numbers])
        k, zeros = self.count(x), len(self.records)
        first, last = searched(self.window)
        return (
            np.concatenate((low, np.zeros(k), np.full(k, first), np.full(zeros, -np.inf))),
            np.concatenate((high, np.full(k, MOST_RATIO), np.full(k, last), np.full(zeros, np.inf))),
        )

    def varied(self, x: Array) -> NDArray[np.bool_]:
        """Entries of ``x`` that are fitted."""
        return np.concatenate((self.elastic.free, np.ones(x.size - self.numbers, dtype=np.bool_)))

    # --- stresses

    def _laws(self, films: Array) -> tuple[Law, Array]:
        """The law with the numbers of several films (films, numbers), and their shear moduli (Pa)."""
        pairs = [self.elastic.film(one) for one in films]
        modulus = np.array([self.law.shear_modulus(m.tolist(), a.tolist()) for m, a in pairs])
        mu, alpha = np.array([m for m, _ in pairs]).T, np.array([a for _, a in pairs]).T
        return self.law(mu, alpha.reshape(-1, len(pairs))), modulus

    def parts(self, films: Array, which: NDArray[np.intp], times: Array) -> tuple[Array, Array]:
        """Stresses at the bins (Pa): relaxed of each film (films, rows); of branches of ratio one (branches, rows).

        ``which`` film each branch is of, and its time (s).
        """
        law, modulus = self._laws(films)
        wide = law.take(which) if len(films) > 1 else law
        count, k = len(films), times.size
        relaxed, added = [], []
        with np.errstate(all="ignore"):
            w = elastic_parts(wide, modulus[which], times, self.times, self.u) if k else []
            for number, (one, mean, u) in enumerate(zip(self.bins, self.means, self.u, strict=True)):
                here = np.repeat(u[:, :, None], count, axis=2)
                first = nominal(law, here, here)
                relaxed += [mean @ first[d] for d in one.directions]
                if k:
                    there = nominal(wide, w[number], np.repeat(u[:, :, None], k, axis=2))
                    added += [mean @ there[d] for d in one.directions]
        rows: Array = np.concatenate(relaxed).T
        more: Array = np.concatenate(added).T if k else np.zeros((0, rows.shape[1]))
        return rows, more

    def of_one(self, film: Array, times: Array) -> tuple[Array, Array]:
        """Stresses at the bins (Pa) of one film: relaxed (rows,), and of its branches of ratio one (times, rows)."""
        relaxed, added = self.parts(film[None], np.zeros(times.size, dtype=np.intp), times)
        return relaxed[0], added

    def zeros(self, values: Array) -> Array:
        """Zeros of the tests as stresses at the bins (Pa)."""
        found: Array = np.repeat(values * ZERO * self.largest, self._rows)
        return found

    def stress(self, x: Array) -> Array:
        """Of the film with branches and zeros, at the bins (Pa)."""
        film, ratio, times, zeros = self.split(x)
        relaxed, added = self.of_one(film, times)
        found: Array = relaxed + ratio @ added + self.zeros(zeros)
        return found

    def evaluate(self, x: Array) -> Point:
        """Residuals and derivatives at ``x``; by the law's numbers and the times from neighbouring films."""
        film, ratio, times, zeros = self.split(x)
        n, k = self.numbers, times.size
        steps = STEP * np.maximum(np.abs(film), 1e-3)
        films = np.concatenate((film[None], film + np.diag(steps)))
        films[1:][~self.elastic.free] = film
        which = np.concatenate((np.repeat(np.arange(len(films)), k), np.zeros(k, dtype=np.intp)))
        relaxed, branches = self.parts(films, which, np.concatenate((np.tile(times, len(films)), times * (1.0 + STEP))))
        added, later = branches[: len(films) * k].reshape(len(films), k, relaxed.shape[1]), branches[len(films) * k :]
        forces = relaxed + np.einsum("k,fkr->fr", ratio, added)
        columns = np.zeros((self.measured.size, x.size))
        columns[:, :n] = ((forces[1:] - forces[0]) / steps[:, None]).T
        columns[:, n : n + k] = added[0].T
        columns[:, n + k : n + 2 * k] = (ratio[:, None] * (later - added[0]) / math.log1p(STEP)).T
        for j in range(zeros.size):
            columns[:, n + 2 * k + j] = self.zeros(np.eye(zeros.size)[j])
        residual = (forces[0] + self.zeros(zeros) - self.measured) / self.sigma
        residual = np.nan_to_num(residual, nan=1e6, posinf=1e6, neginf=-1e6)
        jacobian = np.nan_to_num(columns / self.sigma[:, None], nan=0.0, posinf=0.0, neginf=0.0)
        prior = np.eye(zeros.size, x.size, x.size - zeros.size)
        return Point(x, np.concatenate((residual, zeros)), np.concatenate((jacobian, prior)))

    def minimise(self, start: Array, *, last: bool = False) -> Point:
        """The minimum near ``start``, within the bounds; the ``last`` time to more digits."""
        from scipy.optimize import least_squares

        low, high = self.bounds(start)
        free = self.varied(start)
        known: dict[bytes, Point] = {}

        def at(part: Array) -> Point:
            x = start.copy()
            x[free] = part
            key = part.tobytes()
            if key not in known:
                known.clear()
                known[key] = self.evaluate(x)
            return known[key]

        def residual(part: Array) -> Array:
            return at(part).residual

        def jacobian(part: Array) -> Array:
            return np.asarray(at(part).jacobian[:, free])

        found = least_squares(
            residual,
            np.clip(start, low, high)[free],
            jacobian,
            bounds=(low[free] - 1e-12, high[free] + 1e-12),
            x_scale="jac",
            ftol=1e-4 if last else 1e-3,
            xtol=1e-6 if last else 1e-4,
            gtol=None,
            max_nfev=MOST_LAST if last else MOST_STEPS,
        )
        x = start.copy()
        x[free] = found.x
        return self.evaluate(np.clip(x, low, high))


def _at_bins(test: HomogeneousTest, bins: Bins) -> HomogeneousTest:
    """The test with its means in place of its rows: what a first law is fitted to."""

    l1, l2 = np.exp(bins.record.logs(bins.time))
    second = bins.stress[1] if len(bins.directions) > 1 else np.full_like(l1, np.nan)
    return replace(test, stretch1=l1, stretch2=l2, stress1=bins.stress[0], stress2=second, history=None)
