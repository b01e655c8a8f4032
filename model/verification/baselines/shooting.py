"""Shooting from the disk: guess stretch and slope there, integrate to the ring, correct until the ring is met.

Two forms of the same equations:

- the paper's (Cao & Conn 2018, eqs. (1)-(4)): ``r, z, theta`` over ``R`` by a stiff integrator, with the meridional
  stretch from the algebraic equation ``R S1 sin(theta) = const`` at every evaluation: an index-1 system;
- explicit: ``l1, l2, theta, z`` over ``ln R``, where no algebraic equation is left, by non-stiff integrators.

Right-hand sides are written with plain floats, which is several times faster here than small arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from model.specimen import Specimen
from model.verification.baselines.common import PROFILE, Array, Film, OutOfDomain, Result, failed

MAX_EVALUATIONS = 400_000


class Equations:
    """Right-hand sides for one film."""

    def __init__(self, film: Film) -> None:
        self.terms, self.electric, self.lp = film.terms, film.electric, film.lp
        self.evaluations = 0
        self.pull = 0.0  # R S1 sin(theta), for the paper's form
        self.stretch = 1.0  # last meridional stretch of the paper's form: where the next Newton iteration begins

    def _count(self) -> None:
        self.evaluations += 1
        if self.evaluations > MAX_EVALUATIONS:
            raise OutOfDomain("more than 400 000 evaluations")

    def explicit(self, x: float, y: Array) -> tuple[float, float, float, float]:
        """d/d(ln R) of (l1, l2, theta, z)."""
        self._count()
        l1, l2, theta, _ = y.tolist()
        if not (0.05 < l1 < 50.0 and 0.05 < l2 < 50.0):
            raise OutOfDomain("a stretch outside 0.05 to 50")
        n1 = n2 = w11 = w12 = 0.0  # nominal stresses S1, S2 and dS1/dl1, dS1/dl2
        area = l1 * l2
        for mu, alpha in self.terms:
            along, across, through = mu * l1**alpha, mu * l2**alpha, mu * area**-alpha
            n1 += along - through
            n2 += across - through
            w11 += alpha * (along + through) - along + through
            w12 += alpha * through
        maxwell = self.electric * area * area
        n1, n2 = (n1 - maxwell) / l1, (n2 - maxwell) / l2
        w11, w12 = (w11 - maxwell) / (l1 * l1), (w12 - 2 * maxwell) / area
        cos, sin = math.cos(theta), math.sin(theta)
        widening = l1 * cos - l2
        return (
            (n2 * cos - n1 - w12 * widening) / w11,
            widening,
            -n2 / n1 * sin,
            math.exp(x) * l1 / self.lp * sin,
        )

    def nominal(self, l1: float, l2: float) -> tuple[float, float, float]:
        """``S1, S2, dS1/dl1`` over G."""
        n1 = n2 = w11 = 0.0
        area = l1 * l2
        for mu, alpha in self.terms:
            along, through = mu * l1**alpha, mu * area**-alpha
            n1 += along - through
            n2 += mu * l2**alpha - through
            w11 += alpha * (along + through) - along + through
        maxwell = self.electric * area * area
        return (n1 - maxwell) / l1, (n2 - maxwell) / l2, (w11 - maxwell) / (l1 * l1)

    def paper(self, radius: float, y: Array) -> tuple[float, float, float]:
        """d/dR of (r, z, theta), eqs. (1)-(3), with l1 from eq. (4)."""
        self._count()
        r, _, theta = y.tolist()
        sin = math.sin(theta)
        l2 = self.lp * r / radius
        if not (0.05 < l2 < 50.0 and sin > 0.0):
            raise OutOfDomain("hoop stretch or slope outside the range of the equations")
        wanted = self.pull / (radius * sin)
        l1 = self.stretch
        for _ in range(50):
            n1, n2, w11 = self.nominal(l1, l2)
            change = (wanted - n1) / w11
            l1 = min(max(l1 + change, 0.5 * l1), 2.0 * l1)
            if abs(change) <= 1e-13 * l1:
                break
        else:
            raise OutOfDomain("eq. (4) has no meridional stretch")
        self.stretch = l1
        n1, n2, _ = self.nominal(l1, l2)
        along = l1 / self.lp
        return along * math.cos(theta), along * sin, -n2 / (radius * n1) * sin


def _shoot(
    film: Film,
    tolerance: float,
    integrate: Callable[[float, float, Array | None], tuple[Array, Array, Array]],
    equations: Equations,
    start: tuple[float, ...] | None,
) -> Result:
    """Correct (l1, theta) at the disk with MINPACK's hybr; ``integrate`` returns (miss, l1, l2)."""
    import scipy.optimize

    root: Any = scipy.optimize.root

    def miss(unknowns: Array) -> Array:
        if not unknowns[0] > 0.0:
            return np.array([1e3, 1e3])
        try:
            return integrate(float(unknowns[0]), float(unknowns[1]), None)[0]
        except (OutOfDomain, ArithmeticError, ValueError):
            return np.array([1e3, 1e3])

    # A cone; failing that, a slope at the disk and a stretch as a small disk makes them.
    stretch, slope = film.cone()
    guesses = [start] if start is not None else [(stretch, slope), (stretch**1.5, 0.5 * (slope + 0.5 * math.pi))]
    for guess in guesses:
        options = {"eps": max(tolerance, 1e-14)}
        found = root(miss, np.array(guess), method="hybr", tol=max(tolerance, 1e-13), options=options)
        # hybr may stop for lack of progress when it is as near as the integrator lets it be: judge by the miss.
        if float(np.max(np.abs(found.fun))) <= max(100 * tolerance, 1e-11) * max(1.0, film.height):
            break
    else:
        return failed(f"shooting does not meet the ring: {found.message}", equations.evaluations)
    l1, theta = (float(u) for u in found.x)
    at = np.linspace(math.log(film.disk), 0.0, PROFILE)
    try:
        _, meridional, hoop = integrate(l1, theta, at)
        n1, _, _ = equations.nominal(l1, film.lp)
    except (OutOfDomain, ArithmeticError, ValueError) as problem:
        return failed(f"integration: {problem}", equations.evaluations)
    pull = film.disk * n1 * math.sin(theta)
    return film.answer(pull, meridional, hoop, equations.evaluations, start=(l1, theta))


def explicit_shooting(
    specimen: Specimen,
    h: float,
    voltage: float,
    tolerance: float,
    *,
    integrator: str = "DOP853",
    start: tuple[float, ...] | None = None,
) -> Result:
    """Shooting with the explicit form over ``ln R``; ``integrator`` is any non-stiff name that ``solve_ivp`` knows."""
    import scipy.integrate

    solve_ivp: Any = scipy.integrate.solve_ivp
    film = Film(specimen, h, voltage)
    equations = Equations(film)
    span = (math.log(film.disk), 0.0)

    def integrate(l1: float, theta: float, at: Array | None) -> tuple[Array, Array, Array]:
        solution = solve_ivp(
            equations.explicit,
            span,
            [l1, film.lp, theta, 0.0],
            method=integrator,
            t_eval=at,
            rtol=max(tolerance, 3e-14),
            atol=tolerance * 0.1,
        )
        if solution.status != 0:
            raise OutOfDomain(solution.message)
        end = solution.y[:, -1]
        return np.array([end[1] - film.lp, end[3] - film.height]), solution.y[0], solution.y[1]

    return _shoot(film, tolerance, integrate, equations, start)


def paper_shooting(
    specimen: Specimen,
    h: float,
    voltage: float,
    tolerance: float,
    *,
    integrator: str = "BDF",
    start: tuple[float, ...] | None = None,
) -> Result:
    """The paper's method: stiff integrator (``"BDF"``, ``"Radau"``) over ``R``, eq. (4) solved at every evaluation."""
    import scipy.integrate

    solve_ivp: Any = scipy.integrate.solve_ivp
    film = Film(specimen, h, voltage)
    equations = Equations(film)

    def integrate(l1: float, theta: float, at: Array | None) -> tuple[Array, Array, Array]:
        n1, _, _ = equations.nominal(l1, film.lp)
        equations.pull, equations.stretch = film.disk * n1 * math.sin(theta), l1
        radii = None if at is None else np.clip(np.exp(at), film.disk, 1.0)
        solution = solve_ivp(
            equations.paper,
            (film.disk, 1.0),
            [film.disk, 0.0, theta],
            method=integrator,
            t_eval=radii,
            rtol=max(tolerance, 3e-14),
            atol=tolerance * 0.1,
        )
        if solution.status != 0:
            raise OutOfDomain(solution.message)
        r, z, _ = solution.y
        miss = np.array([film.lp * (r[-1] - 1.0), z[-1] - film.height])
        if radii is None:
            return miss, r, r
        hoop = film.lp * r / radii
        meridional = np.empty_like(hoop)
        equations.stretch = l1
        for i, (radius, y) in enumerate(zip(radii, solution.y.T, strict=True)):
            equations.paper(float(radius), y)
            meridional[i] = equations.stretch
        return miss, meridional, hoop

    return _shoot(film, tolerance, integrate, equations, start)
