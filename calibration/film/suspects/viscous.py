"""A film that takes time: Maxwell branches of many relaxation times."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.film.reduction import interpolation_matrix
from calibration.film.suspects.base import Context, Kind, Shape
from model.arrays import Array
from model.material.law import Law, stack

RELAXATION_S = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
INSTANTS = 600  # of a run's time, at which a viscous force is worked out
EVERY = 4  # of the points along the radius one is used
NAME = "viscous film"
Path = tuple[Array, Array, Array]  # times (n,); log stretches and their slopes by displacement, (n, 2, points)


def _viscous(context: Context) -> Sequence[Shape]:
    """What a Maxwell branch as stiff as the film itself adds, by its relaxation time.

    To first order the film goes the way of the elastic one, and at every point of it the branch's stretches ``x``
    follow those of the film, ``dx/dt = du/dt - N(x)/tau`` (`model.membrane.history`; ``N`` is `_flow`). Its force is
    the virtual work of its stress: ``integral of S(x) . du/dh``.
    """
    if not context.timed:
        return []
    film = context.film
    law = film.law(np.array(film.mu)[:, None], np.array(film.alpha).reshape(-1, 1))
    found: list[list[Array]] = [[] for _ in RELAXATION_S]
    forces = {run: _forces(context, run, law) for run in context.runs}
    for k, row in enumerate(context.block_rows):
        curve = context.curves[row]
        assert curve.time is not None
        times, by_time = forces[curve.run]
        for rows, force in zip(found, by_time.T, strict=True):
            rows.append(np.interp(curve.time[context.blocks[k].rows], times, force))
    places = {id(block): k for k, block in enumerate(context.blocks)}
    return [
        Shape(
            f"{NAME} with a relaxation time near {tau:g} s",
            context.at_samples(lambda _row, block, of=rows: of[places[id(block)]]),  # type: ignore[misc]
        )
        for tau, rows in zip(RELAXATION_S, found, strict=True)
    ]


def _forces(context: Context, run: str, law: Law) -> tuple[Array, Array]:
    """Instants (n,) of a run and the forces of the branches there, (n, relaxation times)."""
    rows = [row for row in context.block_rows if context.curves[row].run == run]
    times, log, slope = _path(context, run)
    _, _, _, weights = context.states
    # Simpson's rule over fewer points: its weights of all of them alternate between 4 and 2, and begin with 1.
    share = np.full(weights.shape[1], 2.0)
    share[1::2], share[0], share[-1] = 4.0, 1.0, 1.0
    fewer = EVERY * (weights[rows[0]] / share)[::EVERY]
    fewer[1::2], fewer[2:-1:2] = 4.0 * fewer[1::2], 2.0 * fewer[2:-1:2]
    virtual = fewer * slope
    modulus = float(law.shear_modulus(law.mu[:, 0].tolist(), law.alpha[:, 0].tolist()))
    tau = np.array(RELAXATION_S)[:, None]
    x = np.zeros((2, tau.size, log.shape[2])) + (log[0] - _rest(context, rows[0]))[:, None]
    out = np.empty((times.size, tau.size))
    stress = _stress(law, x)
    for k in range(times.size):
        if k:
            step = (times[k] - times[k - 1]) / tau
            decay, share_left = np.exp(-step), -np.expm1(-step) / step
            more = _flow(stress, modulus) - x  # what a finite strain adds to the flow
            base, move = decay * x, share_left * (log[k] - log[k - 1])[:, None]
            x = base + move - share_left * step * more
            more = 0.5 * (more + _flow(_stress(law, x), modulus) - x)
            x = base + move - share_left * step * more
            stress = _stress(law, x)
        out[k] = np.einsum("itp,ip->t", stress, virtual[k])
    return times, out


def _path(context: Context, run: str) -> Path:
    """How the elastic film goes through a run: at the samples next to `INSTANTS` of its time and where it turns."""
    l1, l2, _, _ = context.states
    log = np.log(np.stack((l1, l2), axis=2)[..., ::EVERY])  # (rows, nodes, 2, points)
    slope = np.einsum("rij,rjdp->ridp", context.differentiation, log)
    time, place, block = _samples(context, run)
    row = np.array(context.block_rows)[block]
    begin, duration = context.runs[run]
    near = np.searchsorted(time, np.linspace(begin, begin + duration, INSTANTS)).clip(max=time.size - 1)
    turns = np.flatnonzero(np.diff(block))[:INSTANTS]  # a block has one direction
    at = np.unique(np.concatenate((near, turns, turns + 1)))
    logs, slopes = np.empty((2, at.size, *log.shape[2:]))
    for one in np.unique(row[at]):
        mine = row[at] == one
        matrix = interpolation_matrix(context.nodes[one], place[at[mine]])
        logs[mine] = np.einsum("nj,jdp->ndp", matrix, log[one])
        slopes[mine] = np.einsum("nj,jdp->ndp", matrix, slope[one])
    return time[at], logs, slopes


def _samples(context: Context, run: str) -> tuple[Array, Array, NDArray[np.intp]]:
    """Times of a run's samples, in their order and each once, their displacements and the numbers of their blocks."""
    times, places, numbers = [], [], []
    for k, (block, row) in enumerate(zip(context.blocks, context.block_rows, strict=True)):
        curve = context.curves[row]
        if curve.run == run and curve.time is not None:
            times.append(curve.time[block.rows])
            places.append(curve.place[block.rows])
            numbers.append(np.full(block.rows.size, k, dtype=np.intp))
    time, first = np.unique(np.concatenate(times), return_index=True)
    return time, np.concatenate(places)[first], np.concatenate(numbers)[first]


def _rest(context: Context, row: int) -> float:
    """Logarithm of the stretch in which the branches rest."""
    return float(np.log(context.curves[row].specimen.prestretch))


def _stress(law: Law, x: Array) -> Array:
    """``dW/dL`` at log stretches (2, ..., points), in Pa."""
    shape = x.shape
    return np.array(law.derivatives(stack(x[0].ravel(), x[1].ravel()))[:2]).reshape(shape)


def _flow(stress: Array, modulus: float) -> Array:
    """``N``: the flow over ``1/tau``, ``(S_i - (S_1 + S_2)/3) / 2G``; at small strain the log stretch itself."""
    found: Array = (stress - stress.sum(axis=0) / 3.0) / (2.0 * modulus)
    return found


REMEDY = "hold the film displaced, in the same run, for several times as long"
SUSPECTS = [Kind(NAME, "1", 1, 0.1, REMEDY, _viscous)]
