"""What a protocol is expected to tell of a film that takes time, before it is run.

The force of every bin of the planned history changes with the film's parameters as `response` says; with the noise and
the zeros that the sensors have that is a covariance (Cramer & Rao). Holds tell slow branches, speed tells quick ones.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.film.branches.joint import Joint
from calibration.film.branches.record import Record
from calibration.film.branches.spectrum import covariance
from calibration.film.curve import Curve
from calibration.film.propagation import secant
from model.material.materials import Material

Array = NDArray[np.float64]


def planned_record(errors: Curve, t: Array, h: Array, voltage: Array, rate: float) -> Record:
    """The record that a history (times in s, m, V) will give at so many samples a second, without forces."""
    at = np.arange(float(t[0]) + 0.5 / rate, float(t[-1]), 1.0 / rate)
    place, volts = np.interp(at, t, h), np.interp(at, t, voltage)
    whole = replace(
        errors,
        h=place,
        force=np.zeros(at.size),
        voltage=volts,
        direction=np.zeros(at.size, dtype=np.int8),
        time=at,
        flagged=None,
    )
    return Record(whole, at, place, volts, whole.force, place > 0.0)


def expected_of_branches(record: Record, film: Material, stretch: tuple[float, float]) -> dict[str, float]:
    """Relative standard uncertainties by noise and zeros: "stiffness_fixed" (relaxed, at
    ``stretch``), "eps_r", "ratio1",
    "time1", ... in the order of the film's branches."""
    joint = Joint([record], replace(film, branches=()), film.terms)
    x = joint.vector(film)
    joint.settle(x)
    point = joint.evaluate(x)
    matrix = covariance(joint, point).matrix
    value, by_mu, by_alpha = secant(film, np.array([stretch[0]]), stretch[1])
    eps = np.zeros(1)
    slope = joint.coordinates.by_parameters(x[None], by_mu, by_alpha, eps)[0]
    gradient = np.concatenate((slope, np.zeros(x.size - slope.size)))
    found = {"stiffness_fixed": math.sqrt(float(gradient @ matrix @ gradient)) / float(value[0])}
    deviation = np.sqrt(np.diag(matrix))
    if joint.coordinates.electric:
        found["eps_r"] = float(deviation[joint.coordinates.film_numbers]) / film.eps_r
    n, count = len(joint.coordinates.names), len(film.branches)
    for k, one in enumerate(film.branches):
        found[f"ratio{k + 1}"] = float(deviation[n + k]) / one.ratio
        found[f"time{k + 1}"] = float(deviation[n + count + k])
    return found
