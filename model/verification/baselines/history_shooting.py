"""Films that take time by shooting and lines: solve_ivp in the radius within solve_ivp in time, for comparisons.

The viscous strains live at Chebyshev's points in ln R and are polynomials between them. At every evaluation of their
rates the film is shot from disk to ring: of ``r, z, R S1 cos(theta)`` over ln R, with the meridional stretch from
``R S1 = hypot(R S1 cos(theta), R S1 sin(theta))``, the last of which is the force and the same everywhere. Horizontal
pull at the disk and force are corrected until the ring is met, with differences that are kept as long as they help.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from model.arrays import Array
from model.specimen import Specimen

NODES = 12  # of the viscous strains
MEETS = 1e-2  # of the tolerance: how well the ring is met, over its radius
CORRECTIONS = 30
PARTS = (1, 4, 16)


class _Film:
    def __init__(self, specimen: Specimen, tolerance: float) -> None:
        material = specimen.material
        shear = material.shear_modulus
        mu, alpha = material.powers
        self.terms = [(one / shear, power) for one, power in zip(mu, alpha, strict=True)]
        self.branches = [(one.ratio, one.time) for one in material.branches]
        self.electric = material.permittivity / (specimen.thickness**2 * shear)
        self.lp, self.ring = specimen.prestretch, specimen.ring_radius
        self.unit = 2.0 * math.pi * self.ring * specimen.thickness * shear / self.lp
        self.left = math.log(specimen.disk_radius / self.ring)
        at = -np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
        self.nodes = 0.5 * self.left * (1.0 - at)
        self.weights = (-1.0) ** np.arange(NODES) * np.sin(np.pi * (np.arange(NODES) + 0.5) / NODES)
        self.tolerance = tolerance
        s1, _, _ = self.point(math.log(self.lp), math.log(self.lp))
        self.unknown = np.array([math.exp(self.left) * s1 / self.lp, 0.0])  # horizontal pull at the disk, force
        self.slopes: Array | None = None
        self.last = 0.0  # height at which it was met
        self.start = math.log(self.lp)

    def point(self, log1: float, log2: float) -> tuple[float, float, float]:
        """Stresses, and the slope of the first by the first logarithmic stretch."""
        s1 = s2 = s11 = 0.0
        for mu, alpha in self.terms:
            through = mu * math.exp(-alpha * (log1 + log2))
            along = mu * math.exp(alpha * log1)
            s1, s2 = s1 + along - through, s2 + mu * math.exp(alpha * log2) - through
            s11 += alpha * (along + through)
        return s1, s2, s11

    def between(self, viscous: Array, x: float) -> list[list[float]]:
        """Viscous strains (2, K, N) at ``x = ln(R/b)``."""
        gap = x - self.nodes
        if (np.abs(gap) < 1e-14).any():
            found: list[list[float]] = viscous[..., int(np.abs(gap).argmin())].tolist()
            return found
        share = self.weights / gap
        mixed: list[list[float]] = (viscous @ (share / share.sum())).tolist()
        return mixed

    def strains(self, x: float, r: float, pull: float, viscous: Array, field: float) -> tuple[float, float, float]:
        """Logarithmic stretches at ``x`` and the hoop stress, for a meridional pull ``R S1``."""
        log2 = math.log(self.lp * r) - x
        if not abs(log2) < 4.0:
            raise ArithmeticError("a stretch outside 0.02 to 50")
        v1, v2 = self.between(viscous, x) if self.branches else ([], [])
        wanted, log1 = pull * math.exp(-x), self.start
        for _ in range(60):
            s1, s2, h11 = self.point(log1, log2)
            for (ratio, _), one, two in zip(self.branches, v1, v2, strict=True):
                p1, p2, c11 = self.point(log1 - one, log2 - two)
                s1, s2, h11 = s1 + ratio * p1, s2 + ratio * p2, h11 + ratio * c11
            maxwell = field * math.exp(2.0 * (log1 + log2))
            s1, s2, h11 = s1 - maxwell, s2 - maxwell, h11 - 2.0 * maxwell
            step = (wanted * math.exp(log1) - s1) / (h11 - s1)
            log1 += min(max(step, -0.3), 0.3)
            if abs(step) < 1e-13:
                break
        if not abs(log1) < 4.0:
            raise ArithmeticError("a stretch outside 0.02 to 50")
        self.start = log1
        return log1, log2, s2

    def shot(self, unknown: Array, h: float, viscous: Array, field: float, at: Array | None = None) -> Array:
        """``r, z, R S1 cos(theta)`` at the ring, or at points ``at``."""
        from scipy.integrate import solve_ivp

        force = float(unknown[1])

        def slopes(x: float, y: Array) -> tuple[float, float, float]:
            r, _, pull = y.tolist()
            whole = math.hypot(pull, force)
            log1, log2, s2 = self.strains(x, r, whole, viscous, field)
            radius = math.exp(x)
            along = math.exp(log1) / self.lp * radius
            return along * pull / whole, -along * force / whole, radius * s2 * math.exp(-log2)

        begin = (math.exp(self.left), h / self.ring, float(unknown[0]))
        tight = 0.1 * self.tolerance
        found = solve_ivp(slopes, (self.left, 0.0), begin, rtol=tight, atol=tight, t_eval=at)
        if found.status != 0:
            raise ArithmeticError(found.message)
        return np.asarray(found.y[:, -1] if at is None else found.y)

    def meet(self, h: float, viscous: Array, field: float) -> Array:
        """Pull and force with which the ring is met; from the last height in parts where it is not met at once."""
        kept, start = self.unknown.copy(), self.start
        for parts in PARTS:
            try:
                for part in range(1, parts + 1):
                    self._meet(self.last + (h - self.last) * part / parts, viscous, field)
            except ArithmeticError:
                self.unknown, self.start, self.slopes = kept.copy(), start, None
            else:
                self.last = h
                return self.unknown
        raise ArithmeticError("the ring is not met")

    def _meet(self, h: float, viscous: Array, field: float) -> None:
        best = math.inf
        for _ in range(CORRECTIONS):
            end = self.shot(self.unknown, h, viscous, field)
            miss = np.array([end[0] - 1.0, end[1]])
            size = float(np.abs(miss).max())
            if size < MEETS * self.tolerance:
                return
            if self.slopes is None or size > 0.3 * best:
                columns = []
                for k in range(2):
                    step = np.zeros(2)
                    step[k] = 1e-5
                    other = self.shot(self.unknown + step, h, viscous, field)
                    columns.append((other[:2] - end[:2]) / 1e-5)
                self.slopes = np.array(columns).T
            best = size
            self.unknown = self.unknown - np.linalg.solve(self.slopes, miss)
        raise ArithmeticError("the ring is not met")

    def rates(self, h: float, viscous: Array, field: float) -> Array:
        """``dv/dt`` (2, K, N)."""
        self.meet(h, viscous, field)
        force = float(self.unknown[1])
        r, _, pull = self.shot(self.unknown, h, viscous, field, self.nodes)
        found = np.empty_like(viscous)
        for k, x in enumerate(self.nodes.tolist()):
            log1, log2, _ = self.strains(x, float(r[k]), math.hypot(float(pull[k]), force), viscous, field)
            for b, (_, time) in enumerate(self.branches):
                s1, s2, _ = self.point(log1 - viscous[0, b, k], log2 - viscous[1, b, k])
                found[:, b, k] = (2.0 * s1 - s2) / (6.0 * time), (2.0 * s2 - s1) / (6.0 * time)
        return found


def history_by_shooting(
    specimen: Specimen, t: Array, h: Array, voltage: Array, times: Array, tolerance: float
) -> Array:
    """Forces (N) at ``times``; NaN from where it fails on. Histories as in `model.membrane.history.solve_history`."""
    from scipy.integrate import solve_ivp

    film = _Film(specimen, tolerance)
    shape = (2, len(film.branches), NODES)
    viscous = np.full(shape, math.log(film.lp))
    force = np.full(len(times), math.nan)

    def at(time: float, v: Array) -> tuple[float, Array, float]:
        field = film.electric * float(np.interp(time, t, voltage)) ** 2
        return float(np.interp(time, t, h)), v.reshape(shape), field

    try:
        for left, right in pairwise(np.asarray(t, dtype=float).tolist()):
            asked = np.flatnonzero((times > left) & (times <= right))
            stops = np.unique(np.concatenate((times[asked], [right])))
            found = solve_ivp(
                lambda time, v: film.rates(*at(time, v)).ravel(),
                (left, right),
                viscous.ravel(),
                t_eval=stops,
                rtol=tolerance,
                atol=tolerance,
            )
            if found.status != 0:
                return force
            for k in asked.tolist():
                column = found.y[:, int(np.searchsorted(stops, times[k]))]
                force[k] = film.unit * film.meet(*at(float(times[k]), column))[1]
            viscous = found.y[:, -1].reshape(shape)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError):
        return force
    return force
