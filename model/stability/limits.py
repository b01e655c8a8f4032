"""Voltages that end a film's work at a given displacement: loss of tension, breakdown, pull-in."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.arrays import Array
from model.material.law import stack
from model.membrane.solve import Solutions, Status, Wrinkling, solve_many
from model.specimen import Specimen
from model.stability.branches import pull_in

ROUNDS = 60
NEXT_TO_SLACK = 1e-4  # of the slack voltage


@dataclass(frozen=True)
class Limit:
    """A voltage and the state there; arrays of the shape of ``h``, NaN where there is no such voltage.

    Attributes
    ----------
    voltage : V
    force : N
    peak_field : V/m
    min_hoop_stress : Pa
    status : `model.membrane.solve.Status` numbers: of the state there, or of why the voltage was not reached
    """

    voltage: Array
    force: Array
    peak_field: Array
    min_hoop_stress: Array
    status: NDArray[np.int8]


@dataclass(frozen=True)
class TautLimit(Limit):
    """The voltage at which tension is first lost, beside the breakdown voltage at the same displacement."""

    breakdown_voltage: Array


def taut_limit(specimen: Specimen, h: ArrayLike, *, tolerance: float = 1e-8) -> TautLimit:
    """Voltage at which some part of the film first loses its hoop tension, to ``tolerance`` relative.

    A film that is wrinkled without voltage has the limit 0 V and the status WRINKLED; one that is taut until it pulls
    in has the last taut voltage and the status UNSTABLE. ``breakdown_voltage`` is that of `breakdown_voltage` with
    wrinkles allowed for, NaN where the material states no strength.
    """
    displacement = np.asarray(h, dtype=float)
    rest = solve_many(specimen, displacement, 0.0, tolerance=tolerance)
    taut = np.asarray(rest.status == Status.TAUT)

    def margin(found: Solutions) -> Array:
        share = found.min_hoop_stress / np.where(rest.min_hoop_stress > 0.0, rest.min_hoop_stress, 1.0)
        return np.where(found.answered, share, -1.0)

    voltage, found = _root(specimen, displacement, margin, slack_voltage(specimen, displacement), tolerance, "plain")
    voltage = np.where(taut, voltage, np.where(rest.status == Status.WRINKLED, 0.0, np.nan))
    pulled = taut & (found.min_hoop_stress > 1e-3 * rest.min_hoop_stress)
    field = specimen.material.breakdown_field
    strength = np.full(displacement.shape, np.nan)
    if field is not None:
        strength = breakdown_voltage(specimen, displacement, field, tolerance=tolerance).voltage
    return TautLimit(
        voltage=voltage,
        force=np.where(taut, found.force, rest.force),
        peak_field=np.where(taut, found.peak_field, rest.peak_field),
        min_hoop_stress=np.where(taut, found.min_hoop_stress, rest.min_hoop_stress),
        status=np.where(pulled, Status.UNSTABLE, np.where(taut, found.status, rest.status)).astype(np.int8),
        breakdown_voltage=strength,
    )


def breakdown_voltage(
    specimen: Specimen,
    h: ArrayLike,
    field: float | None = None,
    *,
    tolerance: float = 1e-8,
    wrinkling: Wrinkling = "tension_field",
) -> Limit:
    """Voltage at which the largest true field reaches ``field`` (V/m; the material's strength when left out).

    NaN, with the status of the state that ends the way, where the film goes slack or pulls in before.

    Raises
    ------
    ValueError : no field is given and the material states none
    """
    limit = specimen.material.breakdown_field if field is None else field
    if limit is None:
        raise ValueError(f"material {specimen.material.name!r} states no breakdown field: give one")
    if not 0.0 < limit < math.inf:
        raise ValueError(f"field = {limit!r} V/m: it must be positive and finite")
    displacement = np.asarray(h, dtype=float)

    def margin(found: Solutions) -> Array:
        return np.where(found.answered, 1.0 - found.peak_field / limit, -1.0)

    # The film is nowhere thicker than pre-stretched flat: its area grows.
    highest = np.full(displacement.shape, 1.5 * limit * specimen.thickness / min(specimen.prestretch, 1.0) ** 2)
    voltage, found = _root(specimen, displacement, margin, highest, tolerance, wrinkling)
    reached = np.abs(found.peak_field / limit - 1.0) < max(1e-6, 100.0 * tolerance)
    return _where(reached, voltage, found)


def pull_in_voltage(
    specimen: Specimen, h: ArrayLike, *, tolerance: float = 1e-5, wrinkling: Wrinkling = "plain"
) -> Limit:
    """Voltage beyond which the branch that starts at 0 V has no stable state at this displacement.

    With the plain equations the fold is found by arc length; the state given is the last stable one that is solved,
    within ``tolerance`` below it. With "tension_field" the voltage is found by halving. NaN where the film has no such
    voltage, with the status SLACK where it loses all tension first.
    """
    displacement = np.asarray(h, dtype=float)
    slack = slack_voltage(specimen, displacement)
    low, high = np.zeros(displacement.shape), slack * (1.0 - 1e-9)
    top = solve_many(specimen, displacement, high, tolerance=1e-6, wrinkling=wrinkling)
    reason = np.asarray(top.status)
    lost = np.where(top.status == Status.UNSTABLE, high, np.inf)  # lowest voltage known to be beyond
    for _ in range(math.ceil(-math.log2(tolerance))):
        middle = 0.5 * (low + high)
        found = solve_many(specimen, displacement, middle, tolerance=1e-6, wrinkling=wrinkling)
        low = np.where(found.answered, middle, low)
        high = np.where(found.answered, high, middle)
        lost = np.where(found.status == Status.UNSTABLE, np.minimum(lost, middle), lost)
        reason = np.where(found.answered, reason, found.status)
    found = solve_many(specimen, displacement, low, tolerance=1e-6, wrinkling=wrinkling)
    # Close to the fold the solver may give up before it can tell why.
    low, pulled = np.asarray(low), np.asarray(lost < low * (1.0 + max(0.01, tolerance)))
    # Next to slack nothing has stiffness left that could tell the two ends apart; the force is gone there anyway.
    slackens = np.asarray(low >= slack * (1.0 - NEXT_TO_SLACK))
    pulled &= ~slackens
    if wrinkling == "plain":
        for i in np.ndindex(low.shape):
            if not pulled[i]:
                continue
            fold = pull_in(specimen, abs(float(displacement[i])), 1.02 * float(lost[i]))
            if fold is not None:
                low[i] = fold
    answer = _where(pulled, low, found)
    status = np.where(pulled, found.status, np.where(top.answered | slackens, Status.SLACK, reason)).astype(np.int8)
    return Limit(answer.voltage, answer.force, answer.peak_field, answer.min_hoop_stress, status)


def _where(good: NDArray[np.bool_], voltage: Array, found: Solutions) -> Limit:
    return Limit(
        voltage=np.where(good, voltage, np.nan),
        force=np.where(good, found.force, np.nan),
        peak_field=np.where(good, found.peak_field, np.nan),
        min_hoop_stress=np.where(good, found.min_hoop_stress, np.nan),
        status=found.status,
    )


def slack_voltage(specimen: Specimen, h: Array) -> Array:
    """Voltage at which a straight cone without hoop stress would have no tension left: nothing is taut beyond."""
    m = specimen.material
    mean = np.abs(h) / (specimen.ring_radius - specimen.disk_radius)
    stretch = np.log(specimen.prestretch) + 0.5 * np.log1p(mean * mean)
    law = m.law(np.array(m.mu)[:, None], np.array(m.alpha)[:, None])
    log = np.atleast_1d(stretch)
    tension = law.derivatives(stack(log, log))[0].reshape(stretch.shape)
    return np.asarray(np.sqrt(np.maximum(tension, 0.0) / m.permittivity) * specimen.thickness * np.exp(-2.0 * stretch))


def _root(
    specimen: Specimen,
    h: Array,
    margin: Callable[[Solutions], Array],
    high: Array,
    tolerance: float,
    wrinkling: Wrinkling,
) -> tuple[Array, Solutions]:
    """Largest voltage known with a margin above zero, by the Illinois method on V^2, and the solutions there."""
    low2, high2 = np.zeros(h.shape), np.asarray(high, dtype=float) ** 2

    def at(square: Array) -> Solutions:
        return solve_many(specimen, h, np.sqrt(square), tolerance=tolerance, wrinkling=wrinkling)

    at_low, at_high = margin(at(low2)), margin(at(high2))
    side = np.zeros(h.shape)
    for n in range(ROUNDS):
        width = high2 - low2
        if not np.any(width > tolerance * high2):
            break
        bracketed = (at_low > 0.0) & (at_high < 0.0)
        share = np.where(bracketed, at_low / np.where(bracketed, at_low - at_high, 1.0), 0.5)
        # A known sign change is closed in from both sides: a step never leaves less than a hundredth of the tolerance.
        edge = np.minimum(0.5, 0.4 * tolerance * high2 / np.where(width > 0.0, width, 1.0))
        share = np.clip(np.where(n % 4 == 3, 0.5, share), edge, 1.0 - edge)
        middle = low2 + share * width
        value = margin(at(middle))
        up = value > 0.0
        at_high = np.where(up & (side > 0), 0.5 * at_high, at_high)
        at_low = np.where(~up & (side < 0), 0.5 * at_low, at_low)
        side = np.where(up, 1.0, -1.0)
        low2, at_low = np.where(up, middle, low2), np.where(up, value, at_low)
        high2, at_high = np.where(up, high2, middle), np.where(up, at_high, value)
    return np.sqrt(low2), at(low2)
