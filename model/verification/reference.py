"""Reference states of the conical film by Taylor-series shooting, a formulation that takes no part in any comparison.

The unknowns are logarithmic strains ``e1 = ln l1``, ``e2 = ln l2`` (total stretches), the slope ``theta`` and the drop
``w`` below the disk, over ``x = ln R`` from the disk to the ring. With true stresses ``s1``, ``s2``, their derivatives
``sij = ds_i/de_j`` and primes for d/dx:

    e2'    = exp(e1 - e2) cos(theta) - 1
    e1'    = ((s2 - s1) + (s2 - s12) e2') / (s11 - s1)
    theta' = -(s2 / s1) exp(e1 - e2) sin(theta)
    w'     = (R / lp) exp(e1) sin(theta)

Where a film may wrinkle (``wrinkling="tension_field"``) and ``s2`` would be negative, the hoop strain that sets the
stress is the natural one, ``n``, with ``s2(e1, n) = 0``; ``theta`` is constant and ``R S1`` is conserved:

    e1' = -s1 s22 / (s11 s22 - s12^2 - s1 s22),    n' = -(s12 / s22) e1'

The edge of the wrinkled zone is located as a root of the local series, and the equations are changed exactly there.

Every step is a power series of order 28 built by recurrence (as in Corliss & Chang, ACM TOMS 8, 114, 1982), with small
differences formed by ``expm1`` so that strains of 1e-16 keep all their digits. The two unknowns ``(e1, theta)`` at the
disk follow from Newton's method on ``(e2 - ln lp, w - h)`` at the ring. They are reached by continuation: first the
height at no voltage and with a little pre-stretch, then down to the wanted pre-stretch, then up to the wanted voltage,
so that the branch is the one that an experiment would reach.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.specimen import Specimen
from model.verification.taylor_series import States, derivative, evaluate, stresses, taut_series, wrinkled_series

Array = NDArray[np.float64]

FINE_ORDER = 28
COARSE_ORDER = 12
FINE_TOLERANCE = 1e-18  # of the first neglected term of a series
COARSE_TOLERANCE = 1e-5
MAX_LEGS = 80  # tries of the continuation
SAMPLES = 12  # points of a step where extremes and changes of zone are looked for


@dataclass(frozen=True)
class Reference:
    """Reference values, arrays with one entry a state; NaN where no state was found.

    ``closure`` is the relative difference of the force at the disk and at the ring, which the exact solution does not
    have: a check on the integration that does not come from the step control.
    """

    force: Array  # N
    peak_field: Array  # V/m
    min_hoop_stress: Array  # Pa, true stress
    min_meridional_stress: Array  # Pa, true stress
    max_stretch: Array  # of either direction; along the film, folds laid flat
    wrinkled: NDArray[np.bool_]  # some part of the film carries no hoop stress
    converged: NDArray[np.bool_]
    closure: Array


def reference(
    specimens: Specimen | Sequence[Specimen], h: ArrayLike, voltage: ArrayLike = 0.0, *, wrinkling: str = "plain"
) -> Reference:
    """Solve one state for each specimen, displacement (m, positive) and voltage (V); the three are broadcast together.

    ``wrinkling`` is ``"plain"`` (the equations of Cao & Conn 2018, whatever the sign of the hoop stress) or
    ``"tension_field"``. Force and extremes are good to about 1e-12 relative where ``converged`` is set. Where hoop
    tension is lost the plain equations have answers that no film has: given then is the branch that leads there.
    The series are sums of exponentials: a law that is no sum of powers of the stretches raises ValueError.
    """
    if wrinkling not in ("plain", "tension_field"):
        raise ValueError(f'wrinkling is "{wrinkling}"; allowed are "plain" and "tension_field"')
    films = np.empty(1 if isinstance(specimens, Specimen) else len(specimens), dtype=object)
    films[:] = [specimens] if isinstance(specimens, Specimen) else list(specimens)
    films, heights, voltages = np.broadcast_arrays(films, np.asarray(h, float), np.asarray(voltage, float))
    heights, voltages = heights.ravel().astype(float), voltages.ravel().astype(float)
    films = films.ravel()
    results = []
    block = 1500
    with np.errstate(all="ignore"):
        for first in range(0, films.size, block):
            part = slice(first, first + block)
            results.append(_solve_block(list(films[part]), heights[part], voltages[part], wrinkling == "tension_field"))
    return Reference(*(np.concatenate(column) for column in zip(*results, strict=True)))


def _solve_block(films: list[Specimen], h: Array, voltage: Array, relaxed: bool) -> tuple[Array, ...]:
    powers = [film.material.powers for film in films]
    terms = max(len(moduli) for moduli, _ in powers)
    mu, alpha = np.zeros((terms, len(films))), np.ones((terms, len(films)))
    for i, (moduli, exponents) in enumerate(powers):
        mu[: len(moduli), i], alpha[: len(moduli), i] = moduli, exponents
    scale = 0.5 * np.sum(mu * alpha, axis=0)
    ring = np.array([film.ring_radius for film in films])
    disk = np.array([film.disk_radius for film in films])
    thickness = np.array([film.thickness for film in films])
    prestretch = np.array([film.prestretch for film in films])
    permittivity = np.array([film.material.permittivity for film in films])
    states = States(
        mu / scale,
        alpha,
        scale,
        permittivity * (voltage / thickness) ** 2 / scale,
        np.log(prestretch),
        np.log(disk / ring),
        h / ring,
        relaxed,
    )
    unknowns, converged = _continue(states)
    path = _integrate(states, unknowns, FINE_ORDER, FINE_TOLERANCE, np.zeros_like(unknowns), extremes=True)
    converged &= path.min_s1 > 0  # pushed together along the meridian, a film is slack: no state
    bad = ~converged
    lateral = 2 * np.pi * ring * thickness / prestretch * scale
    force = lateral * path.pull_at_disk
    values = [
        force,
        np.abs(voltage) / thickness * path.peak_area,
        scale * path.min_s2,
        scale * path.min_s1,
        path.max_stretch,
    ]
    for value in values:
        value[bad] = np.nan
    closure = np.abs(path.pull_at_ring / path.pull_at_disk - 1.0)
    closure[bad] = np.nan
    return (*values, path.wrinkled & converged, converged, closure)


# ---- from the natural state to the wanted one


def _continue(target: States) -> tuple[Array, NDArray[np.bool_]]:
    """Unknowns ``ln e1``, ``ln theta`` at the disk, shape (2, B), and whether they solve the equations."""
    count = target.size
    slope = target.height / (1.0 - np.exp(target.log_disk))
    helped = np.maximum(target.log_prestretch, np.minimum(0.25, 0.25 * slope**2))
    spread = -np.exp(target.log_disk) * target.log_disk  # (a/b) ln(b/a): height over slope at the disk, small heights
    start = np.minimum(0.05 * np.sqrt(helped) * spread, 0.5 * target.height)

    def at(index: NDArray[np.intp], progress: Array) -> States:
        """Leg 0: height, leg 1: pre-stretch, leg 2: voltage."""
        states = target.take(index)
        leg = [np.clip(progress - k, 0.0, 1.0) for k in range(3)]
        final = states.height
        states.height = np.where(leg[0] < 1, start[index] * (final / start[index]) ** leg[0], final)
        wanted = states.log_prestretch
        states.log_prestretch = np.where(leg[1] < 1, helped[index] + leg[1] * (wanted - helped[index]), wanted)
        states.electric = states.electric * leg[2] ** 2
        return states

    everyone = np.arange(count)
    current = np.stack([np.log(helped), np.log(start / spread)])
    progress = np.zeros(count)
    current, solved, upright = _newton(at(everyone, progress), current, COARSE_ORDER, COARSE_TOLERANCE, 1e-4, 20)
    previous, previous_progress = current.copy(), progress.copy()
    leg_lengths = [np.log(target.height / start), np.ones(count), np.ones(count)]
    skip = [np.zeros(count, bool), helped <= target.log_prestretch, target.electric == 0.0]
    step = np.minimum(0.5, 1.0 / leg_lengths[0])
    growth = np.full(count, 2.0)
    alive = solved.copy()
    for _ in range(MAX_LEGS):
        active = np.flatnonzero(alive & (progress < 3.0))
        if active.size == 0:
            break
        leg = np.minimum(np.floor(progress[active]), 2).astype(int)
        skipped = np.choose(leg, [s[active] for s in skip])
        jump = active[skipped]
        progress[jump] = leg[skipped] + 1.0
        previous_progress[jump] = progress[jump]
        active, leg = active[~skipped], leg[~skipped]
        if active.size == 0:
            continue
        aim = np.minimum(progress[active] + step[active], leg + 1.0)
        travelled = progress[active] - previous_progress[active]
        ratio = np.where(travelled > 0, (aim - progress[active]) / np.where(travelled > 0, travelled, 1.0), 0.0)
        guess = current[:, active] + ratio * (current[:, active] - previous[:, active])
        found, good, side = _newton(at(active, aim), guess, COARSE_ORDER, COARSE_TOLERANCE, 1e-4, 5)
        # A fold of the branch, or a leap over one, changes the sign of the determinant.
        good &= (np.max(np.abs(found - guess), axis=0) < 0.5) & (side == upright[active])
        moved, held = active[good], active[~good]
        previous[:, moved], previous_progress[moved] = current[:, moved], progress[moved]
        current[:, moved], progress[moved] = found[:, good], aim[good]
        step[moved] *= growth[moved]
        growth[moved] = np.minimum(2.0, 1.3 * growth[moved])
        step[held] *= 0.3
        growth[held] = 1.0  # where it has just failed, do not ask for more at once
        crossed = moved[progress[moved] >= leg[good] + 1.0]
        previous_progress[crossed] = progress[crossed]  # a new direction: the last step predicts nothing
        step[crossed] = 0.35
        alive[step < 1e-3] = False
    done = alive & (progress >= 3.0)
    final, good, side = _newton(target, current, FINE_ORDER, FINE_TOLERANCE, 1e-13, 12)
    return final, done & good & (side == upright)


def _newton(
    states: States, guess: Array, order: int, series_tolerance: float, tolerance: float, limit: int
) -> tuple[Array, NDArray[np.bool_], Array]:
    """Newton's method on the two conditions at the ring; steps of ``tolerance`` or less end it.

    Also returned is the sign of the Jacobian's determinant, which a fold of the branch changes.
    """
    orientation = np.zeros(states.size)
    unknowns = guess.copy()
    good = np.zeros(states.size, bool)
    pending = np.arange(states.size)
    delta = 1e-7
    last = np.full(states.size, np.inf)
    for _ in range(limit):
        part = states.take(pending)
        here = unknowns[:, pending]
        copies = part.take(np.tile(np.arange(pending.size), 3))
        nudge = np.zeros((2, 3, pending.size))
        nudge[0, 1] = nudge[1, 2] = delta
        path = _integrate(
            copies, np.tile(here, (1, 3)), order, series_tolerance, nudge.reshape(2, -1), group=pending.size
        )
        hoop = path.hoop_miss.reshape(3, -1)
        rise = path.height_miss.reshape(3, -1)
        j11, j12 = (hoop[1] - hoop[0]) / delta, (hoop[2] - hoop[0]) / delta
        j21, j22 = (rise[1] - rise[0]) / delta, (rise[2] - rise[0]) / delta
        det = j11 * j22 - j12 * j21
        change = np.stack([-(j22 * hoop[0] - j12 * rise[0]), -(j11 * rise[0] - j21 * hoop[0])]) / det
        orientation[pending] = np.sign(det)
        size = np.max(np.abs(change), axis=0)
        lost = ~np.isfinite(size)
        change *= np.minimum(1.0, 1.5 / np.where(lost, 1.0, np.maximum(size, 1e-300)))
        unknowns[:, pending] = here + np.where(lost, 0.0, change)
        # Round-off ends the descent: a step that no longer shrinks, already small, is as good as it gets.
        stalled = (size > 0.25 * last[pending]) & (size < 100 * tolerance)
        ended = (size <= tolerance) | stalled
        last[pending] = size
        good[pending[ended]] = True
        pending = pending[~ended & ~lost]
        if pending.size == 0:
            break
    return unknowns, good, orientation


# ---- one integration from the disk to the ring


@dataclass
class _Path:
    hoop_miss: Array  # (e2 - ln lp) over the scale of the strain
    height_miss: Array  # (w - h) / h
    pull_at_disk: Array  # (R/b) S1 sin(theta)
    pull_at_ring: Array
    peak_area: Array  # largest l1 l2
    min_s1: Array
    min_s2: Array
    max_stretch: Array
    wrinkled: NDArray[np.bool_]


def _integrate(
    states: States,
    unknowns: Array,
    order: int,
    tolerance: float,
    nudge: Array,
    *,
    group: int | None = None,
    extremes: bool = False,
) -> _Path:
    """Series of the given order, step after step, with step lengths chosen for each state.

    ``nudge`` is added to the unknowns; with ``group`` set, entries ``i``, ``i + group``, ... share their step lengths,
    so that differences between them are differences of one smooth map.
    """
    count = states.size
    strain, angle = np.exp(unknowns + nudge)
    e1, theta, drop = strain.copy(), angle.copy(), np.zeros(count)
    e2 = states.log_prestretch.copy()  # of the circle that the film sits on
    natural = e2.copy()  # what sets the stress; the same where the film is taut
    strain_scale, angle_scale = strain.copy(), angle.copy()
    x = states.log_disk.copy()
    wrinkled = np.zeros(count, bool)
    if states.relaxed:
        _, s2 = stresses(states, e1, e2)
        wrinkled = s2 < 0
        natural = np.where(wrinkled, natural_hoop(states, e1, e2), e2)
    ever = wrinkled.copy()
    s1, s2 = stresses(states, e1, natural)
    pull_at_disk = np.exp(x) * s1 * np.exp(-e1) * np.sin(theta)
    peak, low1, low2 = e1 + natural, s1.copy(), np.where(wrinkled, 0.0, s2)
    widest = np.maximum(e1, e2)
    running = np.flatnonzero(s1 > 0)
    for _ in range(8 * order):  # a state whose steps shrink runs into a singularity: no state
        part = states.take(running)
        position = np.stack([e1, e2, natural, theta, drop])[:, running]
        zone = wrinkled[running]
        series = np.empty((order + 1, 5, running.size))
        for pleated in (False, True):
            who = np.flatnonzero(zone == pleated)
            if who.size:
                build = wrinkled_series if pleated else taut_series
                series[:, :, who] = build(part.take(who), x[running][who], position[:, who], order)
        scale = np.stack(
            [strain_scale, strain_scale, strain_scale, angle_scale, np.maximum(drop, states.height)], axis=0
        )[:, running]
        length = np.full(running.size, np.inf)
        for k in (order - 1, order):
            rate = np.max(np.abs(series[k]) / scale, axis=0)
            length = np.minimum(length, (tolerance / np.maximum(rate, 1e-300)) ** (1.0 / k))
        if group is not None:
            shared = np.full(group, np.inf)
            np.minimum.at(shared, running % group, np.where(np.isfinite(length), length, 0.0))
            length = shared[running % group]
        remaining = -x[running]
        last = length >= remaining
        length = np.where(last, remaining, length)
        if states.relaxed:
            length, changed = _first_change(part, series, zone, length)
            last &= ~changed
        if extremes:
            for piece in 0.5 - 0.5 * np.cos(np.pi * np.arange(1, SAMPLES + 1) / SAMPLES):
                value = evaluate(series, piece * length)
                t1, t2 = stresses(part, value[0], value[2])
                peak[running] = np.fmax(peak[running], value[0] + value[2])
                low1[running] = np.fmin(low1[running], t1)
                low2[running] = np.fmin(low2[running], np.where(zone, 0.0, t2))
                widest[running] = np.fmax(widest[running], np.fmax(value[0], value[1]))
            _refine_extremes(part, series, zone, length, running, peak, low1, low2)
        e1[running], e2[running], natural[running], theta[running], drop[running] = evaluate(series, length)
        x[running] = np.where(last, 0.0, x[running] + length)
        if states.relaxed:
            wrinkled[running] = zone ^ changed
            ever |= wrinkled
            natural[running] = np.where(wrinkled[running], natural[running], e2[running])
        tension, _ = stresses(part, e1[running], natural[running])
        alive = (tension > 0) & np.isfinite(theta[running]) & (length > 0)
        running = running[alive & ~last]
        if running.size == 0:
            break
    unfinished = x != 0.0
    s1, _ = stresses(states, e1, natural)
    pull_at_ring = s1 * np.exp(-e1) * np.sin(theta)
    hoop_miss = (e2 - states.log_prestretch) / strain_scale
    height_miss = (drop - states.height) / states.height
    hoop_miss[unfinished] = height_miss[unfinished] = np.nan
    return _Path(hoop_miss, height_miss, pull_at_disk, pull_at_ring, np.exp(peak), low1, low2, np.exp(widest), ever)


def natural_hoop(states: States, e1: Array, start: Array) -> Array:
    """First hoop strain above ``start`` without hoop stress, where the stress at ``start`` is negative; NaN if none."""
    low, high = start.copy(), start + 0.02
    for _ in range(60):
        short = stresses(states, e1, high)[1] < 0
        if not short.any():
            break
        low, high = np.where(short, high, low), np.where(short, high + 0.1, high)
    natural = high.copy()
    for _ in range(80):  # Newton's method, kept inside the bracket
        _, s2 = stresses(states, e1, natural)
        low, high = np.where(s2 < 0, natural, low), np.where(s2 < 0, high, natural)
        change = -s2 / _stiffness(states, e1, natural)[2]
        inside = (natural + change > low) & (natural + change < high)
        change = np.where(inside, change, 0.5 * (low + high) - natural)
        natural = natural + change
        if np.all((np.abs(change) <= 1e-16 * np.maximum(np.abs(natural), np.abs(e1))) | ~np.isfinite(change)):
            break
    return np.where(short, np.nan, natural)


def _margin(states: States, value: Array, zone: NDArray[np.bool_]) -> Array:
    """Positive as long as a state belongs to its zone: hoop stress where taut, width to spare where wrinkled."""
    _, s2 = stresses(states, value[0], value[2])
    return np.where(zone, value[2] - value[1], s2)


def _first_change(
    states: States, series: Array, zone: NDArray[np.bool_], length: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Cut the steps at the first point where the zone changes."""
    low, high = np.zeros_like(length), length.copy()
    changed = np.zeros(length.size, bool)
    for k in range(1, SAMPLES + 1):
        at = length * (k / SAMPLES)
        outside = ~changed & (_margin(states, evaluate(series, at), zone) < 0)
        # A step that starts on an edge begins with a margin of zero: round-off there is no change of zone.
        outside &= at > 1e-12
        high[outside] = at[outside]
        low[outside] = length[outside] * ((k - 1) / SAMPLES)
        changed |= outside
    who = np.flatnonzero(changed)
    if who.size == 0:
        return length, changed
    part, piece, pleated = states.take(who), series[:, :, who], zone[who]
    lo, hi = low[who], high[who]
    f_lo = _margin(part, evaluate(piece, lo), pleated)
    f_hi = _margin(part, evaluate(piece, hi), pleated)
    f_lo = np.maximum(f_lo, 0.0)
    for k in range(80):  # regula falsi, with a bisection every third time
        width = f_lo - f_hi
        share = np.where((width > 0) & (k % 3 != 2), f_lo / np.where(width > 0, width, 1.0), 0.5)
        mid = lo + share * (hi - lo)
        f_mid = _margin(part, evaluate(piece, mid), pleated)
        right = f_mid <= 0
        hi, f_hi = np.where(right, mid, hi), np.where(right, f_mid, f_hi)
        lo, f_lo = np.where(right, lo, mid), np.where(right, f_lo, f_mid)
        if np.all((hi - lo) <= 4e-16 * np.abs(hi)):
            break
    length = length.copy()
    length[who] = hi
    return length, changed


def _refine_extremes(
    states: States,
    series: Array,
    zone: NDArray[np.bool_],
    length: Array,
    running: NDArray[np.intp],
    peak: Array,
    low1: Array,
    low2: Array,
) -> None:
    """Interior extremes, by bisection of the slope along the series wherever it changes sign between samples."""
    slopes = derivative(series)

    def rates(at: Array) -> tuple[Array, Array, Array]:
        value, slope = evaluate(series, at), evaluate(slopes, at)
        s11, s12, s22 = _stiffness(states, value[0], value[2])
        return (
            slope[0] + slope[2],
            s11 * slope[0] + s12 * slope[2],
            np.where(zone, 0.0, s12 * slope[0] + s22 * slope[2]),
        )

    points = np.linspace(0.0, 1.0, SAMPLES + 1)
    table = [rates(p * length) for p in points]
    for quantity, best, sign in ((0, peak, -1.0), (1, low1, 1.0), (2, low2, 1.0)):
        for k in range(SAMPLES):
            left, right = sign * table[k][quantity], sign * table[k + 1][quantity]
            turn = np.flatnonzero((left < 0) & (right > 0))
            if turn.size == 0:
                continue
            lo, hi = points[k] * length, points[k + 1] * length
            for _ in range(45):
                mid = 0.5 * (lo + hi)
                rising = sign * rates(mid)[quantity] > 0
                hi, lo = np.where(rising, mid, hi), np.where(rising, lo, mid)
            value = evaluate(series, hi)
            s1, s2 = stresses(states, value[0], value[2])
            found = (value[0] + value[2], s1, s2)[quantity]
            pick = np.fmax if quantity == 0 else np.fmin
            best[running[turn]] = pick(best[running[turn]], found[turn])


def _stiffness(states: States, e1: Array, e2: Array) -> tuple[Array, Array, Array]:
    """``ds_i/de_j`` over ``scale``."""
    weight = states.mu * states.alpha
    through = np.sum(weight * np.exp(-states.alpha * (e1 + e2)), axis=0)
    s12 = through - 2 * states.electric * np.exp(2 * (e1 + e2))
    s11 = np.sum(weight * np.exp(states.alpha * e1), axis=0) + s12
    s22 = np.sum(weight * np.exp(states.alpha * e2), axis=0) + s12
    return s11, s12, s22
