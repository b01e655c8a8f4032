"""Branches of equilibria by arc length, through the limit points where a step in voltage or displacement would jump."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.material.law import Evaluations, Film
from model.membrane import refinement, ritz
from model.membrane.ritz import Grid, Problem, State
from model.specimen import Specimen

MODES = 40  # enough for the boundary layers of deeply wrinkled plain states near a fold
CORRECTIONS = 8
TURN = 0.25  # largest turn of the tangent in a step (rad), else the step is halved
Parameter = Literal["voltage", "displacement"]


@dataclass(frozen=True)
class Branch:
    """Equilibria along a branch, in the order in which it was followed; plain equations.

    Attributes
    ----------
    h, voltage : where (m, V)
    force : N
    peak_field : V/m, at the points of the discretisation
    min_hoop_stress : Pa, likewise: negative where the film would wrinkle
    stable : minimum of the energy at prescribed displacement and voltage
    limit_points : numbers of the points after which the varied parameter turned back
    ended : why the branch ends
    """

    h: Array
    voltage: Array
    force: Array
    peak_field: Array
    min_hoop_stress: Array
    stable: NDArray[np.bool_]
    limit_points: tuple[int, ...]
    ended: str


@dataclass(slots=True)
class _Point:
    """An equilibrium on the branch: modes, slopes, force, and the varied parameter (K/K_end or h/h_end)."""

    c: Array
    w: Array
    lam: float
    parameter: float
    tangent: Array  # of (c, lam, parameter) in scaled unknowns
    stable: bool

    def rest(self) -> tuple[Array, bool]:
        """What a trial takes over until it is finished."""
        return self.tangent, self.stable


class _Path:
    """The extended system of one film: unknowns (modes, force, parameter), the slopes eliminated at their points."""

    def __init__(self, specimen: Specimen, h: float, voltage: float, vary: Parameter) -> None:
        m = specimen.material
        shear = m.shear_modulus
        self.specimen, self.vary = specimen, vary
        self.h, self.voltage = h, voltage
        if not (h > 0.0 and math.isfinite(h)):
            raise ValueError(f"displacement = {h!r} m: it must be positive and finite")
        if not (voltage >= 0.0 and math.isfinite(voltage)):
            raise ValueError(f"voltage = {voltage!r} V: it must not be negative, and finite")
        full = m.permittivity * (voltage / specimen.thickness) ** 2 / shear
        self.full_field, self.full_height = full, h / specimen.ring_radius
        law = m.law(np.array(m.mu)[:, None] / shear, np.array(m.alpha)[:, None])
        film = Film(law, np.array([full]), Evaluations())
        self.problem = Problem(
            film,
            np.array([math.log(specimen.prestretch)]),
            np.array([math.log(specimen.ring_radius / specimen.disk_radius)]),
            np.array([self.full_height]),
        )
        self.grid = Grid.lay(MODES, self.problem.cut())
        self.scale = np.ones(self.grid.unknowns + 2)

    def set(self, parameter: float) -> None:
        if self.vary == "voltage":
            self.problem.film.field = np.array([self.full_field * parameter])
        else:
            self.problem.height = np.array([self.full_height * parameter])

    def unknowns(self, point: _Point) -> Array:
        """(c, lam, parameter), scaled."""
        return np.concatenate((point.c, [point.lam, point.parameter])) / self.scale

    def rescale(self, point: _Point) -> None:
        """Measure modes and force by what they have become; the parameter's scale stays."""
        raw = point.tangent * self.scale
        self.scale[:-2] = max(self.scale[0], float(np.abs(point.c).max()))
        self.scale[-2] = max(self.scale[-2], point.lam)
        point.tangent = raw / self.scale
        point.tangent /= np.linalg.norm(point.tangent)

    def system(self, point: _Point) -> tuple[Array, Array, ritz.Points, ritz.Reduced, Array]:
        """Matrix (n+1, n+2), residual (n+1,), and what the slopes need afterwards."""
        self.set(point.parameter)
        grid, problem = self.grid, self.problem
        state = State(point.c[:, None], point.w)
        at = ritz.evaluate(problem, grid, state)
        r = ritz.reduce(grid, state.w, at)
        n = len(point.c)
        coupling, give = r.coupling[:, 0], float(r.give[0])
        matrix = np.zeros((n + 1, n + 2))
        matrix[:n, :n] = r.matrix[:, :, 0]
        matrix[:n, n] = coupling
        matrix[n, :n] = -coupling
        matrix[n, n] = give
        rate = np.zeros_like(point.w)  # d2W*/(dw dparameter)
        if self.vary == "voltage":
            b = self.full_field * np.exp(-2.0 * at.log[2])
            rate = -b * at.down
            on_q = grid.twice * (-b * at.along - r.hw * r.kqw * rate)
            on_e = grid.twice * (-b * at.around - r.hw * r.kew * rate)
            matrix[:n, n + 1] = grid.project(on_e, on_q)[:, 0]
            matrix[n, n + 1] = -float((grid.once * r.hw * rate).sum())
        else:
            matrix[n, n + 1] = -self.full_height
        residual = np.empty(n + 1)
        residual[:n] = r.residual[:, 0] + point.lam * coupling
        residual[n] = float((r.reach - problem.height)[0]) + give * point.lam
        return matrix, residual, at, r, rate

    def slopes(self, point: _Point, change: Array, at: ritz.Points, r: ritz.Reduced, rate: Array) -> Array:
        n = len(point.c)
        de, dq = self.grid.strain(change[:n, None])
        lam = point.lam + change[n]
        out: Array = r.hw * (lam / self.grid.radius - r.gw - r.kqw * dq - r.kew * de - rate * change[n + 1])
        return out

    def tangent(self, matrix: Array, before: Array | None) -> Array:
        """Unit tangent in scaled unknowns, on from ``before``."""
        scaled = matrix * self.scale
        _, _, vt = np.linalg.svd(scaled)
        t: Array = vt[-1]
        if before is None:
            return t if t[-1] > 0.0 else -t
        return t if float(t @ before) > 0.0 else -t

    def correct(self, point: _Point, direction: Array, origin: Array, length: float) -> _Point | None:
        """Newton on the equilibrium and on the plane ``direction . (u - origin) = length``."""
        n = len(point.c)
        for _ in range(CORRECTIONS):
            matrix, residual, at, r, rate = self.system(point)
            u = self.unknowns(point)
            bordered = np.vstack((matrix * self.scale, direction))
            rhs = -np.concatenate((residual, [float(direction @ (u - origin)) - length]))
            try:
                change = np.linalg.solve(bordered, rhs) * self.scale
            except np.linalg.LinAlgError:
                return None
            dw = self.slopes(point, change, at, r, rate)
            size = float(np.abs(dw / point.w).max())
            if not size < 1.0:
                return None
            point = _Point(
                point.c + change[:n],
                point.w + dw,
                point.lam + float(change[n]),
                point.parameter + float(change[n + 1]),
                *point.rest(),
            )
            if size < 1e-9:
                return self.finish(point, direction)
        return None

    def finish(self, point: _Point, before: Array | None) -> _Point:
        matrix, _, _, r, _ = self.system(point)
        point.tangent = self.tangent(matrix, before)
        lowest = float(np.linalg.eigvalsh(r.condensed()[:, :, 0])[0])
        point.stable = lowest > 0.0 and bool(r.positive[0])
        return point


def vary_voltage(specimen: Specimen, h: float, highest: float, *, points: int = 400) -> Branch:
    """Follow the branch that starts at 0 V at the displacement ``h`` (m), to ``highest`` (V), round every fold."""
    path = _Path(specimen, h, highest, "voltage")
    with np.errstate(all="ignore"):
        return _branch(path, *_follow(path, 0.0, points))


def pull_in(specimen: Specimen, h: float, highest: float) -> float | None:
    """Voltage (V) of the first limit point on the branch from 0 V at ``h`` (m), or None to ``highest``."""
    path = _Path(specimen, h, highest, "voltage")
    with np.errstate(all="ignore"):
        found, _ = _follow(path, 0.0, 400, to_limit=True)
        if found[-1].tangent[-1] >= 0.0:
            return None
        last, end = found[-2], path_length(path, found[-2], found[-1])
        low, high, at_low, at_high = 0.0, end, float(last.tangent[-1]), float(found[-1].tangent[-1])
        best = last
        u = path.unknowns(last)
        for _ in range(40):
            length = low + (high - low) * float(np.clip(at_low / (at_low - at_high), 0.1, 0.9))
            ahead = (u + length * last.tangent) * path.scale
            n = len(last.c)
            share = length / end
            trial = _Point(
                ahead[:n], last.w + share * (found[-1].w - last.w), float(ahead[n]), float(ahead[n + 1]), *best.rest()
            )
            new = path.correct(trial, last.tangent, u, length)
            if new is None:
                break
            best, rate = new, float(new.tangent[-1])
            if rate > 0.0:
                low, at_low = length, rate
            else:
                high, at_high = length, rate
            if abs(rate) < 1e-6:  # the parameter is flat there: it errs by the square
                break
        return path.voltage * math.sqrt(best.parameter)


def vary_displacement(specimen: Specimen, voltage: float, highest: float, *, points: int = 400) -> Branch:
    """Follow the branch at ``voltage`` (V) from 2 % of the displacement ``highest`` (m) to it and round every fold."""
    path = _Path(specimen, highest, voltage, "displacement")
    with np.errstate(all="ignore"):
        return _branch(path, *_follow(path, 0.02, points))


def _follow(path: _Path, first: float, points: int, *, to_limit: bool = False) -> tuple[list[_Point], str]:
    """Points of the branch, at most so many, and why it ends."""
    path.set(first)
    start = refinement.newton(path.problem, path.grid, ritz.guess(path.problem, path.grid), 1e-9)
    if not start.ok[0]:
        raise ValueError("no stable state where the branch should begin: the film is slack or unstable there")
    c = start.state.c[:, 0]
    path.scale[:-2] = max(1e-3, float(np.abs(c).max()))
    path.scale[-2] = float(start.lam[0])
    point = path.finish(_Point(c, start.state.w, float(start.lam[0]), first, np.empty(0), True), None)
    found = [point]
    length = 0.05
    while len(found) < points:
        u = path.unknowns(point)
        ahead = (u + length * point.tangent) * path.scale
        n = len(point.c)
        w = point.w
        if len(found) > 1:
            share = length / max(path_length(path, found[-2], point), 1e-300)
            w = np.maximum(w + min(share, 2.0) * (w - found[-2].w), 0.3 * w)
        trial = _Point(ahead[:n], w, float(ahead[n]), float(ahead[n + 1]), *point.rest())
        new = path.correct(trial, point.tangent, u, length)
        if new is None or float(new.tangent @ point.tangent) < math.cos(TURN):
            length *= 0.5
            if length < 1e-7:
                return found, "the branch cannot be resolved further"
            continue
        if new.lam <= 0.0:
            return found, "the film goes slack"
        found.append(new)
        point = new
        length = min(1.5 * length, 0.1)
        path.rescale(point)
        if to_limit and point.tangent[-1] < 0.0:
            return found, "a limit point"
        if not 0.0 < point.parameter < 1.0:
            return found, "the end of the range"
    return found, f"{points} points"


def path_length(path: _Path, one: _Point, other: _Point) -> float:
    """Distance of two points in scaled unknowns."""
    return float(np.linalg.norm(path.unknowns(other) - path.unknowns(one)))


def _branch(path: _Path, found: list[_Point], ended: str) -> Branch:
    specimen = path.specimen
    parameter = np.array([p.parameter for p in found])
    shear, b = specimen.material.shear_modulus, specimen.ring_radius
    voltage = np.full(len(found), path.voltage)
    h = np.full(len(found), path.h)
    if path.vary == "voltage":
        voltage = path.voltage * np.sqrt(np.maximum(parameter, 0.0))
    else:
        h = path.h * parameter
    area, hoop = [], []
    for p in found:
        path.set(p.parameter)
        at = ritz.evaluate(path.problem, path.grid, State(p.c[:, None], p.w))
        area.append(float(np.exp(-at.log[2]).max()))
        hoop.append(shear * float(at.law.t2.min()))
    rise = np.diff(parameter)
    turns = np.flatnonzero(rise[1:] * rise[:-1] < 0.0) + 1
    return Branch(
        h=h,
        voltage=voltage,
        force=2.0 * np.pi * b * specimen.thickness * shear / specimen.prestretch**2 * np.array([p.lam for p in found]),
        peak_field=voltage / specimen.thickness * np.array(area),
        min_hoop_stress=np.array(hoop),
        stable=np.array([p.stable for p in found]),
        limit_points=tuple(int(i) for i in turns),
        ended=ended,
    )
