"""One state in plain Python numbers, for loops that ask for one state at a time.

Arrays of ten numbers cost more to hand to NumPy than to compute with, so the very steps of `model.membrane.ritz`,
`model.membrane.wrinkled_cone`,
`model.membrane.tension_field` and `model.membrane.refinement`, restricted to one state, are written out here once
more; a test holds both to each other's digits. Whatever is not an ordinary state is left to them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from math import exp, expm1, log1p

import numpy as np

from model.arrays import Array
from model.material.law import Evaluations
from model.membrane import refinement, ritz, tension_field, wrinkled_cone
from model.membrane.scalar_output import found
from model.membrane.scalar_state import Cone, Film, Floats, Found, NotOrdinary, Panel, places, stress, tables_of

MOST_MODES = 12
MOST_STEPS = 8
# Largest relative change of a slope in one step; a larger one is left to the methods that shorten steps.
LARGEST_CHANGE = 0.8
LARGEST_CHANGE_WRINKLED = 20.0


@dataclass(slots=True)
class _System:
    """Newton's system, `model.membrane.ritz.Reduced`; of the matrix the lower triangle."""

    rows: list[Floats]
    residual: Floats
    coupling: Floats
    give: float = 0.0
    reach: float = 0.0

    def add(self, place: list[int], sums: Floats, cut: bool) -> None:
        """Add an element's matrix, its lower triangle in one row, coupling, residual; without a ``cut`` it is all."""
        size = len(place)
        pairs = size * (size + 1) // 2
        if not cut:
            self.rows = [sums[i * (i + 1) // 2 : (i + 1) * (i + 2) // 2] for i in range(size)]
            self.coupling, self.residual = sums[pairs : pairs + size], sums[pairs + size :]
            return
        at = 0
        for i, row in enumerate(place):
            if row >= 0:
                self.coupling[row] += sums[pairs + i]
                self.residual[row] += sums[pairs + size + i]
            for column in place[: i + 1]:
                if row >= column >= 0:
                    self.rows[row][column] += sums[at]
                elif column > row >= 0:
                    self.rows[column][row] += sums[at]
                at += 1


@dataclass(slots=True)
class _Strip:
    """A linearised panel: what its slopes follow with, and how its hoop stress turns when there are cuts."""

    kept: list[tuple[float, float, float, float]]
    turns: list[tuple[float, float, float]]


@dataclass(slots=True)
class _Spring:
    """A linearised cone, see `model.membrane.wrinkled_cone.Springs`."""

    at: list[tuple[float, float, float, float, float]]  # at points: S1, du/dS1, l1/lp, change of width, its rate
    miss: float
    soft: float
    skew: float
    share: float


class Solver:
    """Newton at one resolution after the other."""

    def __init__(self, film: Film, count: Evaluations) -> None:
        self.film = film
        self.count = count
        self.breaks = [-film.span, 0.0]
        self.c: Floats = []
        self.panels: list[Panel] = []
        self.cones: list[Cone] = []

    def use(self, modes: int) -> None:
        """Tables of so many modes."""
        self.modes, self.tables = modes, tables_of(modes, len(self.breaks) > 2)

    def lay(self) -> None:
        """Radii and weights of the elements between the breaks."""
        tables = self.tables
        parts: list[Panel | Cone] = [*self.panels, *self.cones]
        for part in parts:
            left, right = self.breaks[part.number], self.breaks[part.number + 1]
            length = right - left
            half = 0.5 * length
            part.radius = [exp(right - length * depth) for depth in tables.below]
            part.once = [r * weight * half for r, weight in zip(part.radius, tables.weight, strict=True)]
            if isinstance(part, Panel):
                part.dxi = 1.0 / half
            else:
                part.ends = (-exp(left), exp(right))

    def strains(self, panel: Panel, c: Floats) -> Floats:
        """Sum of the panel's functions at the points, and its derivative in xi."""
        local = [c[i] if i >= 0 else 0.0 for i in panel.place] if self.cones else c
        values: Floats = (self.tables.values @ local).tolist()
        return values

    def begin(self, modes: int, near: Found | None) -> None:
        """The plain state to begin with: `model.membrane.ritz.guess`, or ``near`` with its slopes raised to the
        height."""
        self.use(modes)
        panel = Panel(0, [], places(modes, 1, (0,))[0])
        self.panels = [panel]
        self.lay()
        film = self.film
        if near is None:
            mean = film.height / -expm1(-film.span)
            square = mean * mean
            t1, _, h11, _, _, _ = stress(film, film.log_prestretch + 0.5 * log1p(square), film.log_prestretch)
            part = square / (1.0 + square)
            power = 1.0 - 2.0 * part + part * h11 / t1 if t1 > 0.0 else 1.0
            rate = film.span / (power if power > 0.5 else 1.0)
            self.c = [0.0] * modes
            panel.strain = [0.0] * (2 * self.tables.points)
            w = [exp(rate * depth) for depth in self.tables.below]
        else:
            self.c = near.c[:modes] + [0.0] * (modes - near.modes)
            panel.strain = self.strains(panel, self.c)
            w = (ritz.transfer(near.modes, modes) @ near.panels[0].w).tolist()
        scale = film.height / sum(o * x for o, x in zip(panel.once, w, strict=True))
        panel.w = [scale * x for x in w]

    def step(self, goal: float) -> tuple[float, float, float]:
        """A Newton step: force, largest relative change, tail; as in `model.membrane.ritz` and
        `model.membrane.tension_field`."""
        film, modes, c = self.film, self.modes, self.c
        cut = bool(self.cones)
        n = len(c) if cut else 0  # without cuts the only element brings its own
        system = _System([[0.0] * (i + 1) for i in range(n)], [0.0] * n, [0.0] * n)
        self.stable, self.maxwell_share, self.top = True, 1.0, -math.inf
        strips = [self.strip(panel, system) for panel in self.panels]
        springs = [self.spring(fold, system) for fold in self.cones] if cut else []
        lam0 = (film.height - system.reach) / system.give
        dc, diagonal, positive = _eliminate(system, lam0)
        self.stable = self.stable and positive
        lam = lam0 + sum(x * y for x, y in zip(system.coupling, dc, strict=True)) / system.give
        self.c = [x + y for x, y in zip(c, dc, strict=True)]
        largest = stretched = tail = 0.0
        extent = 1e-300
        for panel, strip in zip(self.panels, strips, strict=True):
            change, dq, reach = self.follow(panel, strip, dc, lam)
            if not change <= largest:
                largest = change
            if cut:
                stretched, extent = max(stretched, dq), max(extent, reach)
            last, fore = panel.place[modes - 1], panel.place[modes - 2]
            tail += self.c[last] ** 2 * diagonal[last] + 0.1 * self.c[fore] ** 2 * diagonal[fore]
        largest *= math.sqrt(self.maxwell_share)
        if cut:
            bent = max(self.bend(fold, spring, dc, lam) for fold, spring in zip(self.cones, springs, strict=True))
            largest = max(largest, stretched / extent, bent)
            breaks, shift = self.moved()
            largest = max(largest, tension_field.CUT_WEIGHT * shift)
            if largest > goal:
                self.breaks = breaks
                self.lay()
        return lam, largest, 0.5 * tail / (lam * film.height)

    def strip(self, panel: Panel, system: _System) -> _Strip:
        """Add a taut element to ``system``; its strains, and what its slopes follow with."""
        film, tables, dxi, cut = self.film, self.tables, panel.dxi, bool(self.cones)
        points = tables.points
        lnlp, law, field = film.log_prestretch, film.law, film.field
        strain = panel.strain
        self.count.mechanical += points
        if field != 0.0:
            self.count.electric += points
        p2, p3, p4, p5, p6 = 2 * points, 3 * points, 4 * points, 5 * points, 6 * points
        sums = [0.0] * (7 * points)
        give = reach = rest = 0.0
        top = self.top
        kept = []
        turns = []
        tension = []
        places = zip(panel.w, panel.once, panel.radius, strain[:points], strain[points:], strict=True)
        for i, (slope, once, radius, e, rise) in enumerate(places):
            q = e + rise * dxi
            g = q * (q + 2.0) + slope * slope
            metric = 1.0 + g
            log1 = 0.5 * log1p(g) + lnlp
            log2 = log1p(e) + lnlp
            t1, t2, h11, h12, h22 = law(log1, log2)
            if field != 0.0:
                b = field * exp(2.0 * (log1 + log2))
                t1 -= b
                t2 -= b
                share = abs(b / t1)
                if share > rest:
                    rest = share
                b += b
                h11 -= b
                h12 -= b
                h22 -= b
            tension.append(t2)
            if t1 > top:
                top = t1
            along, down, around = (1.0 + q) / metric, slope / metric, 1.0 / (1.0 + e)
            tm = t1 / metric
            d = h11 - 2.0 * t1
            kww = d * down * down + tm
            if kww <= 0.0:
                self.stable = False
            hw = 1.0 / kww
            kqw = d * down * along
            h12a = h12 * around
            kew = h12a * down
            gw = t1 * down
            twice = once * radius
            thw = tm * hw
            qq = twice * (d / metric + tm) * thw
            eq = twice * h12a * along * thw
            sums[i] = twice * ((h22 - t2) * around * around - kew * kew * hw) + eq + eq + qq
            sums[points + i] = (qq + eq) * dxi
            sums[p2 + i] = qq * dxi * dxi
            hg = hw * gw
            on_q = once * hw * kqw
            sums[p3 + i] = once * hw * kew + on_q
            sums[p4 + i] = on_q * dxi
            on_q = twice * (t1 * along - hg * kqw)
            sums[p5 + i] = twice * (t2 * around - hg * kew) + on_q
            sums[p6 + i] = on_q * dxi
            give += once * hw / radius
            reach += once * (slope - hg)
            kept.append((hw, gw, kqw, kew))
            if cut:
                turns.append((h12 * along, h12 * down, h22 * around))
        panel.tension = tension
        self.top = top
        self.maxwell_share = max(self.maxwell_share, rest)
        system.give += give
        system.reach += reach
        system.add(panel.place, (tables.assemble @ sums).tolist(), cut)
        return _Strip(kept, turns)

    def follow(self, panel: Panel, strip: _Strip, dc: Floats, lam: float) -> tuple[float, float, float]:
        """The slopes after the step: largest relative change of them, largest change of dr/dR, size of the strains."""
        points, dxi = self.tables.points, panel.dxi
        change_of = self.strains(panel, dc)
        largest = stretched = extent = 0.0
        old, new = panel.w, []
        for i, (hw, gw, kqw, kew) in enumerate(strip.kept):
            de = change_of[i]
            w = old[i]
            dw = hw * (lam / panel.radius[i] - gw - kqw * (de + change_of[points + i] * dxi) - kew * de)
            change = abs(dw / w)
            if not change <= largest:
                largest = change
            new.append(w + dw)
        panel.w = new
        if min(new) <= 0.0:
            raise NotOrdinary
        for i, (on_q, on_w, on_e) in enumerate(strip.turns):
            de = change_of[i]
            dq = de + change_of[points + i] * dxi
            stretched = max(stretched, abs(dq))
            extent = max(extent, abs(panel.strain[i] + panel.strain[points + i] * dxi) + old[i] ** 2)
            panel.tension[i] += on_q * dq + on_w * (new[i] - old[i]) + on_e * de
        panel.strain = [x + dx for x, dx in zip(panel.strain, change_of, strict=True)]
        return largest, stretched, extent

    def spring(self, fold: Cone, system: _System) -> _Spring:
        """Add a wrinkled element to ``system``: `model.membrane.wrinkled_cone.Springs.of` and `join`."""
        film = self.film
        self.count.mechanical += self.tables.points
        self.count.relaxed += self.tables.points
        if film.field != 0.0:
            self.count.electric += self.tables.points
        share = 1.0
        at = []
        for u, natural in zip(fold.u, fold.natural, strict=True):
            t1, t2, h11, h12, h22, b = stress(film, u + film.log_prestretch, natural)
            share = max(share, abs(b / t1))
            follow, change = -h12 / h22, -t2 / h22
            t1 += h12 * change
            h11 += h12 * follow
            stretch = exp(u)
            if h22 <= 0.0 or h11 <= t1:
                raise NotOrdinary
            at.append((t1 / stretch, stretch / (h11 - t1), stretch, change, follow))
        if math.isnan(fold.pull):
            weighted = sum(o * r * x[0] for o, r, x in zip(fold.once, fold.radius, at, strict=True))
            fold.pull = weighted / sum(fold.once)
        excess = axial = 0.0
        for u, once, radius, (s1, rate, stretch, _, _) in zip(fold.u, fold.once, fold.radius, at, strict=True):
            excess += once * (expm1(u) + stretch * rate * (fold.pull / radius - s1))
            axial += once / radius * stretch * rate
        cos, sin, pull = fold.cos, fold.sin, fold.pull
        length = fold.ends[0] + fold.ends[1]
        across = (length + excess) / pull
        soft = axial * cos * cos + across * sin * sin
        skew = (axial - across) * cos * sin
        give = axial * across / soft
        own = [(place, end) for place, end in zip(fold.cut, fold.ends, strict=True) if place >= 0]
        miss = sum(end * self.c[place] for place, end in own)
        miss -= excess * cos - length * sin * sin / (1.0 + cos)
        if not soft > 0.0:
            raise NotOrdinary
        ratio = skew / soft
        force = pull * cos + miss / soft + ratio * pull * sin
        for place, end in own:
            system.residual[place] += end * force
            system.coupling[place] -= end * ratio
            for beside, other in own:
                if beside <= place:
                    system.rows[place][beside] += end * other / soft
        system.reach += across * pull * sin + ratio * miss - give * pull * sin
        system.give += give
        return _Spring(at, miss, soft, skew, share)

    def bend(self, fold: Cone, spring: _Spring, dc: Floats, lam: float) -> float:
        """A wrinkled element after the step, and its largest relative change:
        `model.membrane.wrinkled_cone.Springs.advance`."""
        moved = sum(end * dc[place] for place, end in zip(fold.cut, fold.ends, strict=True) if place >= 0)
        before = fold.pull * fold.sin
        h = fold.pull * fold.cos + (spring.miss + moved - spring.skew * (lam - before)) / spring.soft
        pull = math.hypot(h, lam)
        size = max(abs(expm1(u)) for u in fold.u) + fold.sin**2
        largest = 0.0
        for i, (s1, rate, _, change, follow) in enumerate(spring.at):
            du = rate * (pull / fold.radius[i] - s1)
            wider = change + follow * du
            largest = max(largest, abs(du), abs(wider))
            fold.u[i] += min(max(du, -0.5), 0.5)
            fold.natural[i] += min(max(wider, -0.5), 0.5)
        fold.cos, fold.sin, fold.pull = h / pull, lam / pull, pull
        return wrinkled_cone.CURVED * max(largest / size, abs(lam / before - 1.0)) * math.sqrt(spring.share)

    def moved(self) -> tuple[Floats, float]:
        """Breaks moved to where the panels' hoop tension vanishes: `model.membrane.tension_field.moved`."""
        breaks = list(self.breaks)
        length = [right - left for left, right in pairwise(self.breaks)]
        folded = {fold.number for fold in self.cones}
        ends, end_slopes = self.tables.ends.tolist(), self.tables.end_slopes.tolist()
        largest = 0.0
        for panel in self.panels:
            number = panel.number
            for end, side in ((0, 1), (1, -1)):
                beside = number - side
                if beside not in folded:
                    continue
                value = _dot(ends[end], panel.tension)
                slope = _dot(end_slopes[end], panel.tension) * panel.dxi * side
                shift = -value / slope * side if slope > 0.0 else math.copysign(0.2 * length[number], -value * side)
                cut = max(number, beside)
                shift = min(max(shift, -0.5 * length[cut - 1]), 0.5 * length[cut])
                breaks[cut] += shift
                largest = max(largest, abs(shift) / min(length[number], length[beside]))
        for cut in range(1, len(breaks) - 1):
            breaks[cut] = min(max(breaks[cut], self.breaks[cut - 1]), self.breaks[cut + 1])
        return breaks, largest

    def fold(self, tolerance: float) -> int:
        """Cut the film, so far one panel, where its hoop tension changes sign; the modes to go on with."""
        film, panel, t = self.film, self.panels[0], ritz.table(self.modes)
        values = (self.tables.fine @ panel.tension).tolist()
        last = len(values) - 1
        breaks = [-film.span]
        for k, (low, high) in enumerate(pairwise(values)):
            if (low < 0.0) != (high < 0.0):
                part = min(max(low / (low - high), 0.05), 0.95)
                share = [0.5 * (1.0 - math.cos((k + i) * math.pi / last)) for i in (0, 1)]
                breaks.append(film.span * (share[0] + part * (share[1] - share[0]) - 1.0))
        first = values[0] < 0.0
        elements = len(breaks)
        breaks.append(0.0)
        if elements > tension_field.MOST_ZONES or (elements == 1 and not first):
            raise NotOrdinary
        modes = max(3, refinement.first_modes(max(right - left for left, right in pairwise(breaks)), tolerance))
        if modes > MOST_MODES:
            raise NotOrdinary
        strain = np.array(panel.strain)
        e, rise = strain[: t.points], strain[t.points :] * panel.dxi
        new = ritz.table(modes)
        x = [left + 0.5 * (right - left) * (new.xi + 1.0) for left, right in pairwise(breaks)]
        to_new = ritz.barycentric(t.xi, 2.0 * (np.concatenate((*x, breaks[1:-1])) / film.span + 1.0) - 1.0)
        carried = to_new @ np.array((e, rise, panel.w)).T
        taut = tuple(range(int(first), elements, 2))
        of_panels = places(modes, elements, taut)
        self.c, self.panels, self.cones, self.breaks = [], [], [], breaks
        self.use(modes)
        for number in range(elements):
            e, slope, w = carried[number * new.points : (number + 1) * new.points].T
            if number in taut:
                half = 0.5 * (breaks[number + 1] - breaks[number])
                self.c += (new.to_modes @ slope * half).tolist()
                self.panels.append(Panel(number, w.tolist(), of_panels[len(self.panels)]))
            else:
                cut = [len(taut) * modes + k - 1 if 0 < k < elements else -1 for k in (number, number + 1)]
                self.cones.append(self.cone(number, e, slope, w, np.exp(x[number]) * new.weight, (cut[0], cut[1])))
        self.c += carried[elements * new.points :, 0].tolist()
        self.lay()
        for panel in self.panels:
            panel.strain = self.strains(panel, self.c)
        return modes

    def cone(self, number: int, e: Array, slope: Array, w: Array, once: Array, cut: tuple[int, int]) -> Cone:
        """A wrinkled element made of a state of the plain equations."""
        film = self.film
        q = e + slope
        across, down = float(once @ (1.0 + q)), float(once @ w)
        long = math.hypot(across, down)
        u = (0.5 * np.log1p(q * (q + 2.0) + w * w)).tolist()
        widths = []
        for log1, log2 in zip(u, (np.log1p(e) + film.log_prestretch).tolist(), strict=True):
            for _ in range(8):
                _, t2, _, _, h22, _ = stress(film, log1 + film.log_prestretch, log2)
                self.count.mechanical += 1
                self.count.relaxed += 1
                if film.field != 0.0:
                    self.count.electric += 1
                if h22 <= 0.0:
                    raise NotOrdinary
                change = -t2 / h22
                log2 += min(max(change, -0.3), 0.3)
                if abs(change) <= wrinkled_cone.NEAR:
                    break
            widths.append(log2)
        return Cone(number, u, widths, across / long, down / long, math.nan, cut)

    def prolong(self, modes: int) -> None:
        """The same state with more modes."""
        carry = ritz.transfer(self.modes, modes)
        taut = tuple(panel.number for panel in self.panels)
        of_panels = places(modes, len(self.breaks) - 1, taut)
        c: Floats = []
        for panel, place in zip(self.panels, of_panels, strict=True):
            c += [self.c[i] for i in panel.place[: self.modes]] + [0.0] * (modes - self.modes)
            panel.place = place
            panel.w = (carry @ panel.w).tolist()
        added = len(c) - len(taut) * self.modes
        c += self.c[len(taut) * self.modes :]
        for fold in self.cones:
            fold.u, fold.natural = (carry @ fold.u).tolist(), (carry @ fold.natural).tolist()
            left, right = (place + added if place >= 0 else -1 for place in fold.cut)
            fold.cut = (left, right)
        self.c = c
        self.use(modes)
        self.lay()
        for panel in self.panels:
            panel.strain = self.strains(panel, c)

    def admissible(self, tolerance: float) -> bool:
        """Whether the zones of the state are those that it was solved with; see
        `model.membrane.tension_field.zones`."""
        t, fine = ritz.table(self.modes), self.tables.fine
        margins = [(-1.0, (fine @ panel.tension).tolist()) for panel in self.panels]
        for fold in self.cones:
            stretch = [expm1(u) for u in fold.u]
            versine = fold.sin * fold.sin / (1.0 + fold.cos)
            rise = [(x * fold.cos - versine) * r for x, r in zip(stretch, fold.radius, strict=True)]
            half = 0.5 * (self.breaks[fold.number + 1] - self.breaks[fold.number])
            left = -fold.ends[0] * self.c[fold.cut[0]] if fold.cut[0] >= 0 else 0.0
            run = (t.integrate @ rise).tolist()
            hoop = [log1p((left + half * x) / r) for x, r in zip(run, fold.radius, strict=True)]
            lnlp = self.film.log_prestretch
            excess = [x + lnlp - natural for x, natural in zip(hoop, fold.natural, strict=True)]
            margins.append((1.0, (fine @ excess).tolist()))
        bound = tension_field.wrong_sign(tolerance) * max(abs(x) for _, values in margins for x in values)
        short = min(right - left for left, right in pairwise(self.breaks)) <= 1e-9 * self.film.span
        return not short and all(sign * x < bound for sign, values in margins for x in values)


def _dot(row: Floats, values: Floats) -> float:
    return sum(x * y for x, y in zip(row, values, strict=True))


def _eliminate(system: _System, lam0: float) -> tuple[Floats, Floats, bool]:
    """Solve the system; also its diagonal and whether it is positive definite."""
    rows, coupling = system.rows, system.coupling
    n = len(rows)
    for i, row in enumerate(rows):
        share = coupling[i] / system.give
        for j in range(i + 1):
            row[j] += share * coupling[j]
    diagonal = [row[-1] for row in rows]
    right = [-(x + lam0 * y) for x, y in zip(system.residual, coupling, strict=True)]
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
    for i in range(n - 1, -1, -1):
        total = right[i] / rows[i][i]
        for k in range(i + 1, n):
            total -= rows[k][i] * right[k]
        right[i] = total
    return right, diagonal, positive


def solve(
    film: Film, tolerance: float, count: Evaluations, *, folds: bool = False, near: Found | None = None
) -> Found | None:
    """The state to ``tolerance``, or None when it is not an easy one; ``near`` is a state to begin from.

    Where the plain equations lose hoop tension the relaxed energy decides if ``folds`` may be.
    """
    if film.span > ritz.LONGEST:
        return None
    try:
        return _refine(Solver(film, count), tolerance, folds, near)
    except (NotOrdinary, ValueError, OverflowError, ZeroDivisionError):
        return None


def _refine(solver: Solver, tolerance: float, folds: bool, near: Found | None) -> Found:
    goal = refinement.goal(tolerance)
    modes = max(2, refinement.first_modes(solver.film.span, tolerance))
    solver.begin(modes, None if near is None or near.cones else near)
    previous, before = math.nan, math.inf
    steps = 0
    while modes <= MOST_MODES:
        for _ in range(MOST_STEPS):
            lam, change, tail = solver.step(goal)
            steps += 1
            if not change <= (LARGEST_CHANGE_WRINKLED if solver.cones else LARGEST_CHANGE):
                raise NotOrdinary
            if change <= goal:
                break
        else:
            raise NotOrdinary
        if folds and not solver.cones and min(solver.panels[0].tension) <= refinement.CLEARLY_NEGATIVE * solver.top:
            modes = solver.fold(tolerance)
            previous = math.nan
            continue
        if not (solver.stable and lam > 0.0):
            raise NotOrdinary
        factor = refinement.CUT_LEVEL_FACTOR if solver.cones else refinement.LEVEL_FACTOR
        error = refinement.estimate(lam, previous, change, tail, tolerance, factor)
        if not solver.panels:
            error += refinement.SOFT_BEFORE_FACTOR * before
            before = abs((lam - previous) / lam) if math.isfinite(previous) else math.inf
        if error <= tolerance:
            answer = found(solver, lam, error, steps)
            if not folds or (solver.cones and solver.admissible(tolerance)):
                return answer
            if solver.cones:
                raise NotOrdinary
            if answer.hoop >= refinement.ROUND_OFF_TENSION * answer.meridional:
                return answer
            modes = solver.fold(tolerance)
            previous = math.nan
            continue
        previous = lam
        modes = refinement.next_modes(modes)
        solver.prolong(modes)
    raise NotOrdinary
