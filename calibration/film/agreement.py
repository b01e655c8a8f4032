"""Force against charge at the minimum of a fit of both.

With a factor of its own on the capacitance the two would be told apart: its value is the score test of
`calibration.film.misfit` for a row that only the charge has. Errors that both share (thickness, voltage) are counted
once, since they change the rows of both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.electrical.agreement import AGREE, CONTRADICT, PART, SOFTENED, Charged, Difference
from calibration.electrical.charge import Capacitance
from calibration.electrical.rows import charge_slope
from calibration.film.misfit import VISIBLE, Left
from calibration.film.problem import Problem
from calibration.film.propagation import Covariance
from calibration.film.result import GOOD, WEAK, Quantity, RigParameter, verdict
from calibration.film.suspects.softening import KEY as SOFTENING
from calibration.film.systematic import systematic_rows

Array = NDArray[np.float64]

SURE = 3.0  # standard uncertainties by which the forces must know softening to tell it from a current's gain


def charged(
    problem: Problem, x: Array, free: NDArray[np.bool_], nuisance: Mapping[str, RigParameter]
) -> Charged | None:
    """What the current says beside the force; ``nuisance`` are the errors fitted along. None where there is none."""
    if problem.charge is None:
        return None
    soft = np.array([False] * problem.film_parameters + [one.kind == SOFTENING for one in problem.nuisances])
    currents = problem.charge.currents
    found = Charged(
        plain=_difference(problem, x, free & ~soft, soft),
        softening=None,
        softened=None,
        told_apart=False,
        noise=currents.noise,
        resolution=currents.resolution,
        samples=currents.samples,
        capacitances=_capacitances(problem, x),
    )
    if not soft.any():
        return found
    names = [f"{problem.along[SOFTENING].name} of {one.run}" for one in problem.nuisances if one.kind == SOFTENING]
    most = max((nuisance[name] for name in names), key=lambda one: abs(one.value / one.uncertainty))
    return replace(
        found,
        softening=_difference(problem, x, free, np.zeros_like(soft)),
        softened=(most.value, most.uncertainty),
        told_apart=_by_forces(problem, x, free, soft),
    )


def judged(quantities: Mapping[str, Quantity], found: Charged | None) -> dict[str, Quantity]:
    """The quantities, the permittivity with what force and charge do not agree on."""
    one = quantities.get("eps_r")
    if one is None or found is None or found.verdict == AGREE or (found.verdict == SOFTENED and found.told_apart):
        return dict(quantities)
    doubt = "the film softened, or the gain of the current is not as stated"
    if found.verdict == CONTRADICT:
        apart = max(abs(d.relative) for d in (found.plain, found.softening) if d is not None and d.significant)
        budget = one.budget | {PART: apart * one.value}
        total = math.hypot(*budget.values())
        one = replace(one, uncertainty=total, budget=budget, verdict=verdict(total / one.value, one.at_bound))
        doubt = "force and charge contradict each other"
    doubt = "; ".join(filter(None, (one.doubt, doubt)))
    return {**quantities, "eps_r": replace(one, doubt=doubt, verdict=WEAK if one.verdict == GOOD else one.verdict)}


def _difference(problem: Problem, x: Array, free: NDArray[np.bool_], held: NDArray[np.bool_]) -> Difference:
    """Of the capacitance measured from that of the force, the entries ``held`` of x being 0 (to first order)."""
    assert problem.charge is not None
    residual, jacobian = problem.residual(x), problem.jacobian(x)
    residual = residual - jacobian[:, held] @ x[held]
    shape = np.zeros_like(residual)
    own = slice(problem.force_rows, problem.data_rows)
    shape[own] = problem.charge.project(problem.film(x).eps_r * problem.charge.per_eps)
    left = Left(problem, x, free)
    visible = left.of(shape)
    if np.linalg.norm(visible) <= VISIBLE * np.linalg.norm(shape):
        return Difference(0.0, math.inf)
    weighed = left.weighed(visible)
    square = float(visible @ weighed)
    return Difference(-float(weighed @ residual) / square, square**-0.5)


def _by_forces(problem: Problem, x: Array, free: NDArray[np.bool_], soft: NDArray[np.bool_]) -> bool:
    """Whether the forces without the charge know that the film softened."""
    jacobian, residual = problem.jacobian(x).copy(), problem.residual(x).copy()
    own = slice(problem.force_rows, problem.data_rows)
    jacobian[own], residual[own] = 0.0, 0.0
    response = Covariance(jacobian, free).response[soft]
    value = x[soft] + response @ residual
    stated = np.array(list(systematic_rows(problem, x).values())).reshape(-1, residual.size)
    stated[:, own] = 0.0
    error = np.sqrt((response**2).sum(axis=1) + ((response @ stated.T) ** 2).sum(axis=1))
    return bool((np.abs(value) > SURE * error).any())


def _capacitances(problem: Problem, x: Array) -> list[Capacitance]:
    """d(CV)/dV of film and cable at each place (F): measured, the leakage taken off, and by the fit."""
    charge = problem.charge
    assert charge is not None
    currents = charge.currents
    errors = {n.kind: float(x[k]) * n.prior for k, n in enumerate(problem.nuisances, problem.film_parameters)}
    gain = 1.0 + errors.get("current_gain", 0.0)
    cable = currents.known.cable_F + errors.get("cable", 0.0)
    fitted = gain * (problem.film(x).eps_r * charge.per_eps + cable)
    columns = currents.root.reshape(charge.size, *fitted.shape)
    columns = np.einsum("mpn,pn->mp", columns, fitted)
    target = currents.target - errors.get("current_step", 0.0) * currents.step
    change, *_ = np.linalg.lstsq(columns, target, rcond=None)
    error = np.sqrt(np.diag(np.linalg.pinv(columns.T @ columns)))
    found = []
    for place, values, factor, part in zip(currents.places, fitted, change, error, strict=True):
        volts, slope = place.rows.voltage[place.mine], place.rows.slope[place.mine]
        model = float(charge_slope(place.nodes, volts) @ values @ slope**2 / (slope**2).sum())
        found.append(Capacitance(place.h, float(volts.mean()), model * float(factor), model * float(part), model))
    return found
