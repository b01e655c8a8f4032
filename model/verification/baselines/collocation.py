"""Chebyshev collocation of the balance of forces, over ``R`` or over ``ln R``, with Newton's method.

Unknown are ``r`` and ``z`` at the Chebyshev-Lobatto points. With ``p = dr/dR``, ``q = dz/dR``, ``l1 = lp hypot(p, q)``
and ``k = lp S1 / l1``, the inner points satisfy ``d(R k p)/dR = S2`` and ``d(R k q)/dR = 0``. The number of points
grows until two forces in a row agree to the tolerance.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np

from model.specimen import Specimen
from model.verification.baselines.common import PROFILE, Array, Film, Result, failed

COUNTS = (6, 8, 12, 16, 24, 32, 48, 64, 96, 128)


@lru_cache(maxsize=32)
def chebyshev(n: int) -> tuple[Array, Array]:
    """Points from -1 to 1 and the differentiation matrix, ``n + 1`` of each (Trefethen 2000, program cheb)."""
    x = -np.cos(np.pi * np.arange(n + 1) / n)
    weight = np.ones(n + 1)
    weight[[0, -1]] = 2.0
    weight *= (-1.0) ** np.arange(n + 1)
    gap = x[:, None] - x[None, :]
    matrix = np.outer(weight, 1.0 / weight) / (gap + np.eye(n + 1))
    matrix -= np.diag(matrix.sum(axis=1))
    return x, matrix


def interpolate(values: Array, x: Array) -> Array:
    """Chebyshev-Lobatto values, carried to the points ``x`` (barycentric formula)."""
    n = values.shape[-1] - 1
    nodes, _ = chebyshev(n)
    weight = (-1.0) ** np.arange(n + 1)
    weight[[0, -1]] *= 0.5
    gap = x[:, None] - nodes[None, :]
    hit = gap == 0.0
    factor = weight / np.where(hit, 1.0, gap)
    out = (values @ factor.T) / factor.sum(axis=1)
    row, column = np.nonzero(hit)
    out[..., row] = values[..., column]
    return np.asarray(out)


def collocation(
    specimen: Specimen, h: float, voltage: float, tolerance: float, *, coordinate: Literal["R", "ln R"] = "ln R"
) -> Result:
    """Collocate on more and more points until the force changes by less than ``tolerance``."""
    film = Film(specimen, h, voltage)
    shape: Array | None = None
    last = np.nan
    evaluations = 0
    with np.errstate(all="ignore"):
        for n in COUNTS:
            x, _ = chebyshev(n)
            radius, _ = _mapped(film, n, coordinate)
            if shape is None:
                drop = film.height * (radius - film.disk) / (1.0 - film.disk)
                shape = np.stack([radius, drop])
            else:
                shape = interpolate(shape, x)
                shape[0, [0, -1]], shape[1, [0, -1]] = (film.disk, 1.0), (0.0, film.height)
            shape, used, good = _solve(film, shape, n, coordinate)
            evaluations += used
            if not good:
                return failed(f"Newton's method does not converge on {n + 1} points", evaluations)
            pull, l1, l2 = _read(film, shape, n, coordinate)
            if abs(pull - last) <= tolerance * abs(pull):
                even = np.linspace(-1.0, 1.0, PROFILE)  # of ln R
                if coordinate == "R":
                    even = 2.0 * (np.exp(0.5 * np.log(film.disk) * (1.0 - even)) - film.disk) / (1.0 - film.disk) - 1.0
                l1, l2 = interpolate(np.stack([l1, l2]), np.clip(even, -1.0, 1.0))
                return film.answer(pull, l1, l2, evaluations)
            last = pull
    return failed(f"{COUNTS[-1] + 1} points do not reach the tolerance", evaluations)


def _mapped(film: Film, n: int, coordinate: str) -> tuple[Array, Array]:
    """Radii of the points and the matrix of d/dR."""
    x, matrix = chebyshev(n)
    if coordinate == "R":
        radius = film.disk + (1.0 - film.disk) * 0.5 * (1.0 + x)
        rate = np.full_like(x, 0.5 * (1.0 - film.disk))
    else:
        radius = np.exp(0.5 * np.log(film.disk) * (1.0 - x))
        rate = -0.5 * np.log(film.disk) * radius
    return radius, matrix / rate[:, None]


def _residual(film: Film, shape: Array, radius: Array, derive: Array) -> tuple[Array, Array, Array, Array]:
    p, q = derive @ shape[0], derive @ shape[1]
    l1, l2 = film.lp * np.hypot(p, q), film.lp * shape[0] / radius
    s1, s2 = film.stresses(l1, l2)
    k = film.lp * s1 / l1**2
    inner = slice(1, -1)
    rest = np.concatenate([(derive @ (radius * k * p) - s2 / l2)[inner], (derive @ (radius * k * q))[inner]])
    return rest, p, q, k


def _solve(film: Film, shape: Array, n: int, coordinate: str) -> tuple[Array, int, bool]:
    """Newton's method, a step halved while the residual grows."""
    radius, derive = _mapped(film, n, coordinate)
    inner = slice(1, -1)
    rest, p, q, k = _residual(film, shape, radius, derive)
    size = float(np.linalg.norm(rest))
    evaluations = n + 1
    for _ in range(40):
        l1, l2 = film.lp * np.hypot(p, q), film.lp * shape[0] / radius
        s1, s2 = film.stresses(l1, l2)
        s11, s12, s22 = film.stiffness(l1, l2)
        # k = lp s1 / l1^2; dk = lp/l1^2 ((s11 - 2 s1) dl1/l1 + s12 dl2/l2); dl1/l1 = (p dp + q dq)/(p^2 + q^2).
        metric = p * p + q * q
        by_l1 = film.lp / l1**2 * (s11 - 2 * s1) / metric
        by_r = film.lp / l1**2 * s12 / shape[0]
        kp_p, kp_q, kq_q = k + by_l1 * p * p, by_l1 * p * q, k + by_l1 * q * q
        across_p = s12 / l2 / metric  # dS2 = (s12 dl1/l1 + (s22 - s2) dl2/l2) / l2
        rr = derive @ ((radius * kp_p)[:, None] * derive + np.diag(radius * by_r * p))
        rr -= (across_p * p)[:, None] * derive + np.diag((s22 - s2) / l2 / shape[0])
        rz = derive @ ((radius * kp_q)[:, None] * derive) - (across_p * q)[:, None] * derive
        zr = derive @ ((radius * kp_q)[:, None] * derive + np.diag(radius * by_r * q))
        zz = derive @ ((radius * kq_q)[:, None] * derive)
        jacobian = np.block([[rr[inner, inner], rz[inner, inner]], [zr[inner, inner], zz[inner, inner]]])
        try:
            change = np.linalg.solve(jacobian, -rest).reshape(2, -1)
        except np.linalg.LinAlgError:
            return shape, evaluations, False
        step = 1.0
        while True:
            trial = shape.copy()
            trial[:, inner] += step * change
            rest, p, q, k = _residual(film, trial, radius, derive)
            evaluations += n + 1
            trial_size = float(np.linalg.norm(rest))
            small = float(np.max(np.abs(change))) <= 1e-9 * film.height
            if trial_size < size or (small and np.isfinite(trial_size)):
                break
            step *= 0.5
            if step < 1e-3:
                return shape, evaluations, False
        shape, size = trial, trial_size
        if small:
            return shape, evaluations, True
    return shape, evaluations, False


def _read(film: Film, shape: Array, n: int, coordinate: str) -> tuple[float, Array, Array]:
    """Pull and stretches at the points.

    ``R k q`` has slope zero at the inner points, so it is a constant plus a multiple of the Chebyshev polynomial of
    degree n, which is +1 and -1 in turn on the points: the mean of two neighbours is the constant.
    """
    radius, derive = _mapped(film, n, coordinate)
    _, p, q, k = _residual(film, shape, radius, derive)
    vertical = radius * k * q
    l1, l2 = film.lp * np.hypot(p, q), film.lp * shape[0] / radius
    return float(0.5 * (vertical[0] + vertical[1])), l1, l2
