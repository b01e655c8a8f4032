"""Errors that all curves share and that are not fitted: gains and dimensions, by their stated uncertainties."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from calibration.film.curve import Curve
from calibration.film.differences import DIMENSIONS
from calibration.film.problem import Problem

Array = NDArray[np.float64]

# Systematic effects: entry in the budget, the curve's field with its relative standard uncertainty, what it scales.
SYSTEMATIC = (
    ("force gain", "force_gain", "force"),
    ("displacement gain", "displacement_gain", "h"),
    ("displacement axis", "displacement_axis", "h"),
    ("voltage gain", "voltage_gain", "voltage"),
    ("voltage at the film", "voltage_at_film", "voltage"),
    ("thickness", "thickness_uncertainty", "thickness"),
    ("pre-stretch", "prestretch_uncertainty", "prestretch"),
    ("disk radius", "disk_radius_uncertainty", "disk_radius"),
    ("ring radius", "ring_radius_uncertainty", "ring_radius"),
)


def stiffening(curve: Curve) -> float:
    """Relative rise of the force when the disk sits off the ring's centre by the curve's ``eccentricity``.

    A membrane under even tension carries the disk like a field its charge: the stiffness goes with the capacitance of
    the two circles, ``1/arcosh((a^2 + b^2 - e^2)/(2 a b))``. It can only rise; the rise is taken as its uncertainty.
    """
    a, b, e = curve.specimen.disk_radius, curve.specimen.ring_radius, curve.eccentricity
    return math.log(b / a) / math.acosh((a * a + b * b - e * e) / (2.0 * a * b)) - 1.0 if e > 0.0 else 0.0


def systematic_rows(problem: Problem, x: Array) -> dict[str, Array]:
    """What one standard uncertainty of each does to the weighted residual rows at ``x``, by its entry in the budget."""
    states, found = problem.states(x), {}
    for part, uncertainty, scales in SYSTEMATIC:
        relative = np.array([getattr(problem.curves[i], uncertainty) for i in problem.active])[:, None]
        if scales in DIMENSIONS:
            relative = relative * problem.common(scales)
        if relative.any():
            change = states.force if scales == "force" else states.by[scales] * _size(problem, scales)
            found[part] = problem.project((relative * change)[..., None])[:, 0]
            if problem.charge is not None and scales in problem.charge.systematic:
                # One specimen on one rig: what its curves say of it, its charge does too.
                found[part][problem.force_rows : problem.data_rows] += relative[0] * problem.charge.systematic[scales]
    tilted = np.array([stiffening(problem.curves[i]) for i in problem.active])[:, None]
    if tilted.any():
        found["eccentricity"] = problem.project((tilted * states.force)[..., None])[:, 0]
    return found


def _size(problem: Problem, name: str) -> Array:
    """Displacement, voltage or a dimension of the specimen at the nodes of every active curve."""
    if name == "h":
        return problem.nodes
    if name == "voltage":
        return problem.voltage[:, None]
    return np.array([[getattr(problem.curves[i].specimen, name)] for i in problem.active])
