"""A film that takes time: Maxwell branches of many relaxation times."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.film.suspects.base import Context, Kind, Shape
from model.material.law import stack

Array = NDArray[np.float64]

RELAXATION_S = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
INSTANTS = 2000  # of a run's time, at which a viscous force is worked out
NAME = "viscous film"


def _viscous(context: Context) -> Sequence[Shape]:
    """What a Maxwell branch as stiff as the film itself adds, by its relaxation time.

    The force of one is ``integral of exp(-(t - s)/tau) dD`` over the history of its run. ``D`` is the force that it
    adds to a move that leaves it no time: it rested in the pre-stretched film, so its energy is that of the stretches
    over the pre-stretch (`model.membrane.history`).
    """
    if not context.timed:
        return []
    rest = _instant(context)
    sums: list[dict[int, Array]] = [{} for _ in RELAXATION_S]
    for run, (begin, duration) in context.runs.items():
        mine = [k for k, row in enumerate(context.block_rows) if context.curves[row].run == run]
        times, elastic = [], []
        for k in mine:
            row, block = context.block_rows[k], context.blocks[k]
            time = context.curves[row].time
            assert time is not None
            times.append(time[block.rows])
            elastic.append(context.interpolated(rest, row, block))
        time_all, force = np.concatenate(times), np.concatenate(elastic)
        order = np.argsort(time_all, kind="stable")
        grid = np.linspace(begin, begin + duration, INSTANTS)
        extra = _maxwell(grid[1] - grid[0], np.interp(grid, time_all[order], force[order]))
        for by_block, one in zip(sums, extra, strict=True):
            by_block.update({k: np.interp(at, grid, one) for k, at in zip(mine, times, strict=True)})
    found = []
    for tau, by_block in zip(RELAXATION_S, sums, strict=True):
        places = {id(block): k for k, block in enumerate(context.blocks)}
        rows = context.at_samples(lambda _row, block, by=by_block, at=places: by[at[id(block)]])  # type: ignore[misc]
        found.append(Shape(f"{NAME} with a relaxation time near {tau:g} s", rows))
    return found


def _instant(context: Context) -> Array:
    """Force at the nodes that a branch as stiff as the film adds to a quick move from rest (N)."""
    film = context.film
    law = film.law(np.array(film.mu)[:, None], np.array(film.alpha).reshape(-1, 1))
    rest = np.log([curve.specimen.prestretch for curve in context.curves])[:, None, None]

    def energy(l1: Array, l2: Array, field: Array) -> Array:
        return law.energy(stack(np.log(l1) - rest, np.log(l2) - rest))

    return context.from_energy(energy)


def _maxwell(step: float, elastic: Array) -> Array:
    """Forces of the Maxwell branches at equal steps of time (s), from rest; shape (relaxation times, instants)."""
    ratio = step / np.array(RELAXATION_S)
    decay = np.exp(-ratio)
    share = -np.expm1(-ratio) / ratio  # of a change spread over the step, what is left at its end
    force = np.zeros((elastic.size, ratio.size))
    for k, change in enumerate(np.diff(elastic), start=1):
        force[k] = decay * force[k - 1] + share * change
    return force.T


REMEDY = "hold the film displaced, in the same run, for several times as long"
SUSPECTS = [Kind(NAME, "1", 1, 0.1, REMEDY, _viscous)]
