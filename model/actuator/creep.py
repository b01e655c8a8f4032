"""A film that takes time against a bias: how its disk creeps when nothing holds it.

The disk is let go at ``t[0]``, with the film rested in its flat pre-stretched state: the film is stretched at once
until its force ``F`` is that of the bias, ``share B(h)``, and from then on ``F = share B(h)`` at every instant while
the branches relax (`model.membrane.history`). Two limits are those of films that take no time: the stroke at once is
that of all branches unrelaxed, and after a long time it is that of the relaxed film (`model.actuator.equilibrium`).

A voltage moves the disk at once and then makes it creep. Where the film's stiffness falls to that of the bias the disk
jumps, and from there on it has a status and no number.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.actuator.bias import Antagonist, forces
from model.actuator.equilibrium import Actuator, kind_of
from model.arrays import Array
from model.membrane.history import History, solve_histories


def creep(
    actuator: Actuator,
    t: ArrayLike,
    voltage: ArrayLike = 0.0,
    times: ArrayLike | None = None,
    *,
    share: ArrayLike = 1.0,
    tolerance: float = 1e-6,
    sensitivities: bool = False,
) -> History:
    """Displacement of an actuator's disk along a history of its voltage and load.

    Parameters
    ----------
    actuator : film and bias; the film's material has the branches
    t : times (s) at which the history bends, rising; the disk is let go at the first
    voltage : of the driven film (V) there, linear in between
    times : where the answer is wanted, within ``t``; at ``t`` itself when not given
    share : of the bias that acts (1), 0 or more, linear in between: a mass that is put on and taken off. Where it is 0
        the film is flat
    tolerance : error of the displacement to aim for, over the largest of the history: 1e-10 to 1e-2
    sensitivities : also give ``dh``, the derivatives of the displacement

    Returns
    -------
    History at ``times``: ``h`` with ``error_estimate`` over the largest, ``force``, statuses as of films whose disk is
    held. SLACK: the film carries no force; UNSTABLE: the disk jumps, or the film has pulled in.

    Raises
    ------
    ValueError : the history is none, a share is negative, or the bias is a film that takes time itself
    """
    return creep_many([actuator], [(t, voltage, times, share)], tolerance=tolerance, sensitivities=sensitivities)[0]


def creep_many(
    actuators: Sequence[Actuator],
    histories: Sequence[tuple[ArrayLike, ArrayLike, ArrayLike | None, ArrayLike]],
    *,
    tolerance: float = 1e-6,
    sensitivities: bool = False,
) -> list[History]:
    """`creep` of many actuators at once; ``histories`` are ``(t, voltage, times, share)`` of each.

    Raises
    ------
    ValueError : as in `creep`
    """
    biases = [one.bias for one in actuators]
    for bias in biases:
        if isinstance(bias, Antagonist) and bias.film.material.branches:
            raise ValueError("antagonist: its film has branches; a second film that takes time is not solved")
    courses = []
    for t, voltage, times, share in histories:
        shares = np.asarray(share, dtype=float)
        if (shares < 0.0).any():
            raise ValueError(f"share = {float(shares.min()):g}: a load pushes to positive h; allowed is 0 or more")
        courses.append((t, np.broadcast_to(shares, np.shape(t)) if shares.ndim == 0 else shares, voltage, times))

    def push(which: NDArray[np.intp], h: Array) -> tuple[Array, Array]:
        force, slope = forces([biases[k] for k in which.tolist()], h[:, None])
        return force[:, 0], slope[:, 0]

    films = [one.film for one in actuators]
    wrinkling = kind_of(actuators)
    return solve_histories(
        films, courses, tolerance=tolerance, sensitivities=sensitivities, wrinkling=wrinkling, push=push
    )
