"""Shooting from the disk: guess stretch and slope there, integrate to the ring, correct until the ring is met.

Two forms of the same equations:

- the paper's (Cao & Conn 2018, eqs. (1)-(4)): ``r, z, theta`` over ``R`` by a stiff integrator, with the meridional
  stretch from the algebraic equation ``R S1 sin(theta) = const`` at every evaluation: an index-1 system;
  The correction is the paper's too, with differences;
- explicit: ``ln l1, ln l2, theta, z`` over ``ln R``, where no algebraic equation is left, by non-stiff integrators,
  with the derivatives that Newton's method needs from the variational equations.

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
        """d/d(ln R) of (ln l1, ln l2, theta, z); the equations stand in `baselines.explicit`."""
        self._count()
        log1, log2, theta, _ = y.tolist()
        if not (abs(log1) < 4.0 and abs(log2) < 4.0):
            raise OutOfDomain("a stretch outside 0.02 to 50")
        s1 = s2 = s11 = s12 = 0.0
        for mu, alpha in self.terms:
            along, across = mu * math.exp(alpha * log1), mu * math.exp(alpha * log2)
            through = mu * math.exp(-alpha * (log1 + log2))
            s1 += along - through
            s2 += across - through
            s11 += alpha * (along + through)
            s12 += alpha * through
        maxwell = self.electric * math.exp(2.0 * (log1 + log2))
        s1, s2, s11, s12 = s1 - maxwell, s2 - maxwell, s11 - 2.0 * maxwell, s12 - 2.0 * maxwell
        q, cos, sin = math.exp(log1 - log2), math.cos(theta), math.sin(theta)
        w = q * cos - 1.0
        return (
            ((s2 - s12) * w + s2 - s1) / (s11 - s1),
            w,
            -s2 / s1 * q * sin,
            math.exp(x + log1) / self.lp * sin,
        )

    def varied(self, x: float, y: Array) -> tuple[float, ...]:
        """`explicit`, and after it the slopes of its derivatives by stretch and slope at the disk (variational ODE).

        ``y`` holds (ln l1, ln l2, theta, z), its derivatives by ``ln l1`` at the disk, and those by ``theta`` there.
        """
        self._count()
        log1, log2, theta, _, a1, a2, a3, _, b1, b2, b3, _ = y.tolist()
        if not (abs(log1) < 4.0 and abs(log2) < 4.0):
            raise OutOfDomain("a stretch outside 0.02 to 50")
        s1 = s2 = s11 = s22 = s12 = s111 = s112 = 0.0
        for mu, alpha in self.terms:
            along, across = mu * math.exp(alpha * log1), mu * math.exp(alpha * log2)
            through = mu * math.exp(-alpha * (log1 + log2))
            s1 += along - through
            s2 += across - through
            along, across, through = alpha * along, alpha * across, alpha * through
            s11 += along + through
            s22 += across + through
            s12 += through
            s111 += alpha * (along - through)
            s112 -= alpha * through
        maxwell = self.electric * math.exp(2.0 * (log1 + log2))
        s1, s2 = s1 - maxwell, s2 - maxwell
        s11, s22, s12 = s11 - 2.0 * maxwell, s22 - 2.0 * maxwell, s12 - 2.0 * maxwell
        s111, s112 = s111 - 4.0 * maxwell, s112 - 4.0 * maxwell
        q = math.exp(log1 - log2)
        w1, turn = q * math.cos(theta), q * math.sin(theta)
        w, below, ratio, excess = w1 - 1.0, s11 - s1, s2 / s1, s2 - s12
        slope = (excess * w + s2 - s1) / below
        by11 = ((s12 - s112) * w + excess * w1 + s12 - s11 - slope * (s111 - s11)) / below
        by12 = ((s22 - s112) * w - excess * w1 + s22 - s12 - slope * (s112 - s12)) / below
        by13 = -excess * turn / below
        by31 = -turn * ((s12 - ratio * s11) / s1 + ratio)
        by32 = -turn * ((s22 - ratio * s12) / s1 - ratio)
        by33 = -ratio * w1
        rise = math.exp(x + log1) / self.lp
        up, along = rise * math.sin(theta), rise * math.cos(theta)
        return (
            slope,
            w,
            -ratio * turn,
            up,
            by11 * a1 + by12 * a2 + by13 * a3,
            w1 * (a1 - a2) - turn * a3,
            by31 * a1 + by32 * a2 + by33 * a3,
            up * a1 + along * a3,
            by11 * b1 + by12 * b2 + by13 * b3,
            w1 * (b1 - b2) - turn * b3,
            by31 * b1 + by32 * b2 + by33 * b3,
            up * b1 + along * b3,
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
    """Correct (l1, theta) at the disk with MINPACK's hybr, whose derivatives are differences.

    ``integrate`` returns (miss, l1, l2).
    """
    import scipy.optimize

    root: Any = scipy.optimize.root

    def miss(unknowns: Array) -> Array:
        if not unknowns[0] > 0.0:
            return np.array([1e3, 1e3])
        try:
            return integrate(float(unknowns[0]), float(unknowns[1]), None)[0]
        except (OutOfDomain, ArithmeticError, ValueError):
            return np.array([1e3, 1e3])

    for guess in _guesses(film, start):
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
    """Shooting with the explicit form over ``ln R``; Newton's derivatives are from the variational equations.

    ``integrator`` is any non-stiff name that ``solve_ivp`` knows. ``start``: (l1, theta) at the disk.
    """
    import scipy.integrate

    solve_ivp: Any = scipy.integrate.solve_ivp
    film = Film(specimen, h, voltage)
    equations = Equations(film)
    options = {"method": integrator, "rtol": max(tolerance, 3e-14), "atol": 0.1 * tolerance}
    ring = np.array([math.log(film.lp), film.height])  # ln l2 and z there

    def integrate(slopes: Callable[[float, Array], tuple[float, ...]], y: list[float], at: Array | None) -> Array:
        solution = solve_ivp(slopes, (math.log(film.disk), 0.0), y, t_eval=at, **options)
        if solution.status != 0:
            raise OutOfDomain(solution.message)
        return np.asarray(solution.y)

    def shot(unknowns: Array) -> tuple[Array, Array]:
        y = [unknowns[0], ring[0], unknowns[1], 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
        end = integrate(equations.varied, y, None)[:, -1]
        return end[[1, 3]] - ring, np.array([[end[5], end[9]], [end[7], end[11]]])

    problem = ""
    for l1, theta in _guesses(film, start):
        try:
            u = _newton(shot, np.array([math.log(l1), theta]), math.sqrt(tolerance))
            at = np.linspace(math.log(film.disk), 0.0, PROFILE)
            y = integrate(equations.explicit, [u[0], ring[0], u[1], 0.0], at)
        except (OutOfDomain, ArithmeticError, ValueError, np.linalg.LinAlgError) as failure:
            problem = str(failure)
            continue
        if float(np.max(np.abs(y[[1, 3], -1] - ring))) <= max(100 * tolerance, 1e-11) * max(1.0, film.height):
            meridional, hoop = np.exp(y[:2])
            pull = film.disk * equations.nominal(float(meridional[0]), film.lp)[0] * math.sin(u[1])
            end = (float(meridional[0]), float(u[1]))
            return film.answer(pull, meridional, hoop, equations.evaluations, start=end)
        problem = "the ring is missed"
    return failed(f"shooting does not meet the ring: {problem}", equations.evaluations)


def _guesses(film: Film, start: tuple[float, ...] | None) -> list[tuple[float, ...]]:
    """(l1, theta) at the disk: a power law; failing that, a cone."""
    if start is not None:
        return [start]
    log1, _, theta, _ = film.power_law(np.array([film.disk]))[:, 0]
    return [(math.exp(log1), float(theta)), film.cone()]


def _newton(shot: Callable[[Array], tuple[Array, Array]], u: Array, enough: float) -> Array:
    """Newton's method; a step is halved while it leads out of the domain or makes the miss greater.

    It ends when a step is below ``enough``, whose square is what is wanted: the next would be of that size.
    """
    miss, by = shot(u)
    for _ in range(30):
        change = np.linalg.solve(by, -miss)
        if not np.isfinite(change).all():
            raise OutOfDomain("a step without bounds")
        if float(np.max(np.abs(change))) <= 0.1 * enough:
            return u + change
        change *= min(1.0, 0.5 / float(np.max(np.abs(change))))
        for _ in range(12):
            try:
                trial, trial_by = shot(u + change)
            except (OutOfDomain, ArithmeticError, ValueError):
                trial = np.full(2, np.inf)
            if float(np.linalg.norm(trial)) < float(np.linalg.norm(miss)):
                break
            change *= 0.5
        else:
            raise OutOfDomain("no step leads nearer to the ring")
        u, miss, by = u + change, trial, trial_by
    raise OutOfDomain("30 steps do not lead to the ring")


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
