"""What a film with branches answers to the history of a record, and how that changes with its parameters.

The answer is `model.membrane.history`. Its slopes need be good to some per cent only: Newton's method
with such slopes still ends where the exact residuals are orthogonal to them, and their error is one of the
uncertainties by as many per cent. They are those of the relaxed film's motion: its logarithmic stretches ``u(R, t)``
drive the branches point by point, and by virtual work a branch adds to the force, to first order in its ratio,

    F_k(t) = ratio_k integral of S(w_k) . du/dh dV,    dw_k/dt = du/dt - (2 S_1 - S_2, 2 S_2 - S_1)(w_k)/(6 G time_k).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from calibration.film.branches.record import Bins
from model.material.law import stack
from model.material.materials import Branch, Material
from model.membrane.solve import profiles, solve_many
from model.specimen import Specimen

Array = NDArray[np.float64]

GRID, LEVELS = 25, (0.0, 0.7, 1.0)  # displacements, and voltages over the largest, at which the relaxed film is solved
POINTS = 31  # along the radius
FINE = 10  # steps of time in a stretch of the history
SIZES = ("disk_radius", "prestretch", "h")  # relative changes that others follow from
STEP = 0.02  # relative change of a parameter for a slope


class Relaxed:
    """The relaxed film over displacement and voltage: force and its derivatives, by interpolation."""

    def __init__(self, specimen: Specimen, highest: float, voltage: float) -> None:
        self.h = np.linspace(0.0, 1.02 * highest, GRID)
        self.levels = np.array(LEVELS) * voltage if voltage > 0.0 else np.zeros(1)
        self.voltage = voltage
        solved = solve_many(specimen, self.h[None, :], self.levels[:, None], tolerance=1e-6, sensitivities=True)
        by = solved.dforce or {}
        size = {"thickness": specimen.thickness, "prestretch": specimen.prestretch}
        size |= {"disk_radius": specimen.disk_radius, "ring_radius": specimen.ring_radius}
        columns = {"force": solved.force[..., None], "mu": by["mu"], "alpha": by["alpha"]}
        columns |= {name: by[name][..., None] for name in ("eps_r", "h", "voltage")}
        columns |= {name: by[name][..., None] * one for name, one in size.items()}
        self.places, values, first = {}, [], 0
        for name, one in columns.items():
            self.places[name] = slice(first, first + one.shape[-1])
            values.append(one)
            first += one.shape[-1]
        table = np.concatenate(values, axis=-1)  # (levels, GRID, columns)
        for k, level in enumerate(table):
            known = np.isfinite(level).all(axis=1)
            if not known.any():  # no state at this voltage: those of the lower one, as a start
                level[:] = table[k - 1]
            elif not known.all():  # beyond the last state: the last one's, as a start
                level[:] = level[known][
                    np.searchsorted(np.flatnonzero(known), np.arange(GRID)).clip(0, known.sum() - 1)
                ]
        self.splines = [CubicSpline(self.h, level) for level in table]

    def __call__(self, h: Array, voltage: Array) -> dict[str, Array]:
        """Force (N) and derivatives, (states,) or (states, numbers); of dimensions by their relative change."""
        found = self._of(np.clip(h, 0.0, self.h[-1]), voltage)
        return {
            name: found[:, where] if name in ("mu", "alpha") else found[:, where.start]
            for name, where in self.places.items()
        }

    def force(self, h: Array, voltage: Array) -> Array:
        """Force alone (N)."""
        found: Array = self._of(np.clip(h, 0.0, self.h[-1]), voltage)[:, 0]
        return found

    def _of(self, h: Array, voltage: Array) -> Array:
        if len(self.splines) == 1:
            alone: Array = self.splines[0](h)
            return alone
        x = ((voltage / self.voltage) ** 2)[:, None]
        nodes = np.square(LEVELS)
        total: Array = np.zeros((h.size, self.splines[0].c.shape[-1]))
        for k, spline in enumerate(self.splines):
            others = np.delete(nodes, k)
            total = total + spline(h) * np.prod((x - others) / (nodes[k] - others), axis=1)[:, None]
        return total


class Motion:
    """Logarithmic stretches of the relaxed film at points of its radius, along the fine times of a history.

    u, by_h : (times, 2, points), and their derivatives by the displacement (1/m)
    weight : volume of each point (m3), its share in a sum
    """

    def __init__(self, specimen: Specimen, h: Array, voltage: Array) -> None:
        grid = np.linspace(0.0, 1.02 * float(h.max()), GRID)
        top = float(voltage.max())
        levels = (0.0, 1.0) if top > 0.0 else (0.0,)
        share = (voltage / top) ** 2 if top > 0.0 else np.zeros(h.size)
        self.u, self.by_h = np.zeros((2, h.size, 2, POINTS))
        for level in levels:
            found = profiles(specimen, grid, level * top, POINTS, tolerance=1e-5)
            logs = np.log(np.stack((found.stretch_1, found.stretch_2), axis=1))
            known = np.isfinite(logs).all(axis=(1, 2))
            if known.sum() > 1:  # else the film has no states at the highest voltage: those at 0 V, as a start
                spline, last, radius = CubicSpline(grid[known], logs[known]), grid[known][-1], found.R[0]
            part = (share if level else 1.0 - share)[:, None, None]
            inside = np.minimum(h, last)
            self.u += part * spline(inside)
            self.by_h += part * spline(inside, 1)
        simpson = np.ones(POINTS)
        simpson[1:-1:2], simpson[2:-1:2] = 4.0, 2.0
        step = math.log(specimen.ring_radius / specimen.disk_radius) / (POINTS - 1) / 3.0
        volume = 2.0 * math.pi * specimen.thickness / specimen.prestretch**2 * step
        self.weight = volume * simpson * radius**2

    def forces(self, film: Material, t: Array, times: Sequence[float] | Array) -> Array:
        """What branches as stiff as the film add to the force (N), (times, len(t)); exponential rule of order 2."""
        law = film.law(np.array(film.mu)[:, None], np.array(film.alpha).reshape(-1, 1))
        modulus, tau = film.shear_modulus, np.asarray(times, dtype=float)[:, None]
        w = np.zeros((2, tau.size, POINTS))
        found = np.zeros((tau.size, t.size))
        change, x = np.diff(self.u, axis=0), np.diff(t) / tau
        decay, share = np.exp(-x), -np.expm1(-x) / x
        drive = self.by_h * self.weight

        def stress(at: Array) -> tuple[Array, Array]:
            s1, s2, *_ = law.derivatives(stack(at[0], at[1]))
            return s1, s2

        s1, s2 = stress(w)
        for k in range(t.size - 1):
            e, p = decay[:, k, None], share[:, k, None]
            free = e * w + p * change[k][:, None]
            pull = p * x[:, k, None]
            more = np.array((2.0 * s1 - s2, 2.0 * s2 - s1)) / (6.0 * modulus) - w
            ahead = free - pull * more
            t1, t2 = stress(ahead)
            late = np.array((2.0 * t1 - t2, 2.0 * t2 - t1)) / (6.0 * modulus) - ahead
            w = free - 0.5 * pull * (more + late)
            s1, s2 = stress(w)
            found[:, k + 1] = s1 @ drive[k + 1, 0] + s2 @ drive[k + 1, 1]
        return found


@dataclass(frozen=True, eq=False)
class Around:
    """What changes little near a film: its motion, and derivatives of what each branch adds (branches, bins).

    by_number : by the law's numbers; by_size : by relative changes of dimensions and of the displacement
    """

    motion: Motion
    by_number: list[Array]
    by_size: dict[str, Array]


@dataclass(frozen=True, eq=False)
class Slopes:
    """Force (N) of the bins of a record to first order in the ratios of the branches, and its derivatives.

    Attributes
    ----------
    relaxed : dict of str to ndarray
        The relaxed film's part, as `Relaxed` has it.
    film : ndarray, shape (bins, moduli + shapes)
        By the law's numbers, branches included.
    ratio, log_time : ndarray, shape (bins, branches)
    dimensions : dict of str to ndarray
        By relative changes of dimensions, of the displacement ("h"), the voltage ("voltage") and all forces ("force").
    """

    force: Array
    relaxed: dict[str, Array]
    film: Array
    ratio: Array
    log_time: Array
    dimensions: dict[str, Array]


class Response:
    """The film of a record with any law and branches."""

    def __init__(self, bins: Bins, specimen: Specimen) -> None:
        self.bins, self.specimen = bins, specimen
        self.t, self.h, self.voltage = bins.record.history
        pieces = [np.linspace(left, right, FINE + 1)[:-1] for left, right in zip(self.t[:-1], self.t[1:], strict=True)]
        self.fine = np.unique(np.concatenate((*pieces, bins.time, self.t[-1:])))
        self.fine_h = np.interp(self.fine, self.t, self.h)
        self.fine_v = np.interp(self.fine, self.t, self.voltage)
        self.at = np.searchsorted(self.fine, bins.time)
        self.highest = float(self.h.max())

    def film(self, material: Material) -> Specimen:
        """The specimen of that material."""
        return self.specimen.with_material(material)

    def elastic(self, material: Material, times: Array) -> Array:
        """Force (N) of the relaxed film at ``times``; NaN where it has no state."""
        plain = self.film(replace(material, branches=()))
        h, v = np.interp(times, self.t, self.h), np.interp(times, self.t, self.voltage)
        return solve_many(plain, h, v, tolerance=1e-6).force

    def motion(self, film: Specimen) -> Motion:
        """The relaxed film's motion along the record."""
        return Motion(film.with_material(replace(film.material, branches=())), self.fine_h, self.fine_v)

    def added(self, material: Material, times: Sequence[float] | Array) -> Array:
        """What branches as stiff as the film add at the bins (N), (times, bins), to first order."""
        return self.motion(self.film(material)).forces(material, self.fine, times)[:, self.at]

    def around(self, material: Material) -> Around:
        """What changes little near a film with its branches."""
        plain = replace(material, branches=())
        times = [one.time for one in material.branches]
        motion = self.motion(self.film(plain))
        if not times:
            count = len(plain.mu) + len(plain.alpha)
            nothing = np.zeros((0, self.at.size))
            return Around(motion, [nothing] * count, dict.fromkeys(SIZES, nothing))

        def forces(film: Material, other: Motion) -> Array:
            found: Array = other.forces(film, self.fine, times)[:, self.at]
            return found

        own = forces(plain, motion)
        by_number = []
        for number in range(len(plain.mu) + len(plain.alpha)):
            moved, step = _moved(plain, number)
            by_number.append((forces(moved, motion) - own) / step)
        by_size = {}
        for name in SIZES:
            if name == "h":
                other = Motion(self.film(plain), self.fine_h * (1.0 + STEP), self.fine_v)
            else:
                changed = replace(self.specimen, **{name: getattr(self.specimen, name) * (1.0 + STEP)})
                other = self.motion(changed.with_material(plain))
            by_size[name] = (forces(plain, other) - own) / STEP
        return Around(motion, by_number, by_size)

    def slopes(self, material: Material, around: Around) -> Slopes:
        """Force and derivatives at a film with its branches."""
        plain = replace(material, branches=())
        h, v = self.bins.h, self.bins.voltage
        here = Relaxed(self.film(plain), self.highest, float(self.voltage.max()))(h, v)
        times = [one.time for one in material.branches]
        ratio = np.array([one.ratio for one in material.branches])
        k = len(times)
        near = [*times, *(time * 1.05 for time in times), *(time / 1.05 for time in times)]
        own = around.motion.forces(plain, self.fine, near)[:, self.at] if near else np.zeros((0, self.at.size))
        by_time = (own[k : 2 * k] - own[2 * k :]) / (2.0 * math.log(1.05))
        extra = ratio @ own[:k]
        numbers = np.concatenate((here["mu"], here["alpha"]), axis=1)
        numbers = numbers + np.stack([ratio @ one for one in around.by_number], axis=1)
        sizes = self._sizes(here, extra, {name: ratio @ one for name, one in around.by_size.items()})
        return Slopes(here["force"] + extra, here, numbers, own[:k].T, (ratio[:, None] * by_time).T, sizes)

    def _sizes(self, here: dict[str, Array], extra: Array, moved: dict[str, Array]) -> dict[str, Array]:
        """By relative changes; the branches' part is in proportion to the thickness, and scales as all lengths do."""
        total = here["force"] + extra
        found = {name: here[name] + moved[name] for name in ("disk_radius", "prestretch")}
        found["h"] = here["h"] * self.bins.h + moved["h"]
        found["thickness"] = here["thickness"] + extra
        found["voltage"] = here["voltage"] * self.bins.voltage
        found["ring_radius"] = total - found["disk_radius"] - found["h"]
        found["force"] = total
        return found


def _moved(film: Material, number: int) -> tuple[Material, float]:
    """The film with another modulus or shape parameter, and by how much."""
    values, moduli = [*film.mu, *film.alpha], len(film.mu)
    step = STEP * (abs(values[number]) if number >= moduli else max(abs(one) for one in film.mu))
    values[number] += step
    return replace(film, mu=tuple(values[:moduli]), alpha=tuple(values[moduli:])), step


def with_branches(material: Material, ratio: Sequence[float] | Array, time: Sequence[float] | Array) -> Material:
    """The material with these branches."""
    pairs = zip(ratio, time, strict=True)
    return replace(material, branches=tuple(Branch(float(max(r, 0.0)), float(t)) for r, t in pairs))
