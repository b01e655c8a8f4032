"""Where to measure next, so that a film is known well enough in the least time: the choice of a closed loop.

What a second of holding the film at a place tells is that of `calibration.film.planning.Places`. One reading ``r`` (a
row of derivatives over its standard deviation) takes the variance ``v = w' M^-1 w`` of what is wanted to
``v - t (w' M^-1 r)^2 / (1 + t r' M^-1 r)`` in ``t`` seconds (Sherman & Morrison), with ``M`` the information of all
that was recorded. The next place is the one that lowers the logarithms of the variances most per second, the way there
counted (sequential c-optimality; Wynn 1970).

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
from calibration.film.planning import Places, one_term
from calibration.film.result import Identification, Quantity
from model.specimen import Specimen
from rig.scene.scene import Scene
from rig.steps.advisor import Advice, Ask, Kind, Standing
from rig.steps.places import connected
from rig.steps.wanted import BY_TIME, Wanted

Array = NDArray[np.float64]

QUANTITIES = ("stiffness", "eps_r")  # in the order of `Places.wanted`
HOLDS_S = (4.0, 8.0, 16.0, 32.0, 64.0)
TURN_S = 2.0  # what a question costs: the film is held where it is meanwhile
LITTLE = 0.05  # weight of what is known well enough already
CONFIRM_S = 8.0  # of new data before a claim is believed
HOPELESS = 3  # fits in a row that say that it cannot be reached
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
            return replace(self._next(curves, found, question, {}, "first places: there is no fit yet"), known=known)
        open_ = [one for one in known if one.outcome is Kind.TIME]
        lost = [one for one in known if one.outcome is Kind.UNREACHABLE]
        told = _about(max(open_ or lost or known, key=lambda one: one.relative / one.wanted), known)
        if not open_:
            kind, words = (Kind.UNREACHABLE, lost[0].reason) if lost else (Kind.MET, MET_WORDS)
            return replace(told, kind=kind, reason=words)
        if question.left_s <= TURN_S:
            return replace(told, kind=Kind.TIME, reason="the time is out")
        missing = [one.quantity for one in open_ if one.relative > one.wanted]
        weights = {one.quantity: 1.0 if one.quantity in missing else LITTLE for one in known}
        reason = "tells most per second" if missing else "known well enough; confirmed by new data"
        next_one = self._next(curves, found, question, weights, reason)
        wishes = {one.name: one for one in self.wanted}
        return replace(
            told,
            reason=reason,
            h=next_one.h,
            voltage=next_one.voltage,
            hold_s=next_one.hold_s if missing else CONFIRM_S,
            expected_s=max((_time_left(stands[name], wishes[name], question.spent_s) for name in missing), default=0.0),
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
        inverse = np.linalg.inv(believed.prior + self._information(believed, curves))
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
        weights: Mapping[str, float],
        reason: str,
    ) -> Advice:
        specimen, stretch = self._specimen, (FIRST_STRETCH * self._specimen.prestretch, self._specimen.prestretch)
        if found is not None:
            specimen, stretch = specimen.with_material(found.material), found.stretch
        places = self._places(curves, specimen, stretch)
        names = QUANTITIES[: len(places.wanted)]
        asked = {one.name for one in self.wanted}
        weight = np.array([weights.get(name, 1.0 if name in asked else 0.0) for name in names])
        inverse = np.linalg.inv(places.prior + self._information(places, curves))
        toward = places.rows @ inverse  # (K, P)
        variance = np.einsum("jp,pq,jq->j", places.wanted, inverse, places.wanted)
        gain_per = (places.wanted @ toward.T) ** 2 / variance[:, None]  # (J, K)
        size = np.einsum("kp,kp->k", toward, places.rows)
        holds = np.array(HOLDS_S)[:, None]
        way = self._way(places, question)
        lower = holds * gain_per[:, None] / (1.0 + holds * size)  # (J, D, K), of each variance
        gain = np.einsum("j,jdk->dk", weight, -np.log1p(-np.minimum(lower, 1.0 - 1e-12)))
        rate = gain / (holds + way + TURN_S)
        rate[(holds + way) > max(question.left_s, HOLDS_S[0])] = -1.0
        d, k = np.unravel_index(int(rate.argmax()), rate.shape)
        return Advice(Kind.GO, reason, float(places.h[k]), float(places.voltage[k]), HOLDS_S[d])

    def _places(self, curves: Sequence[Curve], specimen: Specimen, stretch: tuple[float, float]) -> Places:
        return Places(specimen, self.h, self.voltage, self.scene.rates["force"], curves[0], stretch)

    def _information(self, places: Places, curves: Sequence[Curve]) -> Array:
        """That of the samples recorded so far, each at the nearest place."""
        seconds = np.zeros(places.h.size)
        for curve in curves:
            here = np.flatnonzero(np.abs(places.voltage - curve.nominal_voltage) < 1.0)
            if here.size:
                h = curve.h[curve.usable]
                nearest = here[np.abs(places.h[here][:, None] - h).argmin(axis=0)]
                seconds += np.bincount(nearest, minlength=seconds.size) / self.scene.rates["force"]
        information: Array = (places.rows * seconds[:, None]).T @ places.rows
        return information

    def _way(self, places: Places, question: Ask) -> Array:
        """Seconds from where the film is to each place."""
        ramp = self.scene.hv.ramp_V_per_s if self.scene.hv is not None else math.inf
        change = np.abs(places.voltage - question.voltage)
        way: Array = np.abs(places.h - question.h) / self.speed + change / ramp + self.settle_s * (change > 0.0)
        return way


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
