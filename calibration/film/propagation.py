"""From a minimum to uncertainties: linear propagation of noise, zeros, gains and dimensions to what is stated."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calibration.film.charged import KINDS
from calibration.film.differences import DIMENSIONS
from calibration.film.misfit import likely
from calibration.film.problem import Problem
from calibration.film.result import Quantity, RigParameter, Stiffness, Suspect, verdict
from calibration.film.systematic import systematic_rows
from model.material.law import Law, stack
from model.material.materials import Material

Array = NDArray[np.float64]

# Entries of the budget that belong to the specimen: a result "given the dimensions" is without them.
OF_DIMENSIONS = {"thickness": "thickness", "prestretch": "pre-stretch", "disk_radius": "disk radius"}
OF_DIMENSIONS |= {"ring_radius": "ring radius"}

# What is fitted along, and its unit.
NUISANCES = {"force_zero": "N", "displacement_zero": "m", "lag": "s", "compliance": "m/N"}
# Meridional stretch over pre-stretch to which a stiffness belongs that can be compared between runs.
FIXED = 1.25
NEGLIGIBLE = 1e-3  # of the noise: what is less has no line in a budget


def secant_modulus(material: Material, meridional: float, hoop: float) -> float:
    r"""Shear modulus (Pa) of the neo-Hookean film with the same meridional stress at these stretches.

    .. math:: G_s = \frac{\sum_n \mu_n (l_1^{\alpha_n} - (l_1 l_2)^{-\alpha_n})}{l_1^2 - (l_1 l_2)^{-2}}

    It is what a force measures, since ``2 pi R (T/lp) S1 sin(theta) = F``. For small strains it becomes ``G``.
    """
    return float(secant(material, np.array([meridional]), hoop)[0][0])


def least_tangent(material: Material, meridional: float, hoop: float) -> float:
    r"""Smallest tangent modulus (Pa) for stretches from 1 to ``meridional`` and ``hoop``; above 0 in a stable film.

    The smaller eigenvalue of the second derivatives of W by the logarithms of the two stretches (Drucker, Hill). Of
    Ogden terms it is positive whatever the stretch with every ``mu_n alpha_n > 0``.
    """
    one, two = (np.log(np.linspace(1.0, end, 25)) for end in (max(meridional, 1.0), max(hoop, 1.0)))
    return float(law_of(material).least_tangent(*np.meshgrid(one, two)).min())


def law_of(material: Material) -> Law:
    """The material's law with its parameters (Pa)."""
    return material.law(np.array(material.mu)[:, None], np.array(material.alpha).reshape(-1, 1))


def secant(material: Material, meridional: Array, hoop: float) -> tuple[Array, Array, Array]:
    """Secant modulus at k meridional stretches, with derivatives by mu and alpha: (k,), (k, moduli), (k, shapes)."""
    log1 = np.log(meridional)
    log = stack(log1, np.full(log1.shape, math.log(hoop)))
    neo_hookean = meridional**2 - (meridional * hoop) ** -2.0
    law = law_of(material)
    by_mu, by_alpha = law.by_parameters(log)
    return law.derivatives(log)[0] / neo_hookean, (by_mu[:, 0] / neo_hookean).T, (by_alpha[:, 0] / neo_hookean).T


def shear_slopes(material: Material) -> tuple[Array, Array]:
    """Derivatives of the small-strain shear modulus by mu and by alpha."""
    found = []
    for values, shares in ((material.mu, True), (material.alpha, False)):
        slopes = np.zeros(len(values))
        for n, value in enumerate(values):
            step = 1e-4 * max(abs(value), 1e-6)
            ends = []
            for side in (step, -step):
                moved = (*values[:n], value + side, *values[n + 1 :])
                ends.append(
                    material.law.shear_modulus(moved, material.alpha)
                    if shares
                    else material.law.shear_modulus(material.mu, moved)
                )
            slopes[n] = (ends[0] - ends[1]) / (2.0 * step)
        found.append(slopes)
    return found[0], found[1]


def sorted_terms(material: Material) -> Material:
    """The terms of a series sorted by their exponents, by which they are told apart; another law as it is."""
    if not material.law.series:
        return material
    alpha, mu = zip(*sorted(zip(material.alpha, material.mu, strict=True)), strict=True)
    return replace(material, mu=mu, alpha=alpha)


class Covariance:
    """Linear propagation at a minimum: what an error in the data does to the parameters.

    ``response`` maps weighted residual rows to changes of x: ``-(J^T J)^-1 J^T``. Directions that the data do not see
    are kept with a tiny singular value, so that their uncertainty comes out huge rather than absent.
    """

    def __init__(self, jacobian: Array, free: NDArray[np.bool_]) -> None:
        columns = jacobian.shape[1]
        jacobian = jacobian[:, free]
        norms = np.linalg.norm(jacobian, axis=0)
        norms[norms == 0.0] = 1e-30
        u, s, vt = np.linalg.svd(jacobian / norms, full_matrices=False)
        s = np.maximum(s, 1e-13 * s[0])
        self.response = np.zeros((columns, jacobian.shape[0]))
        self.response[free] = -(vt.T / s) @ u.T / norms[:, None]

    @property
    def matrix(self) -> Array:
        """Covariance of x for unit variance of every residual."""
        matrix: Array = self.response @ self.response.T
        return matrix


def _range_rows(problem: Problem, size: int) -> Array:
    """Rows that say of every shape parameter no more than its range (rectangular: JCGM 100:2008, 4.3.7)."""
    n = problem.moduli
    width = np.array([high - low for low, high in (p.search for p in problem.parameters[n:])])
    rows = np.eye(len(width), size, n)
    return rows * (math.sqrt(12.0) / width)[:, None] if len(width) else rows


class Propagation:
    """Standard uncertainties of functions of the film's parameters, part by part.

    ``misfit`` is the chi-square of the lack of fit over its expectation; ``rivals`` are other minima with their
    likelihood relative to this one; ``doubts`` are imperfections, and those that were found bias the result.
    With ``ranges`` it counts as knowledge that exponents lie in their range. Of an exponent that the data do not
    determine the curvature says far more than is possible, and with it of all that is derived from it.
    """

    def __init__(
        self,
        problem: Problem,
        x: Array,
        free: NDArray[np.bool_],
        misfit: float,
        rivals: Sequence[tuple[Material, float]],
        doubts: Sequence[Suspect],
        *,
        ranges: bool = False,
    ) -> None:
        self.problem = problem
        self.film = problem.film(x)
        jacobian = problem.jacobian(x)
        known = _range_rows(problem, x.size) if ranges else np.empty((0, x.size))
        self.covariance = Covariance(np.concatenate((jacobian, known)), free)
        self.response = self.covariance.response[:, : len(jacobian)]
        self.misfit = misfit
        self.doubts = doubts
        # Each of those that cannot be told apart may be the one: the results may be off by what any of them does.
        self.biases = [self.response @ (one.amplitude * one.shape) for one in likely(doubts)]
        self.rivals = rivals
        self.effects: dict[str, Array] = {}
        for part, rows in systematic_rows(problem, x).items():
            self.effects[part] = self.response @ rows

    def label(self, kind: str) -> str:
        """The entry of the budget for errors of a kind that are fitted along."""
        asked = self.problem.along.get(kind)
        return kind.replace("_", " ") if asked is None else asked.name

    def along(self, gradients: Mapping[str, Array], x: Array) -> dict[str, dict[str, float]]:
        """By how much each error that was asked to be fitted along shifted functions of x (to first order)."""
        matrix, found = self.covariance.matrix, {}
        for k, one in enumerate(self.problem.nuisances, start=self.problem.film_parameters):
            if one.kind in self.problem.along:
                name = f"{self.label(one.kind)} of {one.run}"
                found[name] = {q: float(g @ matrix[:, k] / matrix[k, k] * x[k]) for q, g in gradients.items()}
        return found

    def quantity(
        self, of: Callable[[Material], float], gradient: Array, unit: str, *, at_bound: bool = False, known: bool = True
    ) -> Quantity:
        """``of(film)``, whose gradient by x is given; ``known=False`` when nothing in the data bears on it."""
        value = of(self.film)
        budget = self.budget(gradient)
        weights = 1.0 + sum(weight for _, weight in self.rivals)
        spread = sum(weight * (of(film) - value) ** 2 for film, weight in self.rivals) / weights
        # Minima in one valley are described by its curvature already; only what goes beyond that is added.
        if spread > budget["noise"] ** 2:
            budget["other solutions"] = math.sqrt(spread - budget["noise"] ** 2)
        total = math.hypot(*budget.values()) if known else math.inf
        relative = total / abs(value) if value else math.inf
        return Quantity(value, total, unit, budget, verdict(relative, at_bound), at_bound)

    def unseen(self, gradients: Mapping[str, Array]) -> dict[str, dict[str, float]]:
        """By how much each imperfection may shift functions of x before it would be reported."""
        # The shape is what it would do to the model; the data have it and the model has not.
        shifts = {one.name: self.response @ (-one.unseen_size * one.shape) for one in self.doubts}
        return {
            doubt: {name: float(gradient @ shift) for name, gradient in gradients.items()}
            for doubt, shift in shifts.items()
        }

    def covariances(self, gradients: Array) -> Array:
        """Covariance matrix of functions of x with these gradients, by all parts that propagate linearly."""
        total: Array = gradients @ self.covariance.matrix @ gradients.T * self.misfit
        for effect in (*self.effects.values(), *self.biases[:1]):
            change = gradients @ effect
            total = total + np.outer(change, change)
        return total

    def budget(self, gradient: Array) -> dict[str, float]:
        """Independent parts of the standard uncertainty of a function of x with this gradient."""
        rows = gradient @ self.covariance.response
        data = self.problem.data_rows
        parts = {"noise": float(np.linalg.norm(rows[: self.problem.force_rows]))}
        if self.problem.charge is not None:
            parts["current noise"] = float(np.linalg.norm(rows[self.problem.force_rows : data]))
        for kind in (*NUISANCES, *KINDS, *self.problem.along):
            mine = [data + k for k, nuisance in enumerate(self.problem.nuisances) if nuisance.kind == kind]
            if mine:
                parts[self.label(kind)] = float(np.linalg.norm(rows[mine]))
        unknown = float(np.linalg.norm(rows[self.response.shape[1] :]))
        if unknown > NEGLIGIBLE * parts["noise"]:
            parts["range of exponents"] = unknown
        bias = max((abs(float(gradient @ one)) for one in self.biases), default=0.0)
        if self.misfit > 1.0 or self.biases:
            parts["lack of fit"] = math.hypot(parts["noise"] * math.sqrt(max(0.0, self.misfit - 1.0)), bias)
        for part, effect in self.effects.items():
            parts[part] = abs(float(gradient @ effect))
        for dimension, part in OF_DIMENSIONS.items():  # what of the differences between specimens was fitted along
            mine = [data + k for k, nuisance in enumerate(self.problem.nuisances) if nuisance.kind == dimension]
            if mine:
                parts[part] = math.hypot(parts.get(part, 0.0), float(np.linalg.norm(rows[mine])))
        return parts


def determined(problem: Problem, at_bound: NDArray[np.bool_], held: Collection[str]) -> NDArray[np.bool_]:
    """Entries of x that the data bear on: not held, and not the exponent of a term without stiffness."""
    n = problem.moduli
    free = np.array([name not in held for name in problem.names])
    if problem.law.series:
        free[n : 2 * n] &= ~at_bound[:n]
    return free


@dataclass(frozen=True, eq=False)
class Statement:
    """Everything that is derived from a minimum by linear propagation."""

    quantities: dict[str, Quantity]
    nuisance: dict[str, RigParameter]
    stretch: tuple[float, float]
    fixed_stretch: tuple[float, float]  # to which the quantity stiffness_fixed belongs
    stiffness_curve: Stiffness
    along: list[Quantity]  # the same, with their budgets
    parameters: list[str]
    correlation: list[list[float]]
    covariance: list[list[float]]
    condition: float
    moved: dict[str, dict[str, float]]  # shift of the same by each error that was asked to be fitted along
    unseen: dict[str, dict[str, float]]  # shift of stiffness and permittivity by each suspect that does not show yet


def state(
    problem: Problem,
    x: Array,
    at_bound: NDArray[np.bool_],
    held: Collection[str],
    *,
    misfit: float = 1.0,
    rivals: Sequence[tuple[Material, float]] = (),
    doubts: Sequence[Suspect] = (),
    ranges: bool = False,
    fixed_stretch: tuple[float, float] | None = None,
) -> Statement:
    """Quantities with uncertainties at ``x``; ``at_bound`` marks entries of x, ``held`` names those that were given.

    ``doubts`` are the imperfections that the residuals were held against (`calibration.film.misfit`), most probable
    first.
    If that one was found, what it does to the results is part of their uncertainty. With ``ranges`` the shear modulus
    and the permittivity count on exponents being in their range. The terms, and the stiffness at stretches that were
    reached, stand as the data alone have them.
    """
    vanished = at_bound[: problem.moduli]
    free = determined(problem, at_bound, held)
    propagation = Propagation(problem, x, free, misfit, rivals, doubts)
    derived = Propagation(problem, x, free, misfit, rivals, doubts, ranges=True) if ranges else propagation
    film = propagation.film
    zeros = np.zeros(len(film.mu)), np.zeros(len(film.alpha))

    def gradient(by_mu: Array, by_alpha: Array, by_eps: float = 0.0) -> Array:
        return problem.by_parameters(x, by_mu, by_alpha, np.array(by_eps))

    quantities: dict[str, Quantity] = {}
    slopes: dict[str, Array] = {}
    of_law = _law_parameters(problem, held)
    for name, kind, k in of_law:
        term = vanished[k] if kind == "mu" or problem.law.series else np.False_
        shape = kind == "alpha" and at_bound[problem.moduli + k]
        unit = [zero.copy() for zero in zeros]
        unit[kind == "alpha"][k] = 1.0
        slopes[name] = gradient(unit[0], unit[1])
        quantities[name] = propagation.quantity(
            partial(_entry, kind, k),
            slopes[name],
            "Pa" if kind == "mu" else "1",
            at_bound=bool(term or shape),
            known=bool(kind == "mu" or not term),
        )
    quantities["G"] = derived.quantity(lambda m: m.shear_modulus, gradient(*shear_slopes(film)), "Pa")

    hoop = float(np.mean([problem.curves[i].specimen.prestretch for i in problem.active]))
    longest = max(float(problem.states(x).max_stretch.max()), hoop + 0.02)
    stretches = np.arange(math.floor(hoop * 100) + 1, math.floor(longest * 100) + 1) / 100
    _, by_mu, by_alpha = secant(film, stretches, hoop)
    along = [
        propagation.quantity(partial(secant_modulus, meridional=stretch, hoop=hoop), gradient(a, b), "Pa")
        for stretch, a, b in zip(stretches, by_mu, by_alpha, strict=True)
    ]
    at = min(range(len(along)), key=lambda k: _by_data(along[k]))
    quantities["stiffness"] = along[at]
    fixed = (round(FIXED * hoop, 2), hoop) if fixed_stretch is None else fixed_stretch
    _, fixed_mu, fixed_alpha = secant(film, np.array([fixed[0]]), fixed[1])
    quantities["stiffness_fixed"] = propagation.quantity(
        partial(secant_modulus, meridional=fixed[0], hoop=fixed[1]), gradient(fixed_mu[0], fixed_alpha[0]), "Pa"
    )
    quantities["stiffness_end"] = along[-1]
    if problem.electric and "eps_r" not in held:
        slopes["eps_r"] = gradient(*zeros, 1.0)
        quantities["eps_r"] = derived.quantity(
            lambda m: m.eps_r, slopes["eps_r"], "1", at_bound=bool(at_bound[problem.film_numbers])
        )

    told = {"stiffness": gradient(by_mu[at], by_alpha[at]), **({"eps_r": slopes["eps_r"]} if "eps_r" in slopes else {})}

    if vanished.any():  # what is left is another model: its terms are not those that were asked for
        quantities |= {name: replace(quantities[name], verdict=verdict(math.inf, True)) for name, _, _ in of_law}

    nuisance = {}
    for k, one in enumerate(problem.nuisances, start=problem.film_parameters):
        if one.kind in DIMENSIONS:
            continue
        slope = np.zeros(x.size)
        slope[k] = one.prior
        nuisance[f"{propagation.label(one.kind)} of {one.run}"] = RigParameter(
            value=float(x[k] * one.prior),
            uncertainty=math.hypot(*propagation.budget(slope).values()),
            prior=one.prior,
            unit=problem.along[one.kind].unit if one.kind in problem.along else (NUISANCES | KINDS)[one.kind],
        )
    nuisance |= _differences(propagation, x)
    return Statement(
        quantities=quantities,
        nuisance=nuisance,
        stretch=(float(stretches[at]), hoop),
        fixed_stretch=fixed,
        stiffness_curve=Stiffness(
            meridional_stretch=tuple(float(value) for value in stretches),
            hoop_stretch=hoop,
            secant_modulus=tuple(q.value for q in along),
            uncertainty=tuple(q.uncertainty for q in along),
        ),
        along=along,
        parameters=list(slopes),
        correlation=_correlation(np.array(list(slopes.values())), propagation.covariance.matrix),
        covariance=propagation.covariances(np.array(list(slopes.values()))).tolist(),
        condition=_condition(problem, x, free),
        unseen=derived.unseen(told),
        moved=propagation.along(told, x),
    )


def _differences(propagation: Propagation, x: Array) -> dict[str, RigParameter]:
    """By how much each specimen's dimensions differ from what they would be if all were wrong alike (relative)."""
    problem, found = propagation.problem, {}
    for dimension, label in OF_DIMENSIONS.items():
        mine = [k for k, one in enumerate(problem.nuisances, problem.film_parameters) if one.kind == dimension]
        if not mine:
            continue
        modes = problem.contrasts(dimension)
        for part, weights in zip(problem.parts(dimension), modes, strict=True):
            row = next(row for row, i in enumerate(problem.active) if problem.curves[i].part(dimension) == part)
            size = float(getattr(problem.curves[problem.active[row]], DIMENSIONS[dimension]))
            slope = np.zeros(x.size)
            slope[mine] = size * weights
            found[f"{label} of {part}"] = RigParameter(
                value=float(slope @ x),
                uncertainty=math.hypot(*propagation.budget(slope).values()),
                prior=float(np.linalg.norm(slope)),
                unit="1",
            )
    return found


def _law_parameters(problem: Problem, held: Collection[str]) -> list[tuple[str, str, int]]:
    """Name, kind ("mu" or "alpha") and number of what was fitted of the law, term by term in a series."""
    n, shapes = problem.moduli, problem.film_numbers - problem.moduli
    names = problem.law.names(n, shapes)
    found = [(name, "mu", k) for k, name in enumerate(names[:n])]
    found += [(name, "alpha", k) for k, name in enumerate(names[n:])]
    if problem.law.series:
        found.sort(key=lambda one: one[2])
    return [one for one in found if one[0] not in held]


def _by_data(quantity: Quantity) -> float:
    """Relative uncertainty without what no data at any stretch can change: where it is least, they tell most."""
    passed = (*OF_DIMENSIONS.values(), "eccentricity", "displacement axis", "voltage at the film")
    if not math.isfinite(quantity.uncertainty):
        return math.inf
    return math.hypot(*(size for part, size in quantity.budget.items() if part not in passed)) / abs(quantity.value)


def _entry(name: str, k: int, film: Material) -> float:
    return float(getattr(film, name)[k])


def _correlation(slopes: Array, covariance: Array) -> list[list[float]]:
    """Correlation matrix of functions of x with these gradients; 0 beside a function without uncertainty."""
    own = slopes @ covariance @ slopes.T
    deviation = np.sqrt(np.diag(own))
    deviation[deviation == 0.0] = 1.0
    matrix = own / np.outer(deviation, deviation)
    np.fill_diagonal(matrix, 1.0)
    return [[float(value) for value in row] for row in matrix]


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
