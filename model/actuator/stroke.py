"""How far an actuator goes as its voltage rises, what ends it, and the work it can do on the way.

At every displacement one voltage makes the film balance the bias. As the voltage rises from zero the disk follows that
curve; where the curve falls the disk snaps to where it has risen again. So the displacement is a good coordinate: it
passes folds of the equilibrium, and the highest voltage met on the way is the one that was needed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from model.actuator.bias import forces
from model.actuator.equilibrium import Actuator, Balance, balance, films_of, kind_of, solve_films, weigh
from model.actuator.roots import bracketed, enclosed
from model.arrays import Array
from model.membrane.solve import Solutions, Status, Wrinkling
from model.stability.limits import slack_voltage

SAMPLES = 65  # displacements at which the rest is looked for
CHUNK = 6  # displacements of the path solved together
STEP = 0.01  # their distance at first, in ring radii ...
GROWTH = 1.2  # ... and how it grows from one to the next
COARSE = 1e-6  # tolerance on the way to the bracket of the end
CORRECTIONS = 5  # of a voltage that is nearly right
ORDER = 16  # of the quadrature of the work
NEAR = 1e-6  # of zero, a criterion that is reached
INSIDE = 1e-5  # error of a peak field inside the film, which a parabola between points finds


class Limit(IntEnum):
    """What ends the stroke of an actuator."""

    BREAKDOWN = 0
    TENSION = 1
    STRETCH = 2
    VOLTAGE = 3
    SNAP = 4
    FILM = 5
    RANGE = 6
    NO_REST = 7

    @property
    def message(self) -> str:
        """One sentence for the operator."""
        return _MESSAGES[self]


_MESSAGES = {
    Limit.BREAKDOWN: "The largest true field reaches the dielectric strength.",
    Limit.TENSION: "Hoop tension is lost somewhere.",
    Limit.STRETCH: "The largest stretch reaches its limit.",
    Limit.VOLTAGE: "The voltage reaches its limit.",
    Limit.SNAP: "A little more voltage, and the disk snaps to where another limit is exceeded or nothing holds it.",
    Limit.FILM: "The film has no further answer: it goes slack or unstable.",
    Limit.RANGE: "The displacement reaches the end of the bias's law, or of what is looked at.",
    Limit.NO_REST: "Film and bias have no stable balance without voltage.",
}


@dataclass(frozen=True)
class Criteria:
    """What must not be exceeded; None or False: no such limit.

    Parameters
    ----------
    field : largest true field (V/m)
    tension : the hoop stress must not fall below zero
    stretch : largest principal stretch
    voltage : V
    """

    field: float | None = None
    tension: bool = False
    stretch: float | None = None
    voltage: float | None = None

    def __post_init__(self) -> None:
        for name in ("field", "stretch", "voltage"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise ValueError(f"criteria: {name} = {value!r}; it must be positive and finite, or None")

    def excess(self, film: Solutions, voltage: Array, shear: Array) -> tuple[Array, NDArray[np.int8]]:
        """The largest of the criteria's values, each below zero while it is kept, and which one that is."""
        values = np.full((4, *voltage.shape), -np.inf)
        if self.field is not None:
            values[Limit.BREAKDOWN] = film.peak_field / self.field - 1.0
        if self.tension:
            values[Limit.TENSION] = -film.min_hoop_stress / shear
        if self.stretch is not None:
            values[Limit.STRETCH] = film.max_stretch / self.stretch - 1.0
        if self.voltage is not None:
            values[Limit.VOLTAGE] = voltage / self.voltage - 1.0
        return values.max(axis=0), values.argmax(axis=0).astype(np.int8)


@dataclass(frozen=True)
class Strokes:
    """Strokes of many actuators: arrays with one entry each, NaN where there is no rest.

    Attributes
    ----------
    rest, reached : displacement without voltage and at the end (m)
    voltage : the highest that was needed (V)
    work : integral of bias minus film force at that voltage over the stroke (J)
    work_error : estimated relative error of the quadrature
    blocked_force : bias minus film force at that voltage with the disk held at rest (N)
    peak_field, min_hoop_stress, max_stretch : at the end (V/m, Pa, 1)
    limit : what ends the stroke, `Limit` numbers
    status : of the film at the end, `model.membrane.solve.Status` numbers
    way : the worst status of the film while it does the work; SLACK: there it pulls with no force
    snaps : how often the disk snaps on the way
    error_estimate : estimated error of the stroke (m)
    """

    rest: Array
    reached: Array
    voltage: Array
    work: Array
    work_error: Array
    blocked_force: Array
    peak_field: Array
    min_hoop_stress: Array
    max_stretch: Array
    limit: NDArray[np.int8]
    status: NDArray[np.int8]
    way: NDArray[np.int8]
    snaps: NDArray[np.intp]
    error_estimate: Array

    @property
    def stroke(self) -> Array:
        """Displacement gained (m)."""
        return self.reached - self.rest


def rests(actuators: Sequence[Actuator], tolerance: float = 1e-9) -> Array:
    """Displacement of the first stable balance without voltage (m), NaN where there is none."""
    spans = np.array([one.span for one in actuators])
    h = np.linspace(spans[:, 0], spans[:, 1], SAMPLES, axis=1)
    here = balance(actuators, h, np.zeros(h.shape), 1e-5)
    excess = np.where(here.known, here.excess, np.nan)
    rises = (excess[:, :-1] < 0.0) & (excess[:, 1:] >= 0.0)
    some = np.flatnonzero(rises.any(axis=1))
    rest = np.full(len(actuators), np.nan)
    if some.size == 0:
        return rest
    left = rises.argmax(axis=1)[some]

    def value(x: Array, which: NDArray[np.intp]) -> tuple[Array, Array]:
        there = balance([actuators[i] for i in some[which]], x, np.zeros(x.shape), tolerance)
        return there.excess, there.stiffness

    close = tolerance * spans[some, 1]
    rest[some] = bracketed(value, h[some, left], h[some, left + 1], np.ones(some.size, dtype=np.bool_), close)
    return rest


def balancing(
    actuators: Sequence[Actuator], h: Array, tolerance: float = 1e-8, start: Array | None = None
) -> tuple[Balance, NDArray[np.bool_]]:
    """Film and bias at the voltage that makes them balance at ``h`` (actuators, ...), and where the bias is stronger.

    The voltage is NaN where none does: where the bias is stronger than the film without voltage, or where the film goes
    slack or unstable before it is as weak as the bias.
    """
    films, kind = films_of(actuators, h), kind_of(actuators)
    push, bias_by_h = forces([one.bias for one in actuators], h)
    passive = weigh(h, np.zeros(h.shape), solve_films(films, h, np.zeros(h.shape), kind, tolerance), push, bias_by_h)
    overcome = passive.known & (passive.excess < 0.0)
    films = np.broadcast_to(films, h.shape)
    some = passive.known & ~overcome & (push > 0.0)
    part, x, load = films[some], h[some], push[some]
    highest = np.array([slack_voltage(one.film, row) ** 2 for one, row in zip(actuators, h, strict=True)])[some]
    strongest = np.maximum(passive.pull[some], 1e-300)

    def value(square: Array, which: NDArray[np.intp]) -> tuple[Array, Array]:
        root = np.sqrt(square)
        there = weigh(
            x[which], root, solve_films(part[which], x[which], root, kind, tolerance), load[which], load[which]
        )
        return there.excess / strongest[which], 0.5 * there.by_voltage / np.maximum(root, 1e-300) / strongest[which]

    guess = highest * (1.0 - load / strongest) if start is None else np.square(start[some])
    falling = np.zeros(x.size, dtype=np.bool_)
    square = bracketed(value, np.zeros(x.size), highest, falling, tolerance * highest, guess)
    voltage = np.zeros(h.shape)
    voltage[some] = np.sqrt(square)
    found = weigh(h, voltage, solve_films(films, h, voltage, kind, tolerance), push, bias_by_h)
    with np.errstate(all="ignore"):
        off = np.abs(found.excess) > 1e3 * tolerance * passive.pull
    none = ~some | off | ~found.film.answered
    return replace(found, voltage=np.where(none, np.nan, voltage), known=~none), overcome


def corrected(actuators: Sequence[Actuator], h: Array, voltage: Array, tolerance: float = 1e-8) -> Balance:
    """Like `balancing`, from voltages that are nearly right; ``h`` and ``voltage`` hold one state an actuator."""
    films, kind = films_of(actuators, h), kind_of(actuators)
    push, bias_by_h = forces([one.bias for one in actuators], h)
    voltage = np.array(voltage)
    for n in range(CORRECTIONS):
        there = weigh(h, voltage, solve_films(films, h, voltage, kind, tolerance), push, bias_by_h)
        near = there.known & (np.abs(there.excess) <= tolerance * np.abs(push))
        if near.all() or n == CORRECTIONS - 1:
            break
        with np.errstate(all="ignore"):
            # V^2 is the nearly linear unknown: d(V^2) = 2 V dV.
            square = voltage**2 - 2.0 * voltage * there.excess / there.by_voltage
        voltage = np.where(near | ~(square > 0.0), voltage, np.sqrt(np.maximum(square, 0.0)))
    if not near.all():
        some = np.flatnonzero(~near)
        voltage[some] = balancing([actuators[int(i)] for i in some], h[some], tolerance)[0].voltage
        volts = np.nan_to_num(voltage)
        there = weigh(h, volts, solve_films(films, h, volts, kind, tolerance), push, bias_by_h)
        known = there.known & np.isfinite(voltage)
        there = replace(there, voltage=np.where(known, voltage, np.nan), known=known)
    return there


@dataclass
class _Way:
    """One actuator's way: the last state reached, the fold it is jumping from, and the bracket of its end."""

    h: float
    voltage: float
    excess: float
    stiffness: float
    reached: float  # displacement looked at last
    slope: float = 0.0  # of V^2 over displacement, lately
    fold: bool = False
    end: _Point | None = None  # beyond the end
    steepness: float = math.inf  # how fast the criterion's value rises with displacement at the end (1/m)
    limit: Limit | None = None
    snaps: int = 0

    @property
    def square(self) -> float:
        """V^2."""
        return self.voltage**2


def strokes(
    actuators: Sequence[Actuator],
    criteria: Criteria,
    *,
    tolerance: float = 1e-8,
    folds_at_work: Wrinkling | None = None,
) -> Strokes:
    """Raise the voltage of every actuator slowly from zero until a criterion ends its stroke.

    The work is ``integral of (B - F(h, V)) dh`` from rest to the end, at the highest voltage throughout: what the
    actuator gives to a load that holds it back all the way. ``folds_at_work`` says how folds are treated in it; when
    left out, as in the actuators. A snap is followed to where it lands; what the film meets on its flight is not
    looked at.
    """
    rest = rests(actuators, min(tolerance, 1e-9))
    good = np.flatnonzero(np.isfinite(rest))
    chosen = [actuators[int(i)] for i in good]
    ways = _follow(chosen, rest[good], criteria, tolerance) if chosen else []
    return _gather(actuators, rest, good, ways, criteria, tolerance, folds_at_work)


def _shear(actuators: Sequence[Actuator]) -> Array:
    return np.array([one.film.material.shear_modulus for one in actuators])


def _follow(actuators: list[Actuator], rest: Array, criteria: Criteria, tolerance: float) -> list[_Way]:
    """Every actuator's way to the bracket of its end, and through it."""
    start = balance(actuators, rest, np.zeros(rest.shape), tolerance)
    excess, which = criteria.excess(start.film, start.voltage, _shear(actuators))
    ways = [
        _Way(float(h), 0.0, float(c), float(k), float(h)) for h, c, k in zip(rest, excess, start.stiffness, strict=True)
    ]
    for way, c, limit in zip(ways, excess, which, strict=True):
        if not c < 0.0:
            way.limit = Limit(int(limit))
    last = np.array([one.span[1] for one in actuators])
    advance = np.cumsum(GROWTH ** np.arange(CHUNK))
    step = STEP * np.array([one.film.ring_radius for one in actuators])
    while active := [i for i, way in enumerate(ways) if way.limit is None and way.end is None]:
        part = [actuators[i] for i in active]
        reached = np.array([ways[i].reached for i in active])
        ahead = np.minimum(reached[:, None] + step[active, None] * advance, last[active, None])
        there, overcome = balancing(part, ahead, max(tolerance, COARSE), _ahead([ways[i] for i in active], ahead))
        excess, _ = criteria.excess(there.film, there.voltage, _shear(part)[:, None])
        for row, i in enumerate(active):
            way = ways[i]
            for j in range(CHUNK):
                if way.end is None and way.limit is None and ahead[row, j] > way.reached:
                    point = _Point(
                        float(ahead[row, j]),
                        float(there.voltage[row, j]),
                        float(excess[row, j]),
                        bool(there.known[row, j]),
                        float(there.stiffness[row, j]),
                        bool(overcome[row, j]),
                    )
                    _advance(way, point, actuators[i], criteria, tolerance)
            if way.end is None and way.limit is None and way.reached >= last[i]:
                way.limit = Limit.SNAP if way.fold else Limit.RANGE
        step = GROWTH**CHUNK * step
    _close_in(actuators, ways, criteria, tolerance)
    return ways


def _ahead(ways: Sequence[_Way], h: Array) -> Array | None:
    """A guess of the voltages that balance at ``h`` (ways, ...): V^2 goes on as it has come."""
    if not all(way.slope > 0.0 for way in ways):
        return None
    square, slope, last = (np.array([getattr(way, name) for way in ways])[:, None] for name in ("square", "slope", "h"))
    return np.asarray(np.sqrt(square + slope * (h - last)))


@dataclass
class _Point:
    """A displacement ahead: the voltage that balances there, if any, and whether that balance is stable."""

    h: float
    voltage: float
    excess: float
    known: bool
    stiffness: float
    overcome: bool

    def beyond(self, way: _Way) -> bool:
        """Whether more voltage leads here, stably."""
        return self.known and self.stiffness > 0.0 and self.voltage >= way.voltage

    def arrive(self, way: _Way) -> None:
        """Make this the state reached, or the far side of the end."""
        if self.excess >= 0.0:
            way.end = self
        else:
            if self.h > way.h:
                way.slope = (self.voltage**2 - way.square) / (self.h - way.h)
            way.h, way.voltage, way.excess, way.stiffness = self.h, self.voltage, self.excess, self.stiffness


def _advance(way: _Way, point: _Point, actuator: Actuator, criteria: Criteria, tolerance: float) -> None:
    """Go on to ``point``: along the stable path, into a snap, or out of one."""
    before, way.reached = way.reached, point.h
    if not (point.known or point.overcome):
        if way.fold:
            way.limit = Limit.SNAP
        else:
            way.end = replace(point, voltage=math.nan, excess=math.nan)
        return
    if way.fold:
        if point.beyond(way):
            _land(way, before, point, actuator, criteria, tolerance)
        return
    if point.beyond(way):
        point.arrive(way)
        return
    # The path turns between the last point and this one.
    fold = enclosed(
        lambda x, _: -balancing([actuator], x, tolerance)[0].stiffness,
        np.array([way.h]),
        np.array([point.h]),
        np.array([-way.stiffness]),
        np.array([-point.stiffness if point.known and point.stiffness < 0.0 else math.nan]),
        np.array([tolerance * actuator.film.ring_radius]),
    )
    _state(actuator, fold, None, criteria, tolerance).arrive(way)
    way.fold = way.end is None


def _state(actuator: Actuator, h: Array, voltage: float | None, criteria: Criteria, tolerance: float) -> _Point:
    """The state at ``h`` (1,) and a voltage; in balance when that is left out."""
    if voltage is None:
        there, _ = balancing([actuator], h, tolerance)
    else:
        there = balance([actuator], h, np.array([voltage]), tolerance)
    excess, _ = criteria.excess(there.film, there.voltage, _shear([actuator]))
    return _Point(
        float(h[0]), float(there.voltage[0]), float(excess[0]), bool(there.known[0]), float(there.stiffness[0]), False
    )


def _land(way: _Way, low: float, point: _Point, actuator: Actuator, criteria: Criteria, tolerance: float) -> None:
    """The end of a snap, between ``low``, which is still jumped over, and ``point``."""

    def missing(x: Array, _: NDArray[np.intp]) -> Array:
        there, overcome = balancing([actuator], x, tolerance)
        value = np.where(overcome, -1.0, there.voltage / way.voltage - 1.0)
        return np.where(there.known & (there.stiffness < 0.0), -1.0, value)

    width = tolerance * actuator.film.ring_radius
    at = enclosed(
        missing,
        np.array([low]),
        np.array([point.h]),
        np.array([-1.0]),
        np.array([point.voltage / way.voltage - 1.0]),
        np.array([width]),
    )
    landing = _state(actuator, at + width, way.voltage, criteria, tolerance)
    if not landing.excess < 0.0:
        way.limit = Limit.SNAP
        return
    way.fold, way.snaps = False, way.snaps + 1
    landing.arrive(way)
    point.arrive(way)


def _close_in(actuators: list[Actuator], ways: list[_Way], criteria: Criteria, tolerance: float) -> None:
    """Follow the ways to the end of their brackets, all together."""
    some = [i for i, way in enumerate(ways) if way.end is not None]
    if not some:
        return
    begin = [ways[i] for i in some]
    ends = [way.end for way in begin if way.end is not None]
    low, low_square, at_low = np.array([(way.h, way.voltage**2, way.excess) for way in begin]).T
    high, high_square, at_high = np.array([(end.h, end.voltage**2, end.excess) for end in ends]).T
    rise = (high_square - low_square) / (high - low)  # V^2 is nearly linear in h
    parts = [actuators[i] for i in some]
    shear = _shear(parts)

    def state(x: Array, which: NDArray[np.intp]) -> Balance:
        part = [parts[i] for i in which]
        if not np.isfinite(rise[which]).all():
            return balancing(part, x, tolerance)[0]
        return corrected(part, x, np.sqrt(low_square[which] + rise[which] * (x - low[which])), tolerance)

    def value(x: Array, which: NDArray[np.intp]) -> Array:
        there = state(x, which)
        return np.where(there.known, criteria.excess(there.film, there.voltage, shear[which])[0], np.nan)

    close = 0.1 * tolerance * np.array([one.film.ring_radius for one in parts])
    h = enclosed(value, low, high, at_low, at_high, close)
    there = state(h, np.arange(len(some)))
    excess, which = criteria.excess(there.film, there.voltage, shear)
    for k, way in enumerate(begin):
        if h[k] > low[k]:
            way.steepness = float((excess[k] - at_low[k]) / (h[k] - low[k]))
        way.h, way.voltage, way.excess = float(h[k]), float(there.voltage[k]), float(excess[k])
        # Where no film was found further on, the criterion may still have ended the stroke before.
        ended = math.isfinite(at_high[k]) or float(excess[k]) > -NEAR
        way.limit = Limit(int(which[k])) if ended else Limit.FILM


def _gather(
    actuators: Sequence[Actuator],
    rest: Array,
    good: NDArray[np.intp],
    ways: list[_Way],
    criteria: Criteria,
    tolerance: float,
    folds_at_work: Wrinkling | None,
) -> Strokes:
    """The results of all actuators."""
    count = len(actuators)
    real = {
        name: np.full(count, np.nan)
        for name in (
            "reached",
            "voltage",
            "work",
            "work_error",
            "blocked_force",
            "peak_field",
            "min_hoop_stress",
            "max_stretch",
            "error_estimate",
        )
    }
    limit = np.full(count, Limit.NO_REST, dtype=np.int8)
    status, way = (np.full(count, Status.INVALID, dtype=np.int8) for _ in range(2))
    snaps = np.zeros(count, dtype=np.intp)
    if ways:
        chosen = [actuators[i] for i in good]
        reached, voltage = np.array([one.h for one in ways]), np.array([one.voltage for one in ways])
        limit[good], snaps[good] = [int(one.limit or 0) for one in ways], [one.snaps for one in ways]
        end = balance(chosen, reached, voltage, tolerance)
        begin = balance(chosen, rest[good], np.zeros(len(good)), tolerance)
        for name in ("peak_field", "min_hoop_stress", "max_stretch"):
            real[name][good] = getattr(end.film, name)
        status[good] = end.film.status
        real["reached"][good], real["voltage"][good] = reached, voltage
        sharp = balance(chosen, reached, voltage, max(1e-3 * tolerance, 1e-12))
        shear = _shear(chosen)
        off = criteria.excess(sharp.film, voltage, shear)[0] - criteria.excess(end.film, voltage, shear)[0]
        inside = end.film.peak_field_radius > 1.0001 * np.array([one.film.disk_radius for one in chosen])
        off = 2.0 * np.abs(np.nan_to_num(off)) + np.where(inside & (limit[good] == Limit.BREAKDOWN), INSIDE, 0.0)
        steep = np.array([one.steepness for one in ways])
        with np.errstate(all="ignore"):
            real["error_estimate"][good] = (
                begin.film.error_estimate * begin.pull / np.abs(begin.stiffness)
                + (off + end.film.error_estimate) / steep
                + tolerance * np.array([one.film.ring_radius for one in chosen])
            )
        work = _work(chosen, rest[good], reached, voltage, tolerance, folds_at_work)
        real["work"][good], real["work_error"][good], real["blocked_force"][good], way[good] = work
    return Strokes(rest=rest, limit=limit, status=status, way=way, snaps=snaps, **real)


def _work(
    actuators: list[Actuator], low: Array, high: Array, voltage: Array, tolerance: float, folds: Wrinkling | None
) -> tuple[Array, Array, Array, NDArray[np.int8]]:
    """Work, its relative error, the force at the beginning, and the worst status met."""
    nodes, weights, coarse = quadrature()
    h = low[:, None] + (high - low)[:, None] * nodes
    kind = folds or kind_of(actuators)
    volts = np.broadcast_to(voltage[:, None], h.shape)
    push, slope = forces([one.bias for one in actuators], h)
    there = weigh(h, volts, solve_films(films_of(actuators, h), h, volts, kind, tolerance), push, slope)
    net = -there.excess
    work, rough = (high - low) * (net @ weights), (high - low) * (net[:, ::2] @ coarse)
    with np.errstate(all="ignore"):
        error = np.abs(work - rough) / np.abs(work) + tolerance
    return work, error, net[:, 0], there.film.status.max(axis=1)


@lru_cache(maxsize=1)
def quadrature() -> tuple[Array, Array, Array]:
    """Clenshaw-Curtis on 0 to 1: nodes, weights, and the weights of every other node for the error."""
    return _nodes(ORDER), clenshaw_curtis(ORDER), clenshaw_curtis(ORDER // 2)


def _nodes(n: int) -> Array:
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.arange(n + 1) / n))


def clenshaw_curtis(n: int) -> Array:
    """Weights of the nodes ``(1 - cos(pi k/n))/2``, ``k = 0 ... n`` even, on an interval of length one."""
    k = np.arange(1, n // 2 + 1)
    b = np.where(k == n // 2, 1.0, 2.0)
    angle = 2.0 * np.pi * np.outer(np.arange(n + 1), k) / n
    c = np.where((np.arange(n + 1) == 0) | (np.arange(n + 1) == n), 1.0, 2.0)
    return np.asarray(0.5 * c / n * (1.0 - (np.cos(angle) * b / (4.0 * k**2 - 1.0)).sum(axis=1)))
