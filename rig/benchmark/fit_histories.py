"""Error against run time when a film that takes time is fitted to its whole history.

Every method fits the same means of forces, from the same start, and is held against a fit with far finer numerics: what
remains is the method's own error. The straightforward way solves the history at every step of least squares, with the
solver's own slopes or with finite differences; ours does so at the ends of a search along slopes of first order.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calibration.film.branches.joint import Joint
from calibration.film.branches.record import Record
from calibration.film.branches.spectrum import covariance
from calibration.film.curve import Curve
from model.material.materials import Branch, Material
from model.membrane.history import solve_histories, solve_history
from model.specimen import Specimen

if TYPE_CHECKING:
    from rich.table import Table

Array = NDArray[np.float64]

TRUTH = Material("film", (37_834.0,), (5.4985,), 1.7, branches=(Branch(0.3, 0.8), Branch(0.2, 12.0)))
GUESS = Material("guess", (42_000.0,), (5.0,), 2.0, branches=(Branch(0.2, 1.5), Branch(0.3, 20.0)))
FILM = Specimen(4e-3, 20e-3, 40e-6, 1.2, TRUTH, name="film")
# Pushed, held, charged in the hold, let back: times (s), displacements (m), voltages (V).
COURSE = (
    np.array([0.0, 2.0, 22.0, 22.5, 42.0, 44.0]),
    np.array([0.0, 10e-3, 10e-3, 10e-3, 10e-3, 0.0]),
    np.array([0.0, 0.0, 0.0, 1500.0, 1500.0, 1500.0]),
)
NOISE_N, PERIOD_S = 1e-3, 0.02
QUANTITIES = ("G", "eps_r", "ratio", "time")
OURS, ANALYTIC, DIFFERENCES = "exact at the ends", "exact at every step", "exact, finite differences"
FINEST = 1e-5


@dataclass(frozen=True)
class Fitted:
    """One fit: seconds of processor, histories solved, and relative errors; of ratios and times the larger one."""

    method: str
    tolerance: float
    seconds: float
    histories: int
    error: dict[str, float]


@dataclass(frozen=True)
class Histories:
    """The fits, and the relative standard uncertainties by noise that they are to be held against."""

    rows: list[Fitted]
    stated: dict[str, float]


def measure(
    ours: Sequence[float], analytic: Sequence[float], differences: Sequence[float], finest: float = FINEST
) -> Histories:
    """Each method at its tolerances of the solver, over the largest force."""
    record = _record()
    begun = _ours(record, finest)
    reference = _every(record, finest, analytic=True, start=begun[0])[0]
    joint = Joint([record], GUESS, 1)
    joint.settle(reference)
    deviation = np.sqrt(np.diag(covariance(joint, joint.evaluate(reference)).matrix))
    rows = []
    ways: list[tuple[str, Sequence[float], Callable[[float], tuple[Array, int]]]] = [
        (OURS, ours, lambda tolerance: _ours(record, tolerance)),
        (ANALYTIC, analytic, lambda tolerance: _every(record, tolerance, analytic=True)),
        (DIFFERENCES, differences, lambda tolerance: _every(record, tolerance, analytic=False)),
    ]
    for method, tolerances, way in ways:
        for tolerance in tolerances:
            begin = time.process_time()
            x, solved = way(tolerance)
            seconds = time.process_time() - begin
            rows.append(Fitted(method, tolerance, seconds, solved, _relative(joint, x, x - reference)))
    return Histories(rows, _relative(joint, reference, deviation))


def _relative(joint: Joint, x: Array, change: Array) -> dict[str, float]:
    """Relative changes of the quantities by a change of x, largest of the branches."""
    names, k = joint.coordinates.names, joint.count(x)
    n = len(names)
    share = np.abs(change / x)
    found = {"G": share[0], "eps_r": share[names.index("eps_r")], "ratio": share[n : n + k].max()}
    found["time"] = np.abs(change[n + k : n + 2 * k]).max()
    return {name: float(one) for name, one in found.items()}


def _record() -> Record:
    """The film's run, with noise of the force."""
    t = np.arange(PERIOD_S / 2.0, COURSE[0][-1], PERIOD_S)
    h, voltage = (np.interp(t, COURSE[0], side) for side in COURSE[1:])
    random = np.random.default_rng(7)
    force = solve_history(FILM, *COURSE, t, tolerance=1e-6).force + NOISE_N * random.standard_normal(t.size)
    curve = Curve(
        label="run",
        run="run",
        specimen=FILM,
        h=h,
        force=force,
        voltage=voltage,
        nominal_voltage=1500.0,
        direction=np.zeros(t.size, dtype=np.int8),
        force_noise=NOISE_N,
        displacement_axis=0.0,
        voltage_at_film=0.0,
        thickness_uncertainty=0.0,
        prestretch_uncertainty=0.0,
        disk_radius_uncertainty=0.0,
        ring_radius_uncertainty=0.0,
        time=t,
    )
    return Record(curve, t, h, voltage, force, h > 0.2e-3)


def _ours(record: Record, tolerance: float) -> tuple[Array, int]:
    """The fit as the project does it: its end, and the histories that were solved."""
    joint = Joint([record], GUESS, 1, tolerance=tolerance)
    return _sorted(joint, joint.fit(joint.vector(GUESS)).x), joint.solved


def _every(record: Record, tolerance: float, *, analytic: bool, start: Array | None = None) -> tuple[Array, int]:
    """Least squares with the exact history at every step."""
    from scipy.optimize import least_squares

    joint = Joint([record], GUESS, 1)
    begin = joint.vector(GUESS) if start is None else start
    solved = 0
    last: dict[bytes, tuple[Array, Array]] = {}

    def both(x: Array) -> tuple[Array, Array]:
        nonlocal solved
        key = x.tobytes()
        if key not in last:
            solved += 1
            last.clear()
            last[key] = _exact(joint, x, tolerance, analytic)
        return last[key]

    def residual(x: Array) -> Array:
        return both(x)[0]

    def jacobian(x: Array) -> Array:
        return both(x)[1]

    options: dict[str, Any] = {"x_scale": "jac", "ftol": 1e-8, "xtol": 1e-8, "gtol": 1e-10, "max_nfev": 40}
    options["bounds"] = joint.bounds(begin)
    if analytic:
        found = least_squares(residual, begin, jacobian, **options)
    else:  # steps that the solver's own error does not drown
        steps = np.full(begin.size, max(1e-3, math.sqrt(tolerance) / 10.0))
        found = least_squares(residual, begin, "2-point", diff_step=steps, **options)
    return _sorted(joint, found.x), solved


def _exact(joint: Joint, x: Array, tolerance: float, slopes: bool) -> tuple[Array, Array]:
    """Residuals of the exact history, and their derivatives."""
    film, (one,) = joint.film(x), joint.responses
    course = (one.t, one.h, one.voltage, one.bins.time)
    (found,) = solve_histories([one.film(film)], [course], tolerance=tolerance, sensitivities=slopes)
    residual = (found.force - joint.force) / joint.sigma
    if not slopes:
        return residual, np.zeros((0, 0))
    by = found.dforce or {}
    law = joint.coordinates.by_parameters(x[None], by["mu"], by["alpha"], by["eps_r"])
    by_log_time = by["time"] * [branch.time for branch in film.branches]
    return residual, np.concatenate((law, by["ratio"], by_log_time), axis=1) / joint.sigma[:, None]


def _sorted(joint: Joint, x: Array) -> Array:
    """The quickest branch first."""
    n, k = len(joint.coordinates.names), joint.count(x)
    order = np.argsort(x[n + k : n + 2 * k])
    return np.concatenate((x[:n], x[n : n + k][order], x[n + k : n + 2 * k][order], x[n + 2 * k :]))


def table(found: Histories) -> Table:
    """For the terminal."""
    from rich.table import Table

    made = Table(title="A film with two branches, fitted to its history: error against a fit with far finer numerics")
    for heading in ("method", "solver tolerance", "time / s", "histories", *QUANTITIES):
        made.add_column(heading, justify="left" if heading == "method" else "right")
    for row in found.rows:
        cost = (f"{row.tolerance:g}", f"{row.seconds:.2f}", str(row.histories))
        made.add_row(row.method, *cost, *(f"{row.error[name]:.1e}" for name in QUANTITIES))
    made.add_row("uncertainty by noise", "", "", "", *(f"{found.stated[name]:.1e}" for name in QUANTITIES))
    return made
