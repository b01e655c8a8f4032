"""One taut state in plain Python numbers, for loops that ask for one state at a time.

Arrays of ten numbers cost more to hand to NumPy than to compute with, so the very steps of `model.ritz` and
`model.ladder`, restricted to one element and one state, are written out here once more; a test holds both to each
other's digits. Whatever is not an ordinary taut or mildly wrinkled state is left to them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from math import exp, expm1, log1p

import numpy as np

from model import ladder, output, ritz
from model.law import Array, Evaluations

Floats = list[float]
MOST_MODES = 12
MOST_STEPS = 8


@dataclass(frozen=True, slots=True)
class Film:
    """One state, dimensionless."""

    terms: tuple[tuple[float, float, float], ...]  # mu/G, alpha, their product
    field: float  # eps (V/T)^2 / G
    log_prestretch: float
    span: float
    height: float


@dataclass(slots=True)
class Found:
    """The state, and what `model.output.Extremes` has."""

    modes: int
    c: Floats
    w: Floats
    lam: float
    error: float
    steps: int
    log_area: float
    radius: float
    hoop: float
    meridional: float
    log_stretch: float
    softening: float


@dataclass(frozen=True, slots=True)
class _Lists:
    """A table of `model.ritz` as lists."""

    points: int
    below: Floats  # (1 - xi)/2
    weight: Floats
    values: Array  # (2Q, N)
    project: Array  # (N, 2Q)
    pairs: Array  # (N(N+1)/2, 3Q)
    ends: Array  # (2, Q)
    tests: tuple[Floats, Floats, Floats, Floats]
    fine: Array


@lru_cache(maxsize=32)
def _lists(modes: int) -> _Lists:
    t = ritz.table(modes)
    (disk, disk_slope), (ring, ring_slope) = output.edge_tests(modes)
    return _Lists(
        points=t.points,
        below=(0.5 * (1.0 - t.xi)).tolist(),
        weight=t.weight.tolist(),
        values=np.ascontiguousarray(t.values[:, :modes]),
        project=np.ascontiguousarray(t.project[:modes]),
        pairs=np.ascontiguousarray(t.pairs[: modes * (modes + 1) // 2]),
        ends=t.ends,
        tests=(disk.tolist(), disk_slope.tolist(), ring.tolist(), ring_slope.tolist()),
        fine=output.fine_table(modes),
    )


def _stress(film: Film, log1: float, log2: float) -> tuple[float, float, float, float, float, float]:
    """t1, t2, h11, h12, h22 and the Maxwell stress; see `model.law`."""
    log3 = -(log1 + log2)
    t1 = t2 = 0.0
    h11 = h22 = 4.0  # sum mu alpha = 2 in units of G
    h12 = 2.0
    for mu, alpha, product in film.terms:
        x, y, z = expm1(alpha * log1), expm1(alpha * log2), expm1(alpha * log3)
        t1 += mu * (x - z)
        t2 += mu * (y - z)
        h11 += product * (x + z)
        h22 += product * (y + z)
        h12 += product * z
    if film.field == 0.0:
        return t1, t2, h11, h12, h22, 0.0
    b = film.field * exp(-2.0 * log3)
    return t1 - b, t2 - b, h11 - 2.0 * b, h12 - 2.0 * b, h22 - 2.0 * b, b


class _Solver:
    """Newton at one resolution after the other."""

    def __init__(self, film: Film, count: Evaluations) -> None:
        self.film = film
        self.count = count

    def lay(self, modes: int) -> None:
        self.modes, self.lists = modes, _lists(modes)
        half = 0.5 * self.film.span
        self.dxi = 1.0 / half
        self.radius = [exp(-self.film.span * depth) for depth in self.lists.below]
        self.once = [r * weight * half for r, weight in zip(self.radius, self.lists.weight, strict=True)]

    def guess(self) -> tuple[Floats, Floats]:
        """`model.ritz.guess`."""
        film = self.film
        mean = film.height / -expm1(-film.span)
        square = mean * mean
        t1, _, h11, _, _, _ = _stress(film, film.log_prestretch + 0.5 * log1p(square), film.log_prestretch)
        part = square / (1.0 + square)
        power = 1.0 - 2.0 * part + part * h11 / t1 if t1 > 0.0 else 1.0
        rate = film.span / (power if power > 0.5 else 1.0)
        w = [exp(rate * depth) for depth in self.lists.below]
        scale = film.height / sum(o * x for o, x in zip(self.once, w, strict=True))
        return [0.0] * self.modes, [scale * x for x in w]

    def carried(self, near: Found) -> tuple[Floats, Floats]:
        """Another state of such a film, its slopes raised to the height of this one."""
        c = near.c[: self.modes] + [0.0] * (self.modes - near.modes)
        w = (ritz.transfer(near.modes, self.modes) @ near.w).tolist()
        scale = self.film.height / sum(o * x for o, x in zip(self.once, w, strict=True))
        return c, [scale * x for x in w]

    def step(self, c: Floats, w: Floats) -> tuple[Floats, Floats, float, float, bool, float]:
        """State after a Newton step, force, largest change of a slope, stability, tail; as in `model.ritz`."""
        film, lists, dxi = self.film, self.lists, self.dxi
        points, modes = lists.points, self.modes
        lnlp, terms, field = film.log_prestretch, film.terms, film.field
        strain = (lists.values @ c).tolist()
        self.count.mechanical += points
        if field != 0.0:
            self.count.electric += points
        products = [0.0] * (3 * points)
        vectors = [0.0] * (4 * points)
        give = miss = rest = 0.0
        kept = []
        stable = True
        for i, (slope, once, radius) in enumerate(zip(w, self.once, self.radius, strict=True)):
            e = strain[i]
            q = e + strain[points + i] * dxi
            g = q * (q + 2.0) + slope * slope
            metric = 1.0 + g
            log1 = 0.5 * log1p(g) + lnlp
            log2 = log1p(e) + lnlp
            log3 = -(log1 + log2)
            t1 = t2 = 0.0
            h11 = h22 = 4.0
            h12 = 2.0
            for mu, alpha, product in terms:
                x, y, z = expm1(alpha * log1), expm1(alpha * log2), expm1(alpha * log3)
                t1 += mu * (x - z)
                t2 += mu * (y - z)
                h11 += product * (x + z)
                h22 += product * (y + z)
                h12 += product * z
            if field != 0.0:
                b = field * exp(-2.0 * log3)
                t1 -= b
                t2 -= b
                rest = max(rest, abs(b / t1))
                b += b
                h11 -= b
                h12 -= b
                h22 -= b
            along, down, around = (1.0 + q) / metric, slope / metric, 1.0 / (1.0 + e)
            tm = t1 / metric
            d = h11 - 2.0 * t1
            kww = d * down * down + tm
            if kww <= 0.0:
                stable = False
            hw = 1.0 / kww
            kqw = d * down * along
            h12a = h12 * around
            kew = h12a * down
            gw = t1 * down
            twice = once * radius
            thw = tm * hw
            qq = twice * (d / metric + tm) * thw
            eq = twice * h12a * along * thw
            mixed = (qq + eq) * dxi
            products[i] = twice * ((h22 - t2) * around * around - kew * kew * hw) + eq + eq + qq
            products[points + i] = mixed
            products[2 * points + i] = qq * dxi * dxi
            hg = hw * gw
            on_q = once * hw * kqw
            vectors[2 * i] = once * hw * kew + on_q
            vectors[2 * (points + i)] = on_q * dxi
            on_q = twice * (t1 * along - hg * kqw)
            vectors[2 * i + 1] = twice * (t2 * around - hg * kew) + on_q
            vectors[2 * (points + i) + 1] = on_q * dxi
            give += once * hw / radius
            miss += once * (hg - slope)
            kept.append((hw, gw, kqw, kew))
        lam0 = (film.height + miss) / give
        packed = (lists.pairs @ products).tolist()
        pairs = (lists.project @ np.array(vectors).reshape(-1, 2)).tolist()
        dc, diagonal, positive = _eliminate(packed, pairs, give, lam0, modes)
        lam = lam0 + sum(pair[0] * x for pair, x in zip(pairs, dc, strict=True)) / give
        change_of = (lists.values @ dc).tolist()
        largest = 0.0
        new = []
        for i, (hw, gw, kqw, kew) in enumerate(kept):
            de = change_of[i]
            dw = hw * (lam / self.radius[i] - gw - kqw * (de + change_of[points + i] * dxi) - kew * de)
            change = abs(dw / w[i])
            if not change <= largest:
                largest = change
            new.append(w[i] + dw)
        largest *= math.sqrt(max(1.0, rest))
        moved = [x + dx for x, dx in zip(c, dc, strict=True)]
        tail = moved[-1] ** 2 * diagonal[-1] + 0.1 * moved[-2] ** 2 * diagonal[-2]
        return moved, new, lam, largest, stable and positive, 0.5 * tail / (lam * film.height)

    def refine(self, c: Floats, w: Floats, modes: int) -> tuple[Floats, Floats]:
        """The same state with more modes."""
        carried = (ritz.transfer(self.modes, modes) @ w).tolist()
        padded = c + [0.0] * (modes - self.modes)
        self.lay(modes)
        return padded, carried

    def found(self, c: Floats, w: Floats, lam: float, error: float, steps: int) -> Found | None:
        """Extremes of the state, as in `model.output`."""
        film, lists, dxi = self.film, self.lists, self.dxi
        points = lists.points
        strain = (lists.values @ c).tolist()
        self.count.mechanical += points
        if film.field != 0.0:
            self.count.electric += points
        columns: tuple[Floats, ...] = ([], [], [], [], [])
        areas, hoops, meridionals, logs1, logs2 = columns
        disk, disk_slope, ring, ring_slope = lists.tests
        at_disk = at_ring = softening = 0.0
        for i in range(points):
            e = strain[i]
            q = e + strain[points + i] * dxi
            g = q * (q + 2.0) + w[i] * w[i]
            log1 = 0.5 * log1p(g) + film.log_prestretch
            log2 = log1p(e) + film.log_prestretch
            t1, t2, h11, _, _, b = _stress(film, log1, log2)
            twice = self.once[i] * self.radius[i]
            on_q = twice * t1 * (1.0 + q) / (1.0 + g)
            both = twice * t2 / (1.0 + e) + on_q
            at_disk += disk[i] * both + disk_slope[i] * on_q * dxi
            at_ring += ring[i] * both + ring_slope[i] * on_q * dxi
            softening = max(softening, 2.0 * b / (h11 + 2.0 * b))
            areas.append(log1 + log2)
            hoops.append(-t2)
            meridionals.append(-t1)
            logs1.append(log1)
            logs2.append(log2)
        inner = exp(-film.span)
        pulls = (math.hypot(at_disk, lam * inner) / (inner * inner), math.hypot(at_ring, lam))
        starts = (lists.ends @ logs1).tolist()
        edges = [self.edge(pull, start) for pull, start in zip(pulls, starts, strict=True)]
        if None in edges:
            return None
        best, where = [], 0.0
        for kind, column in enumerate(columns):
            ends = [edge[kind] for edge in edges if edge is not None]
            top = max(ends)
            place = 0.0 if ends[0] >= ends[1] else 1.0
            if max(column) > top:
                inside, share = _peak(lists.fine, column)
                if inside > top:
                    top, place = inside, share
            if kind == 0:
                where = exp(-film.span * (1.0 - place))
            best.append(top)
        return Found(self.modes, c, w, lam, error, steps, best[0], where, -best[1], -best[2], max(best[3:]), softening)

    def edge(self, pull: float, start: float) -> tuple[float, float, float, float, float] | None:
        """The five kinds of values at a clamped edge, from the nominal stress there."""
        lnlp = self.film.log_prestretch
        log1 = start
        for _ in range(3):
            t1, _, h11, _, _, _ = _stress(self.film, log1, lnlp)
            factor = exp(lnlp - log1)
            step = (pull - t1 * factor) / ((h11 - t1) * factor)
            log1 += step
            if abs(step) < 1e-7:  # the next one would be its square
                break
        if not abs(log1 - start) < 0.1 + 0.5 * abs(start - lnlp):
            return None
        t1, t2, _, _, _, _ = _stress(self.film, log1, lnlp)
        return log1 + lnlp, -t2, -t1, log1, lnlp


def _peak(fine: Array, column: Floats) -> tuple[float, float]:
    """Largest value between the points and its share of the way from the disk (in ln R); see `model.output`."""
    values = (fine @ column).tolist()
    last = len(values) - 1
    top = max(range(last + 1), key=values.__getitem__)
    place = min(max(top, 1), last - 1)
    low, mid, high = values[place - 1 : place + 2]
    curve = low - 2.0 * mid + high
    shift = min(max(0.5 * (low - high) / curve, -1.0), 1.0) if curve < 0.0 else 0.0
    peak = max(values[top], mid - 0.25 * (low - high) * shift)
    return peak, 0.5 * (1.0 - math.cos((place + shift) * math.pi / last))


def _eliminate(
    packed: Floats, pairs: list[Floats], give: float, lam0: float, modes: int
) -> tuple[Floats, Floats, bool]:
    """Solve the reduced system; also its diagonal and whether it is positive definite."""
    rows = []
    at = 0
    for i in range(modes):
        share = pairs[i][0] / give
        rows.append([packed[at + j] + share * pairs[j][0] for j in range(i + 1)])
        at += i + 1
    diagonal = [row[-1] for row in rows]
    right = [-(pair[1] + lam0 * pair[0]) for pair in pairs]
    positive = True
    # L D L^T in place: below the diagonal L, on it D.
    for i, row in enumerate(rows):
        for j in range(i):
            other = rows[j]
            total = row[j]
            for k in range(j):
                total -= row[k] * other[k]
            row[j] = total
        total = row[i]
        for j in range(i):
            factor = row[j] / rows[j][j]
            total -= factor * row[j]
            row[j] = factor
        if not total > 0.0:
            positive = False
            total = total or math.nan
        row[i] = total
        for j in range(i):
            right[i] -= row[j] * right[j]
    for i in range(modes - 1, -1, -1):
        total = right[i] / rows[i][i]
        for k in range(i + 1, modes):
            total -= rows[k][i] * right[k]
        right[i] = total
    return right, diagonal, positive


def solve(film: Film, tolerance: float, count: Evaluations, near: Found | None = None) -> Found | None:
    """The state to ``tolerance``, or None when it is not an easy one; ``near`` is a state to begin from."""
    if film.span > ritz.LONGEST:
        return None
    try:
        return _climb(_Solver(film, count), tolerance, near)
    except (ValueError, OverflowError, ZeroDivisionError):
        return None


def _climb(solver: _Solver, tolerance: float, near: Found | None) -> Found | None:
    goal = ladder.goal(tolerance)
    modes = max(2, ladder.first_modes(solver.film.span, tolerance))
    solver.lay(modes)
    c, w = solver.guess() if near is None else solver.carried(near)
    previous = math.nan
    steps = 0
    while modes <= MOST_MODES:
        for _ in range(MOST_STEPS):
            c, w, lam, change, stable, tail = solver.step(c, w)
            steps += 1
            if not change <= 0.8 or min(w) <= 0.0:
                return None
            if change <= goal:
                break
        else:
            return None
        if not (stable and lam > 0.0):
            return None
        error = ladder.estimate(lam, previous, change, tail, tolerance)
        if error <= tolerance:
            return solver.found(c, w, lam, error, steps)
        previous = lam
        modes = ladder.next_modes(modes)
        c, w = solver.refine(c, w, modes)
    return None
