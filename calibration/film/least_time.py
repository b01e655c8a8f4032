"""How long a film still has to be held, and where, until what is wanted is known well enough.

`calibration.film.planning.Places` says what a second at each place tells. With the information ``M0`` of what was
recorded already, ``s_k`` seconds at the places ``k`` leave the variances ``w_j' (M0 + sum s_k r_k r_k')^-1 w_j``. The
least sum of the ``s_k`` that takes each of them to its target is found by halving the time; for each time the shares
that minimise the sum of the squares of the variances over their targets follow from a multiplicative rule (Silvey,
Titterington & Torsney 1978, with the square root that keeps it from swinging).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.film.planning import Places

Array = NDArray[np.float64]

HALVINGS, SHARES = 10, 20  # of the time; iterations of the rule at each
SHORTEST_S = 0.5


def least_time(
    places: Places, known: Array, target: Array, these: Sequence[int], longest: float
) -> tuple[float, Array]:
    """Excess and seconds.

    Parameters
    ----------
    places : Places
    known : (P, P)
        Information of what was recorded, the prior in it.
    target : (J,)
        Variance at most, of each of ``places.wanted``; inf where nothing is wanted.
    these : sequence of int
        Places that may be used.
    longest : float
        Seconds at most.

    Returns
    -------
    excess : float
        Largest ratio of a variance to its target: about 1, or more where ``longest`` is not enough.
    seconds : (K,)
        At each place of ``places``.
    """
    rows, wanted = places.rows[list(these)], places.wanted
    share = np.full(len(rows), 1.0 / len(rows))
    short, long = SHORTEST_S, longest
    excess, found = _shared(rows, wanted, known, target, share, longest)
    best = excess, longest * found
    for _ in range(HALVINGS if excess <= 1.0 else 0):
        time = math.sqrt(short * long)
        excess, share = _shared(rows, wanted, known, target, found, time)
        if excess <= 1.0:
            long, found, best = time, share, (excess, time * share)
        else:
            short = time
    seconds = np.zeros(places.h.size)
    seconds[list(these)] = best[1]
    return best[0], seconds


def _shared(rows: Array, wanted: Array, known: Array, target: Array, share: Array, time: float) -> tuple[float, Array]:
    """Largest ratio of a variance to its target with the best shares of ``time``, and the shares; from ``share`` on."""
    for _ in range(SHARES):
        toward, variance = _variance(rows, wanted, known, time * share)
        worth = (rows @ toward) ** 2 @ (variance / target**2)
        if not worth.max() > 0.0:  # nothing here tells of what is wanted
            break
        share = share * np.sqrt(worth / worth.max())
        share /= share.sum()
    return float((_variance(rows, wanted, known, time * share)[1] / target).max()), share


def _variance(rows: Array, wanted: Array, known: Array, seconds: Array) -> tuple[Array, Array]:
    """M^-1 w, and the variance of each w."""
    toward = np.asarray(np.linalg.solve(known + (rows * seconds[:, None]).T @ rows, wanted.T), dtype=np.float64)
    return toward, np.einsum("jp,pj->j", wanted, toward)
