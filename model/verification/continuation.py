r"""A state followed from rest in small steps, by finite elements that share nothing with the solver: slow, for tests.

The meridian is a chain of straight elements between nodes ``(r_i, z_i)``; an element has the meridional stretch of its
two nodes and the hoop stretch of its middle, so that

    E = sum_i 2 pi R_i dR_i (T/lp^2) W(l1_i, l2_i),    l1 = lp |d(r, z)|/dR,    l2 = lp r_mid/R_mid

and the force is dE/dh. Forces err with the square of the element's length and are extrapolated from two meshes. A step
raises first h at 0 V, then V; it is taken only when the Hessian stays positive definite, which for straight elements
also means that the law is convex in every element, and when no element moves further than a small step may move it. The
path ends where steps of ``LEAST`` are refused.

``wrinkling="tension_field"`` replaces the energy by its minimum over hoop stretches wider than the film's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded

from model.material.gent import Gent
from model.specimen import Specimen

Array = NDArray[np.float64]

LEAST = 2e-4  # of V (or h): where steps of this size are refused the branch has ended
FIRST = 0.02  # of V (or h)
LARGEST_MOVE = 0.05  # change of ln(l1) of an element in one step: more is a leap to another branch
TRIES = 12  # Newton iterations of a step


@dataclass(frozen=True)
class End:
    """Where a path from rest ended.

    Attributes
    ----------
    reached : the wanted state is on the branch
    force : N there, NaN where it was not reached
    error : estimated relative error of the force, from the two meshes
    voltage : the last voltage on the branch (V)
    wrinkled : some element carries no hoop stress
    slack : an element lost its meridional tension
    softest : smallest stiffness of an element along the meridian in the last state, of its stiffness without voltage
    """

    reached: bool
    force: float
    error: float
    voltage: float
    wrinkled: bool
    slack: bool
    softest: float


def follow(specimen: Specimen, h: float, voltage: float, *, wrinkling: str = "plain", elements: int = 160) -> End:
    """Follow the film from rest to ``h`` (m) and then to ``voltage`` (V), on ``elements`` and twice as many."""
    coarse = _Path(specimen, elements, wrinkling == "tension_field")
    fine = _Path(specimen, 2 * elements, wrinkling == "tension_field")
    ends = [path.to(abs(h), abs(voltage)) for path in (coarse, fine)]
    done = all(share >= 1.0 for share in ends)
    force, error = math.nan, math.nan
    if done:
        force = (4.0 * fine.force - coarse.force) / 3.0
        error = abs(fine.force - coarse.force) / (3.0 * abs(force))
    return End(
        reached=done,
        force=math.copysign(force, h),
        error=error,
        voltage=abs(voltage) * min(ends),
        wrinkled=bool(fine.wrinkled.any()),
        slack=fine.slack,
        softest=fine.softest,
    )


class _Path:
    """One mesh and the state on it."""

    def __init__(self, film: Specimen, elements: int, relaxed: bool) -> None:
        m, a, b = film.material, film.disk_radius, film.ring_radius
        self.film, self.relaxed = film, relaxed
        self.mu, self.alpha = np.array(m.mu)[:, None], np.array(m.alpha)[:, None]
        self.shear = m.shear_modulus
        # Even in R where disk and ring are alike, even in ln R where they are not: elements as long as R^0.5 asks.
        self.node = np.linspace(a**0.5, b**0.5, elements + 1) ** 2
        self.length, self.middle = np.diff(self.node), 0.5 * (self.node[1:] + self.node[:-1])
        self.weight = 2.0 * math.pi * self.middle * self.length * film.thickness / film.prestretch**2
        self.r, self.z = self.node.copy(), np.zeros(elements + 1)
        self.hoop = np.zeros(elements)  # the hoop strain that makes the stress
        self.wrinkled = np.zeros(elements, dtype=np.bool_)
        self.force, self.slack, self.softest = math.nan, False, 1.0

    # ---- the law

    def stress(self, log1: Array, log2: Array, k: float) -> tuple[Array, ...]:
        """True stresses and their derivatives in ln(l1), ln(l2); ``k`` = eps (V/T)^2."""
        if self.film.material.law is Gent:
            return self.gent(log1, log2, k)
        x, y = np.expm1(self.alpha * log1), np.expm1(self.alpha * log2)
        z = np.expm1(-self.alpha * (log1 + log2))
        b = k * np.exp(2.0 * (log1 + log2))
        product = self.mu * self.alpha
        s1, s2 = (self.mu * (x - z)).sum(0) - b, (self.mu * (y - z)).sum(0) - b
        through = (product * (z + 1.0)).sum(0) - 2.0 * b
        return s1, s2, (product * (x + 1.0)).sum(0) + through, through, (product * (y + 1.0)).sum(0) + through

    def gent(self, log1: Array, log2: Array, k: float) -> tuple[Array, ...]:
        """The same for ``W = -mu J/2 ln(1 - (I1 - 3)/J)``; NaN beyond its limit."""
        mu, limit = float(self.mu[0, 0]), float(self.alpha[0, 0])
        x, y, z, b = np.exp(2.0 * log1), np.exp(2.0 * log2), np.exp(-2.0 * (log1 + log2)), k * np.exp(2 * (log1 + log2))
        room = 1.0 - (x + y + z - 3.0) / limit
        room = np.where(room > 0.0, room, np.nan)
        i1, i2 = 2.0 * (x - z), 2.0 * (y - z)
        first = 0.5 * mu / room
        second = first / (limit * room)
        s11 = second * i1 * i1 + first * 4.0 * (x + z) - 2.0 * b
        s12 = second * i1 * i2 + first * 4.0 * z - 2.0 * b
        s22 = second * i2 * i2 + first * 4.0 * (y + z) - 2.0 * b
        return first * i1 - b, first * i2 - b, s11, s12, s22

    def widths(self, log1: Array, log2: Array, k: float) -> Array:
        """First hoop strain from ``log2`` on that makes no hoop stress, in steps; NaN where there is none to be had."""
        _, s2, _, _, _ = self.stress(log1, log2, k)
        low, short = log2.copy(), s2 < 0.0
        high = low.copy()
        for _ in range(400):
            if not short.any():
                break
            low = np.where(short, high, low)
            high = np.where(short, high + 0.01, high)
            short &= self.stress(log1, high, k)[1] < 0.0
        high = np.where(short, np.nan, high)
        for _ in range(60):
            middle = 0.5 * (low + high)
            _, s2, _, _, _ = self.stress(log1, middle, k)
            low, high = np.where(s2 < 0.0, middle, low), np.where(s2 < 0.0, high, middle)
        return 0.5 * (low + high)

    # ---- equilibrium

    def system(self, r: Array, z: Array, k: float) -> tuple[Array, Array, bool]:
        """Gradient (2 a node) and banded Hessian of the energy; whether the law is convex in every element."""
        lp, dr, dz = self.film.prestretch, np.diff(r), np.diff(z)
        long = np.hypot(dr, dz)
        log1 = np.log(lp * long / self.length)
        log2 = np.log(lp * (0.5 * (r[1:] + r[:-1])) / self.middle)
        s1, s2, s11, s12, s22 = self.stress(log1, log2, k)
        good = True
        self.wrinkled = np.zeros(len(log1), dtype=np.bool_)
        if self.relaxed and (s2 < 0.0).any():
            self.wrinkled = s2 < 0.0
            wide = self.widths(log1, np.where(self.wrinkled, log2, 0.0), k)
            wide = np.where(self.wrinkled, wide, log2)
            s1, s2, s11, s12, s22 = self.stress(log1, wide, k)
            good = bool(np.isfinite(s1).all() and (s22[self.wrinkled] > 0.0).all())
            s11 = np.where(self.wrinkled, s11 - s12**2 / s22, s11)
            s2, s12, s22 = (np.where(self.wrinkled, 0.0, x) for x in (s2, s12, s22))
        self.slack = bool((s1 <= 0.0).any())
        self.hoop = np.where(self.wrinkled, wide, log2) if self.wrinkled.any() else log2
        bare = self.stress(log1, log2 if not self.relaxed else np.where(self.wrinkled, -0.5 * log1, log2), 0.0)
        self.softest = float(((s11 - s1) / np.abs(bare[2] - bare[0])).min())
        good &= not self.slack
        # The energy in logarithms: gradients of ln|d| and of ln(r_mid) in (r0, z0, r1, z1).
        c, s = dr / long, dz / long
        n = len(log1)
        one = np.zeros((n, 4))
        one[:, 0], one[:, 1], one[:, 2], one[:, 3] = -c, -s, c, s
        one /= long[:, None]
        two = np.zeros((n, 4))
        two[:, 0] = two[:, 2] = 1.0 / (r[1:] + r[:-1])
        across = np.stack((s, -c, -s, c), axis=1) / long[:, None]
        w = self.weight
        local = w[:, None] * (s1[:, None] * one + s2[:, None] * two)
        h = s11[:, None, None] * one[:, :, None] * one[:, None, :] + s22[:, None, None] * two[:, :, None] * two[:, None]
        h += s12[:, None, None] * (one[:, :, None] * two[:, None] + two[:, :, None] * one[:, None])
        h += s1[:, None, None] * (across[:, :, None] * across[:, None] - one[:, :, None] * one[:, None])
        h -= s2[:, None, None] * two[:, :, None] * two[:, None]
        h *= w[:, None, None]
        gradient = np.zeros(2 * n + 2)
        band = np.zeros((4, 2 * n + 2))  # lower form
        base = 2 * np.arange(n)
        for i in range(4):
            np.add.at(gradient, base + i, local[:, i])
            for j in range(i + 1):
                np.add.at(band[i - j], base + j, h[:, i, j])
        return gradient, band, good

    def equilibrium(self, r: Array, z: Array, k: float) -> tuple[Array, Array] | None:
        """Newton from a guess with the right ends; None when it leads to no stable state close by."""
        for _ in range(TRIES):
            gradient, band, good = self.system(r, z, k)
            if not good or not np.isfinite(band).all():
                return None
            try:
                factor = cholesky_banded(band[:, 2:-2], lower=True)
            except (LinAlgError, ValueError):
                return None
            step = cho_solve_banded((factor, True), -gradient[2:-2])
            move = step.reshape(-1, 2)
            size = float(np.abs(move).max()) / float(self.length.min())
            scale = min(1.0, 1.0 / max(size, 1e-300))
            r, z = r.copy(), z.copy()
            r[1:-1] += scale * move[:, 0]
            z[1:-1] += scale * move[:, 1]
            if float(np.abs(move).max()) < 1e-10 * float(self.node[-1]):
                gradient, band, good = self.system(r, z, k)
                if not good:
                    return None
                self.force = -float(gradient[-1])
                return r, z
        return None

    def to(self, h: float, voltage: float) -> float:
        """Follow both legs; the share of the voltage that was reached, 0 when the height was not."""
        b = self.node[-1]
        share = self.leg(lambda s: (s * h, 0.0), start=min(1.0, 0.02 * b / h))
        if share < 1.0 or voltage == 0.0:
            return 1.0 if share >= 1.0 else 0.0
        full = self.film.material.permittivity * (voltage / self.film.thickness) ** 2
        return self.leg(lambda s: (h, full * s * s), start=0.0)

    def leg(self, at: Callable[[float], tuple[float, float]], start: float) -> float:
        """Follow one leg, ``at(share)`` giving height and ``k``; the share reached."""
        share, step = start, FIRST
        height, k = at(start)
        if start > 0.0:
            cone = (self.node[-1] - self.node) / (self.node[-1] - self.node[0])
            found = self.equilibrium(self.node.copy(), -height * (1.0 - cone), k)
            if found is None:
                return 0.0
            self.r, self.z = found
        before: tuple[float, Array, Array] | None = None
        while share < 1.0:
            aim = min(1.0, share + step)
            height, k = at(aim)
            r, z = self.r, self.z
            if before is not None:
                ratio = (aim - share) / (share - before[0])
                r, z = r + ratio * (r - before[1]), z + ratio * (z - before[2])
            elif self.z[-1] != 0.0:
                z = z * (height / -self.z[-1])
            z = z.copy()
            z[-1] = -height
            z[0] = 0.0
            kept = self.force, self.wrinkled, self.slack, self.softest, self.hoop
            found = self.equilibrium(r, z, k)
            if found is not None:
                old, new = (np.log(np.hypot(np.diff(x), np.diff(y))) for x, y in ((self.r, self.z), found))
                leap = max(float(np.abs(new - old).max()), 0.5 * float(np.abs(self.hoop - kept[-1]).max()))
                if k > 0.0 and leap > LARGEST_MOVE:
                    found = None
            if found is None:
                lost = self.slack
                self.force, self.wrinkled, self.slack, self.softest, self.hoop = kept
                self.slack = lost
                step *= 0.4
                if step < LEAST:
                    return share
                continue
            before = (share, self.r, self.z)
            self.r, self.z = found
            share = aim
            step = min(1.5 * step, FIRST)
        return share
