r"""The mounted film when it takes time: a membrane of finite elements whose branches relax at every point.

Written for the simulated bench alone: it has only the law of the elastomer in common with `model.membrane`. The film's
radius r(R) and height z(R) are polynomials of degree `DEGREE` on elements of the undeformed radius, and the energy

.. math:: \int \Big(W(\lambda_1, \lambda_2) - \tfrac{\varepsilon}{2} (V/T)^2 \lambda_1^2 \lambda_2^2\Big) R\,dR
          + \tfrac{1}{2 C} (s - h)^2

is least among them, with the rig's compliance C between stage and disk. Of the logarithmic stretches u a branch keeps
the part x that makes stress; from a film at rest it moves by

.. math:: \dot x = \dot u - x/\tau - N(x)/\tau, \qquad N(x) = P S(x)/(2 G) - x, \quad P = \tfrac13 [[2, -1], [-1, 2]]

and a step in time takes the exponential exactly, u and N as straight lines: of the second order, and exact for small
strains however long the step. Lengths are over the ring radius, stresses over the shear modulus of the relaxed film.

Where the hoop stress would be negative the film wrinkles, and its natural width takes the place of the hoop stretch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from model.specimen import Specimen

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

ELEMENTS, DEGREE = 3, 4  # force to 1e-6 of a film whose disk is a tenth of its ring, see the tests
STIFFEST = 1e-9  # compliance over that of a film of ring radius and shear modulus: a rig that does not give way
CHANGE = 3e-5  # of places and strains in Newton's last step, whose square is its error
MOST_ITERATIONS = 25
FLAT = 1e-9  # dimensionless force that is none
WRINKLE_FLIPS = 12  # iterations in which points may wrinkle or get taut again
PARTS = 4  # how often a step without a solution is halved before there is none
SLACK_SHARE = 0.05  # of the largest meridional stress: a film with less somewhere hangs slack next
Found = Literal["taut", "slack", "lost"]


@dataclass(frozen=True)
class Moment:
    """The film at one time.

    force : on the disk (N)
    field : largest true field (V/m)
    found : "taut"; "slack": it hangs, and has no force; "lost": beyond pull-in, it has no state
    """

    s: float
    voltage: float
    force: float
    field: float
    found: Found
    places: Floats  # of the nodes that are free: radii, heights
    natural: Floats  # (G,) hoop logarithmic stretch that makes the stress
    wrinkled: Bools  # (G,)
    total: Floats  # (2, G) logarithmic stretches that make the stress
    elastic: Floats  # (2, K, G) of them what the branches feel
    tension: float = 1.0  # least over largest meridional stress


class ViscousFilm:
    """A film with Maxwell branches ``(ratio, time)`` on a rig of ``compliance`` (m/N), from rest."""

    def __init__(
        self,
        specimen: Specimen,
        branches: list[tuple[float, float]],
        compliance: float,
        elements: int = ELEMENTS,
        degree: int = DEGREE,
    ) -> None:
        material, b = specimen.material, specimen.ring_radius
        shear = material.shear_modulus
        self._law = material.law(np.array(material.mu)[:, None] / shear, np.array(material.alpha).reshape(-1, 1))
        self._ratio = np.array([ratio for ratio, _ in branches], dtype=float)[:, None]
        self._time = np.array([time for _, time in branches], dtype=float)[:, None]
        self._field = material.permittivity / (specimen.thickness**2 * shear)
        self._thickness, self._ring = specimen.thickness, b
        self._log = math.log(specimen.prestretch)
        self.unit = 2.0 * math.pi * b * specimen.thickness * shear / specimen.prestretch**2
        self._gives = max(compliance * self.unit / b, STIFFEST)
        self._mesh(specimen.disk_radius / b, elements, degree)
        points = self._radius.size
        rest = np.full((2, points), self._log)
        places = np.concatenate((self._nodes[1:-1], np.zeros(len(self._nodes) - 1)))
        none = np.zeros(points, dtype=bool)
        zero = np.zeros((2, len(branches), points))
        self.rested = Moment(0.0, 0.0, 0.0, 0.0, "taut", places, rest[1], none, rest, zero)

    def _mesh(self, disk: float, elements: int, degree: int) -> None:
        """Nodes, and the matrices from places of nodes to r, dr/dR and dz/dR at Gauss points."""
        cuts = disk ** (1.0 - np.arange(elements + 1) / elements)  # finer where the film is steep
        at = -np.cos(np.pi * np.arange(degree + 1) / degree)
        xi, weight = np.polynomial.legendre.leggauss(degree + 2)
        legendre = np.polynomial.legendre
        inverse = np.linalg.inv(legendre.legvander(at, degree))
        value = legendre.legvander(xi, degree) @ inverse
        slope, end_slope = (
            legendre.legval(where, legendre.legder(np.eye(degree + 1))).T @ inverse
            for where in (xi, np.array([-1.0, 1.0]))
        )
        count, points = elements * degree + 1, len(xi)
        self._nodes = np.empty(count)
        self._radius = np.empty(elements * points)
        self._weight = np.empty(elements * points)
        values, slopes = np.zeros((2, elements * points, count))
        ends = np.zeros((2, count))
        for k in range(elements):
            half, middle = 0.5 * (cuts[k + 1] - cuts[k]), 0.5 * (cuts[k + 1] + cuts[k])
            rows, columns = slice(k * points, (k + 1) * points), slice(k * degree, (k + 1) * degree + 1)
            self._nodes[columns] = middle + half * at
            self._radius[rows] = middle + half * xi
            self._weight[rows] = half * weight * self._radius[rows]
            values[rows, columns] = value
            slopes[rows, columns] = slope / half
            if k == 0:
                ends[0, columns] = end_slope[0] / half
            if k == elements - 1:
                ends[1, columns] = end_slope[1] / half
        # Rows: dr/dR, r, dz/dR at the points; columns: free radii (all but disk and ring), free heights (all but ring).
        inner, size = count - 2, 2 * count - 3
        self._to = np.zeros((3, elements * points, size))
        self._to[0, :, :inner], self._to[1, :, :inner] = slopes[:, 1:-1], values[:, 1:-1]
        self._to[2, :, inner:] = slopes[:, :-1]
        self._fixed = np.stack((slopes[:, [0, -1]] @ self._nodes[[0, -1]], values[:, [0, -1]] @ self._nodes[[0, -1]]))
        self._disk = inner  # the place of the disk's height among the free ones
        self._ends = np.zeros((2, 2, size))  # the first and the last of the rows, at disk and ring
        self._ends[0, :, :inner], self._ends[1, :, inner:] = ends[:, 1:-1], ends[:, :-1]
        self._ends_fixed = ends[:, [0, -1]] @ self._nodes[[0, -1]]

    def untouched(self, voltage: float) -> Moment:
        """The flat film at rest, under ``voltage`` (V)."""
        area = math.exp(2.0 * self._log)
        return replace(self.rested, voltage=voltage, field=area * voltage / self._thickness)

    def step(self, before: Moment, dt: float, s: float, voltage: float) -> Moment:
        """The film ``dt`` (s) later, driven to ``s`` (m) and ``voltage`` (V) at constant rates."""
        found = self._settled(before, before, dt, s, voltage)
        parts = 2 if before.found == "taut" else 2 ** (PARTS + 1)
        while found is None and parts <= 2**PARTS:  # from nearer by, in the same time
            start: Moment | None = before
            for k in range(1, parts + 1):
                if start is not None:
                    way, rise = (s - before.s) * k / parts, (voltage - before.voltage) * k / parts
                    start = self._settled(before, start, dt, before.s + way, before.voltage + rise)
            found, parts = start, 2 * parts
        return self._hanging(before, dt, s, voltage) if found is None else found

    def _hanging(self, before: Moment, dt: float, s: float, voltage: float) -> Moment:
        """No state in tension: the film hangs as it was last, or it has pulled in; its branches relax."""
        decay = np.exp(-dt / self._time)
        found = before.found
        if found == "taut":
            found = "lost" if voltage > 0.0 and before.tension > SLACK_SHARE else "slack"
        return replace(
            before, s=s, voltage=voltage, force=0.0, found=found, elastic=before.elastic * decay, field=math.nan
        )

    def _settled(self, before: Moment, guess: Moment, dt: float, s: float, voltage: float) -> Moment | None:
        """The film in equilibrium at the end of a step, or None; Newton's method from ``guess``."""
        z = dt / self._time
        decay = np.exp(-z)
        line = -np.expm1(-z) / z
        x0 = before.elastic
        s1, s2, *_ = self._law.derivatives(_three(x0))
        bent0 = np.array((2.0 * s1 - s2, 2.0 * s2 - s1)) / 6.0 - x0
        # x + lag P S(x)/2 = u - kept
        lag = (1.0 - line) / line
        kept = before.total[:, None] - (decay * x0 - (line - decay) * bent0) / line
        field = self._field * voltage * voltage
        s = s / self._ring
        places, natural, wrinkled, x = guess.places, guess.natural, guess.wrinkled, guess.elastic
        for iteration in range(MOST_ITERATIONS):
            dr, r, dz = self._to @ places
            dr, r = dr + self._fixed[0], r + self._fixed[1]
            metric = dr * dr + dz * dz
            if not (r.min() > 0.0 and metric.min() > 0.0):
                return None
            u1 = self._log + 0.5 * np.log(metric)
            width = self._log + np.log(r / self._radius)
            natural = np.where(wrinkled, natural, width)
            t1, t2, h11, h12, h22, follow = self._stress(np.array((u1, natural)), x, lag, kept, field)
            if iteration < WRINKLE_FLIPS:
                flips = np.where(wrinkled, natural < width, t2 < 0.0)
                if flips.any():
                    wrinkled = wrinkled ^ flips
                    if not wrinkled[flips].all():  # some are taut again: their width is the film's
                        continue
            give = wrinkled / h22
            rate, change = -h12 * give, -t2 * give
            t1, h11 = t1 + h12 * change, h11 + h12 * rate
            keep = ~wrinkled
            t2, h12, h22 = t2 * keep, h12 * keep, h22 * keep
            a, c = dr / metric, dz / metric
            around = 1.0 / r
            weight = self._weight
            d = (h11 - 2.0 * t1) * weight
            plain = weight * t1 / metric
            cross = weight * h12 * around
            blocks = (
                d * a * a + plain,
                cross * a,
                d * a * c,
                weight * (h22 - t2) * around * around,
                cross * c,
                d * c * c + plain,
            )
            pp, pr, pq, rr, rq, qq = (one[:, None] for one in blocks)
            p_to, r_to, q_to = self._to
            stiff = (
                p_to.T @ (pp * p_to + pr * r_to + pq * q_to)
                + r_to.T @ (pr * p_to + rr * r_to + rq * q_to)
                + q_to.T @ (pq * p_to + rq * r_to + qq * q_to)
            )
            pull = (weight * t1 * a) @ p_to + (weight * t2 * around) @ r_to + (weight * t1 * c) @ q_to
            force, row = float(pull[self._disk]), stiff[self._disk].copy()
            pull[self._disk] -= (s - places[self._disk]) / self._gives
            stiff[self._disk, self._disk] += 1.0 / self._gives
            try:
                move = np.linalg.solve(stiff, -pull)
            except np.linalg.LinAlgError:
                return None
            mr, mw, mz = self._to @ move
            du1 = a * mr + c * mz
            du2 = np.where(wrinkled, change + rate * du1, around * mw)
            dx = follow(du1, du2)
            largest = max(float(np.abs(move).max()), float(np.abs(dx).max(initial=0.0)))
            if not math.isfinite(largest):
                return None
            short = min(1.0, 0.3 / largest) if largest > 0.3 else 1.0
            places = places + short * move
            x = x + short * dx
            natural = natural + short * np.where(wrinkled, du2, 0.0)
            if largest < CHANGE:
                break
        else:
            return None
        try:
            np.linalg.cholesky(stiff)
        except np.linalg.LinAlgError:
            return None
        force += float(row @ move)
        total = np.array((u1 + du1, np.where(wrinkled, natural, width + du2)))
        tension = float(t1.min() / t1.max())
        if tension <= 0.0 or force < -FLAT:
            return None
        peak = self._peak(places, total) * voltage / self._thickness
        force *= self.unit
        return Moment(s * self._ring, voltage, force, peak, "taut", places, total[1], wrinkled, total, x, tension)

    def _stress(
        self, u: Floats, x: Floats, lag: Floats, kept: Floats, field: float
    ) -> tuple[Floats, Floats, Floats, Floats, Floats, Callable[[Floats, Floats], Floats]]:
        """Stresses and tangents (G,) with the branches' strains eliminated, and how these follow the film's."""
        t1, t2, h11, h12, h22 = self._law.derivatives(_three(u))
        p1, p2, c11, c12, c22 = self._law.derivatives(_three(x))
        sixth = lag / 6.0
        r1, r2 = u[:, None] - kept - x
        r1 = r1 - sixth * (2.0 * p1 - p2)
        r2 = r2 - sixth * (2.0 * p2 - p1)
        a11, a12 = 1.0 + sixth * (2.0 * c11 - c12), sixth * (2.0 * c12 - c22)
        a21, a22 = sixth * (2.0 * c12 - c11), 1.0 + sixth * (2.0 * c22 - c12)
        over = 1.0 / (a11 * a22 - a12 * a21)

        def follow(du1: Floats, du2: Floats) -> Floats:
            e1, e2 = r1 + du1, r2 + du2
            return np.array((over * (a22 * e1 - a12 * e2), over * (a11 * e2 - a21 * e1)))

        d1, d2 = follow(np.zeros(1), np.zeros(1))
        share = self._ratio * over
        t1 += (self._ratio * (p1 + c11 * d1 + c12 * d2)).sum(axis=0)
        t2 += (self._ratio * (p2 + c12 * d1 + c22 * d2)).sum(axis=0)
        h11 += (share * (c11 * a22 - c12 * a21)).sum(axis=0)
        h12 += (share * (c12 * a11 - c11 * a12)).sum(axis=0)
        h22 += (share * (c22 * a11 - c12 * a12)).sum(axis=0)
        if field:
            maxwell = field * np.exp(2.0 * (u[0] + u[1]))
            t1 -= maxwell
            t2 -= maxwell
            h11 -= 2.0 * maxwell
            h12 -= 2.0 * maxwell
            h22 -= 2.0 * maxwell
        return t1, t2, h11, h12, h22, follow

    def _peak(self, places: Floats, total: Floats) -> float:
        """Largest product of the stretches, disk and ring included."""
        dr, dz = self._ends @ places
        edges = self._log + 0.5 * np.log((dr + self._ends_fixed) ** 2 + dz**2) + self._log
        return math.exp(max(float(total.sum(axis=0).max()), float(edges.max())))


def _three(strains: Floats) -> Floats:
    """The two logarithmic strains in the film's plane, and the third."""
    return np.concatenate((strains, -(strains[:1] + strains[1:])))
