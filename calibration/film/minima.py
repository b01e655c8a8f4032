"""Where the fit starts, and how it gets from there to a minimum."""

from __future__ import annotations

import warnings as python_warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.film.curve import Curve
from calibration.film.problem import IdentificationError, Problem
from calibration.film.search import minimise_many
from model.material.law import Law
from model.material.materials import Material
from model.membrane.solve import solve_many

Array = NDArray[np.float64]

FINAL, MOST_STEPS = 1e-5, 60  # relative decrease of chi-square that ends the last fit, and its evaluations
AT_BOUND = 1e-4  # distance to a bound, relative to the distance of the bounds
SAME_MINIMUM = 0.5  # chi-square by which two minima may differ and count as one


def scaled(materials: Sequence[Material], curves: Sequence[Curve]) -> list[Material]:
    """The materials made as stiff as the curves with the least voltage say they are.

    A material that has no state at the film's stretches (a Gent film drawn beyond its limit) is left out.

    Raises
    ------
    IdentificationError
        None of them has, or the force does not rise with the displacement.
    """
    rows = [curve.usable & (curve.h > 0.0) for curve in curves]
    given = [(curve, used) for curve, used in zip(curves, rows, strict=True) if used.any()]
    if not given:  # why, the selection of samples will tell
        return list(materials)
    least = min(abs(curve.nominal_voltage) for curve, _ in given)
    plain = [(curve, used) for curve, used in given if abs(curve.nominal_voltage) == least]
    specimens = np.empty((len(materials), len(plain), 1), dtype=np.object_)
    for s, material in enumerate(materials):
        specimens[s, :, 0] = [curve.specimen.with_material(material) for curve, _ in plain]
    grid = np.array([np.linspace(0.0, float(curve.h[used].max()), 9) for curve, used in plain]).reshape(-1, 9)
    solved = solve_many(specimens, grid, tolerance=1e-5).force
    scaled = []
    for material, forces in zip(materials, solved, strict=True):
        if not (np.isfinite(forces).sum(axis=1) > 1).all():
            continue
        measured_by_model = model_squared = 0.0
        for (curve, used), places, force in zip(plain, grid, forces, strict=True):
            known = np.isfinite(force)
            model = np.interp(curve.h[used], places[known], force[known])
            measured_by_model += float(curve.force[used] @ model)
            model_squared += float(model @ model)
        if not measured_by_model > 0.0:
            raise IdentificationError(
                "the force does not rise with the displacement in the curves with the least voltage: "
                "is the sign of the force or of the displacement right, and is there a film?"
            )
        ratio = measured_by_model / model_squared
        scaled.append(replace(material, mu=tuple(mu * ratio for mu in material.mu)))
    if not scaled:
        raise IdentificationError(
            "the law has no state at the stretches of these films with any of its starting values: are pre-stretch and "
            "radii right, and does the scene's material reach these stretches?"
        )
    return scaled


def spread(material: Material, terms: int) -> Material:
    """The same film with more Ogden terms: its last one, cut in pieces with exponents around its own."""
    mu, alpha = list(material.mu), list(material.alpha)
    pieces = terms - len(mu) + 1
    share = mu.pop() * alpha[-1] / pieces
    last = alpha.pop()
    exponents = last * np.linspace(0.8, 1.2, pieces) if pieces > 1 else np.array([last])
    mu += [float(share / exponent) for exponent in exponents]
    return replace(material, mu=tuple(mu), alpha=(*alpha, *map(float, exponents)))


def starting_materials(
    guess: Material, terms: int, count: int, seed: int, held: Mapping[str, float], negative: bool
) -> list[Material]:
    """The guess, where it has as many terms, and random sets of its law with the same modulus."""
    random, law = np.random.default_rng(seed), guess.law
    sets: list[tuple[Array, Array]] = []
    moduli, shapes = law.counts(terms)
    alpha = np.array(guess.alpha)
    share = np.array(guess.mu) * law.weights(alpha)[0]
    if len(share) == moduli and (not law.series or (share > 0.0).all()):
        sets.append((share, alpha))
    while len(sets) < count:
        share, alpha = law.draw(random, terms)
        if negative and law.series and terms > 1 and len(sets) % 3 == 2:
            alpha[0] *= -1.0
        sets.append((guess.shear_modulus * share, alpha))
    names = law.names(moduli, shapes)[moduli:]
    materials = []
    for share, alpha in sets[:count]:
        alpha = np.array([held.get(name, value) for name, value in zip(names, alpha, strict=True)])
        mu = share / law.weights(alpha)[0]
        materials.append(Material(name="start", mu=tuple(mu), alpha=tuple(alpha), eps_r=guess.eps_r, law=law))
    return materials


def of_law(material: Material, law: type[Law], terms: int, seed: int) -> Material:
    """A film of another law with the same modulus and permittivity; itself where it is of that law already."""
    if material.law is law:
        return material
    share, alpha = law.draw(np.random.default_rng(seed), terms)
    mu = material.shear_modulus * share / law.weights(alpha)[0]
    return replace(material, mu=tuple(mu), alpha=tuple(alpha), law=law)


@dataclass(frozen=True, eq=False)
class Fit:
    """A minimum: parameter vector, chi-square of the reduced data, which film parameters may vary or sit at a bound."""

    problem: Problem
    x: Array
    cost: float
    converged: bool
    varied: NDArray[np.bool_]
    at_bound: NDArray[np.bool_]

    @property
    def compliance(self) -> float:
        """The rig's, beyond that believed (m/N)."""
        found = zip(self.problem.nuisances, self.x[self.problem.film_parameters :], strict=True)
        return sum(one.prior * float(value) for one, value in found if one.kind == "compliance")

    def restarted(self, problem: Problem) -> Array:
        """This minimum as a starting point of ``problem``, whose scale and set of nuisances may differ."""
        x = problem.vector(self.problem.film(self.x))
        found = self.x[self.problem.film_parameters :]
        known = {(one.kind, one.run): value for one, value in zip(self.problem.nuisances, found, strict=True)}
        x[problem.film_parameters :] = [known.get((one.kind, one.run), 0.0) for one in problem.nuisances]
        return x


def search(problem: Problem, materials: Sequence[Material], held: Mapping[str, float]) -> list[Fit]:
    """Minima from all starting materials, best first."""
    n = problem.film_numbers
    varied = np.array([name not in held for name in problem.names])
    points = np.array([problem.vector(material) for material in materials])
    low, high = (np.array(side) for side in zip(*(problem.bounds(x) for x in points), strict=True))
    points = np.where(varied, np.clip(points, low, high), points)
    if problem.electric and "eps_r" not in held:
        for _ in range(8):
            lost = ~problem.evaluate(points, slopes=False).answered & (points[:, n] > 1.0)
            if not lost.any():
                break
            points[lost, n] *= 0.5  # a film this soft cannot hold the voltage with that permittivity
    found = minimise_many(problem, points, (low, high), varied)
    fits = [
        _fit(problem, one.x, one.cost, one.converged, (low[k], high[k]), varied, held)
        for k, one in enumerate(found)
        if one is not None
    ]
    if not fits:
        raise IdentificationError("no fit converged from any starting point; is the specimen's geometry right?")
    return sorted(fits, key=lambda fit: fit.cost)


def _fit(
    problem: Problem,
    x: Array,
    cost: float,
    converged: bool,
    bounds: tuple[Array, Array],
    varied: NDArray[np.bool_],
    held: Mapping[str, float],
) -> Fit:
    """A minimum, the terms of a series sorted by exponent."""
    n = problem.moduli
    low, high = bounds
    span = high - low
    at_bound = varied & (np.minimum(x - low, high - x) < AT_BOUND * span) & np.isfinite(span)
    if problem.law.series and not set(problem.names[n : problem.film_numbers]) & set(held):
        order = np.argsort(x[n : 2 * n])
        order = np.concatenate((order, n + order, np.arange(2 * n, x.size)))
        x, at_bound = x[order], at_bound[order]
    return Fit(problem, x, cost, converged, varied, at_bound)


def polish(problem: Problem, near: Fit, held: Mapping[str, float]) -> Fit | None:
    """The minimum of ``problem`` near that of another one; None where the model has no answer there."""
    start = near.restarted(problem)
    low, high = problem.bounds(start)
    varied = np.array([name not in held for name in problem.names])
    start = np.where(varied, np.clip(start, low, high), start)
    (found,) = minimise_many(problem, start[None], (low[None], high[None]), varied, decrease=1e-4)
    return None if found is None else _fit(problem, found.x, found.cost, found.converged, (low, high), varied, held)


def confirm(problem: Problem, near: Fit, held: Mapping[str, float]) -> Fit:
    """The minimum by lmfit's least squares, from where ours ended."""
    import lmfit

    lower, upper = problem.bounds(near.x)
    varied, start = near.varied, near.x
    parameters = lmfit.Parameters()
    for name, value, low, high, vary in zip(problem.names, start, lower, upper, varied, strict=True):
        parameters.add(name, value=float(value), min=low, max=high, vary=bool(vary))

    def vector(values: Any) -> Array:
        return np.array([values[name].value for name in problem.names])

    def residual(values: Any) -> Array:
        return problem.residual(vector(values))

    def jacobian(values: Any) -> Array:
        return problem.jacobian(vector(values))[:, varied]

    # scale_covar off: the weights come from calibration, and a misfit must show as one.
    minimiser = lmfit.Minimizer(residual, parameters, scale_covar=False, nan_policy="raise")
    with python_warnings.catch_warnings(), np.errstate(all="ignore"):
        # lmfit takes square roots of its own covariance, which is not positive definite for terms that are not
        # identifiable. Ours (`calibration.film.propagation.Covariance`) is used instead.
        python_warnings.simplefilter("ignore")
        out = minimiser.minimize(
            method="least_squares", jac=jacobian, x_scale="jac", ftol=FINAL, xtol=1e-9, gtol=1e-9, max_nfev=MOST_STEPS
        )
    x = vector(out.params)
    final = problem.residual(x)
    cost = float(final @ final)
    if not cost < near.cost:  # it was there already
        return replace(near, converged=near.converged or bool(out.success))
    return _fit(problem, x, cost, bool(out.success), (lower, upper), varied, held)


def representative(fits: Sequence[Fit]) -> Fit:
    """The best fit; among equals one whose terms all carry stiffness, where its curvature tells more."""
    equals = [fit for fit in fits if fit.cost - fits[0].cost < SAME_MINIMUM / 2]
    return min(equals, key=lambda fit: (int(fit.at_bound.sum()), fit.cost))


def other_minima(fits: Sequence[Fit]) -> list[str]:
    """Words for sets of parameters that differ from the best one by more than 20 % and fit as well."""
    best = fits[0]
    for fit in fits[1:]:
        if fit.cost - best.cost >= SAME_MINIMUM:
            break
        n = fit.problem.film_numbers
        if (np.abs(fit.x[:n] - best.x[:n]) > 0.2 * np.abs(best.x[:n])).any():
            film = fit.problem.film(fit.x)
            told = ", ".join(f"{name} = {value:.4g}" for name, value in film.values.items())
            return [f"other parameters fit these data equally well, for instance {told} (moduli in Pa)"]
    return []
