r"""Stress of a sheet with Maxwell branches along a history of its stretches.

The law is that of the film (`model.membrane.history`), at one point: with logarithmic stretches ``u_i = ln l_i`` and
the elastic part ``w`` of them in each branch

.. math:: P_i = \Big(S_i(u) + \sum_k r_k S_i(w^k)\Big)/l_i, \qquad
          \dot w_i = \dot u_i - \frac{2 S_i(w) - S_j(w)}{6 G \tau_k}

where ``S`` is the true stress of the relaxed law with no stress on the faces, and G its shear modulus. At rest at
stretch 1 all are zero. The flow knows no ratio, so that the stress is linear in the ratios.

A step takes ``exp(-dt/tau)`` exactly, ``u`` and what a finite strain adds to the flow as straight lines: of the second
order, stable for steps of any length, and exact at small strain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from model.material.law import Law, stack

Array = NDArray[np.float64]

CHANGE = 1e-5  # of a strain, in the last step of Newton's method
MOST_ITERATIONS = 30
LONGEST = 0.5  # change of a strain in one step of it


def elastic_parts(law: Law, modulus: Array, tau: Array, t: Sequence[Array], u: Sequence[Array]) -> list[Array]:
    """Elastic logarithmic strains of branches along histories from rest.

    Parameters
    ----------
    law : with the numbers of C columns, or of one for all
    modulus, tau : shear modulus of the law and relaxation time (s) of each column, (C,)
    t, u : times (s) of every history, (n,), and logarithmic stretches there (2, n), linear in between

    Returns
    -------
    Of every history (2, n, C). Histories are stepped side by side; a short one waits at its end.
    """
    most = max(one.size for one in t)
    times = np.stack([np.pad(one, (0, most - one.size), mode="edge") for one in t])
    logs = np.stack([np.pad(one, ((0, 0), (0, most - one.shape[1])), mode="edge") for one in u])
    z = np.diff(times)[:, :, None] / tau  # (tests, steps, columns)
    decay = np.exp(-z)
    line = np.where(z > 1e-8, -np.expm1(-z) / np.where(z > 0.0, z, 1.0), 1.0 - 0.5 * z)
    late, early = 1.0 - line, line - decay  # shares of what a finite strain adds, at the end and the beginning
    change = np.diff(logs, axis=2)
    count, columns = len(t), tau.size
    wide = law if law.mu.shape[1] == 1 else law.take(np.tile(np.arange(columns), count))
    sixth = 1.0 / (6.0 * np.broadcast_to(modulus, (count, columns)).ravel())
    w = np.zeros((2, count * columns))
    bent = np.zeros_like(w)
    found = np.zeros((2, most, count, columns))
    for k in range(most - 1):
        d, f, g, e = (one[:, k].ravel() for one in (decay, line, late, early))
        du = np.repeat(change[:, :, k].T, columns, axis=1)
        target = d * w - e * bent + f * du
        w, bent = _implicit(wide, sixth, g, target, w + du * f)
        found[:, k + 1] = w.reshape(2, count, columns)
    return [found[:, : one.size, number] for number, one in enumerate(t)]


def _implicit(law: Law, sixth: Array, late: Array, target: Array, start: Array) -> tuple[Array, Array]:
    """``w + late N(w) = target``, N what a finite strain adds to the flow; and N(w)."""
    w = start
    for _ in range(MOST_ITERATIONS):
        s1, s2, c11, c12, c22 = law.derivatives(stack(w[0], w[1]))
        flow = sixth * np.array((2.0 * s1 - s2, 2.0 * s2 - s1))
        slope = sixth * np.array((2.0 * c11 - c12, 2.0 * c12 - c22, 2.0 * c12 - c11, 2.0 * c22 - c12))
        r = target - late * flow - (1.0 - late) * w
        a11, a12, a21, a22 = late * slope
        a11, a22 = a11 + (1.0 - late), a22 + (1.0 - late)
        step = np.array((a22 * r[0] - a12 * r[1], a11 * r[1] - a21 * r[0])) / (a11 * a22 - a12 * a21)
        sizes = np.abs(step).max(axis=0)
        size = float(sizes.max())
        if not math.isfinite(size):
            return np.full_like(w, np.nan), np.full_like(w, np.nan)
        if size > LONGEST:
            w = w + step * np.minimum(1.0, LONGEST / np.maximum(sizes, LONGEST))
            continue
        w = w + step
        if size < CHANGE:  # Newton's next step would be its square
            break
    flow += np.array((slope[0] * step[0] + slope[1] * step[1], slope[2] * step[0] + slope[3] * step[1]))
    return w, flow - w


def nominal(law: Law, w: Array, u: Array) -> Array:
    """Nominal stresses (2, ...) of elastic logarithmic strains ``w`` in a sheet at the stretches ``exp(u)``."""
    s1, s2, *_ = law.derivatives(stack(w[0], w[1]))
    found: Array = np.array((s1, s2)) * np.exp(-u)
    return found
