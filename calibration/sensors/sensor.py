r"""From standards applied and readings taken to a sensor's gain, with a budget of its uncertainty.

A calibration is a list of standstills: a standard (a weight, a stage position, a reference meter's voltage) was applied
and the sensor read for a while. The readings y follow the standards x as

.. math:: y = z + d\,t + s\,x \; (+ c_2 x^2 + c_3 x^3)

with a zero z, a drift d and the slope s; the gain is 1/s. Higher orders are looked for (least AICc, Hurvich & Tsai
1989) and, where found, counted as an error of linearity, because the gain of a certificate is one number. The budget
follows the GUM (JCGM 100:2008): every component is a relative standard uncertainty of the gain; they add in squares.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

HIGHEST_ORDER = 3
FEWEST = 6  # standstills; fewer leave nothing to judge the fit by
COVERAGE = 2.0  # expanded uncertainty U = 2 u


class SensorError(ValueError):
    """Data that make no calibration; the message says what is missing."""


@dataclass(frozen=True)
class Standstill:
    """One standard applied, and what the sensor read meanwhile.

    Attributes
    ----------
    applied : float
        The standard's quantity (N, m, V).
    applied_error : float
        Its own standard uncertainty, the same error each time this ``standard`` is applied.
    standard : str
        Which one: "20 g", "12 mm". Applications of one standard share its error.
    reading : float
        Mean of the sensor's readings, in its own unit.
    scatter : float
        Standard deviation of one reading.
    count : int
        How many readings.
    t : float
        Mean time (s).
    cycle, direction : int
        Which round; +1 when the standards were rising, -1 falling.
    """

    applied: float
    applied_error: float
    standard: str
    reading: float
    scatter: float
    count: int
    t: float
    cycle: int = 1
    direction: int = 1


@dataclass(frozen=True)
class Component:
    """One line of the budget: a relative standard uncertainty of the gain.

    ``type`` is A where it was found by statistics of these data, B otherwise.
    """

    name: str
    type: Literal["A", "B"]
    relative: float
    note: str = ""


@dataclass(frozen=True)
class Characteristic:
    """What the standstills say of one sensor.

    Attributes
    ----------
    gain : float
        Quantity per unit of the reading.
    gain_uncertainty : float
        Relative standard uncertainty of it, the root of the budget's squares.
    budget : tuple of Component
    order : int
        Polynomial order of least AICc; 1: nothing beyond a straight line is seen.
    zero, drift : float
        Reading at nothing applied at the first standstill; its change per second. In the sensor's unit.
    noise : float
        Standard deviation of one reading, as a quantity.
    zero_uncertainty : float
        Standard deviation of the readings with nothing applied, drift included, as a quantity.
    hysteresis, repeatability, linearity : float
        As quantities: mean difference of falling and rising; standard deviation between rounds; largest difference
        between the best polynomial and the line.
    residuals : array
        Of each standstill from the line, as a quantity.
    low, high : float
        Range of the standards.
    """

    gain: float
    gain_uncertainty: float
    budget: tuple[Component, ...]
    order: int
    zero: float
    drift: float
    noise: float
    zero_uncertainty: float
    hysteresis: float
    repeatability: float
    linearity: float
    residuals: Floats
    low: float
    high: float
    standstills: tuple[Standstill, ...] = field(repr=False)

    def expanded_uncertainty(self, quantity: float) -> float:
        """U (k = 2) of one mean reading of ``quantity``: gain and zero in squares."""
        return COVERAGE * math.hypot(self.gain_uncertainty * quantity, self.zero_uncertainty)


def characterise(
    standstills: Sequence[Standstill], common: Mapping[str, float], resolution: float = 0.0
) -> Characteristic:
    """Fit the standstills of one sensor and draw up its budget.

    Parameters
    ----------
    standstills : sequence of Standstill
        At least `FEWEST`, with at least two standards.
    common : mapping of str to float
        Relative standard uncertainties that all standards share (local gravity, air buoyancy), by name.
    resolution : float
        Smallest step of the reading, in its unit.

    Raises
    ------
    SensorError
        When the data cannot determine a gain.
    """
    if len(standstills) < FEWEST:
        raise SensorError(f"{len(standstills)} standstills; at least {FEWEST} are needed.")
    x, y, t = (np.array([getattr(one, key) for one in standstills]) for key in ("applied", "reading", "t"))
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise SensorError("The sensor gave no valid reading at one of the standstills; is it in range?")
    span = float(np.ptp(x))
    if not span > 0:
        raise SensorError("All standstills have the same standard; a gain needs at least two.")
    t = t - t[0]
    own = np.array([one.scatter / math.sqrt(one.count) for one in standstills])
    orders = range(1, min(HIGHEST_ORDER, len(set(x.tolist())) - 1) + 1)
    fits = {order: _fit(x, y, t, order) for order in orders}
    rounding = 1e-12 * float(np.abs(y).max())  # below this residuals say nothing
    order = min(fits, key=lambda one: _aicc(fits[one][1], one + 2, rounding))
    coefficients, residuals, inverse = fits[1]
    zero, drift, slope = coefficients[:3].tolist()
    if slope == 0:
        raise SensorError("The reading does not follow the standard at all. Is the sensor connected?")
    gain = 1.0 / slope
    freedom = len(x) - 3
    scatter = max(math.sqrt(float(residuals @ residuals) / freedom), float(np.sqrt(np.mean(own**2))))
    best, line = (_polynomial(fits[one][0], x) for one in (order, 1))
    linearity = float(np.ptp(best - line)) / 2 * abs(gain) if order > 1 else 0.0
    hysteresis = _hysteresis(standstills, residuals) * gain
    budget = [
        Component("fit", "A", scatter * math.sqrt(inverse[2] @ inverse[2]) / abs(slope), "scatter of the standstills"),
        Component("standards", "B", _of_standards(standstills, inverse[2]), "each with an error of its own"),
        *(Component(name, "B", value, "shared by all standards") for name, value in common.items()),
        Component("linearity", "B", linearity / span * 2 / math.sqrt(3), f"polynomial of order {order}"),
        Component("hysteresis", "B", abs(hysteresis) / span / math.sqrt(12), "falling against rising"),
    ]
    if resolution > 0:
        each = resolution / math.sqrt(12)
        relative = each * math.sqrt(inverse[2] @ inverse[2]) / abs(slope)
        budget.append(Component("resolution", "B", relative, f"{resolution:g} of the reading"))
    unloaded = y[x == x[np.argmin(np.abs(x))]]
    settled = float(unloaded.std(ddof=1)) if len(unloaded) > 1 else scatter
    return Characteristic(
        gain=gain,
        gain_uncertainty=math.sqrt(sum(one.relative**2 for one in budget)),
        budget=tuple(budget),
        order=order,
        zero=zero,
        drift=drift,
        noise=math.sqrt(float(np.mean([one.scatter**2 for one in standstills]))) * abs(gain),
        zero_uncertainty=max(settled, float(own.mean())) * abs(gain),
        hysteresis=hysteresis,
        repeatability=_repeatability(standstills) * abs(gain),
        linearity=linearity,
        residuals=residuals * gain,
        low=float(x.min()),
        high=float(x.max()),
        standstills=tuple(standstills),
    )


def _fit(x: Floats, y: Floats, t: Floats, order: int) -> tuple[Floats, Floats, Floats]:
    """Coefficients (z, d, s, c2, ...), residuals, and the matrix that makes coefficients of readings."""
    scale, time = float(np.abs(x).max()), max(float(t.max()), 1.0)
    powers = [(x / scale) ** k for k in range(1, order + 1)]
    columns = np.stack([np.ones_like(x), t / time, *powers], axis=1)
    units = np.array([1.0, time, *(scale**k for k in range(1, order + 1))])
    inverse = np.linalg.pinv(columns) / units[:, None]
    coefficients = inverse @ y
    return coefficients, y - columns @ (coefficients * units), inverse


def _polynomial(coefficients: Floats, x: Floats) -> Floats:
    """What the standards add to the reading."""
    total: Floats = sum((c * x**k for k, c in enumerate(coefficients[2:], start=1)), start=np.zeros_like(x))
    return total


def _aicc(residuals: Floats, parameters: int, rounding: float) -> float:
    n, k = len(residuals), parameters + 1  # the variance is estimated too
    if n <= k + 1:
        return math.inf
    return n * math.log(float(residuals @ residuals) / n + rounding**2 + 1e-300) + 2 * k + 2 * k * (k + 1) / (n - k - 1)


def _of_standards(standstills: Sequence[Standstill], weights: Floats) -> float:
    """Relative uncertainty of the slope from the standards' own errors, the same each time one is applied."""
    shares: dict[str, float] = {}
    for one, weight in zip(standstills, weights.tolist(), strict=True):
        shares[one.standard] = shares.get(one.standard, 0.0) + weight * one.applied_error
    return math.sqrt(sum(share**2 for share in shares.values()))


def _hysteresis(standstills: Sequence[Standstill], residuals: Floats) -> float:
    """Mean over the standards of falling minus rising, in the reading's unit; 0 where there is no pair."""
    by: dict[tuple[str, int], list[float]] = {}
    for one, residual in zip(standstills, residuals.tolist(), strict=True):
        by.setdefault((one.standard, one.direction), []).append(residual)
    pairs = [
        float(np.mean(by[name, -1]) - np.mean(by[name, 1]))
        for name in sorted({name for name, _ in by})
        if (name, 1) in by and (name, -1) in by
    ]
    return float(np.mean(pairs)) if pairs else 0.0


def _repeatability(standstills: Sequence[Standstill]) -> float:
    """Standard deviation between the rounds of one standard in one direction, in the reading's unit."""
    by: dict[tuple[str, int], list[float]] = {}
    for one in standstills:
        by.setdefault((one.standard, one.direction), []).append(one.reading)
    several = [values for values in by.values() if len(values) > 1]
    if not several:
        return 0.0
    freedom = sum(len(values) - 1 for values in several)
    return math.sqrt(sum(float(np.var(values)) * len(values) for values in several) / freedom)
