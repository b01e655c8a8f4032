"""Error of the identified film against the time spent: on the computer, and on the rig.

On the computer every method fits the same curves and is held against the same fit with far finer numerics, so that what
remains is the method's own error. On the rig the error is that of simulated experiments against the film behind them.
"""

from __future__ import annotations

import csv
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calibration.film.curve import Curve
from calibration.film.identify import identify
from calibration.film.problem import Problem
from calibration.film.reduction import select
from calibration.sensors.certificate import Certificate
from model.material.materials import Material
from model.membrane.solve import solve_many
from model.specimen import Specimen
from rig.analysis import proposal
from rig.benchmark import fit_histories
from rig.benchmark.fit_histories import Histories
from rig.protocol.experiment import certificates_of
from rig.protocol.protocol import Protocol
from rig.scene.scene import Scene, load_scene

if TYPE_CHECKING:
    from rich.console import RenderableType

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

TRUTH = Material(name="one-term Parker film", mu=(37_834.0,), alpha=(5.4985,), eps_r=1.7)
GUESS = replace(TRUTH, mu=(45_000.0,), alpha=(4.5,), eps_r=2.2)
QUANTITIES = ("G", "alpha", "eps_r")
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
NOISE_N = 5e-3
SWEPT = 300  # samples of a curve while the tolerance changes
REDUCED, DIFFERENCES, EVERY = "reduced, analytic Jacobian", "reduced, finite differences", "every sample, analytic"


@dataclass(frozen=True)
class Point:
    """One fit: how it was done, what it cost, how far it ended from the reference (relative)."""

    method: str
    tolerance: float
    samples: int  # of a curve
    seconds: float
    states: int  # of the membrane that were solved
    error: dict[str, float]


@dataclass(frozen=True)
class RigPoint:
    """A protocol of a duration (s): root mean square error over ``runs`` experiments, and the one stated (relative)."""

    protocol: str
    duration: float
    runs: int
    error: dict[str, float]
    stated: dict[str, float]


@dataclass(frozen=True)
class Report:
    """What the benchmark of the fit found."""

    full: bool
    points: list[Point]
    rig: list[RigPoint]
    histories: Histories
    swept: int = SWEPT


def run(full: bool, out_dir: Path, progress: Progress = lambda share, what: None) -> Report:
    """Measure (a minute; full: some minutes); write ``fit.json``, ``fit.csv`` and ``fit.png``."""
    report = measure(
        samples=(10, 100, 1000, 10_000, 100_000) if full else (10, 100, 1000, 10_000),
        every=(10, 30, 100, 300) if full else (10, 30, 100),
        repeats=5 if full else 2,
        minutes=(3.0, 5.0, 10.0, 20.0, 60.0) if full else (3.0, 5.0, 10.0),
        runs=40 if full else 8,
        histories=((1e-2, 1e-3, 1e-4), (1e-2, 1e-3, 1e-4), (1e-2, 1e-3)) if full else ((1e-2, 1e-3, 1e-4), (1e-3,), ()),
        full=full,
        progress=progress,
    )
    save(report, out_dir)
    return report


def measure(
    *,
    samples: Sequence[int],
    every: Sequence[int],
    repeats: int,
    minutes: Sequence[float],
    runs: int,
    histories: tuple[Sequence[float], Sequence[float], Sequence[float]],
    tolerances: Sequence[float] = TOLERANCES,
    full: bool = False,
    progress: Progress = lambda share, what: None,
) -> Report:
    """Fits of ``samples`` a curve (``every``: without reduction), and ``runs`` experiments for each of ``minutes``.

    ``histories`` are the tolerances of each method of `fit_histories.measure`.
    """
    points = []
    curves = _curves(SWEPT, zeros=True)
    reference = _fit(_Reduced(curves, 1e-10, nodes=20), analytic=True)[0]
    for k, tolerance in enumerate(tolerances):
        progress(0.3 * k / len(tolerances), f"solver tolerance {tolerance:g}")
        for method, analytic in ((REDUCED, True), (DIFFERENCES, False)):
            points.append(_point(method, _Reduced, curves, tolerance, reference, analytic=analytic, repeats=repeats))
    for k, count in enumerate(samples):
        progress(0.3 + 0.2 * k / len(samples), f"{count} samples a curve")
        some = _curves(count)
        truth = _fit(_Reduced(some, 1e-10, nodes=20), analytic=True)[0] if count > 20 else None
        points.append(_point(REDUCED, _Reduced, some, 1e-7, truth, analytic=True, repeats=repeats))
        if count in every:
            points.append(_point(EVERY, _EverySample, some, 1e-7, truth, analytic=True, repeats=1))
    rig = _on_the_rig(minutes, runs, lambda share, what: progress(0.5 + 0.3 * share, what))
    progress(0.8, "films that take time")
    return Report(full, points, rig, fit_histories.measure(*histories))


def simulated(
    protocol: Protocol, scene: Scene, certificates: Mapping[str, Certificate], film: Material, seed: int
) -> list[Curve]:
    """What a run of ``protocol`` records of a film, with noise and zeros as the certificates state them."""
    random = np.random.default_rng(seed)
    zero_f, zero_h = random.standard_normal(2)
    made = []
    for curve in proposal.recorded(protocol, scene, certificates, scene.specimen.specimen()):
        grid = np.linspace(0.0, 1.02 * float(curve.h.max()), 200)
        specimen = curve.specimen.with_material(film)
        force = solve_many(specimen, grid, curve.nominal_voltage, wrinkling="tension_field").force
        known = np.isfinite(force)
        n = curve.h.size
        exact = np.interp(curve.h, grid[known], force[known])
        made.append(
            replace(
                curve,
                force=exact + curve.force_zero * zero_f + curve.force_noise * random.standard_normal(n),
                h=curve.h + curve.displacement_zero * zero_h + curve.displacement_noise * random.standard_normal(n),
            )
        )
    return made


def _curves(samples: int, *, zeros: bool = False) -> list[Curve]:
    """Two films, three voltages, up and back, with independent noise; ``zeros`` are parameters of the fit, too."""
    random = np.random.default_rng(5)
    made = []
    for disk in (4e-3, 6e-3):
        specimen = Specimen(disk, 20e-3, 40e-6, 1.2, TRUTH)
        for voltage in (0.0, 1000.0, 1500.0):
            up = np.linspace(0.5e-3, 11e-3, samples // 2)
            h = np.concatenate((up, up[::-1]))
            grid = np.linspace(0.0, 11.1e-3, 400)
            force = np.interp(h, grid, solve_many(specimen, grid, voltage).force)
            made.append(
                Curve(
                    label=f"{disk} {voltage}",
                    run=f"{disk}",
                    specimen=specimen.with_material(GUESS),
                    h=h,
                    force=force + NOISE_N * random.standard_normal(h.size),
                    voltage=np.full(h.size, voltage),
                    nominal_voltage=voltage,
                    direction=np.repeat([1, -1], samples // 2),
                    force_noise=NOISE_N,
                    force_zero=2e-4 if zeros else 0.0,
                    displacement_zero=5e-6 if zeros else 0.0,
                    displacement_axis=0.0,  # known, so that every fitter has the same parameters
                    voltage_at_film=0.0,
                    thickness_uncertainty=0.0,
                    prestretch_uncertainty=0.0,
                    disk_radius_uncertainty=0.0,
                    ring_radius_uncertainty=0.0,
                )
            )
    return made


class _Reduced:
    """The fit as the project does it: a few states a curve carry all samples."""

    def __init__(self, curves: Sequence[Curve], tolerance: float, nodes: int = 8) -> None:
        selections = select(curves, TRUTH)
        self.problem = Problem(curves, selections, 1, GUESS, nodes=nodes, tolerance=tolerance, trust_noise=True)
        self.start = self.problem.vector(GUESS)

    def residual(self, x: Array) -> Array:
        residual: Array = self.problem.evaluate(x[None], slopes=False).residual[0]
        return residual

    def both(self, x: Array) -> tuple[Array, Array]:
        found = self.problem.evaluate(x[None])
        return found.residual[0], found.jacobian[0]

    @property
    def solved(self) -> int:
        return self.problem.solved

    def film(self, x: Array) -> Material:
        return self.problem.film(x)


class _EverySample:
    """The straightforward way: one state of the membrane for every sample."""

    def __init__(self, curves: Sequence[Curve], tolerance: float) -> None:
        self.curves = curves
        self.tolerance = tolerance
        self.start = np.array([1.0, GUESS.alpha[0], GUESS.eps_r])
        self.solved = 0

    def film(self, x: Array) -> Material:
        mu = 2.0 * GUESS.shear_modulus * float(x[0] / x[1])
        return Material(name="fitted", mu=(mu,), alpha=(float(x[1]),), eps_r=float(x[2]))

    def residual(self, x: Array) -> Array:
        return self.both(x)[0]

    def both(self, x: Array) -> tuple[Array, Array]:
        film = self.film(x)
        rows, slopes = [], []
        for curve in self.curves:
            solved = solve_many(
                curve.specimen.with_material(film),
                curve.h,
                curve.nominal_voltage,
                tolerance=self.tolerance,
                sensitivities=True,
            )
            by = solved.dforce
            assert by is not None
            self.solved += curve.h.size
            by_mu, by_alpha = by["mu"][:, 0], by["alpha"][:, 0]
            rows.append((solved.force - curve.force) / curve.force_noise)
            slopes.append(
                np.stack((by_mu * film.mu[0] / x[0], by_alpha - by_mu * film.mu[0] / x[1], by["eps_r"]), axis=1)
                / curve.force_noise
            )
        return np.concatenate(rows), np.concatenate(slopes)


def _fit(problem: Any, *, analytic: bool) -> tuple[dict[str, float], float]:
    """What SciPy's least squares finds, and the seconds it took."""
    from scipy.optimize import least_squares

    last: dict[bytes, tuple[Array, Array]] = {}

    def both(x: Array) -> tuple[Array, Array]:
        key = x.tobytes()
        if key not in last:
            last.clear()
            last[key] = problem.both(x)
        return last[key]

    begin = time.perf_counter()
    options: dict[str, Any] = {"x_scale": "jac", "ftol": 1e-12, "xtol": 1e-10, "gtol": 1e-12, "max_nfev": 40}

    def residual(x: Array) -> Array:
        return both(x)[0]

    def jacobian(x: Array) -> Array:
        return both(x)[1]

    if analytic:
        found = least_squares(residual, problem.start, jacobian, **options)
    else:
        found = least_squares(problem.residual, problem.start, "2-point", **options)
    film = problem.film(found.x)
    values = {"G": film.shear_modulus, "alpha": film.alpha[0], "eps_r": film.eps_r}
    return values, time.perf_counter() - begin


def _point(
    method: str,
    way: Callable[[Sequence[Curve], float], Any],
    curves: Sequence[Curve],
    tolerance: float,
    reference: Mapping[str, float] | None,
    *,
    analytic: bool,
    repeats: int,
) -> Point:
    seconds = math.inf
    for _ in range(repeats):
        begin = time.perf_counter()
        problem = way(curves, tolerance)
        values, _ = _fit(problem, analytic=analytic)
        seconds = min(seconds, time.perf_counter() - begin)
    known = reference or {"G": TRUTH.shear_modulus, "alpha": TRUTH.alpha[0], "eps_r": TRUTH.eps_r}
    error = {name: abs(values[name] / known[name] - 1.0) for name in QUANTITIES}
    return Point(method, tolerance, curves[0].h.size, seconds, problem.solved, error)


def _on_the_rig(minutes: Sequence[float], runs: int, progress: Progress) -> list[RigPoint]:
    """Uniform sweep and planned protocol of several durations on the simulated scene of the smaller disk."""
    found = []
    with as_file(files("sim_fixtures")) as fixtures:
        path = fixtures / "scenes" / "cone-4mm.toml"
        scene, _ = load_scene(path)
        certificates = certificates_of(scene, path)
        for k, duration in enumerate(minutes):
            proposed = proposal.propose_protocol(path, 60.0 * duration, TRUTH, terms=1)
            for j, (name, design) in enumerate((("uniform sweep", proposed.sweep), ("planned", proposed.planned))):
                progress((k + 0.5 * j) / len(minutes), f"{name} of {duration:g} min")
                found.append(_experiments(name, design, scene, certificates, runs))
    return found


def _experiments(
    name: str, design: proposal.Design, scene: Scene, certificates: Mapping[str, Certificate], runs: int
) -> RigPoint:
    truth = {"G": TRUTH.shear_modulus, "alpha1": TRUTH.alpha[0], "eps_r": TRUTH.eps_r}
    errors, stated = [], []
    for seed in range(runs):
        fit = identify(simulated(design.protocol, scene, certificates, TRUTH, seed), terms=1, starts=1).quantities
        errors.append([fit[key].value / known - 1.0 for key, known in truth.items()])
        parts = ("noise", "force zero", "displacement zero")
        stated.append([math.hypot(*(fit[key].budget.get(p, 0.0) for p in parts)) / fit[key].value for key in truth])
    rms, median = np.sqrt(np.mean(np.square(errors), axis=0)), np.median(stated, axis=0)
    return RigPoint(
        name,
        design.duration,
        runs,
        {key: float(value) for key, value in zip(QUANTITIES, rms, strict=True)},
        {key: float(value) for key, value in zip(QUANTITIES, median, strict=True)},
    )


def save(report: Report, out_dir: Path) -> None:
    """Write the report as JSON, CSV and a picture."""
    from rig.benchmark import plot

    out_dir.mkdir(parents=True, exist_ok=True)
    (out_dir / "fit.json").write_text(json.dumps(asdict(report), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    with (out_dir / "fit.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        names = [f"relative_error_{name}" for name in QUANTITIES]
        writer.writerow(["what", "tolerance", "samples_a_curve", "compute_s", "states", "rig_s", *names])
        for point in report.points:
            row = [point.method, point.tolerance, point.samples, point.seconds, point.states, ""]
            writer.writerow([*row, *(point.error[name] for name in QUANTITIES)])
        for one in report.rig:
            writer.writerow([one.protocol, "", "", "", "", one.duration, *(one.error[name] for name in QUANTITIES)])
        for fitted in report.histories.rows:
            label = f"film that takes time, {fitted.method}"
            errors = [fitted.error.get(name, "") for name in QUANTITIES]
            writer.writerow([label, fitted.tolerance, "", fitted.seconds, fitted.histories, "", *errors])
    plot.fits(report, out_dir / "fit.png")


def render(report: Report) -> RenderableType:
    """Tables for the terminal."""
    from rich.console import Group
    from rich.table import Table

    fits = Table(title="Fit on the computer: error against a fit with far finer numerics")
    for heading in ("method", "solver tolerance", "samples a curve", "time / ms", "states", *QUANTITIES):
        fits.add_column(heading, justify="left" if heading == "method" else "right")
    for point in report.points:
        cost = (f"{point.tolerance:g}", str(point.samples), f"{1e3 * point.seconds:.0f}", str(point.states))
        fits.add_row(point.method, *cost, *(f"{point.error[name]:.1e}" for name in QUANTITIES))
    rig = Table(title="Experiments on the rig: error against the film, and the uncertainty that was stated, %")
    for heading in ("protocol", "rig time / min", "runs", *QUANTITIES):
        rig.add_column(heading, justify="left" if heading == "protocol" else "right")
    for one in report.rig:
        cells = (f"{100 * one.error[name]:.2g} ({100 * one.stated[name]:.2g})" for name in QUANTITIES)
        rig.add_row(one.protocol, f"{one.duration / 60:.1f}", str(one.runs), *cells)
    return Group(fits, fit_histories.table(report.histories), rig)
