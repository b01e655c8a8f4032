"""Law, permittivity and branches of a film together with the errors of the rig: residuals over whole histories.

Residuals are those of mean forces (`record`), weighted by their noise and its correlation. The model is the exact one
where it was last solved, with its slopes, and bends from there as the response to first order in the ratios does
(`response`): one or two exact solutions bring a fit to its end.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from calibration.film.branches.counting import searched
from calibration.film.branches.polygon import correlation
from calibration.film.branches.record import Bins, Record
from calibration.film.branches.response import Around, Relaxed, Response, Slopes, with_branches
from calibration.film.coordinates import Coordinates
from calibration.film.curve import Curve
from calibration.film.differences import DIMENSIONS, common, contrast_weights
from calibration.film.systematic import SYSTEMATIC, stiffening
from model.material.materials import Material
from model.membrane.history import History, solve_histories
from model.membrane.solve import Status

Array = NDArray[np.float64]

MOST_RATIO = 20.0
TOLERANCE = 1e-4  # of the exact solution, of the peak
NUMERICAL = 3e-5  # of the peak: error of the model and of the means that no sample's noise explains
LONG = 20  # samples of a bin from which its noise tells correlations
INNER, OUTER = 12, 30  # steps of Newton's method between exact solutions; exact solutions at most
SETTLED, RELATIVE = 0.05, 3e-4  # decrease of chi-square that is none; the same over chi-square
ENOUGH = 0.3  # decrease of chi-square by a step after which the exact model is not solved again
LOST = 1e6  # residual where the film has no state
LEAST_KEPT = 0.1  # of the bins: a film that is taut at fewer is no film of this record
SOFTENING, SOFTENS = "softening", 0.05  # by how much a film softens in its first cycle; in the k-th by 1/k of it


@dataclass(frozen=True)
class Nuisance:
    """An error that is fitted along, in units of its stated uncertainty: kind, run, prior."""

    kind: str
    run: str
    prior: float


@dataclass(eq=False)
class Point:
    """A film with the errors of the rig, in the coordinates of a `Joint`, and what the model says there.

    residual : (bins + nuisances,), jacobian : the same by x; slopes : of every record; settled : whether the fit that
    ends here came to its end
    """

    x: Array
    residual: Array
    jacobian: Array
    slopes: list[Slopes]
    settled: bool = True

    @property
    def cost(self) -> float:
        """Chi-square."""
        return float(self.residual @ self.residual)


@dataclass(frozen=True, eq=False)
class Correction:
    """What the exact solution at ``at`` (film and branches) has more than the response, of every record.

    force : (bins,), N; slope : (bins, film and branches)
    """

    at: Array
    force: list[Array]
    slope: list[Array]


State = tuple[Correction, list[Around], NDArray[np.bool_], NDArray[np.bool_]]


class Joint:
    """All records of one film, with a number of branches."""

    def __init__(
        self,
        records: Sequence[Record],
        start: Material,
        terms: int,
        held: Sequence[str] = (),
        *,
        tolerance: float = TOLERANCE,
    ) -> None:
        self.records, self.tolerance = records, tolerance
        self.held = tuple(held)
        electric = any(record.history[2].max() > 0.0 for record in records) and "eps_r" not in held
        self.coordinates = Coordinates.of(start, terms, electric)
        self.responses: list[Response] = []
        self.bins: list[Bins] = []
        for record in records:
            specimen = record.errors.specimen.with_material(replace(start, branches=()))
            _, h, v = record.history
            relaxed = Relaxed(specimen, float(h.max()), float(v.max()))
            bins = record.bins(relaxed.force)
            self.bins.append(bins)
            self.responses.append(Response(bins, specimen))
        self.peak = max(float(np.abs(one.force).max()) for one in self.bins)
        self.force = np.concatenate([one.force for one in self.bins])
        self.sigma, self.excess, self.correlation_time = self._weights(start)
        self.nuisances = self._nuisances()
        nothing = [np.zeros(one.time.size) for one in self.bins]
        self.correction = Correction(np.zeros(0), nothing, [one[:, None] for one in nothing])
        self.kept = np.ones(self.force.size, dtype=np.bool_)  # bins at which the film is taut where it was last solved
        self.within = self.kept  # bins that may be kept: others are left out of this fit, because another needs it
        self.soften = False  # whether a softening of every cycle is fitted along
        self.around: list[Around] = []
        self.solved = 0  # exact histories

    @property
    def independent(self) -> float:
        """How many samples are held against the model, as those count that are independent."""
        return int(np.concatenate([one.size for one in self.bins])[self.kept].sum()) / self.correlation_time

    @property
    def stretches(self) -> NDArray[np.intp]:
        """Which stretch between bends of which record every bin is of; -1 where it is left out."""
        first, found = 0, []
        for one in self.bins:
            found.append(one.segment + first)
            first += one.record.history[0].size
        return np.where(self.kept, np.concatenate(found), -1)

    # --- noise

    def _weights(self, start: Material) -> tuple[Array, float, float]:
        """Standard deviations of the mean forces; variance over the stated one, and samples an independent one."""
        total, freedom, times, base = 0.0, 0, [], []
        for one, response in zip(self.bins, self.responses, strict=True):
            curve = one.record.errors
            steep = Relaxed(response.film(start), response.highest, float(response.voltage.max()))(one.h, one.voltage)
            moving = one.record.moving[one.segment]
            single = np.hypot(curve.force_noise, steep["h"] * curve.displacement_noise * moving)
            scaled = one.noise / single[one.number]
            total += float(scaled @ scaled)
            freedom += scaled.size - one.size.size
            long = (one.size >= LONG)[one.number]
            times.append(correlation(scaled[long], one.rows[long], LONG))
            base.append(single / np.sqrt(one.size))
        ratio = total / freedom if freedom > 0 else 1.0
        excess = ratio if freedom > 0 and ratio > 1.0 + 3.0 * math.sqrt(2.0 / freedom) else 1.0
        correlated = max(times, default=1.0)
        sizes = np.concatenate([one.size for one in self.bins]).astype(float)
        sigma = np.concatenate(base) * np.sqrt(excess * np.minimum(correlated, sizes))
        return np.hypot(sigma, NUMERICAL * self.peak), excess, correlated

    def _nuisances(self) -> list[Nuisance]:
        found = []
        for run in dict.fromkeys(record.run for record in self.records):
            curves = [record.errors for record in self.records if record.run == run]
            for kind, of in (
                ("force_zero", "force_zero"),
                ("displacement_zero", "displacement_zero"),
                ("lag", "lag_uncertainty"),
            ):
                prior = max(getattr(curve, of) for curve in curves)
                if prior > 0.0:
                    found.append(Nuisance(kind, run, prior))
        prior = max(record.errors.compliance_uncertainty for record in self.records)
        if prior > 0.0:
            found.append(Nuisance("compliance", "the rig", prior))
        for record, bins in zip(self.records, self.bins, strict=True):
            measured = record.cycle[bins.segment]
            cycles = range(int(measured.min()) + 1, int(measured.max()) + 1) if measured.size else ()
            found += [Nuisance(SOFTENING, f"{record.run}, cycle {k + 1}", SOFTENS / k) for k in cycles]
        for dimension in DIMENSIONS:
            weights = contrast_weights(self.curves, dimension)
            found += [Nuisance(dimension, f"contrast {k + 1}", 1.0) for k in range(len(weights))]
        return found

    @property
    def curves(self) -> list[Curve]:
        """The stated errors of every record."""
        return [record.errors for record in self.records]

    # --- the vector

    def count(self, x: Array) -> int:
        """How many branches ``x`` has."""
        return (x.size - len(self.coordinates.names) - len(self.nuisances)) // 2

    def vector(self, material: Material, nuisances: Array | None = None) -> Array:
        """``[film, ratios, log times, nuisances]`` of a film."""
        ratio = [one.ratio for one in material.branches]
        time = [math.log(one.time) for one in material.branches]
        errors = np.zeros(len(self.nuisances)) if nuisances is None else nuisances
        return np.concatenate((self.coordinates.vector(material), ratio, time, errors))

    def film(self, x: Array) -> Material:
        """The film with its branches."""
        n, k = len(self.coordinates.names), self.count(x)
        return with_branches(self.coordinates.film(x), x[n : n + k], np.exp(x[n + k : n + 2 * k]))

    @property
    def window(self) -> tuple[float, float]:
        """Shortest and longest relaxation time (s) that is looked for: two samples, and the length of the record."""
        return 2.0 * min(one.period for one in self.records), max(one.span for one in self.records)

    def bounds(self, x: Array) -> tuple[Array, Array]:
        """Of a vector."""
        low, high = self.coordinates.bounds(x)
        k, errors = self.count(x), len(self.nuisances)
        shortest, longest = searched(self.window)
        low = np.concatenate((low, np.zeros(k), np.full(k, shortest), np.full(errors, -np.inf)))
        return low, np.concatenate((high, np.full(k, MOST_RATIO), np.full(k, longest), np.full(errors, np.inf)))

    def varied(self, x: Array) -> NDArray[np.bool_]:
        """Entries that are fitted."""
        free = np.ones(x.size, dtype=np.bool_)
        free[: len(self.coordinates.names)] = [name not in self.held for name in self.coordinates.names]
        if not self.soften:
            free[x.size - len(self.nuisances) :] = [one.kind != SOFTENING for one in self.nuisances]
        return free

    # --- residuals

    @property
    def state(self) -> State:
        """What the model was last corrected by: to be set again for another fit."""
        return self.correction, self.around, self.kept, self.within

    @state.setter
    def state(self, to: State) -> None:
        self.correction, self.around, self.kept, self.within = to

    def settle(self, x: Array) -> None:
        """Take what changes little (`response.Around`) from the film at ``x``."""
        film = self.film(x)
        self.around = [one.around(film) for one in self.responses]

    def evaluate(self, x: Array) -> Point:
        """Residuals and slopes at ``x``, the model as corrected by the last exact solution."""
        film, own = self.film(x), len(self.coordinates.names) + 2 * self.count(x)
        slopes = [one.slopes(film, around) for one, around in zip(self.responses, self.around, strict=True)]
        columns, forces = [], []
        for number, (one, record) in enumerate(zip(slopes, self.records, strict=True)):
            force = one.force + self.correction.force[number]
            column = self._own_columns(x, one)
            if self.correction.at.size == own:
                force = force + self.correction.slope[number] @ (x[:own] - self.correction.at)
                column = column + self.correction.slope[number]
            errors = [each.prior * self._by_nuisance(each, one, force, number, record) for each in self.nuisances]
            others = np.array(errors).reshape(-1, force.size).T
            columns.append(np.concatenate((column, others), axis=1))
            forces.append(force + others @ x[own:])
        force = np.concatenate(forces)
        residual = np.concatenate(((force - self.force) / self.sigma, x[own:]))
        lost = ~np.isfinite(residual)
        residual[lost] = LOST
        residual[: self.kept.size][~self.kept] = 0.0
        jacobian = np.concatenate(columns) / self.sigma[:, None]
        prior = np.eye(len(self.nuisances), x.size, own)
        jacobian = np.where(np.isfinite(jacobian) & self.kept[:, None], jacobian, 0.0)
        return Point(x, residual, np.concatenate((jacobian, prior)), slopes)

    def _own_columns(self, x: Array, one: Slopes) -> Array:
        """Derivatives of the force (N) of a record's bins by film and branches."""
        moduli, eps = self.coordinates.moduli, one.relaxed["eps_r"]
        film = self.coordinates.by_parameters(x[None], one.film[:, :moduli], one.film[:, moduli:], eps)
        return np.concatenate((film, one.ratio, one.log_time), axis=1)

    def _by_nuisance(self, nuisance: Nuisance, one: Slopes, force: Array, number: int, record: Record) -> Array:
        bins = self.bins[number]
        mine = 1.0 if nuisance.run in (record.run, "the rig") else 0.0
        if nuisance.kind in DIMENSIONS:
            weights = contrast_weights(self.curves, nuisance.kind)
            found: Array = one.dimensions[nuisance.kind] * weights[int(nuisance.run.split()[-1]) - 1][number]
            return found
        if nuisance.kind == SOFTENING:
            run, _, cycle = nuisance.run.rpartition(", cycle ")
            softer = record.cycle[bins.segment] >= int(cycle) - 1
            return -force * softer * (run == record.run)
        if nuisance.kind == "force_zero":
            return np.full(bins.time.size, mine)
        # A move later or farther is answered by the film as stiff as it is at once.
        stiff = one.relaxed["h"] + self._quick(one, bins)
        if nuisance.kind == "displacement_zero":
            return mine * one.relaxed["h"]
        if nuisance.kind == "compliance":
            return -force * one.relaxed["h"]
        t, h, _ = record.history
        speed = (np.diff(h) / np.diff(t))[bins.segment]
        return -mine * stiff * speed

    @staticmethod
    def _quick(one: Slopes, bins: Bins) -> Array:
        """What branches add to the stiffness against a quick move (N/m), from the force along the record's moves."""
        extra = one.force - one.relaxed["force"]
        h = np.where(bins.h > 0.02 * bins.h.max(), bins.h, math.inf)
        found: Array = 2.0 * np.maximum(extra, 0.0) / h
        return found

    def exact(self, point: Point) -> None:
        """Correct the model by the exact solution at a point; bins at which the film is not taut are left out."""
        forces, slopes = self._exact(point)
        known = [np.isfinite(force) for force in forces]
        own = len(self.coordinates.names) + 2 * self.count(point.x)
        more, tilt = [], []
        for one, force, slope, there in zip(point.slopes, forces, slopes, known, strict=True):
            more.append(np.where(there, force - one.force, 0.0))
            change = slope - self._own_columns(point.x, one)
            tilt.append(np.where(there[:, None] & np.isfinite(change), change, 0.0))
        self.correction = Correction(point.x[:own].copy(), more, tilt)
        kept = self.within & np.concatenate(known)
        if kept.sum() >= LEAST_KEPT * self.kept.size and not np.array_equal(kept, self.kept):
            self.kept = kept

    def _exact(self, point: Point) -> tuple[list[Array], list[Array]]:
        """Exact forces (N) at the bins of every record, and their derivatives by film and branches."""
        film = self.film(point.x)
        if not film.branches:
            forces = [one.elastic(film, one.bins.time) for one in self.responses]
            return forces, [self._own_columns(point.x, one) for one in point.slopes]
        forces, slopes = [], []
        for one in self._histories(film, [one.bins.time for one in self.responses], sensitivities=True):
            by = one.dforce or {}
            columns = self.coordinates.by_parameters(point.x[None], by["mu"], by["alpha"], by["eps_r"])
            by_log_time = by["time"] * [branch.time for branch in film.branches]
            forces.append(np.where(one.status == Status.TAUT, one.force, np.nan))
            slopes.append(np.concatenate((columns, by["ratio"], by_log_time), axis=1))
        return forces, slopes

    def _histories(self, film: Material, times: Sequence[Array], *, sensitivities: bool) -> list[History]:
        self.solved += 1
        specimens = [one.film(film) for one in self.responses]
        histories = [(one.t, one.h, one.voltage, at) for one, at in zip(self.responses, times, strict=True)]
        return solve_histories(specimens, histories, tolerance=self.tolerance, sensitivities=sensitivities)

    def softening(self, x: Array, record: Record, times: Array) -> Array:
        """Share of the force that the film has lost by the cycles before, at times (s) of a record."""
        found, cycle = np.zeros(times.size), record.cycle_at(times)
        errors = x[x.size - len(self.nuisances) :]
        for one, size in zip(self.nuisances, errors, strict=True):
            run, _, number = one.run.rpartition(", cycle ")
            if one.kind == SOFTENING and run == record.run:
                found += size * one.prior * (cycle >= int(number) - 1)
        return found

    def solve(self, x: Array) -> list[Array]:
        """Exact forces (N) of every record at its fine times; NaN where the film is not taut."""
        film, times = self.film(x), [one.fine for one in self.responses]
        if not film.branches:
            return [one.elastic(film, at) for one, at in zip(self.responses, times, strict=True)]
        found = self._histories(film, times, sensitivities=False)
        return [np.where(one.status == Status.TAUT, one.force, np.nan) for one in found]

    def systematic(self, point: Point) -> dict[str, Array]:
        """What one standard uncertainty of gains and dimensions does to the residuals, by its entry in the budget."""
        found = {}
        nothing = np.zeros(len(self.nuisances))
        for part, uncertainty, scales in SYSTEMATIC:
            sizes = [float(getattr(curve, uncertainty)) for curve in self.curves]
            shared = common(self.curves, scales) if scales in DIMENSIONS else 1.0
            if any(sizes):
                change = [size * shared * one.dimensions[scales] for size, one in zip(sizes, point.slopes, strict=True)]
                found[part] = np.concatenate((np.concatenate(change) / self.sigma, nothing))
        tilted = [stiffening(curve) for curve in self.curves]
        if any(tilted):
            change = [size * one.force for size, one in zip(tilted, point.slopes, strict=True)]
            found["eccentricity"] = np.concatenate((np.concatenate(change) / self.sigma, nothing))
        return found

    # --- minimisation

    def minimise(self, here: Point) -> Point:
        """The minimum near a point of the model as it is corrected (Levenberg & Marquardt, within bounds)."""
        damping = 1e-4
        for _ in range(INNER):
            low, high = self.bounds(here.x)
            free = self.varied(here.x)
            norms = np.linalg.norm(here.jacobian, axis=0)
            norms[norms == 0.0] = 1.0
            better = None
            for _ in range(6):
                columns = (here.jacobian / norms)[:, free]
                rows = np.concatenate((columns, math.sqrt(damping) * np.eye(columns.shape[1])))
                right = np.concatenate((-here.residual, np.zeros(columns.shape[1])))
                ends = ((low - here.x) * norms)[free] - 1e-9, ((high - here.x) * norms)[free] + 1e-9
                step = lsq_linear(rows, right, bounds=ends, method="bvls" if free.sum() < 60 else "trf").x
                trial = here.x.copy()
                trial[free] += step / norms[free]
                there = self.evaluate(np.clip(trial, low, high))
                if there.cost < here.cost:
                    better = there
                    damping = max(damping / 10.0, 1e-9)
                    break
                damping *= 10.0
            if better is None:
                break
            gain, here = here.cost - better.cost, better
            if gain < max(SETTLED, RELATIVE * here.cost):
                break
        return here

    def fit(self, x: Array) -> Point:
        """The minimum near ``x`` of the exact model."""
        self.settle(x)
        here = self.minimise(self.evaluate(x))
        self.settle(here.x)
        here = self.evaluate(here.x)
        for _ in range(OUTER):
            kept = self.kept
            self.exact(here)
            before = self.evaluate(here.x)
            here = self.minimise(before)
            if self.kept is kept and before.cost - here.cost < max(ENOUGH, RELATIVE * here.cost):
                break
        else:
            here.settled = False
        return here

    def fewer(self, here: Point, kept: NDArray[np.bool_]) -> Point:
        """The minimum near one that was found, with the bins that are ``kept`` alone."""
        self.kept = self.within = kept
        found = self.minimise(self.evaluate(here.x))
        found.settled = here.settled
        return found
