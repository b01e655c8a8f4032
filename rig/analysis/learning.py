"""Where to measure next, so that a film is known well enough in the least time: the choice of a closed loop.

After each fit the whole rest is planned anew (`calibration.film.least_time`): the places and seconds that take every
wish to its target by what the fit says of the film, and the ways between them, since a change of the voltage may cost
as much as a hold. The best plan of a few sets of voltages is begun: first what it holds at the present voltage. Half of
what belongs to 0 V comes before the high voltage and half after it, so that a film or a sensor that changes with time
does not pass for an effect of the voltage; the way back to 0 V has to be gone anyway. No hold is longer than all
that was held before, so that a plan made with little knowledge does not go far. A fit takes its time while the film is
held where the plan wants it.

A claim is not believed below what the information of these data says for the film of the scene with all its parameters
free. With few places a term of the law may vanish in the fit; then it states less uncertainty than it has, and whoever
stops as soon as the stated one is small would stop at such fits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calibration.film.curve import Curve
from calibration.film.least_time import least_time
from calibration.film.planning import Places, one_term
from calibration.film.result import Identification, Quantity
from model.specimen import Specimen
from rig.scene.scene import Scene
from rig.steps.advisor import Advice, Ask, Kind, Standing
from rig.steps.places import connected
from rig.steps.wanted import BY_TIME, Wanted

Array = NDArray[np.float64]

QUANTITIES = ("stiffness", "eps_r")  # in the order of `Places.wanted`
FIRST_S = 8.0  # hold at most, while little was held before
LEAST_S = 1.0  # of a hold worth it
TURN_S = 2.0  # what a question takes: the film is held where it is meanwhile, and that is data
CONFIRM, CONFIRM_S = 0.02, (1.0, 8.0)  # new data before a claim is believed: share of the time spent, from, to
AIM = 0.99  # times the uncertainty that is wanted: a hold that ends just short of it costs another fit
LEAST_ROOM = 0.9  # what stays counts at most as so much of a wish, in a plan
TRUST = 4.0  # by what factor a variance that a fit claims may move what is planned
HOPELESS = 3  # fits in a row that say that it cannot be reached
NOTICED = 0.01  # of a variance: what time at the present voltage has to take off it, where it allows no other
OUT = "the time is out"
MET_WORDS = "known well enough, and so said the fit before"
FIRST_STRETCH = 1.25  # times the pre-stretch: where the stiffness is wanted before there is a fit


@dataclass
class Learner:
    """Chooses place after place for one step of one specimen.

    Parameters
    ----------
    scene : Scene
    wanted : sequence of Wanted
    settle_s, speed : float
        Of the step: wait after a voltage, speed of the disk (m/s).
    """

    scene: Scene
    wanted: Sequence[Wanted]
    settle_s: float = 1.0
    speed: float = 5e-3
    _met: dict[str, int] = field(default_factory=dict)  # fits in a row that say so, by name
    _hopeless: dict[str, int] = field(default_factory=dict)
    _specimen: Specimen = field(init=False)

    def __post_init__(self) -> None:
        self._specimen = self.scene.specimen.specimen()
        grid = connected(self.scene, self._specimen)
        self.h = np.concatenate([np.array(h) for h in grid.values()])
        self.voltage = np.repeat(list(grid), [len(h) for h in grid.values()])

    def advise(self, curves: Sequence[Curve], found: Identification | None, question: Ask) -> Advice:
        """What to do, by the curves recorded and the fit of them; None while there is none."""
        stands = {} if found is None else self.standing(curves, found)
        known = () if found is None else self._known(stands, found, question.spent_s)
        if len(known) < len(self.wanted):
            names = [one.name for one in self.wanted]
            first = self._next(curves, found, question, stands, names, "first places: there is no fit of all yet")
            return replace(first, known=known)
        open_ = [one for one in known if one.outcome is Kind.TIME]
        lost = [one for one in known if one.outcome is Kind.UNREACHABLE]
        told = _about(max(open_ or lost or known, key=lambda one: one.relative / one.wanted), known)
        if not open_:
            kind, words = (Kind.UNREACHABLE, lost[0].reason) if lost else (Kind.MET, MET_WORDS)
            return replace(told, kind=kind, reason=words)
        if question.left_s <= TURN_S:
            return replace(told, kind=Kind.TIME, reason=OUT)
        missing = [one.quantity for one in open_ if one.relative > one.wanted]
        if not missing:
            seconds = min(max(CONFIRM * question.spent_s, CONFIRM_S[0]), CONFIRM_S[1])
            h, voltage = self._nearest(question)
            reason = "known well enough; confirmed by new data"
            return replace(told, reason=reason, h=h, voltage=voltage, hold_s=seconds, expected_s=0.0)
        after = self._next(curves, found, question, stands, missing, "least time to what is wanted")
        return replace(
            told,
            kind=after.kind,
            reason=after.reason,
            h=after.h,
            voltage=after.voltage,
            hold_s=after.hold_s,
            expected_s=after.expected_s,
        )

    def _known(
        self, stands: Mapping[str, tuple[float, float]], found: Identification, spent: float
    ) -> tuple[Standing, ...]:
        """Each wish that the fit knows, with its own outcome."""
        known = []
        for wish in self.wanted:
            if wish.name not in stands:
                self._met[wish.name] = self._hopeless[wish.name] = 0
                continue
            relative, stays = stands[wish.name]
            self._met[wish.name] = self._met.get(wish.name, 0) + 1 if relative <= wish.relative else 0
            self._hopeless[wish.name] = self._hopeless.get(wish.name, 0) + 1 if stays > wish.relative else 0
            quantity = found.quantities[wish.name]
            outcome, reason = self._outcome(wish, quantity, stands[wish.name], spent)
            error = relative * abs(quantity.value)
            known.append(Standing(wish.name, quantity.value, error, relative, wish.relative, outcome, reason))
        return tuple(known)

    def _outcome(self, wish: Wanted, quantity: Quantity, stands: tuple[float, float], spent: float) -> tuple[Kind, str]:
        """Met, unreachable or more time; and why."""
        if self._hopeless[wish.name] >= HOPELESS:
            part, size = _largest(quantity, wish)
            return Kind.UNREACHABLE, f"{wish} cannot be reached by more time: {part} alone leaves {100 * size:.3g} %"
        if self._met[wish.name] > 1:
            return Kind.MET, MET_WORDS
        if self._met[wish.name]:
            return Kind.TIME, "well enough by one fit; another one has to confirm it"
        left = _time_left(stands, wish, spent)
        return Kind.TIME, f"about {left:.0f} s more" if math.isfinite(left) else "more time"

    def standing(self, curves: Sequence[Curve], fit: Identification) -> dict[str, tuple[float, float]]:
        """By name of what is wanted: relative standard uncertainty, and what of it no time makes smaller."""
        believed = self._places(curves, believed_film(self._specimen, fit.terms), fit.stretch)
        held = self._seconds(believed, curves)
        inverse = np.linalg.inv(believed.prior + (believed.rows * held[:, None]).T @ believed.rows)
        least = np.sqrt(np.einsum("jp,pq,jq->j", believed.wanted, inverse, believed.wanted)).tolist()
        found = {}
        for one, quantity in ((one, fit.quantities[one.name]) for one in self.wanted if one.name in fit.quantities):
            if not (math.isfinite(quantity.uncertainty) and quantity.value):
                found[one.name] = (math.inf, 0.0)
                continue
            relative, stays = one.of(quantity.value, quantity.budget)
            found[one.name] = (max(relative, math.hypot(stays, least[QUANTITIES.index(one.name)])), stays)
        return found

    def _next(
        self,
        curves: Sequence[Curve],
        found: Identification | None,
        question: Ask,
        stands: Mapping[str, tuple[float, float]],
        missing: Sequence[str],
        reason: str,
    ) -> Advice:
        """The beginning of the best plan for what is ``missing``; that the time is out where it allows none."""
        specimen, stretch = self._specimen, (FIRST_STRETCH * self._specimen.prestretch, self._specimen.prestretch)
        if found is not None:
            specimen, stretch = specimen.with_material(found.material), found.stretch
        places = self._places(curves, specimen, stretch)
        held = self._seconds(places, curves)
        known = places.prior + (places.rows * held[:, None]).T @ places.rows
        target = self._targets(places, known, stands, missing)
        allowed = [(one, self._way(one, question)) for one in self._sets(places, question)]
        allowed = [(one, way) for one, way in allowed if self._rest(way, question) >= TURN_S + LEAST_S]
        plans = [self._plan(places, known, target, levels, way, question) for levels, way in allowed]
        plan = min(plans, key=lambda one: (one.excess, one.total), default=None)
        if plan is None or (len(plans) == 1 and not _tells(places, known, target, plan)):
            return Advice(Kind.TIME, OUT)
        h, voltage, seconds = _begin(places, plan.seconds, held, question)
        seconds = min(seconds, max(FIRST_S, float(held.sum())))
        return Advice(Kind.GO, reason, h, voltage, max(seconds - TURN_S, LEAST_S), expected_s=plan.total)

    def _targets(
        self, places: Places, known: Array, stands: Mapping[str, tuple[float, float]], missing: Sequence[str]
    ) -> Array:
        """Variance that is wanted of each of ``places.wanted``, by the information; inf: nothing is wanted of it.

        A fit may claim more, or less, than its information says; the target moves by as much.
        """
        now = np.einsum("jp,pj->j", places.wanted, np.linalg.solve(known, places.wanted.T)).tolist()
        target = np.full(len(places.wanted), np.inf)
        for wish in self.wanted:
            if wish.name in missing:
                which = QUANTITIES.index(wish.name)
                relative, stays = stands.get(wish.name, (math.inf, 0.0))
                room = AIM**2 * (wish.relative**2 - min(stays, LEAST_ROOM * wish.relative) ** 2)
                claimed = relative**2 - stays**2
                more = now[which] / claimed if math.isfinite(claimed) and claimed > 0.0 else 1.0
                target[which] = room * min(max(more, 1.0 / TRUST), TRUST)
        return target

    def _sets(self, places: Places, question: Ask) -> list[tuple[float, ...]]:
        """Sets of voltages that a plan may use: at most the present one, 0 V and another."""
        levels = np.unique(places.voltage).tolist()
        here = min(levels, key=lambda one: abs(one - question.voltage))
        sets = {frozenset(one) for v in levels for one in ((here,), (v,), (here, v), (0.0, v), (here, 0.0, v))}
        return sorted(tuple(sorted(one)) for one in sets)

    def _way(self, levels: tuple[float, ...], question: Ask) -> float:
        """Seconds of the ways between these voltages, from the present one on, and back to 0 V."""
        way, at = 0.0, question.voltage
        here = [one for one in levels if abs(one - at) < 1.0]
        for level in [*here, *sorted(set(levels) - set(here), reverse=True), 0.0]:
            way += self._change(at, level)
            at = level
        return way

    def _change(self, before: float, after: float) -> float:
        """Seconds of a change of the voltage."""
        ramp = self.scene.hv.ramp_V_per_s if self.scene.hv is not None else math.inf
        return abs(after - before) / ramp + self.settle_s * (after != before)

    def _rest(self, way: float, question: Ask) -> float:
        """Seconds that the ways leave; that back from here is taken off what is left already."""
        return question.left_s - (way - self._change(question.voltage, 0.0))

    def _plan(
        self, places: Places, known: Array, target: Array, levels: tuple[float, ...], way: float, question: Ask
    ) -> _Plan:
        """The best plan with these voltages, the way back to 0 V in its time."""
        these = np.flatnonzero(np.isin(places.voltage, levels)).tolist()
        excess, seconds = least_time(places, known, target, these, self._rest(way, question))
        return _Plan(max(excess, 1.0), float(seconds.sum()) + way, seconds)

    def _nearest(self, question: Ask) -> tuple[float, float]:
        """The place nearest to where the film is held: a pause may have left it between two."""
        here = np.flatnonzero(np.abs(self.voltage - question.voltage) == np.abs(self.voltage - question.voltage).min())
        k = here[np.abs(self.h[here] - question.h).argmin()]
        return float(self.h[k]), float(self.voltage[k])

    def _places(self, curves: Sequence[Curve], specimen: Specimen, stretch: tuple[float, float]) -> Places:
        return Places(specimen, self.h, self.voltage, self.scene.rates["force"], curves[0], stretch)

    def _seconds(self, places: Places, curves: Sequence[Curve]) -> Array:
        """Seconds recorded so far, each sample at the nearest place."""
        seconds = np.zeros(places.h.size)
        for curve in curves:
            here = np.flatnonzero(np.abs(places.voltage - curve.nominal_voltage) < 1.0)
            if here.size:
                h = curve.h[curve.usable]
                nearest = here[np.abs(places.h[here][:, None] - h).argmin(axis=0)]
                seconds += np.bincount(nearest, minlength=seconds.size) / self.scene.rates["force"]
        return seconds


@dataclass(frozen=True, eq=False)
class _Plan:
    """Largest ratio of a variance to its target (1: all are met), time with the ways (s), seconds at each place."""

    excess: float
    total: float
    seconds: Array


def _tells(places: Places, known: Array, target: Array, plan: _Plan) -> bool:
    """Whether a plan reaches what is wanted, or makes a variance of it noticeably smaller."""
    after = known + (places.rows * plan.seconds[:, None]).T @ places.rows
    before, then = (
        np.einsum("jp,pj->j", places.wanted, np.linalg.solve(one, places.wanted.T)) for one in (known, after)
    )
    return plan.excess <= 1.0 or bool((then < (1.0 - NOTICED) * before)[np.isfinite(target)].any())


def _begin(places: Places, seconds: Array, held: Array, question: Ask) -> tuple[float, float, float]:
    """Displacement, voltage and seconds of the hold that the plan begins with."""
    levels = np.unique(places.voltage)
    here = levels[np.abs(levels - question.voltage).argmin()]
    planned = {float(one): float(seconds[places.voltage == one].sum()) for one in levels}
    stay = planned.pop(float(here))
    others = max(planned.values(), default=0.0)
    if here == 0.0 and others > LEAST_S:
        stay = 0.5 * (stay - float(held[places.voltage == 0.0].sum()))
    if stay < TURN_S and others > LEAST_S:
        here = max(planned, key=lambda one: (planned[one] > LEAST_S, one))
        stay = planned[here]
    k = int(np.argmax(np.where(places.voltage == here, seconds, -1.0)))
    return float(places.h[k]), float(here), stay


def believed_film(specimen: Specimen, terms: int) -> Specimen:
    """The specimen with its film as it is believed, of one term where one is fitted."""
    if terms > 1 or specimen.material.terms < 2:
        return specimen
    lp = specimen.prestretch
    return specimen.with_material(one_term(specimen.material, (1.1 * lp, 1.4 * lp), lp))


def _about(one: Standing, known: tuple[Standing, ...]) -> Advice:
    """An advice that says how well a quantity is known, and the others, and so far nothing else."""
    told = {name: getattr(one, name) for name in ("quantity", "value", "standard_uncertainty", "relative", "wanted")}
    return Advice(Kind.GO, "", **told, known=known)


def _largest(quantity: Quantity, wanted: Wanted) -> tuple[str, float]:
    """The largest part of what no time makes smaller, and its relative size."""
    parts = {part: wanted.of(quantity.value, {part: size})[0] for part, size in quantity.budget.items()}
    part = max((one for one in parts if one not in BY_TIME), key=lambda one: parts[one])
    return part, parts[part]


def _time_left(stands: tuple[float, float], wanted: Wanted, spent: float) -> float:
    """Seconds by the rule that noise falls with the root of the time."""
    relative, stays = stands
    room = wanted.relative**2 - stays**2
    if not (room > 0.0 and math.isfinite(relative)):
        return math.nan
    return max((relative**2 - stays**2) / room - 1.0, 0.0) * spent
