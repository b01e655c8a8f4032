r"""Statistics between specimens: each fitted alone, then a mean with scatter between and within them.

Specimen i gives ``y_i`` with the standard uncertainty ``u_i`` of what is its own (noise, zeros, its dimensions). With
the variance ``t^2`` between specimens the mean is that of a random-effects model,

.. math:: m = \frac{\sum w_i y_i}{\sum w_i}, \qquad w_i = \frac{1}{u_i^2 + t^2}, \qquad
          \sum w_i (y_i - m)^2 = n - 1

whose second equation determines t (Paule & Mandel 1982; Rukhin 2009), and is 0 where the scatter is no larger than the
``u_i`` explain. What all specimens share (gains, the thickness of one batch) does not average, and is added to the
uncertainty of the mean in squares.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from calibration.film.curve import Curve
from calibration.film.identify import identify
from calibration.film.problem import IdentificationError
from calibration.film.result import Identification

SHARED = ("force gain", "displacement gain", "displacement axis", "voltage gain", "voltage at the film")
WANTED = ("stiffness_fixed", "eps_r", "G")


@dataclass(frozen=True)
class Spread:
    """One quantity over several specimens, in its own unit.

    ``between`` is the standard deviation between specimens beyond what their own uncertainties explain, ``within`` the
    root mean square of these, ``uncertainty`` that of the mean with what all share (``shared``), and ``probability`` of
    so much scatter by the specimens' own uncertainties alone.
    """

    unit: str
    values: dict[str, float]
    uncertainties: dict[str, float]
    mean: float
    uncertainty: float
    between: float
    within: float
    shared: float
    probability: float

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def by_specimen(curves: Sequence[Curve]) -> dict[str, list[Curve]]:
    """The curves of every specimen, by what its pre-stretch belongs to: its own name."""
    found: dict[str, list[Curve]] = {}
    for curve in curves:
        found.setdefault(curve.part("prestretch"), []).append(curve)
    return found


def identify_each(curves: Sequence[Curve], **options: Any) -> tuple[dict[str, Identification], list[str]]:
    """Every specimen fitted alone, and why the others could not be; ``options`` as in `identify`."""
    found, failed = {}, []
    for name, mine in by_specimen(curves).items():
        try:
            found[name] = identify(mine, **options)
        except IdentificationError as error:
            failed.append(f"{name}: {error}")
    return found, failed


def between(each: Mapping[str, Identification], one_batch: bool) -> dict[str, Spread]:
    """Statistics of the quantities that at least two specimens have. ``one_batch``: all films share their thickness."""
    from scipy.special import gammaincc

    shared_parts = (*SHARED, "thickness") if one_batch else SHARED
    spreads = {}
    for name in WANTED:
        mine = {who: one.quantities[name] for who, one in each.items() if name in one.quantities}
        mine = {who: one for who, one in mine.items() if 0.0 < one.uncertainty < math.inf}
        if len(mine) < 2:
            continue
        values = np.array([one.value for one in mine.values()])
        shared = np.array([math.hypot(*(one.budget.get(part, 0.0) for part in shared_parts)) for one in mine.values()])
        total = np.array([one.uncertainty for one in mine.values()])
        own = np.sqrt(np.maximum(total**2 - shared**2, 1e-12 * total**2))
        variance = paule_mandel(values, own)
        weights = 1.0 / (own**2 + variance)
        mean = float(weights @ values / weights.sum())
        plain = own**-2.0
        scatter = float(plain @ (values - plain @ values / plain.sum()) ** 2)
        common = float(np.sqrt(np.mean(shared**2)))
        spreads[name] = Spread(
            unit=next(iter(mine.values())).unit,
            values=dict(zip(mine, values.tolist(), strict=True)),
            uncertainties=dict(zip(mine, own.tolist(), strict=True)),
            mean=mean,
            uncertainty=math.hypot(1.0 / math.sqrt(weights.sum()), common),
            between=math.sqrt(variance),
            within=float(np.sqrt(np.mean(own**2))),
            shared=common,
            probability=float(gammaincc((len(mine) - 1) / 2.0, scatter / 2.0)),
        )
    return spreads


def paule_mandel(values: np.ndarray, own: np.ndarray) -> float:
    """Variance between specimens, by bisection; 0 where none is needed."""

    def excess(variance: float) -> float:
        weights = 1.0 / (own**2 + variance)
        mean = weights @ values / weights.sum()
        return float(weights @ (values - mean) ** 2) - (values.size - 1)

    if excess(0.0) <= 0.0:
        return 0.0
    low, high = 0.0, float(np.var(values, ddof=1)) * values.size + float((own**2).max())
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) > 0.0 else (low, middle)
    return 0.5 * (low + high)
