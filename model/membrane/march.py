"""Films with Maxwell branches through time: implicit steps of the fourth order, each film with steps of its own.

An L-stable, stiffly accurate method (Hairer & Wanner, Solving Ordinary Differential Equations II, table IV.6.5); its
stages are equilibria (`model.membrane.viscous`). Steps end where a history bends. The error of a step is the answer of
the film to the difference to the embedded method of the third order, damped as the stages are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.arrays import Array
from model.material.law import Evaluations, Film
from model.membrane import ritz
from model.membrane.ritz import Problem
from model.membrane.solution import Status
from model.membrane.viscous import Balance, balance, flow, flow_slopes, slopes
from model.membrane.viscous_films import FLAT, Films, Instant, Load, PushLaw, State, pack, unpack

# The method's coefficients: nodes, matrix, and solution less embedded solution of the third order.
NODES = (1 / 4, 3 / 4, 11 / 20, 1 / 2, 1.0)
MATRIX = (
    (),
    (1 / 2,),
    (17 / 50, -1 / 25),
    (371 / 1360, -137 / 2720, 15 / 544),
    (25 / 24, -49 / 48, 125 / 16, -85 / 12),
)
DIAGONAL = 1 / 4
DEFECT = (-3 / 16, -27 / 32, 25 / 32, 0.0, 1 / 4)
# The stages and the beginning of a step from which the first state of a stage is extrapolated; -2, -1: the last step's
# middle and the beginning of this one. The first two begin anew after a bend.
FROM = ((-3, -2, -1), (-2, -1, 0), (-1, 0, 1), (0, 1, 2), (-1, 3, 1))
MIDDLE = 3

SAFETY = 0.9  # of the step that the error estimate allows
LEAST_FACTOR, MOST_FACTOR = 0.2, 4.0  # of the next step over the last
STEP_SHARE = 0.3  # of the tolerance: error that one step may add, as many steps add up
EMBEDDED_FACTOR = 0.1  # error of a step over the estimate, which is the embedded method's: held to the truth by tests
FIRST_SHARE = 0.02  # of a stretch of the history: its first step
MOST_REJECTED = 40  # steps in a row without success: there is no state
LIFTS = (
    1e-3,
    *np.geomspace(0.01, 2.0, 24).tolist(),
)  # heights over the ring radius, to begin with under a load
SLACK_SHARE = 0.05  # of the largest meridional stress, force or load: with less a film hangs slack next
FARTHEST = 4.0  # lengths of a last step over which a first state is drawn on beyond a bend
JUMP = 0.2  # change of a logarithmic stretch from stage to stage that is none of the time that passes
NEAR_SNAP = 0.2  # of the film's stiffness: with less left over the load's a free disk jumps next
LEAST_STEP = 1e-5  # of the shorter of a stretch of the history and the shortest relaxation time: the same
GOAL, SLOPES_GOAL = 0.03, 10.0  # Newton's last change: of the tolerance, its square; with derivatives, times this


@dataclass(frozen=True, slots=True)
class Course:
    """Where a film is driven: times (s), displacement (m) and voltage (V) where they bend, (N,) each.

    Of a free disk ``h`` is the share of its load.
    """

    t: Array
    h: Array
    voltage: Array


@dataclass(frozen=True, slots=True)
class How:
    """How films are solved.

    push : the law of the loads of free disks, for the films by their number; None where disks are held
    relaxed : whether films fold where they have lost their hoop tension
    """

    tolerance: float
    sensitivities: bool = False
    push: PushLaw | None = None
    relaxed: bool = False

    @property
    def goal(self) -> float:
        """Change at which Newton's method stops: its error is the square of it, that of derivatives of its order."""
        found = max(1e-7, math.sqrt(GOAL * self.tolerance))
        return max(1e-8, min(found, SLOPES_GOAL * self.tolerance)) if self.sensitivities else found

    def instant(self, which: NDArray[np.intp], h: Array, voltage: Array) -> Instant:
        """What drives the films ``which``."""
        load = None if self.push is None else Load(which, h, self.push)
        return Instant(h, voltage, load, self.relaxed)


@dataclass(slots=True)
class Moment:
    """Films at one time: viscous strains and rates (2, K, Q, M, S), packed states (D, S), derivatives of the first."""

    viscous: Array
    rate: Array
    packed: Array
    viscous_slopes: Array | None = None  # (2, K, Q, M, P, S)
    rate_slopes: Array | None = None

    def take(self, index: NDArray[np.intp]) -> Moment:
        """The films at ``index``."""
        two = (None if one is None else one[..., index] for one in (self.viscous_slopes, self.rate_slopes))
        return Moment(self.viscous[..., index], self.rate[..., index], self.packed[..., index], *two)

    def put(self, index: NDArray[np.bool_], other: Moment) -> Moment:
        """These moments, and those of ``other`` where ``index``."""

        def pick(one: Array | None, two: Array | None) -> Array | None:
            return None if one is None or two is None else np.where(index, two, one)

        return Moment(
            np.where(index, other.viscous, self.viscous),
            np.where(index, other.rate, self.rate),
            np.where(index, other.packed, self.packed),
            pick(self.viscous_slopes, other.viscous_slopes),
            pick(self.rate_slopes, other.rate_slopes),
        )


@dataclass(slots=True)
class Step:
    """One step of every film that was still going, as the answers between its ends need it, (S,) and as `Moment`.

    which : the films, by their number
    ok : whether the step was taken
    begin, dt : when it began, and its length (s)
    before, after : the films at its ends
    middle : packed states halfway, roughly
    answer : dimensionless force at the end, of a free disk its height
    defect, drift : estimated errors of the answer, and of the viscous strains on average
    tail : error of the answer by the number of modes
    folded : whether the film was folded somewhere
    error : estimated error of the answer up to the end, over the largest
    """

    which: NDArray[np.intp]
    ok: NDArray[np.bool_]
    begin: Array
    dt: Array
    before: Moment
    after: Moment
    middle: Array
    answer: Array
    defect: Array
    drift: Array
    tail: Array
    folded: NDArray[np.bool_]
    error: Array


def _extrapolated(times: Sequence[Array], values: Sequence[Array], at: Array, fresh: NDArray[np.bool_]) -> Array:
    """Parabola through three points in time, (S,) and (D, S); a line through the last two where ``fresh``."""
    t0, t1, t2 = times
    with np.errstate(all="ignore"):
        w0 = (at - t1) * (at - t2) / ((t0 - t1) * (t0 - t2))
        w1 = (at - t0) * (at - t2) / ((t1 - t0) * (t1 - t2))
        line = (at - t2) / (t1 - t2)
    line = np.where((t1 == t2) | (np.abs(line) > FARTHEST), 0.0, line)
    w0, w1 = np.where(fresh, 0.0, w0), np.where(fresh, line, w1)
    found: Array = w0 * values[0] + w1 * values[1] + (1.0 - w0 - w1) * values[2]
    return found


def flat_guess(films: Films, instant: Instant) -> State:
    """A first state of films that were never pushed before; free disks lie flat."""
    flat = instant.height(films) if instant.load is None else np.full(len(instant.h), FLAT)
    height = np.maximum(flat, 1e-3)
    problem = Problem(Film(films.law, None, Evaluations()), films.log_prestretch, films.span, height)
    guess = ritz.guess(problem, films.grid)
    elastic = np.zeros((2, films.branches, *films.grid.radius.shape))
    slack = np.zeros_like(guess.w) if instant.relaxed else None
    return State(guess.c, guess.w * (flat / height), elastic, flat, slack)


def lifted(films: Films, instant: Instant, viscous: Array, goal: float) -> tuple[State, NDArray[np.bool_]]:
    """States near the lowest height at which each free disk carries its load, and where there is one."""
    assert instant.load is not None
    found = state = flat_guess(films, instant)
    done = ~instant.driven
    for height in LIFTS:
        here = Instant(height * films.ring, instant.voltage, None, instant.relaxed)
        at = balance(films, here, viscous, np.zeros_like(films.time), _at_height(films, here, state), goal)
        state = _picked(at.ok, state, at.state)
        push, _ = instant.load.at(films, np.full(len(done), height))
        met = at.ok & (at.lam >= push) & ~done
        found, done = _picked(met, found, at.state), done | met
        if done.all():
            break
    return found, done


def _at_height(films: Films, instant: Instant, state: State) -> State:
    return unpack(films, instant, pack(films, state))


def _picked(where: NDArray[np.bool_], one: State, two: State) -> State:
    """The states ``two`` at ``where``, the others of ``one``."""

    def pick(name: str) -> Array | None:
        values = getattr(one, name), getattr(two, name)
        return None if values[0] is None else np.where(where, values[1], values[0])

    return State(*(pick(name) for name in ("c", "w", "x", "height", "slack")))  # type: ignore[arg-type]


class March:
    """Films on their way, each through its own course."""

    def __init__(self, films: Films, courses: Sequence[Course], how: How) -> None:
        self.films, self.how = films, how
        self.which = np.arange(len(courses))
        self.courses = list(courses)
        self.part = np.zeros(len(courses), dtype=np.intp)  # of its course that a film is on
        self._bends()
        self.now = self.left.copy()
        self.strain = np.broadcast_to(films.log_prestretch, (2, *films.grid.radius.shape))  # now, and after a step
        self.moment = self._begin()
        self._strain_after = self.strain
        self.earlier: tuple[Array, Array] = (np.stack((self.now, self.now)), np.stack((self.moment.packed,) * 2))
        self.fresh = np.ones(len(courses), dtype=np.bool_)

    def _bends(self) -> None:
        """Both ends of the part of its course that each film is on."""
        ends = np.array(
            [
                [(c.t[k + j], c.h[k + j], c.voltage[k + j]) for j in (0, 1)]
                for c, k in zip(self.courses, self.part.tolist(), strict=True)
            ]
        )
        self.left, self.right = ends[:, 0, 0], ends[:, 1, 0]
        self._from, self._to = ends[:, 0, 1:].T, ends[:, 1, 1:].T

    def instant(self, t: Array) -> Instant:
        """What drives the films at the times ``t`` (S,) of the part that they are on."""
        share = (t - self.left) / (self.right - self.left)
        h, voltage = self._from + share * (self._to - self._from)
        return self.how.instant(self.which, h, voltage)

    def _begin(self) -> Moment:
        """Films rested in their flat state, pushed in no time where a course does not begin there."""
        films, instant = self.films, self.instant(self.now)
        self.ok = np.ones(len(self.now), dtype=np.bool_)
        shape = (2, films.branches, *films.grid.radius.shape)
        viscous = np.broadcast_to(films.log_prestretch, shape).copy()
        state = flat_guess(films, instant)
        rested = np.zeros_like(viscous)
        moment = Moment(viscous, rested, pack(films, state))
        if self.how.sensitivities:
            moment.viscous_slopes = np.zeros((*shape[:-1], films.columns, shape[-1]))
            moment.viscous_slopes[..., -2, :] = 1.0
            moment.rate_slopes = np.zeros_like(moment.viscous_slopes)
        pushed = instant.driven
        if not pushed.any():
            return moment
        met = np.ones_like(self.ok)
        if instant.load is not None:
            state, met = lifted(films, instant, viscous, self.how.goal)
        at = balance(films, instant, viscous, np.zeros_like(films.time), state, self.how.goal)
        self.ok = (at.ok & met) | ~pushed
        self.strain = np.where(pushed, at.u, self.strain)
        moment.rate = np.where(pushed, flow(films, at.state.x), 0.0)
        moment.packed = np.where(pushed, pack(films, at.state), moment.packed)
        if moment.viscous_slopes is not None:
            found = slopes(at, instant, moment.viscous_slopes)
            moment.rate_slopes = np.where(pushed, flow_slopes(films, at, found.x, moment.rate), 0.0)
        return moment

    def take(self, keep: NDArray[np.intp]) -> None:
        """Go on with these films alone, by their place among those that are still going."""
        self.films = self.films.take(keep)
        self.which, self.part, self.now = self.which[keep], self.part[keep], self.now[keep]
        self.courses = [self.courses[k] for k in keep.tolist()]
        self.moment = self.moment.take(keep)
        self.earlier = (self.earlier[0][:, keep], self.earlier[1][..., keep])
        self.fresh, self.ok, self.strain = self.fresh[keep], self.ok[keep], self.strain[..., keep]
        self._bends()

    def step(self, dt: Array) -> Step:
        """A step from now of the lengths ``dt`` (S,), which `accept` takes."""
        films, now, moment = self.films, self.now, self.moment
        lag = DIAGONAL * dt / films.time
        times = {-3: self.earlier[0][0], -2: self.earlier[0][1], -1: now}
        states = {-3: self.earlier[1][0], -2: self.earlier[1][1], -1: moment.packed}
        rates: list[Array] = []
        rate_slopes: list[Array] = []
        ok = np.ones(len(dt), dtype=np.bool_)
        start_slopes, strain = None, self.strain
        for stage, (node, row) in enumerate(zip(NODES, MATRIX, strict=True)):
            here = now + node * dt
            instant = self.instant(here)
            start = moment.viscous + dt * _sum(row, rates)
            three = FROM[stage]
            first = _extrapolated([times[k] for k in three], [states[k] for k in three], here, self.fresh & (stage < 2))
            guess = unpack(films, instant, first)
            least = 0.2 * unpack(films, instant, moment.packed).w
            guess.w = np.where(guess.w > least, guess.w, 5.0 * least)
            at = balance(films, instant, start, lag, guess, self.how.goal)
            # At a fold the next state may be far away: no step is so short that a film could have gone there.
            ok &= at.ok & (np.abs(at.u - strain).max(axis=(0, 1, 2)) < JUMP)
            strain = at.u
            times[stage], states[stage] = here, pack(films, at.state)
            rates.append((at.u[:, None] - at.state.x - start) / (DIAGONAL * dt))
            if moment.viscous_slopes is not None:
                start_slopes = moment.viscous_slopes + dt * _sum(row, rate_slopes)
                found = slopes(at, instant, start_slopes)
                rate_slopes.append((found.viscous - start_slopes) / (DIAGONAL * dt))
            if not ok.any():
                return self.standing(np.nan)
        after = Moment(start + DIAGONAL * dt * rates[-1], rates[-1], states[4])
        if start_slopes is not None:
            after.viscous_slopes, after.rate_slopes = start_slopes + DIAGONAL * dt * rate_slopes[-1], rate_slopes[-1]
        defect = dt * _sum(DEFECT, rates)
        self._strain_after = strain
        answer, u, x = at.respond(0.0, defect[..., None, :])
        off = np.abs(np.array(u)[:, None, ..., 0, :] - np.array(x)[..., 0, :] + defect)
        drift = (films.ratio / (1.0 + films.ratio.sum(axis=0)) * off).sum(axis=1).mean(axis=(0, 1, 2))
        folded = at.folded
        return Step(
            self.which,
            ok,
            now,
            dt,
            moment,
            after,
            states[MIDDLE],
            at.answer,
            np.abs(answer[0]),
            drift,
            at.tail,
            folded,
            np.zeros(len(dt)),
        )

    def standing(self, value: float = 0.0) -> Step:
        """No step: both its ends are now, and its numbers are ``value``."""
        same = np.full(len(self.now), value)
        ok = np.zeros(len(self.now), dtype=np.bool_)
        m = self.moment
        return Step(self.which, ok, self.now, same + 1.0, m, m, m.packed, same, same, same, same, ok, same)

    def accept(self, step: Step, taken: NDArray[np.bool_], end: Array) -> None:
        """Go on to the ``end`` of a step where it is ``taken``."""
        earlier = np.stack((self.now, self.now + 0.5 * step.dt)), np.stack((self.moment.packed, step.middle))
        self.earlier = np.where(taken, earlier[0], self.earlier[0]), np.where(taken, earlier[1], self.earlier[1])
        self.moment = self.moment.put(taken, step.after)
        if taken.any():
            self.strain = np.where(taken, self._strain_after, self.strain)
        self.now = np.where(taken, end, self.now)
        self.fresh &= ~taken

    def turn(self) -> NDArray[np.bool_]:
        """Go on to the next part of its course where a film has come to a bend; which films have."""
        here = self.now >= self.right
        if here.any():
            last = np.array([self.part[k] + 2 == len(c.t) for k, c in enumerate(self.courses)])
            self.part = np.where(here & ~last, self.part + 1, self.part)
            self.fresh |= here
            self._bends()
        return here

    def lost(self, place: int, converged: bool, scale: float) -> Status:
        """Why a film has no state after now: it hangs slack, is unstable under its voltage, or neither is sure."""
        if converged:
            return Status.NOT_CONVERGED
        one = np.array([place])
        films, moment, instant = self.films.take(one), self.moment.take(one), self.instant(self.now).take(one)
        state = unpack(films, instant, moment.packed)
        at: Balance = balance(films, instant, moment.viscous, np.zeros_like(films.time), state, self.how.goal)
        law = at.points.law
        if float(law.t1.min()) < SLACK_SHARE * float(law.t1.max()):
            return Status.SLACK
        if at.folded[0] and at.free is None and float(at.lam[0]) < SLACK_SHARE * scale:
            return Status.SLACK
        if instant.load is not None:
            most = max(float(self._from[0, place]), float(self._to[0, place]))
            if float(instant.load.share[0]) < SLACK_SHARE * most:  # it hangs, too long for the flat film
                return Status.SLACK
        if at.free is not None and float(at.free.excess[0]) < NEAR_SNAP * float(at.free.stiffness[0]):
            return Status.UNSTABLE
        return Status.UNSTABLE if float(instant.voltage[0]) != 0.0 else Status.NOT_CONVERGED


def _sum(weights: Sequence[float], values: Sequence[Array]) -> Array:
    total = np.zeros(1)
    for weight, value in zip(weights, values, strict=True):
        if weight != 0.0:
            total = total + weight * value
    return total


@dataclass(slots=True)
class Trail:
    """What a march leaves behind: the steps, how many each film took and tried in vain, and where it ended.

    begin : no step, but the films at their beginning
    scale : largest dimensionless force, of free disks largest height, (S,)
    folded : which films were folded somewhere at some time
    lost : by the film's number, the time after which it has no state, and why
    """

    begin: Step
    steps: list[Step]
    taken: NDArray[np.intp]
    rejected: NDArray[np.intp]
    scale: Array
    folded: NDArray[np.bool_]
    lost: dict[int, tuple[float, Status]]


def march(films: Films, courses: Sequence[Course], scale: Array, how: How) -> Trail:
    """Every film to the end of its course, or as far as there are states.

    scale : largest dimensionless force of each, (S,), over which errors are meant; of free disks the largest height is
        what they come to, and this what it begins with
    """
    allowed = STEP_SHARE * how.tolerance
    on = March(films, courses, how)
    count = len(courses)
    scale = scale if how.push is None else np.maximum(scale, on.moment.packed[0])
    none = np.zeros(count, dtype=np.intp)
    trail = Trail(on.standing(), [], none, none.copy(), scale, np.zeros(count, dtype=np.bool_), {})
    error, failures = np.zeros(count), np.zeros(count, dtype=np.intp)
    shortest_time = films.time.min(axis=(0, 1, 2), initial=np.inf)
    dt = FIRST_SHARE * (on.right - on.left)
    for k in np.flatnonzero(~on.ok):
        trail.lost[int(k)] = (-np.inf, Status.NOT_CONVERGED)
    alive = on.ok.copy()
    while True:
        if not alive.all():
            keep = np.flatnonzero(alive)
            if len(keep) == 0:
                return trail
            on.take(keep)
            dt, alive = dt[keep], alive[keep]
        which = on.which
        rest = on.right - on.now
        whole = dt > 0.99 * rest
        dt = np.where(whole, rest, np.minimum(dt, np.maximum(0.5 * rest, 1e-3 * dt)))
        step = on.step(dt)
        if how.push is not None:
            scale[which] = np.where(step.ok, np.fmax(scale[which], step.answer), scale[which])
        with np.errstate(invalid="ignore"):
            wrong = np.maximum(step.defect / scale[which], step.drift)
            size = np.where(step.ok & np.isfinite(wrong), wrong / allowed, np.inf)
            factor = np.where(np.isfinite(size), SAFETY * np.maximum(size, 1e-12) ** -0.25, 0.25)
        factor = np.clip(factor, LEAST_FACTOR, MOST_FACTOR)
        taken = size <= 1.0
        error[which] += np.where(taken, EMBEDDED_FACTOR * np.where(taken, wrong, 0.0), 0.0)
        step.ok, step.error = taken, error[which] + step.tail / scale[which]
        trail.steps.append(step)
        trail.taken[which] += taken
        trail.folded[which] |= taken & step.folded
        trail.rejected[which] += ~taken
        failures[which] = np.where(taken, 0, failures[which] + 1)
        on.accept(step, taken, np.where(whole, on.right, on.now + dt))
        dt = dt * np.where(taken, factor, np.minimum(factor, 0.7))
        length = on.right - on.left
        shortest = LEAST_STEP * np.minimum(length, shortest_time[which])
        for k in np.flatnonzero(~taken & ((failures[which] > MOST_REJECTED) | (dt < shortest))):
            trail.lost[int(which[k])] = (
                float(on.now[k]),
                on.lost(int(k), bool(np.isfinite(size[k])), float(scale[which[k]])),
            )
            alive[k] = False
        ended = on.now >= np.array([c.t[-1] for c in on.courses])
        alive &= ~ended
        turned = on.turn()
        dt = np.where(turned, FIRST_SHARE * (on.right - on.left), dt)
