"""Extremes of one state, in plain Python numbers: `model.membrane.output` written out once more, as
`model.membrane.scalar` is."""

from __future__ import annotations

import math
from math import exp, log1p
from typing import TYPE_CHECKING

from model.membrane.output import FAR, FINE, HOOP, MORE_OF_WAY, POLISH, WAY, series
from model.membrane.scalar_state import Cone, Film, Floats, Found, NotOrdinary, Panel, Tables, stress

if TYPE_CHECKING:
    from model.membrane.scalar import Solver

Values = tuple[float, float, float, float, float]  # ln(l1 l2), -sigma2, -sigma1, ln l1, ln l2


def found(solver: Solver, lam: float, error: float, steps: int) -> Found:
    """Extremes of the state, as in `model.membrane.output`."""
    edges: list[Values] = []
    inside = []
    softening = 0.0
    parts: list[Panel | Cone] = [*solver.panels, *solver.cones]
    for part in sorted(parts, key=lambda part: part.number):
        columns, ends, soft = _taut(solver, part, lam) if isinstance(part, Panel) else _wrinkled(solver, part)
        edges += ends
        inside.append(columns)
        softening = max(softening, soft)
    best, where = [], 0.0
    for kind in range(5):
        ring = edges[1][kind] > edges[0][kind]
        top, place = edges[ring][kind], solver.breaks[-1 if ring else 0]
        for number, columns in enumerate(inside):
            if max(columns[kind]) > top:
                value, share = _peak(solver.tables, columns[kind])
                if value > top:
                    left, right = solver.breaks[number : number + 2]
                    top, place = value, left + share * (right - left)
        if kind == 0:
            where = exp(place)
        best.append(top)
    if solver.film.field != 0.0:
        softening = max(softening, _softened(solver, edges, inside))
    return Found(
        solver.modes,
        solver.breaks,
        solver.c,
        solver.panels,
        solver.cones,
        lam,
        error,
        steps,
        log_area=best[0],
        radius=where,
        hoop=-best[1],
        meridional=-best[2],
        log_stretch=max(best[3:]),
        softening=softening,
    )


def _softened(solver: Solver, edges: list[Values], inside: list[tuple[Floats, ...]]) -> float:
    """As `model.membrane.output` has it: on the way to the widest point."""
    film = solver.film
    area, log1, log2 = max((edge[0], edge[3], edge[4]) for edge in edges)
    for areas, _, _, logs1, logs2 in inside:
        widest = max(areas)
        if widest > area:
            at = areas.index(widest)
            area, log1, log2 = widest, logs1[at], logs2[at]
    start, softened = film.log_prestretch, 0.0
    shares = WAY if area - 2.0 * start <= FAR else WAY + MORE_OF_WAY
    solver.count.mechanical += len(shares)
    solver.count.electric += len(shares)
    for share in shares:
        _, _, h11, _, h22, b = stress(film, start + share * (log1 - start), start + share * (log2 - start))
        twice = 2.0 * b
        if not (h11 + twice > 0.0 and h22 + twice > 0.0):
            return 1.0
        softened = max(softened, twice / (h11 + twice), HOOP * twice / (h22 + twice))
    return softened


def _taut(solver: Solver, panel: Panel, lam: float) -> tuple[tuple[Floats, ...], list[Values], float]:
    """The five kinds of values at the points of a taut element and at its clamped ends, and its softening."""
    film, tables, dxi = solver.film, solver.tables, panel.dxi
    points = tables.points
    strain = panel.strain
    solver.count.mechanical += points
    if film.field != 0.0:
        solver.count.electric += points
    columns: tuple[Floats, ...] = ([], [], [], [], [])
    areas, hoops, meridionals, logs1, logs2 = columns
    disk, disk_slope, ring, ring_slope = tables.tests
    at_disk = at_ring = softening = 0.0
    for i, (once, radius, w) in enumerate(zip(panel.once, panel.radius, panel.w, strict=True)):
        e = strain[i]
        q = e + strain[points + i] * dxi
        g = q * (q + 2.0) + w * w
        log1 = 0.5 * log1p(g) + film.log_prestretch
        log2 = log1p(e) + film.log_prestretch
        t1, t2, h11, _, _, b = stress(film, log1, log2)
        twice = once * radius
        on_q = twice * t1 * (1.0 + q) / (1.0 + g)
        both = twice * t2 / (1.0 + e) + on_q
        at_disk += disk[i] * both + disk_slope[i] * on_q * dxi
        at_ring += ring[i] * both + ring_slope[i] * on_q * dxi
        if b != 0.0:
            softening = max(softening, 2.0 * b / (h11 + 2.0 * b))
        areas.append(log1 + log2)
        hoops.append(-t2)
        meridionals.append(-t1)
        logs1.append(log1)
        logs2.append(log2)
    panel.tension = [-t2 for t2 in hoops]
    starts = (tables.ends @ logs1).tolist()
    ends = []
    if panel.number == 0:
        inner = exp(solver.breaks[0])
        ends.append(_edge(film, math.hypot(at_disk, lam * inner) / (inner * inner), starts[0]))
    if panel.number == len(solver.breaks) - 2:
        ends.append(_edge(film, math.hypot(at_ring, lam), starts[1]))
    return columns, ends, softening


def _edge(film: Film, pull: float, start: float) -> Values:
    """The five kinds of values at a clamped edge, from the nominal stress there."""
    lnlp = film.log_prestretch
    log1 = start
    for _ in range(3):
        t1, t2, h11, h12, _, _ = stress(film, log1, lnlp)
        factor = exp(lnlp - log1)
        step = (pull - t1 * factor) / ((h11 - t1) * factor)
        log1 += step
        if abs(step) < 1e-6:  # what the tangent leaves is its square
            t1 += h11 * step
            t2 += h12 * step
            break
    else:
        t1, t2, _, _, _, _ = stress(film, log1, lnlp)
    if not abs(log1 - start) < 0.1 + 0.5 * abs(start - lnlp):
        raise NotOrdinary
    return log1 + lnlp, -t2, -t1, log1, lnlp


def _wrinkled(solver: Solver, fold: Cone) -> tuple[tuple[Floats, ...], list[Values], float]:
    """As `taut`, of a wrinkled element."""
    film, tables = solver.film, solver.tables
    us, naturals = (tables.ends @ fold.u).tolist(), (tables.ends @ fold.natural).tolist()
    ends = []
    if fold.number == 0:
        ends.append(_folded(film, us[0], naturals[0], -fold.pull / fold.ends[0])[0])
    if fold.number == len(solver.breaks) - 2:
        ends.append(_folded(film, us[1], naturals[1], fold.pull / fold.ends[1])[0])
    rows = []
    softening = 0.0
    for u, natural, radius in zip(fold.u, fold.natural, fold.radius, strict=True):
        values, soft = _folded(film, u, natural, fold.pull / radius)
        rows.append(values)
        softening = max(softening, soft)
    solver.count.mechanical += tables.points
    solver.count.relaxed += tables.points
    if film.field != 0.0:
        solver.count.electric += tables.points
    return tuple(list(column) for column in zip(*rows, strict=True)), ends, softening


def _folded(film: Film, u: float, natural: float, s1: float) -> tuple[Values, float]:
    """The five kinds of values where a fold's nominal stress is ``s1``, and its softening."""
    lnlp = film.log_prestretch
    for _ in range(2):
        t1, t2, h11, h12, h22, b = stress(film, u + lnlp, natural)
        change, follow = -t2 / h22, -h12 / h22
        t1 += h12 * change
        h11 += h12 * follow
        du = (s1 * exp(u) - t1) / (h11 - t1)
        u += du
        natural += change + follow * du
        if abs(du) + abs(change) < 1e-7:
            break
    return (u + lnlp + natural, 0.0, -s1 * exp(u), u + lnlp, natural), 2.0 * b / (h11 + 2.0 * b)


def _peak(tables: Tables, column: Floats) -> tuple[float, float]:
    """Largest value between the points and its share of the way from the disk (in ln R); see
    `model.membrane.output`."""
    values = (tables.fine @ column).tolist()
    top = max(range(len(values)), key=values.__getitem__)
    low, xi, high = (-math.cos(min(max(top + k, 0), FINE - 1) * math.pi / (FINE - 1)) for k in (-1, 0, 1))
    c = (tables.to_legendre @ column).tolist()
    for _ in range(POLISH):
        value, slope, curve = series(c, xi)
        if curve >= 0.0:
            return value, 0.5 * (1.0 + xi)
        step = slope / curve
        if abs(step) < 1e-3:  # the parabola there errs by its cube
            return value - 0.5 * slope * step, 0.5 * (1.0 + xi - step)
        xi = min(max(xi - step, low), high)
    return series(c, xi)[0], 0.5 * (1.0 + xi)
