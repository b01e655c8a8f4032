"""Which known imperfection the residuals look like.

The overall chi-square spreads its attention over all shapes that a misfit can have, and a small error of one known kind
hides in it although it biases the result. So the residuals are also held against the shape of each usual suspect: with
``d`` the change of the weighted residuals by one unit of it, and ``P`` the projection off everything that the fitted
parameters can do, its amplitude is ``a = -d P r / |P d|^2`` with standard uncertainty ``1/|P d|`` (a score test).

What the parameters can do for themselves no test finds (Neyman & Pearson 1933): an imperfection that looks much like
another stiffness or permittivity biases them before it shows. So each suspect also tells from which size on it would
be reported, and what it does to the result until then.
"""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from calibration.film.problem import Problem
from calibration.film.reduction import interpolation_matrix
from calibration.film.result import SIGNIFICANT, Suspect

Array = NDArray[np.float64]

RELAXATION_S = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
INSTANTS = 2000  # of a run's time, at which a viscous force is worked out
ALMOST_SURE = 1.6449  # standard deviations that 95 of 100 stay below
VISIBLE = 1e-3  # share of a shape that the parameters must leave over; less is round-off and interpolation


COMPLIANCE = "compliance of the rig that is not taken off"
SOFTENING = "film that softens from one curve to the next"
NOT_SQUARE = "electric force that does not go with V^2"
HYSTERESIS = "hysteresis: loading above unloading"
# How each is ruled out or found, by the beginning of its name.
REMEDIES = {
    "viscous film": "hold the film displaced, in the same run, for several times as long",
    COMPLIANCE: "press on a rigid dummy in place of the film; what the displacement sensor reads then is compliance",
    SOFTENING: "measure the curve at the first voltage once more at the end",
    NOT_SQUARE: "`dea-rig calibrate hv`; compare fits of single voltages",
    HYSTERESIS: "give the curves with their times, and one more at another speed",
    "thickness": "measure the thickness of every specimen",
}


def suspects(problem: Problem, x: Array, free: NDArray[np.bool_]) -> list[Suspect]:
    """The imperfections that this data could show, most probable first."""
    base, s, _ = np.linalg.svd(problem.jacobian(x)[:, free], full_matrices=False)
    base = base[:, s > 1e-10 * s[0]]
    residual = problem.residual(x)
    found = []
    for name, unit, shape in _shapes(problem, x):
        visible = shape - base @ (base.T @ shape)
        size = float(np.linalg.norm(visible))
        if size > VISIBLE * float(np.linalg.norm(shape)) and size > 0.0:
            found.append((name, unit, shape, -float(visible @ residual) / size**2, 1.0 / size))
    reported = NormalDist().inv_cdf(1.0 - 0.5 * SIGNIFICANT / max(1, len(found)))
    judged = [
        Suspect(
            name=name,
            amplitude=a,
            uncertainty=u,
            unit=unit,
            probability=min(1.0, len(found) * math.erfc(abs(a) / u / math.sqrt(2.0))),
            shows_from=(reported + ALMOST_SURE) * u,
            remedy=next(words for beginning, words in REMEDIES.items() if name.startswith(beginning)),
            shape=shape,
        )
        for name, unit, shape, a, u in found
    ]
    return sorted(judged, key=lambda one: one.probability)


def _shapes(problem: Problem, x: Array) -> list[tuple[str, str, Array]]:
    """Name, unit and change of the weighted residuals by one unit of every suspect."""
    states = problem.states(x)
    curves = [problem.curves[i] for i in problem.active]
    force, by = states.force, states.by

    def plain(change: Array) -> Array:
        rows: Array = problem.project(change[..., None])[:, 0]
        return rows

    shapes = []
    if all(curve.time is not None for curve in curves):
        for tau, shape in _viscous(problem, x).items():
            shapes.append((f"viscous film with a relaxation time near {tau:g} s", "1", shape))
    elif 1 in problem.ways and -1 in problem.ways:
        ways = np.concatenate(
            [np.full(root.shape[0], way) for root, way in zip(problem.roots, problem.ways, strict=True)]
        )
        loop = plain(force)
        loop[: ways.size] *= ways
        shapes.append((HYSTERESIS, "1", loop))
    if not any(nuisance.kind == "compliance" for nuisance in problem.nuisances):
        shapes.append((COMPLIANCE, "m/N", plain(-force * by["h"])))
    if len(set(problem.active)) > 1:
        first = {curve.run: i for i, curve in reversed(list(zip(problem.active, curves, strict=True)))}
        order = np.array([[float(i - first[curve.run])] for i, curve in zip(problem.active, curves, strict=True)])
        shapes.append((SOFTENING, "1", plain(-force * order)))
    films = list(dict.fromkeys(curve.specimen.with_material(problem.material) for curve in curves))
    for film in films[1:]:
        here = np.array([[curve.specimen.with_material(problem.material) == film] for curve in curves])
        name = f"thickness of {film.name or 'a specimen'} unlike the other's"
        shapes.append((name, "1", plain(here * by["thickness"] * film.thickness)))
    voltages = np.abs(problem.voltage)
    if len(set(np.rint(voltages[voltages > 0.0]))) > 1:
        weight = ((voltages / voltages.max()) ** 2)[:, None]
        eps_r = problem.film(x).eps_r
        shapes.append((NOT_SQUARE, "1", plain(by["eps_r"] * eps_r * weight)))
    return shapes


def _viscous(problem: Problem, x: Array) -> dict[float, Array]:
    """What Maxwell branches as stiff as the film itself do to the weighted residuals, by their relaxation time (s).

    The force of one is ``integral of exp(-(t - s)/tau) dF0`` over the history of its run, with the force ``F0`` at 0 V.
    Branches slower than any run are left out: they are stiffness to it.
    """
    rest = problem.at_rest(x)
    found = np.zeros((len(RELAXATION_S), problem.data_rows + len(problem.nuisances)))
    longest = 0.0
    places = np.cumsum([0, *(root.shape[0] for root in problem.roots)])
    runs = [problem.curves[problem.active[row]].run for row in problem.block_rows]
    for run in dict.fromkeys(runs):
        mine = [k for k, one in enumerate(runs) if one == run]
        times, elastic = [], []
        for k in mine:
            block, row = problem.blocks[k], problem.block_rows[k]
            curve = problem.curves[problem.active[row]]
            assert curve.time is not None
            times.append(curve.time[block.rows])
            elastic.append(interpolation_matrix(problem.nodes[row], curve.place[block.rows]) @ rest[row])
        time, force = np.concatenate(times), np.concatenate(elastic)
        order = np.argsort(time, kind="stable")
        grid = np.linspace(time.min(), time.max(), INSTANTS)
        if grid[0] == grid[-1]:
            continue  # no time to relax in
        longest = max(longest, float(grid[-1] - grid[0]))
        extra = _maxwell(grid[1] - grid[0], np.interp(grid, time[order], force[order]))
        for k, at in zip(mine, times, strict=True):
            block = problem.blocks[k]
            samples = np.array([np.interp(at, grid, one) for one in extra])
            found[:, places[k] : places[k + 1]] = samples / block.sigma @ block.base / math.sqrt(problem.inflation)
    return {tau: rows for tau, rows in zip(RELAXATION_S, found, strict=True) if tau <= longest}


def _maxwell(step: float, elastic: Array) -> Array:
    """Forces of the Maxwell branches at equal steps of time (s), from rest; shape (relaxation times, instants)."""
    ratio = step / np.array(RELAXATION_S)
    decay = np.exp(-ratio)
    share = -np.expm1(-ratio) / ratio  # of a change spread over the step, what is left at its end
    force = np.zeros((elastic.size, ratio.size))
    for k, change in enumerate(np.diff(elastic), start=1):
        force[k] = decay * force[k - 1] + share * change
    return force.T
