"""Where to hold a film, and for how long, so that its stiffness and permittivity come out best in the time there is.

Holding the film for ``t`` seconds at a displacement and a voltage gives ``rate t`` readings of one force, with the
information ``rate t s s'/sigma^2`` about the parameters (``s``: derivatives of the force by them). The design minimises
the sum of the logarithms of the variances of what is wanted (compound c-optimality, Atkinson & Donev). For given places
the best shares of the time follow from a multiplicative rule (Silvey, Titterington & Torsney 1978); the places are
improved by exchange on a grid, where every place costs the time of getting there.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.film.curve import Curve
from calibration.film.propagation import secant
from model.material.materials import Material
from model.material.ogden import Ogden
from model.membrane.solve import solve_many
from model.specimen import Specimen

Array = NDArray[np.float64]

LEAST_DWELL = 2.0  # s at a place worth going to
PLACE = 2e-3  # what a place less may cost of the sum of logarithms
ROUNDS, SHARES = 60, 40  # exchanges at most; iterations of the rule for the shares
WIDE_PRIOR = 100.0  # prior deviation of ln mu, alpha, ln eps_r: says nothing, keeps every matrix regular


@dataclass(frozen=True, order=True)
class Dwell:
    """Hold the film at ``voltage`` (V) and displacement ``h`` (m) for ``seconds``."""

    voltage: float
    h: float
    seconds: float


Overhead = Callable[[Sequence[Dwell]], float]  # seconds that the places of a route cost besides the time held


class Places:
    """Displacements and voltages (K,) at which a film can be held, and what a second at each of them tells."""

    def __init__(
        self, specimen: Specimen, h: Array, voltage: Array, rate: float, errors: Curve, stretch: tuple[float, float]
    ) -> None:
        """``errors`` states noise, zeros and compliance; ``stretch`` is where the stiffness is wanted."""
        material = specimen.material
        solved = solve_many(specimen, h, voltage, sensitivities=True)
        slopes = solved.dforce
        assert slopes is not None
        mu = np.array(material.mu)
        charged = bool((voltage != 0.0).any())
        columns = [slopes["mu"] * mu, slopes["alpha"]]
        prior = [WIDE_PRIOR] * (mu.size + len(material.alpha))
        if charged:
            columns.append(slopes["eps_r"][:, None] * material.eps_r)
            prior.append(WIDE_PRIOR)
        for slope, size in (
            (np.ones(h.size), errors.force_zero),
            (slopes["h"], errors.displacement_zero),
            (slopes["h"] * solved.force, errors.compliance_uncertainty),
        ):
            if size > 0.0:
                columns.append(slope[:, None])
                prior.append(size)
        sigma = np.hypot(errors.force_noise, slopes["h"] * errors.displacement_noise)
        rows = np.concatenate(columns, axis=1) * (math.sqrt(rate) / sigma)[:, None]
        value, by_mu, by_alpha = secant(material, np.array([stretch[0]]), stretch[1])
        self.wanted = np.zeros((2 if charged else 1, rows.shape[1]))
        of_law = np.concatenate((by_mu[0] * mu, by_alpha[0])) / value[0]
        self.wanted[0, : of_law.size] = of_law
        if charged:
            self.wanted[1, of_law.size] = 1.0
        self.prior = np.diag(np.array(prior) ** -2.0)
        self.weight = np.ones(len(self.wanted))  # of the logarithms of the variances of what is wanted
        usable = np.isfinite(rows).all(axis=1)
        self.h, self.voltage, self.rows = h[usable], voltage[usable], rows[usable]

    def judge(self, seconds: Array, these: Sequence[int]) -> tuple[float, Array]:
        """The weighted sum of the logarithms of the variances of stiffness and permittivity, and what a second more at
        each of ``these`` places takes off it."""
        rows = self.rows[list(these)]
        toward = np.linalg.solve(self.prior + (rows * seconds[:, None]).T @ rows, self.wanted.T)
        variance = np.einsum("jp,pj->j", self.wanted, toward)
        worth: Array = (rows @ toward) ** 2 @ (self.weight / variance)
        return float(self.weight @ np.log(variance)), worth

    def shared(self, time: float, these: Sequence[int]) -> tuple[float, Array]:
        """The value of the best shares of ``time`` (s) at ``these`` places, and the shares.

        A share grows by the root of what it is worth: by the worth itself, shares go to and fro about those that make a
        variance least (Fellman 1974; Torsney 1983).
        """
        seconds = np.full(len(these), time / len(these))
        for _ in range(SHARES):
            seconds = seconds * np.sqrt(self.judge(seconds, these)[1])
            seconds *= time / seconds.sum()
        return self.judge(seconds, these)[0], seconds


def one_term(material: Material, stretches: tuple[float, float], hoop: float) -> Material:
    """The film of one Ogden term with the same meridional stress at two meridional stretches."""
    wanted, *_ = secant(material, np.array(stretches), hoop)

    def stiffening(alpha: float) -> float:
        found, *_ = secant(replace(material, mu=(1.0,), alpha=(alpha,), law=Ogden), np.array(stretches), hoop)
        return float(found[1] / found[0])

    low, high = 0.5, 30.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stiffening(middle) < wanted[1] / wanted[0] else (low, middle)
    unit, *_ = secant(replace(material, mu=(1.0,), alpha=(low,), law=Ogden), np.array(stretches), hoop)
    modulus = float(wanted[0] / unit[0])
    return replace(material, name=f"{material.name}, one term", mu=(modulus,), alpha=(low,), law=Ogden)


def propose(places: Places, time: float, overhead: Overhead) -> list[Dwell]:
    """Where to hold the film and how long, in all no longer than ``time`` (s) with what getting there costs.

    Returns the route: voltage by voltage, up and down in turn, and at last the lowest voltage once more. Empty when
    the time is not enough for any two places.
    """

    def judged(these: Sequence[int]) -> tuple[float, list[Dwell]]:
        if len(these) < 2:
            return math.inf, []
        left = time - overhead(_route(places, these, np.full(len(these), 2.0 * LEAST_DWELL)))
        if left < LEAST_DWELL * len(these):
            return math.inf, []
        value, seconds = places.shared(left, these)
        if seconds.min() < LEAST_DWELL:
            seconds = np.maximum(seconds, LEAST_DWELL)
            seconds *= left / seconds.sum()
            value = places.judge(seconds, these)[0]
        return value, _route(places, these, seconds)

    everywhere = range(places.h.size)
    if len(everywhere) < 2:
        return []
    _, ideal = places.shared(time, everywhere)
    chosen: list[int] = []
    for k in np.argsort(-ideal):  # the ideal's places, one of each neighbourhood
        if len(chosen) < 8 and not any(_near(places, int(k), other) for other in chosen):
            chosen.append(int(k))
    best, route = judged(chosen)
    for _ in range(ROUNDS):
        trials = [[*chosen[:i], *chosen[i + 1 :]] for i in range(len(chosen))]
        trials += [
            [*chosen[:i], k, *chosen[i + 1 :]]
            for i in range(len(chosen))
            for k in everywhere
            if k not in chosen and _near(places, k, chosen[i])
        ]
        if chosen:
            worth = places.judge(_spread_over(places, chosen, time), everywhere)[1]
            trials += [[*chosen, int(k)] for k in np.argsort(-worth)[:6] if k not in chosen]
        if not trials:
            break
        # Fewer places are worth a little: every one is a step of the protocol.
        value, found, those = min(((*judged(one), one) for one in trials), key=lambda e: e[0] + PLACE * len(e[2]))
        if not value + PLACE * len(those) < best + PLACE * len(chosen) - 1e-6:
            break
        best, route, chosen = value, found, those
    return route


def _spread_over(places: Places, these: Sequence[int], time: float) -> Array:
    seconds = np.zeros(places.h.size)
    seconds[list(these)] = time / len(these)
    return seconds


def _near(places: Places, one: int, other: int) -> bool:
    """Whether two places are neighbours on their grid."""
    h, voltage = np.unique(places.h), np.unique(places.voltage)
    step_h = np.diff(h).max(initial=0.0)
    away = abs(
        int(np.searchsorted(voltage, places.voltage[one])) - int(np.searchsorted(voltage, places.voltage[other]))
    )
    return away <= 1 and abs(places.h[one] - places.h[other]) <= 1.01 * step_h


def _route(places: Places, these: Sequence[int], seconds: Array) -> list[Dwell]:
    """Voltage by voltage upwards; the displacements of every other voltage in falling order.

    Half of the longest stay at the lowest voltage comes at the end, so that a film or a sensor that changes with time
    does not pass for an effect of the voltage.
    """
    dwells = [
        Dwell(float(places.voltage[k]), float(places.h[k]), float(one)) for k, one in zip(these, seconds, strict=True)
    ]
    route = []
    for number, (_, group) in enumerate(itertools.groupby(sorted(dwells), key=lambda dwell: dwell.voltage)):
        route += sorted(group, key=lambda dwell: dwell.h, reverse=number % 2 == 1)
    lowest = [dwell for dwell in route if dwell.voltage == route[0].voltage]
    longest = max(lowest, key=lambda dwell: dwell.seconds)
    if len(lowest) < len(route) and longest.seconds >= 2.0 * LEAST_DWELL:
        half = replace(longest, seconds=0.5 * longest.seconds)
        route[route.index(longest)] = half
        route.append(half)
    return route
