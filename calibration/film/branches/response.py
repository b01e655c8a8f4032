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
from typing import Self

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
POINTS = 15  # along the radius
FINE = 10  # steps of time in a stretch of the history
SIZES = ("disk_radius", "prestretch", "h")  # relative changes that others follow from
STEP = 0.02  # relative change of a parameter for a slope
NEAR = 0.05  # change of a film's law, over which its motion is solved anew: it hardly depends on the law
NEVER_ZERO = 1e-40  # strain: one that decays in a hold to less becomes a number that processors are slow with


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
        self.none = False
        for k, level in enumerate(table):
            known = np.isfinite(level).all(axis=1)
            if not known.any() and k == 0:  # no film: a step of a search that is not taken
                level[:] = 0.0
                self.none = True
            elif not known.any():  # no state at this voltage: those of the lower one, as a start
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
        if self.none:
            return np.full((h.size, self.splines[0].c.shape[-1]), np.nan)
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
        self._follow(_Stretched.of([specimen], h, voltage)[0], h, voltage)

    @classmethod
    def of(cls, specimens: Sequence[Specimen], h: Array, voltage: Array, more: float) -> list[Self]:
        """Those of several films, and that of the first one with all displacements larger by the share ``more``."""
        stretched = _Stretched.of(specimens, h, voltage)
        found = []
        for one, places in [*((film, h) for film in stretched), (stretched[0], h * (1.0 + more))]:
            motion = cls.__new__(cls)
            motion._follow(one, places, voltage)
            found.append(motion)
        return found

    def _follow(self, film: _Stretched, h: Array, voltage: Array) -> None:
        top = float(voltage.max())
        share = (voltage / top) ** 2 if top > 0.0 else np.zeros(h.size)
        self.u, self.by_h = np.zeros((2, h.size, 2, POINTS))
        for spline, last, level in zip(film.splines, film.last, film.levels, strict=True):
            part = (share if level else 1.0 - share)[:, None, None]
            inside = np.minimum(h, last)
            self.u += part * spline(inside)
            self.by_h += part * spline(inside, 1)
        self.weight = film.weight

    def forces(self, film: Material, t: Array, times: Sequence[float] | Array) -> Array:
        """What branches as stiff as the film add to the force (N), (times, len(t))."""
        found: Array = forces_of([self], [film], t, times)[0]
        return found


class _Stretched:
    """Logarithmic stretches of one relaxed film over displacement, at 0 V and at the largest voltage.

    splines, last : of every level, and the largest displacement that it is good for (m)
    """

    def __init__(self, specimen: Specimen, grid: Array, levels: Sequence[float], logs: Array) -> None:
        self.levels = levels
        self.splines: list[CubicSpline] = []
        self.last: list[float] = []
        for level in logs:
            known = np.isfinite(level).all(axis=(1, 2))
            if known.sum() > 1:
                self.splines.append(CubicSpline(grid[known], level[known]))
                self.last.append(float(grid[known][-1]))
            else:  # the film has no states at the highest voltage: those at 0 V, as a start
                self.splines.append(self.splines[-1])
                self.last.append(self.last[-1])
        simpson = np.ones(POINTS)
        simpson[1:-1:2], simpson[2:-1:2] = 4.0, 2.0
        step = math.log(specimen.ring_radius / specimen.disk_radius) / (POINTS - 1) / 3.0
        volume = 2.0 * math.pi * specimen.thickness / specimen.prestretch**2 * step
        self.weight = volume * simpson * np.geomspace(specimen.disk_radius, specimen.ring_radius, POINTS) ** 2

    @classmethod
    def of(cls, specimens: Sequence[Specimen], h: Array, voltage: Array) -> list[Self]:
        """Those of films that are driven alike, solved together."""
        grid = np.linspace(0.0, (1.0 + STEP) * float(h.max()), GRID)
        top = float(voltage.max())
        levels = (0.0, top) if top > 0.0 else (0.0,)
        films = np.empty((len(specimens), 1, 1), dtype=np.object_)
        films[:, 0, 0] = specimens
        found = profiles(films, grid, np.array(levels)[:, None], POINTS, tolerance=1e-5)
        logs = np.log(np.stack((found.stretch_1, found.stretch_2), axis=1))
        logs = logs.reshape(len(specimens), len(levels), GRID, 2, POINTS)
        return [cls(one, grid, levels, mine) for one, mine in zip(specimens, logs, strict=True)]


def forces_of(motions: Sequence[Motion], films: Sequence[Material], t: Array, times: Sequence[float] | Array) -> Array:
    """What branches as stiff as each film add to its force (N), (films, times, len(t)); exponential rule of order 2.

    Films of one law that move each in its way, with branches of the same ``times`` (s).
    """
    count, many = len(films), len(times)
    which = np.repeat(np.arange(count), many)
    mu, alpha = (np.array([getattr(one, name) for one in films]).reshape(count, -1).T for name in ("mu", "alpha"))
    law = films[0].law(mu[:, which], alpha[:, which]) if count > 1 else films[0].law(mu, alpha)
    modulus = np.array([one.shear_modulus for one in films])[which]
    tau = np.tile(np.asarray(times, dtype=float), count)
    change = np.stack([np.diff(one.u, axis=0) for one in motions], axis=-1)[..., which] + NEVER_ZERO
    drive = np.stack([one.by_h * one.weight for one in motions], axis=-1)
    x = np.diff(t)[:, None] / tau
    decay, share = np.exp(-x), -np.expm1(-x) / x
    half = 0.5 * share * x
    sheared = 1.0 / (6.0 * modulus)
    w = np.zeros((2, POINTS, tau.size))
    stress = np.empty((t.size, *w.shape))

    def excess(at: Array, out: Array) -> Array:
        out[0], out[1], *_ = law.derivatives(stack(at[0], at[1]))
        found: Array = (2.0 * out - out[::-1]) * sheared
        return found - at

    more = excess(w, stress[0])
    ahead = np.empty_like(w)
    for k in range(t.size - 1):
        free = decay[k] * w + share[k] * change[k]
        late = excess(free - 2.0 * half[k] * more, ahead)
        w = free - half[k] * (more + late)
        more = excess(w, stress[k + 1])
    found: Array = np.einsum("tipvs,tipv->vst", stress.reshape(t.size, 2, POINTS, count, many), drive)
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
        self._solved: tuple[Array, list[Motion]] | None = None

    def film(self, material: Material) -> Specimen:
        """The specimen of that material."""
        return self.specimen.with_material(material)

    def elastic(self, material: Material, times: Array) -> Array:
        """Force (N) of the relaxed film at ``times``; NaN where it has no state."""
        plain = self.film(replace(material, branches=()))
        h, v = np.interp(times, self.t, self.h), np.interp(times, self.t, self.voltage)
        return solve_many(plain, h, v, tolerance=1e-6).force

    def motions(self, material: Material) -> list[Motion]:
        """The relaxed film's motion along the record, with each of `SIZES` larger by `STEP`, and its own at last.

        Those of a film that is near are taken again.
        """
        law = _kind(material)
        if self._solved is None or not float(np.abs(law - self._solved[0]).max()) <= NEAR:
            plain = replace(material, branches=())
            sizes = [name for name in SIZES if name != "h"]
            larger = [replace(self.specimen, **{name: getattr(self.specimen, name) * (1.0 + STEP)}) for name in sizes]
            films = [one.with_material(plain) for one in (self.specimen, *larger)]
            own, *others = Motion.of(films, self.fine_h, self.fine_v, STEP)
            self._solved = law, [*others, own]
        return self._solved[1]

    def added(self, material: Material, times: Sequence[float] | Array) -> Array:
        """What branches as stiff as the film add at the bins (N), (times, bins), to first order."""
        return self.motions(material)[-1].forces(material, self.fine, times)[:, self.at]

    def around(self, material: Material) -> Around:
        """What changes little near a film with its branches."""
        plain = replace(material, branches=())
        times = [one.time for one in material.branches]
        numbers = len(plain.mu) + len(plain.alpha)
        *others, motion = self.motions(plain)
        if not times:
            nothing = np.zeros((0, self.at.size))
            return Around(motion, [nothing] * numbers, dict.fromkeys(SIZES, nothing))
        moved = [_moved(plain, number) for number in range(numbers)]
        motions = [motion] * (1 + numbers) + others
        films = [plain, *(film for film, _ in moved)] + [plain] * len(others)
        own, *rest = forces_of(motions, films, self.fine, times)[..., self.at]
        steps = [step for _, step in moved] + [STEP] * len(others)
        changes = [(there - own) / step for there, step in zip(rest, steps, strict=True)]
        return Around(motion, changes[:numbers], dict(zip(SIZES, changes[numbers:], strict=True)))

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


def _kind(film: Material) -> Array:
    """What of a film's law its motion depends on: shares of the moduli, shape parameters, permittivity by stiffness."""
    mu, alpha = np.array(film.mu), np.array(film.alpha)
    shapes = np.log(np.maximum(np.abs(alpha), 1e-3))
    loaded = math.log(film.eps_r / film.shear_modulus)
    return np.concatenate((mu / np.abs(mu).sum(), shapes, np.sign(alpha), [loaded]))


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
