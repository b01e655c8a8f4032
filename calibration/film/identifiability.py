"""What data can determine before they are taken, and which further measurement would help."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calibration.film.curve import Curve
from calibration.film.problem import IdentificationError, Problem
from calibration.film.propagation import Statement, state
from calibration.film.reduction import select
from calibration.film.result import WEAKLY_IDENTIFIED, Quantity
from calibration.rounding import two_digits
from model.material.materials import Material

FARTHER = 1.5  # times the displacement reached so far
WORTH_SAYING = 0.7  # factor by which a measurement must shrink an uncertainty at least


def expected(curves: Sequence[Curve], material: Material) -> Statement:
    """What `calibration.film.identify.identify` would state if ``material`` were the truth and the noise as stated.

    Only the displacements, voltages and uncertainties of ``curves`` matter, not their forces: this is for planning.
    """
    problem = Problem(curves, select(curves, material), material.terms, material, trust_noise=True)
    x = problem.vector(material)
    return state(problem, x, np.zeros(x.size, dtype=np.bool_), held=())


def expected_uncertainties(curves: Sequence[Curve], material: Material) -> dict[str, Quantity]:
    """The quantities of `expected`."""
    return expected(curves, material).quantities


def advice(
    curves: Sequence[Curve], material: Material, quantities: Mapping[str, Quantity], reach: float = math.inf
) -> list[str]:
    """Which of a few further measurements would shrink the largest uncertainty of a law's parameter, and to what.

    Every candidate is a set of curves added to the present ones, at 0 V and with the present noise, judged by the
    Fisher information at ``material``. ``reach`` (m) is as far as the rig may go. Empty when all terms are at least
    weakly identified.
    """
    raw = {name: q.relative for name, q in quantities.items() if name in material.values}
    if max(raw.values()) <= WEAKLY_IDENTIFIED:
        return []
    now = expected_uncertainties(curves, material)
    worst = max(raw, key=lambda name: now[name].relative)
    given = [curve for curve in curves if curve.usable.any()]
    least = min(abs(curve.nominal_voltage) for curve in given)
    plain = [curve for curve in given if abs(curve.nominal_voltage) == least]
    farthest = max(float(curve.place[curve.usable].max()) for curve in plain)
    factor = min(FARTHER, reach / farthest)
    candidates, words = {}, []
    if factor > 1.02:
        limit = " (the limit)" if factor < FARTHER else ""
        candidates[f"going on to {1e3 * factor * farthest:.3g} mm{limit} at 0 V"] = [
            _added(c, factor, c.specimen.prestretch) for c in plain
        ]
    else:
        words.append(f"a larger displacement would help, but {1e3 * reach:.3g} mm is the limit")
    if max(curve.specimen.prestretch for curve in plain) > 1.05:
        candidates["a film mounted without pre-stretch, at 0 V"] = [_added(curve, 1.0, 1.0) for curve in plain]
    for what, added in candidates.items():
        try:
            then = expected_uncertainties([*curves, *added], material)[worst].relative
        except IdentificationError:
            continue
        if then < WORTH_SAYING * now[worst].relative:
            enough = "" if then <= WEAKLY_IDENTIFIED else ", which is still not enough"
            words.append(f"{what} would bring {worst} from {_percent(now[worst].relative)} to {_percent(then)}{enough}")
    words.sort(key=lambda text: "not enough" in text)
    if material.terms > 1:
        words.append("or fit fewer terms: the stiffness at the stretches reached does not need them")
    return words


def _added(curve: Curve, farther: float, prestretch: float) -> Curve:
    """A curve like this one at 0 V, with its displacements stretched, on a film with another pre-stretch."""
    return replace(
        curve,
        label=f"{curve.label}, added",
        run=f"{curve.run}, added",
        specimen=replace(curve.specimen, prestretch=prestretch),
        h=curve.h * farther,
        voltage=np.zeros(curve.h.size),
        nominal_voltage=0.0,
    )


def _percent(relative: float) -> str:
    if relative > 10.0:
        return f"{two_digits(relative)} times its value"
    return f"{100 * relative:.2g} %" if relative < 1.0 else f"{100 * relative:.0f} %"
