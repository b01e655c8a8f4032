r"""The paper's optimisation as it may have been computed: a hypothesis, not physics.

Of many readings of Cao & Conn 2018 one comes nearest to the optima that it prints: the field is read at the disk's
edge, and eq. (4) has the undeformed radius R in place of r,

    2 pi T/(l1 l2) R sigma1 sin(theta) = F.

With the paper's eqs. (1)-(3) that is inconsistent: it breaks the first integral ``2 pi R (T/lp) S1 sin(theta) = F``.
Nothing but the comparison with the paper's numbers may use this. ``slip=False`` leaves eq. (4) as it is printed, which
the tests compare with the solver.

The equations are explicit over ``ln R`` (the derivative of eq. (4) gives that of l1); many films are shot together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from model.membrane.solve import profiles
from model.specimen import Specimen

Array = NDArray[np.float64]
Bias = Callable[[Array], Array]  # force (N) at displacements (m), one a film

STEPS = 40  # of Runge-Kutta over ln R
NEWTON = 8
CLOSE = 1e-9
RAISE = 17  # steps of E^2 from rest to breakdown
NODES = 8  # Gauss-Legendre nodes of the work
LOW, HIGH, HEIGHTS = 0.2, 0.9, 29  # h/b at which the passive film is tabulated


@dataclass(frozen=True)
class Ends:
    """Strokes to breakdown of films against a bias, one entry each, SI units; NaN where there is none."""

    rest: Array
    stroke: Array
    work: Array
    voltage: Array
    blocked_force: Array
    min_hoop_stress: Array
    max_stretch: Array


class Films:
    """Films of one material: forces and strokes in this reading."""

    def __init__(self, films: Sequence[Specimen], *, slip: bool = True) -> None:
        self.films, self.slip = list(films), 1.0 if slip else 0.0
        material = films[0].material
        if any(film.material != material for film in films):
            raise ValueError("one material at a time")
        moduli, exponents = material.powers
        self.shear = material.shear_modulus
        self.permittivity = material.permittivity
        self.mu = np.array(moduli)[:, None] / self.shear
        self.alpha = np.array(exponents)[:, None]
        a, self.b, self.t, self.lp = np.array(
            [(f.disk_radius, f.ring_radius, f.thickness, f.prestretch) for f in films]
        ).T
        self.disk = a / self.b

    def _law(self, l1: Array, l2: Array, electric: Array) -> tuple[Array, ...]:
        """sigma1, sigma2 and the derivatives of sigma1 with ln(l1), ln(l2), over G."""
        along, across, through = l1**self.alpha, l2**self.alpha, (l1 * l2) ** -self.alpha
        maxwell = electric * (l1 * l2) ** 2
        weight = self.mu * self.alpha
        s1, s2 = (self.mu * (along - through)).sum(0) - maxwell, (self.mu * (across - through)).sum(0) - maxwell
        s12 = (weight * through).sum(0) - 2.0 * maxwell
        return s1, s2, (weight * along).sum(0) + s12, s12

    def shot(self, stretch: Array, slope: Array, electric: Array) -> tuple[Array, Array, Array, Array, Array]:
        """From the disk: hoop stretch missed at the ring, height over b, force (N), least sigma2 (Pa), largest l1."""
        span = -np.log(self.disk)
        step = span / STEPS

        def rate(x: Array, y: Array) -> Array:
            l1, l2, theta, _ = y
            s1, s2, s11, s12 = self._law(l1, l2, electric)
            sin, cos = np.sin(theta), np.cos(theta)
            wider, bend = l1 * cos - l2, -s2 * l1 / (s1 * l2) * sin
            log1 = -(1.0 + (s12 / s1 - self.slip) * wider / l2 + cos / sin * bend) / (s11 / s1 - 1.0)
            return np.stack([l1 * log1, wider, bend, np.exp(x) * l1 / self.lp * sin])

        x = -span
        y = np.stack([stretch, self.lp, slope, np.zeros_like(slope)])
        s1, least, _, _ = self._law(stretch, self.lp, electric)
        area = 2.0 * math.pi * self.disk * self.b * self.t / self.lp
        force = area * self.shear * s1 / stretch * np.sin(slope)
        largest = stretch
        for _ in range(STEPS):
            k1 = rate(x, y)
            k2 = rate(x + 0.5 * step, y + 0.5 * step * k1)
            k3 = rate(x + 0.5 * step, y + 0.5 * step * k2)
            k4 = rate(x + step, y + step * k3)
            y = y + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            x = x + step
            least = np.minimum(least, self._law(y[0], y[1], electric)[1])
            largest = np.maximum(largest, y[0])
        return y[1] - self.lp, y[3], force, self.shear * least, largest

    def solve(
        self, start: Array, electric: Callable[[Array], Array], miss: Callable[[Array, Array], Array]
    ) -> tuple[Array, tuple[Array, ...]]:
        """Newton for ln(l1) and theta at the disk, (2, films); ``miss`` of height over b and force is the second."""

        def off(u: Array) -> tuple[Array, tuple[Array, ...]]:
            found = self.shot(np.exp(u[0]), u[1], electric(np.exp(u[0])))
            return np.stack([found[0], miss(found[1], found[2])]), found

        u = start.copy()
        with np.errstate(all="ignore"):
            value, found = off(u)
            for _ in range(NEWTON):
                if not np.nanmax(np.abs(value), initial=0.0) > CLOSE:
                    break
                columns = [(off(u + 1e-7 * unit)[0] - value) / 1e-7 for unit in np.eye(2)[:, :, None]]
                (m11, m21), (m12, m22) = columns
                change = np.stack([m22 * value[0] - m12 * value[1], m11 * value[1] - m21 * value[0]])
                u = u - np.clip(change / (m11 * m22 - m12 * m21), -0.15, 0.15)
                value, found = off(u)
        u[:, ~(np.abs(value).max(axis=0) < 1e3 * CLOSE)] = np.nan
        return u, found

    def at(self, h: Array) -> tuple[Array, Array]:
        """The passive films at ``h`` (m): unknowns at the disk, and force (N)."""
        # The first guess is the solver's state, of the equations as they are printed.
        known = profiles(self.films, h, points=3)
        start = np.stack([np.log(known.stretch_1[:, 0]), known.slope[:, 0]])
        height = h / self.b
        u, found = self.solve(start, np.zeros_like, lambda z, _: z - height)
        return u, found[2]

    @cached_property
    def passive(self) -> tuple[Array, Array, Array]:
        """Heights (m), unknowns at the disk and forces (N) of the films without voltage, (heights, ..., films)."""
        h = np.linspace(LOW, HIGH, HEIGHTS)[:, None] * self.b
        u, force = Films(self.films * HEIGHTS, slip=bool(self.slip)).at(h.ravel())
        return h, u.reshape(2, HEIGHTS, -1).swapaxes(0, 1), force.reshape(HEIGHTS, -1)

    def ends(self, bias: Bias, field: float) -> Ends:
        """Strokes until the field (V/m) at the disk's edge is reached, and the work at that voltage."""
        h, u, force = self.passive
        rest, u = self._rest(h, u, force, bias)
        full = self.permittivity * field**2 / self.shear / self.lp**2

        def balanced(z: Array, pull: Array) -> Array:
            return pull / bias(z * self.b) - 1.0

        def charged(share: float) -> Callable[[Array], Array]:
            return lambda l1: share * full / l1**2

        def held(at: Array) -> Callable[[Array, Array], Array]:
            return lambda z, _: z - at / self.b

        before = u
        for share in np.linspace(0.0, 1.0, RAISE)[1:]:
            first = 2.0 * u - before
            before = u
            u, found = self.solve(first, charged(float(share)), balanced)
        reached, stretch = found[1] * self.b, np.exp(u[0])
        voltage = field * self.t / (stretch * self.lp)
        electric = full / stretch**2
        stroke = reached - rest
        x, weight = np.polynomial.legendre.leggauss(NODES)
        work, at = np.zeros_like(rest), u
        for node, part in zip(0.5 * (1.0 + x[::-1]), 0.5 * weight[::-1], strict=True):
            here = rest + node * stroke
            at, part_found = self.solve(at, lambda _: electric, held(here))
            work = work + part * stroke * (bias(here) - part_found[2])
        _, blocked = self.solve(at, lambda _: electric, held(rest))
        return Ends(rest, stroke, work, voltage, bias(rest) - blocked[2], found[3], found[4])

    def _rest(self, h: Array, u: Array, force: Array, bias: Bias) -> tuple[Array, Array]:
        """Displacement where film and bias balance without voltage, and the unknowns there."""
        push = np.array([bias(row) for row in h])
        excess = force - push
        rises = (excess[:-1] < 0.0) & (excess[1:] >= 0.0)
        first = rises.argmax(axis=0)
        column = np.arange(len(self.films))
        low, high = excess[first, column], excess[first + 1, column]
        part = -low / (high - low)
        start = u[first, :, column] + part[:, None] * (u[first + 1, :, column] - u[first, :, column])
        at, found = self.solve(start.T.copy(), np.zeros_like, lambda z, pull: pull / bias(z * self.b) - 1.0)
        none = ~rises.any(axis=0)
        at[:, none] = np.nan
        return np.where(none, np.nan, found[1] * self.b), at


def antagonist(films: Films, spacer: float) -> Bias:
    """A second, passive cone of the same film: force at ``spacer - h``."""
    from scipy.interpolate import CubicSpline

    h, _, force = films.passive
    curves = [CubicSpline(h[:, i], force[:, i]) for i in range(force.shape[1])]
    return lambda at: np.array([float(curve(x)) for curve, x in zip(curves, spacer - at, strict=True)])
