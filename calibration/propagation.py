"""From a minimum to uncertainties: linear propagation of noise, zeros, gains and dimensions to what is stated."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.problem import Problem
from calibration.result import Quantity, Stiffness
from model.materials import Material

Array = NDArray[np.float64]

IDENTIFIED = 0.05  # relative standard uncertainty up to which a quantity counts as identified ...
WEAKLY_IDENTIFIED = 0.30  # ... and as weakly identified

# Systematic effects: entry in the budget, the curve's field with its relative standard uncertainty, what it scales.
SYSTEMATIC = (
    ("force gain", "force_gain", "force"),
    ("displacement gain", "displacement_gain", "h"),
    ("voltage gain", "voltage_gain", "voltage"),
    ("thickness", "thickness_uncertainty", "thickness"),
    ("pre-stretch", "prestretch_uncertainty", "prestretch"),
    ("disk radius", "disk_radius_uncertainty", "disk_radius"),
)


def secant_modulus(material: Material, meridional: float, hoop: float) -> float:
    r"""Shear modulus (Pa) of the neo-Hookean film with the same meridional stress at these stretches.

    .. math:: G_s = \frac{\sum_n \mu_n (l_1^{\alpha_n} - (l_1 l_2)^{-\alpha_n})}{l_1^2 - (l_1 l_2)^{-2}}

    It is what a force measures, since ``2 pi R (T/lp) S1 sin(theta) = F``. For small strains it becomes ``G``.
    """
    mu, alpha = np.array(material.mu), np.array(material.alpha)
    return float(_secant(mu, alpha, np.array([meridional]), hoop)[0][0])


def _secant(mu: Array, alpha: Array, meridional: Array, hoop: float) -> tuple[Array, Array, Array]:
    """Secant modulus at k meridional stretches, with derivatives by mu and by alpha; shapes (k,), (k, N), (k, N)."""
    l1 = meridional[:, None]
    stretch = l1**alpha - (l1 * hoop) ** -alpha
    by_alpha = mu * (l1**alpha * np.log(l1) + (l1 * hoop) ** -alpha * np.log(l1 * hoop))
    neo_hookean = l1**2 - (l1 * hoop) ** -2.0
    return (stretch @ mu) / neo_hookean[:, 0], stretch / neo_hookean, by_alpha / neo_hookean


class Covariance:
    """Linear propagation at a minimum: what an error in the data does to the parameters.

    ``response`` maps weighted residual rows to changes of x: ``-(J^T J)^-1 J^T``. Directions that the data do not see
    are kept with a tiny singular value, so that their uncertainty comes out huge rather than absent.
    """

    def __init__(self, problem: Problem, x: Array, free: NDArray[np.bool_]) -> None:
        jacobian = problem.jacobian(x)[:, free]
        norms = np.linalg.norm(jacobian, axis=0)
        norms[norms == 0.0] = 1e-30
        u, s, vt = np.linalg.svd(jacobian / norms, full_matrices=False)
        s = np.maximum(s, 1e-13 * s[0])
        self.response = np.zeros((x.size, jacobian.shape[0]))
        self.response[free] = -(vt.T / s) @ u.T / norms[:, None]

    @property
    def matrix(self) -> Array:
        """Covariance of x for unit variance of every residual."""
        matrix: Array = self.response @ self.response.T
        return matrix


class Propagation:
    """Standard uncertainties of functions of the parameters, part by part."""

    def __init__(self, problem: Problem, x: Array, free: NDArray[np.bool_], misfit: float) -> None:
        self.problem = problem
        self.covariance = Covariance(problem, x, free)
        self.misfit = misfit
        self.effects: dict[str, Array] = {}
        states = problem.states(x)
        for part, uncertainty, scales in SYSTEMATIC:
            relative = np.array([getattr(problem.curves[i], uncertainty) for i in problem.active])[:, None]
            if relative.any():
                change = states.force if scales == "force" else states.by[scales] * self._size(scales)
                self.effects[part] = self.covariance.response @ problem.project(relative * change)

    def _size(self, name: str) -> Array:
        """Displacement, voltage or a dimension of the specimen at the nodes of every active curve."""
        if name == "h":
            return self.problem.nodes
        if name == "voltage":
            return self.problem.voltage[:, None]
        return np.array([[getattr(self.problem.curves[i].specimen, name)] for i in self.problem.active])

    def quantity(
        self, value: float, gradient: Array, unit: str, *, at_bound: bool = False, known: bool = True
    ) -> Quantity:
        """A function of x with this value and gradient; ``known=False`` when nothing in the data bears on it."""
        rows = gradient @ self.covariance.response
        data = self.problem.data_rows
        budget = {"noise": float(np.linalg.norm(rows[:data]))}
        for kind in ("force_zero", "displacement_zero"):
            mine = [data + k for k, zero in enumerate(self.problem.zeros) if zero[0] == kind]
            if mine:
                budget[kind.replace("_", " ")] = float(np.linalg.norm(rows[mine]))
        if self.misfit > 1.0:
            budget["lack of fit"] = budget["noise"] * math.sqrt(self.misfit - 1.0)
        for part, effect in self.effects.items():
            budget[part] = abs(float(gradient @ effect))
        total = math.hypot(*budget.values()) if known else math.inf
        relative = total / abs(value) if value else math.inf
        if relative <= IDENTIFIED and not at_bound:
            verdict = "identified"
        elif relative <= WEAKLY_IDENTIFIED and not at_bound:
            verdict = "weakly identified"
        else:
            verdict = "not identifiable from this data"
        return Quantity(value, total, unit, budget, verdict, at_bound)


@dataclass(frozen=True, eq=False)
class Statement:
    """Everything that is derived from a minimum by linear propagation."""

    quantities: dict[str, Quantity]
    nuisance: dict[str, Quantity]
    stretch: tuple[float, float]
    stiffness_curve: Stiffness
    parameters: list[str]
    correlation: list[list[float]]
    condition: float


def state(
    problem: Problem, x: Array, at_bound: NDArray[np.bool_], held: Mapping[str, float], *, misfit: float = 1.0
) -> Statement:
    n = problem.terms
    film = problem.film(x)
    mu, alpha = np.array(film.mu), np.array(film.alpha)
    vanished = at_bound[:n]  # a term without stiffness says nothing about its exponent
    free = np.array([name not in held for name in problem.names])
    free[n : 2 * n] &= ~vanished
    propagation = Propagation(problem, x, free, misfit)

    def gradient(by_mu: Array, by_alpha: Array, by_eps: float = 0.0) -> Array:
        return problem.by_parameters(x, by_mu, by_alpha, np.array(by_eps))

    zero, unit = np.zeros(n), np.eye(n)
    quantities: dict[str, Quantity] = {}
    raw: dict[str, tuple[float, Array]] = {}
    for k in range(n):
        raw[f"mu{k + 1}"] = (mu[k], gradient(unit[k], zero))
        if f"alpha{k + 1}" not in held:
            raw[f"alpha{k + 1}"] = (alpha[k], gradient(zero, unit[k]))
    for name, (value, slope) in raw.items():
        k = int(name[-1]) - 1
        edge = bool(at_bound[k] if name.startswith("mu") else at_bound[n + k] or vanished[k])
        known = not (name.startswith("alpha") and vanished[k])
        quantities[name] = propagation.quantity(
            float(value), slope, "Pa" if name.startswith("mu") else "1", at_bound=edge, known=known
        )
    quantities["G"] = propagation.quantity(film.shear_modulus, gradient(alpha / 2.0, mu / 2.0), "Pa")

    hoop = float(np.mean([problem.curves[i].specimen.prestretch for i in problem.active]))
    longest = max(float(problem.states(x).max_stretch.max()), hoop + 0.02)
    stretches = np.arange(math.floor(hoop * 100) + 1, math.floor(longest * 100) + 1) / 100
    modulus, by_mu, by_alpha = _secant(mu, alpha, stretches, hoop)
    along = [
        propagation.quantity(float(m), gradient(a, b), "Pa") for m, a, b in zip(modulus, by_mu, by_alpha, strict=True)
    ]
    at = min(range(len(along)), key=lambda k: along[k].relative)
    quantities["stiffness"] = along[at]
    if problem.electric and "eps_r" not in held:
        slope = gradient(zero, zero, 1.0)
        raw["eps_r"] = (film.eps_r, slope)
        quantities["eps_r"] = propagation.quantity(film.eps_r, slope, "1", at_bound=bool(at_bound[2 * n]))

    nuisance = {}
    for k, (kind, run, prior, _) in enumerate(problem.zeros, start=problem.film_parameters):
        slope = np.zeros(x.size)
        slope[k] = prior
        unit_name = "N" if kind == "force_zero" else "m"
        quantity = propagation.quantity(float(x[k] * prior), slope, unit_name)
        nuisance[f"{kind.replace('_', ' ')} of {run}"] = replace(quantity, verdict=f"prior {prior:.3g} {unit_name}")

    slopes = np.array([slope for _, slope in raw.values()])
    covariance = slopes @ propagation.covariance.matrix @ slopes.T
    deviation = np.sqrt(np.diag(covariance))
    deviation[deviation == 0.0] = 1.0
    correlation = covariance / np.outer(deviation, deviation)
    np.fill_diagonal(correlation, 1.0)
    return Statement(
        quantities=quantities,
        nuisance=nuisance,
        stretch=(float(stretches[at]), hoop),
        stiffness_curve=Stiffness(
            meridional_stretch=tuple(float(value) for value in stretches),
            hoop_stretch=hoop,
            secant_modulus=tuple(q.value for q in along),
            uncertainty=tuple(q.uncertainty for q in along),
        ),
        parameters=list(raw),
        correlation=[[float(value) for value in row] for row in correlation],
        condition=_condition(problem, x, free),
    )


def _condition(problem: Problem, x: Array, free: NDArray[np.bool_]) -> float:
    """Condition number of the Jacobian by relative changes of the film's free parameters, the zeros left free."""
    jacobian = problem.jacobian(x)
    film = np.flatnonzero(free[: problem.film_parameters])
    columns = jacobian[:, film] * x[film]
    zeros = jacobian[:, problem.film_parameters :]
    if zeros.shape[1]:
        base, _ = np.linalg.qr(zeros)
        columns = columns - base @ (base.T @ columns)
    s = np.linalg.svd(columns, compute_uv=False)
    return float(s[0] / s[-1]) if s[-1] > 0.0 else math.inf
