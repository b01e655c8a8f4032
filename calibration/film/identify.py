"""Ogden parameters and permittivity of a film from its force-displacement curves, with uncertainties to be believed.

All curves, voltages and specimens are fitted at once. The film's parameters enter as stiffness shares ``g_n = mu_n
alpha_n / (2 G_0) > 0`` and exponents ``alpha_n``, all of order one, with ``eps_r`` where there is voltage. Exponents
stay between 0.2 and 30; one that the data do not determine counts as anywhere in between. The zeros of force and
displacement and the lag of the force of each run, and the rig's compliance, are nuisance parameters whose prior is
their stated uncertainty. Gains and the specimen's dimensions are not fitted, because the data must not be allowed to
excuse a wrong model with a wrong gain: their uncertainties are propagated linearly (JCGM 100:2008, 5.1) and stated
apart.

Convention of the Ogden terms: `model.material.materials.Material`.
"""

from __future__ import annotations

import importlib.metadata
import math
import warnings as python_warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc

from calibration.film.curve import Curve
from calibration.film.held_out import held_out
from calibration.film.identifiability import advice
from calibration.film.misfit import SIGNIFICANT, suspects
from calibration.film.problem import NODES, TOLERANCE, IdentificationError, Problem
from calibration.film.profile import intervals, targets, widened
from calibration.film.propagation import determined, least_tangent, secant_modulus, state
from calibration.film.reduction import Selection, interpolation_matrix, select
from calibration.film.result import IDENTIFIED, CurveResult, Identification, verdict
from calibration.film.search import minimise_many
from model.material.materials import Material
from model.membrane.solve import Wrinkling, solve_many

Array = NDArray[np.float64]

__all__ = ["IdentificationError", "compare", "identify", "secant_modulus"]

PASSES = 5
WRONG_MODEL = 9.0  # lack of fit per degree of freedom from which on the model does not describe the data at all
FINAL, MOST_STEPS = 1e-5, 60  # relative decrease of chi-square that ends the last fit, and its evaluations
MOST_NODES = 36
SEARCH_TOLERANCE = 1e-6  # of the membrane's force, relative, while the minima are sought
INTERPOLATION = 0.1  # largest estimated error of interpolation, in standard deviations of what a node carries
AT_BOUND = 1e-4  # distance to a bound, relative to the distance of the bounds
SAME_MINIMUM = 0.5  # chi-square by which two minima may differ and count as one


def identify(
    curves: Sequence[Curve],
    *,
    terms: int = 2,
    starts: int = 6,
    seed: int = 0,
    negative_exponents: bool = False,
    profiles: bool = False,
    fixed: Mapping[str, float] | None = None,
    wrinkling: Wrinkling = "plain",
    near: Sequence[Material] = (),
    reach: float = math.inf,
    provenance: Mapping[str, Any] | None = None,
) -> Identification:
    """Fit an Ogden film to force-displacement curves.

    Parameters
    ----------
    curves : sequence of Curve
        All curves of all runs and specimens of one film material.
    terms : int
        Number of Ogden terms.
    starts : int
        Starting points; the first is the material of the specimens, the others are drawn with ``seed``.
    negative_exponents : bool
        Let every third starting point have ``alpha_1 < 0`` (and ``mu_1 < 0``). A sign never changes during a fit.
    profiles : bool
        Also find the 95 % intervals of ``G``, ``stiffness`` and ``eps_r`` by profile likelihood. It takes a few times
        as long, and widens the uncertainties where the problem is too far from linear for its curvature to tell.
    fixed : mapping of str to float, optional
        ``alpha1``... and ``eps_r`` that are known and not to be fitted, e.g. ``{"eps_r": 1.7}``.
    wrinkling : {"plain", "tension_field"}
        What becomes of samples at which the film is wrinkled: left out, or described by the tension field. They are
        counted either way.
    near : sequence of Material
        Further starting points, of at most as many terms.
    reach : float
        Largest displacement (m) that the rig may go to; no advice goes beyond.
    provenance : mapping, optional
        Whatever identifies the data (hashes of logs, names of files), as plain JSON values; kept in the result.

    Raises
    ------
    IdentificationError
        When nothing can be identified from these curves.
    """
    held = dict(fixed or {})
    allowed = [*(f"alpha{n + 1}" for n in range(terms)), "eps_r"]
    unknown = [name for name in held if name not in allowed]
    if unknown:
        raise IdentificationError(f"cannot fix {', '.join(unknown)}; what can be fixed is {', '.join(allowed)}")
    if terms < 1 or starts < 1:
        raise IdentificationError("terms and starts must be at least 1")
    if not curves:
        raise IdentificationError("there are no curves")

    guess = curves[0].specimen.material
    if "eps_r" in held:
        guess = replace(guess, eps_r=held["eps_r"])
    (material,) = _scaled([guess], curves)
    selections = select(curves, material, wrinkling)
    notes: list[str] = []
    nodes = NODES
    for number in range(PASSES):
        if number == 0:
            search = Problem(curves, selections, terms, material, tolerance=SEARCH_TOLERANCE, wrinkling=wrinkling)
            points = _starting_materials(material, terms, starts, seed, held, negative_exponents)
            points += [_spread(one, terms) for one in near]
            fits = _search(search, _scaled(points, curves), held)
            best = _representative(fits)
            material = search.film(best.x)
        problem = Problem(
            curves, selections, terms, material, nodes=nodes, wrinkling=wrinkling, compliance=best.compliance
        )
        best = _polish(problem, best, held) or best
        material = problem.film(best.x)
        previous, selections = selections, select(curves, material, wrinkling)
        if nodes < MOST_NODES and _too_coarse(problem, best.x):
            nodes = min(MOST_NODES, nodes * 3 // 2)
        elif number > 0 and _same(previous, selections):
            # The first pass took its weights and corrections from the search: always make a second one.
            break
    else:
        notes.append("the set of samples at which the film is taut did not settle while fitting")
    best = _confirm(problem, best, held)
    notes += _other_minima(fits)
    record = {
        "data": dict(provenance or {}),
        "settings": {"terms": terms, "starts": starts, "seed": seed, "fixed": held, "wrinkling": wrinkling},
        "software": {name: importlib.metadata.version(name) for name in ("dea-rig", "lmfit", "numpy", "scipy")},
    }
    return _assemble(best, fits, held, notes, record, profiles=profiles, reach=reach)


def _too_coarse(problem: Problem, x: Array) -> bool:
    """Whether the interpolation of some curve is off by a tenth of the standard error of what a node carries."""
    most = max(block.samples for block in problem.blocks) / problem.nodes.shape[1]
    noise = np.array([problem.curves[i].force_noise for i in problem.active]) / math.sqrt(max(1.0, most))
    return bool((problem.interpolation_error(problem.states(x)) > INTERPOLATION * noise).any())


def _same(before: Sequence[Selection], after: Sequence[Selection]) -> bool:
    """Whether two selections hold the same samples in the same parts."""
    return all(
        len(a.parts) == len(b.parts)
        and all(np.array_equal(one.used, other.used) for one, other in zip(a.parts, b.parts, strict=True))
        for a, b in zip(before, after, strict=True)
    )


def compare(curves: Sequence[Curve], *, terms: Sequence[int] = (1, 2, 3), **options: Any) -> list[Identification]:
    """`identify` with each number of Ogden terms, compared by ``aicc``, ``bic`` and ``held_out``; ``options`` as there.

    Each starts from what fewer terms found, too: more terms never fit worse.
    """
    found: list[Identification] = []
    for count in terms:
        fewer = [one.material for one in found if one.terms < count]
        one = identify(curves, terms=count, near=fewer[-1:], **options)
        found.append(replace(one, held_out=held_out(curves, one.material, options.get("wrinkling", "plain"))))
    return found


# --- starting points and minimisation


def _scaled(materials: Sequence[Material], curves: Sequence[Curve]) -> list[Material]:
    """The materials made as stiff as the curves with the least voltage say they are."""
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
    return scaled


def _spread(material: Material, terms: int) -> Material:
    """The same film with more terms: its last one, cut in pieces with exponents around its own."""
    mu, alpha = list(material.mu), list(material.alpha)
    pieces = terms - len(mu) + 1
    share = mu.pop() * alpha[-1] / pieces
    last = alpha.pop()
    exponents = last * np.linspace(0.8, 1.2, pieces) if pieces > 1 else np.array([last])
    mu += [float(share / exponent) for exponent in exponents]
    return replace(material, mu=tuple(mu), alpha=(*alpha, *map(float, exponents)))


def _starting_materials(
    guess: Material, terms: int, count: int, seed: int, held: Mapping[str, float], negative: bool
) -> list[Material]:
    """The guess, where it has as many terms, and random sets with the same modulus."""
    random = np.random.default_rng(seed)
    sets: list[tuple[Array, Array]] = []
    mu, alpha = np.array(guess.mu), np.array(guess.alpha)
    if len(mu) == terms and (mu * alpha > 0.0).all():
        sets.append((mu * alpha / 2.0, alpha))
    while len(sets) < count:
        alpha = np.sort(np.exp(random.uniform(math.log(1.2), math.log(12.0), terms)))
        if negative and terms > 1 and len(sets) % 3 == 2:
            alpha[0] *= -1.0
        sets.append((guess.shear_modulus * random.dirichlet(np.ones(terms)), alpha))
    materials = []
    for share, alpha in sets[:count]:
        alpha = np.array([held.get(f"alpha{n + 1}", value) for n, value in enumerate(alpha)])
        mu = 2.0 * share / alpha
        materials.append(Material(name="start", mu=tuple(mu), alpha=tuple(alpha), eps_r=guess.eps_r))
    return materials


@dataclass(frozen=True, eq=False)
class _Fit:
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


def _search(problem: Problem, materials: Sequence[Material], held: Mapping[str, float]) -> list[_Fit]:
    """Minima from all starting materials, best first."""
    n = problem.terms
    varied = np.array([name not in held for name in problem.names])
    points = np.array([problem.vector(material) for material in materials])
    low, high = (np.array(side) for side in zip(*(problem.bounds(x) for x in points), strict=True))
    points = np.where(varied, np.clip(points, low, high), points)
    if problem.electric and "eps_r" not in held:
        for _ in range(8):
            lost = ~problem.evaluate(points, slopes=False).answered & (points[:, 2 * n] > 1.0)
            if not lost.any():
                break
            points[lost, 2 * n] *= 0.5  # a film this soft cannot hold the voltage with that permittivity
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
) -> _Fit:
    """A minimum with its terms sorted by exponent."""
    n = problem.terms
    low, high = bounds
    span = high - low
    at_bound = varied & (np.minimum(x - low, high - x) < AT_BOUND * span) & np.isfinite(span)
    if not any(name.startswith("alpha") for name in held):
        order = np.argsort(x[n : 2 * n])
        order = np.concatenate((order, n + order, np.arange(2 * n, x.size)))
        x, at_bound = x[order], at_bound[order]
    return _Fit(problem, x, cost, converged, varied, at_bound)


def _polish(problem: Problem, near: _Fit, held: Mapping[str, float]) -> _Fit | None:
    """The minimum of ``problem`` near that of another one; None where the model has no answer there."""
    start = near.restarted(problem)
    low, high = problem.bounds(start)
    varied = np.array([name not in held for name in problem.names])
    start = np.where(varied, np.clip(start, low, high), start)
    (found,) = minimise_many(problem, start[None], (low[None], high[None]), varied, decrease=1e-4)
    return None if found is None else _fit(problem, found.x, found.cost, found.converged, (low, high), varied, held)


def _confirm(problem: Problem, near: _Fit, held: Mapping[str, float]) -> _Fit:
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


def _representative(fits: Sequence[_Fit]) -> _Fit:
    """The best fit; among equals one whose terms all carry stiffness, where its curvature tells more."""
    equals = [fit for fit in fits if fit.cost - fits[0].cost < SAME_MINIMUM / 2]
    return min(equals, key=lambda fit: (int(fit.at_bound.sum()), fit.cost))


def _other_minima(fits: Sequence[_Fit]) -> list[str]:
    """Words for sets of parameters that differ from the best one by more than 20 % and fit as well."""
    best = fits[0]
    for fit in fits[1:]:
        if fit.cost - best.cost >= SAME_MINIMUM:
            break
        n = 2 * fit.problem.terms
        if (np.abs(fit.x[:n] - best.x[:n]) > 0.2 * np.abs(best.x[:n])).any():
            film = fit.problem.film(fit.x)
            pairs = ", ".join(f"mu = {m:.4g} Pa with alpha = {a:.3g}" for m, a in zip(film.mu, film.alpha, strict=True))
            return [f"other Ogden parameters fit these data equally well, for instance {pairs}"]
    return []


# --- the result


def _assemble(
    fit: _Fit,
    fits: Sequence[_Fit],
    held: Mapping[str, float],
    notes: Sequence[str],
    provenance: dict[str, Any],
    *,
    profiles: bool,
    reach: float,
) -> Identification:
    """The result of ``fit``; ``fits`` are the minima from all starting points, best first."""
    problem, x = fit.problem, fit.x
    free = int(fit.varied[: problem.film_parameters].sum())
    misfit_freedom = problem.data_rows - free
    if misfit_freedom <= 0:
        raise IdentificationError(f"{problem.data_rows} independent values cannot determine {free} parameters")
    probability = float(gammaincc(misfit_freedom / 2, fit.cost / 2))
    misfit = fit.cost / misfit_freedom if probability < SIGNIFICANT else 1.0
    rivals = [(other.problem.film(other.x), math.exp((fits[0].cost - other.cost) / 2 / misfit)) for other in fits]
    doubts = suspects(problem, x, determined(problem, fit.at_bound, held))
    stated = state(problem, x, fit.at_bound, held, misfit=misfit, rivals=rivals, doubts=doubts, ranges=True)
    quantities = stated.quantities
    if profiles or fit.at_bound[: problem.terms].any():  # where a term has vanished, curvature says nothing of it
        aims = targets(problem, stated.stretch, held)
        found = intervals(problem, x, problem.bounds(x), fit.varied, quantities, aims, misfit)
        quantities.update({name: widened(quantities[name], ends, misfit) for name, ends in found.items()})
    curves = _curve_results(problem, x)
    used = sum(curve.used for curve in curves)
    reduced = problem.residual(x)[: problem.data_rows]
    prior = problem.residual(x)[problem.data_rows :]
    chi_square = float(problem.inflation * (reduced @ reduced) + prior @ prior) + sum(b.floor for b in problem.blocks)
    effective = used / problem.correlation_time
    fitness = chi_square / problem.inflation
    crowding = 2.0 * free * (free + 1) / (effective - free - 1) if effective > free + 1 else math.inf
    result = Identification(
        material=replace(problem.film(x), source="identified from force-displacement curves"),
        quantities=quantities,
        stretch=stated.stretch,
        stiffness_curve=stated.stiffness_curve,
        least_tangent=least_tangent(problem.film(x), stated.stiffness_curve.meridional_stretch[-1], stated.stretch[1]),
        nuisance=stated.nuisance,
        chi_square=chi_square,
        freedom=used - free,
        lack_of_fit=fit.cost,
        lack_of_fit_freedom=misfit_freedom,
        lack_of_fit_probability=probability,
        suspects=doubts,
        unseen=stated.unseen,
        noise_ratio=math.sqrt(problem.noise_variance),
        samples_per_independent=problem.correlation_time,
        parameters=stated.parameters,
        correlation=stated.correlation,
        covariance=stated.covariance,
        condition=stated.condition,
        aicc=fitness + 2.0 * free + crowding,
        bic=fitness + free * math.log(effective),
        curves=curves,
        starts=len(fits),
        starts_agreeing=sum(other.cost - fits[0].cost < SAME_MINIMUM for other in fits),
        warnings=[],
        advice=[] if held else advice(problem.curves, problem.film(x), stated.quantities, reach),
        provenance=provenance,
    )
    if misfit > WRONG_MODEL:
        doubted = {
            name: replace(quantity, verdict=verdict(max(quantity.relative, 1.01 * IDENTIFIED), quantity.at_bound))
            for name, quantity in quantities.items()
        }
        notes = [
            "the model misses the data by far more than their noise, so nothing counts as identified; are all logs of "
            "one film? Fit each alone and compare",
            *notes,
        ]
        result = replace(result, quantities=doubted)
    return replace(result, warnings=[*_warnings(result, problem, fit), *notes])


def _curve_results(problem: Problem, x: Array) -> list[CurveResult]:
    states = problem.states(x)
    errors = _interpolation_errors(problem, problem.film(x))
    results = []
    for i, (curve, selection) in enumerate(zip(problem.curves, problem.selections, strict=True)):
        rms = expected = lag1 = error = math.nan
        loading: float | None = None
        unloading: float | None = None
        rows = [row for row, active in enumerate(problem.active) if active == i]
        if rows:
            residual, sigma = np.zeros(curve.h.size), np.zeros(curve.h.size)
            for row in rows:
                used = problem.parts[row][1].used
                residual[used], sigma[used], _ = problem.samples(row, x, states)
            residual, sigma = residual[selection.used], sigma[selection.used]
            direction = curve.direction[selection.used]
            rms, expected = float(np.sqrt(np.mean(residual**2))), float(np.sqrt(np.mean(sigma**2)))
            lag1 = float(residual[1:] @ residual[:-1] / (residual @ residual)) if residual.size > 1 else math.nan
            loading, unloading = (
                float(residual[direction == way].mean()) if (direction == way).any() else None for way in (1, -1)
            )
            error = float(errors[rows].max())
        results.append(
            CurveResult(
                label=curve.label,
                run=curve.run,
                specimen=curve.specimen.name,
                nominal_voltage=curve.nominal_voltage,
                samples=curve.h.size,
                used=int(selection.used.sum()),
                excluded=dict(selection.excluded),
                wrinkled=selection.wrinkled,
                rms_residual=rms,
                rms_expected=expected,
                lag1_autocorrelation=lag1,
                mean_residual_loading=loading,
                mean_residual_unloading=unloading,
                interpolation_error=error,
            )
        )
    return results


def _interpolation_errors(problem: Problem, film: Material) -> Array:
    """Largest difference (N) between the interpolant of each row and the model, at its ends and between its nodes."""
    ends = np.array([[part.low, part.high] for _, part in problem.parts])
    between = 0.5 * (problem.nodes[:, 1:] + problem.nodes[:, :-1])
    points = np.concatenate((problem.nodes, ends, between), axis=1)
    specimens = np.empty((len(points), 1), dtype=np.object_)
    specimens[:, 0] = [problem.curves[i].specimen.with_material(film) for i in problem.active]
    force = solve_many(
        specimens, points, problem.voltage[:, None], tolerance=TOLERANCE, wrinkling=problem.wrinkling
    ).force
    count = problem.nodes.shape[1]
    return np.array(
        [
            np.abs(interpolation_matrix(nodes, at[count:]) @ values[:count] - values[count:]).max()
            for nodes, at, values in zip(problem.nodes, points, force, strict=True)
        ]
    )


_ASK_ZERO = "was it taken in contact, or did it drift?"
_ASK = {  # by the beginning of the nuisance's name; else it is a zero
    "lag": "`dea-rig calibrate timing` tells how far the sensors lag, for their certificates",
    "compliance": "`dea-rig calibrate compliance` tells",
}


def _warnings(result: Identification, problem: Problem, fit: _Fit) -> list[str]:
    words = []
    if not fit.converged:
        words.append(f"the fit did not converge in {MOST_STEPS} evaluations; its numbers are provisional")
    edge = [name for name, quantity in result.quantities.items() if quantity.at_bound]
    if edge:
        words.append(f"{', '.join(edge)} ended at the edge of the allowed range: not determined by this data")
    lost = {name: q for name, q in result.quantities.items() if q.verdict.startswith("not") and not q.at_bound}
    if lost:
        shares = ", ".join(f"{name} to {_share(quantity.relative)}" for name, quantity in lost.items())
        words.append(f"not determined by this data: {shares} (standard uncertainty over value)")
    if not result.least_tangent > 0.0:
        words.append("the film found is not stable at every stretch that was reached: use no model built on it")
    if result.lack_of_fit_probability < SIGNIFICANT:
        ratio = math.sqrt(result.lack_of_fit / result.lack_of_fit_freedom)
        words.append(
            f"the model does not explain the data within their noise (lack of fit {ratio:.1f} times what noise would "
            f"give, probability {result.lack_of_fit_probability:.1g}); the uncertainties contain an allowance for it, "
            "but a wrong model has errors that no uncertainty covers"
        )
    for suspect in result.suspects[:1]:
        if suspect.significant:
            words.append(
                f"the model does not explain the data: the residuals look like {suspect.words}; what that does to the "
                "results is in their uncertainties"
            )
    if problem.excess > 1.0:
        words.append(
            f"the samples scatter {result.noise_ratio:.2f} times as much as stated; "
            "the uncertainties were enlarged by that"
        )
    if result.samples_per_independent > 1.0:
        words.append(
            f"neighbouring samples are correlated: {result.used} samples count as "
            f"{result.used / result.samples_per_independent:.0f} independent ones"
        )
    for curve, measured, selection in zip(result.curves, problem.curves, problem.selections, strict=True):
        words += _curve_warnings(curve, measured.direction[selection.used], result.samples_per_independent)
    for name, zero in result.nuisance.items():
        if abs(zero.value) > 3.0 * zero.prior:
            words.append(
                f"the {name} had to move by {zero.value / zero.prior:+.1f} of its stated standard uncertainties; "
                + next((ask for beginning, ask in _ASK.items() if name.startswith(beginning)), _ASK_ZERO)
            )
    if not problem.electric and any(curve.nominal_voltage != 0.0 for curve in problem.curves):
        words.append("no sample with voltage is left after the exclusions: the permittivity was not identified")
    return words


def _share(relative: float) -> str:
    return f"{100 * relative:.0f} %" if relative <= 10.0 else "more than 1000 %"


def _curve_warnings(curve: CurveResult, direction: NDArray[np.int8], per_independent: float) -> list[str]:
    """What is to be said of one curve; ``direction`` is that of its used samples."""
    words = []
    if curve.samples - curve.used > curve.excluded.get("before contact", 0):
        reasons = ", ".join(f"{count} {reason}" for reason, count in curve.excluded.items())
        words.append(f"{curve.label}: {curve.samples - curve.used} of {curve.samples} samples left out ({reasons})")
    if curve.interpolation_error > 0.1 * curve.rms_expected:
        words.append(
            f"{curve.label}: the interpolation between model states is off by {curve.interpolation_error:.1g} N"
        )
    if curve.mean_residual_loading is not None and curve.mean_residual_unloading is not None:
        loop = curve.mean_residual_loading - curve.mean_residual_unloading
        counts = [max(1, int((direction == way).sum())) for way in (1, -1)]
        error = curve.rms_expected * math.sqrt(per_independent * sum(1 / count for count in counts))
        if abs(loop) > 4.0 * error:
            words.append(
                f"{curve.label}: loading lies {loop * 1e3:+.2f} mN above unloading on average (hysteresis); "
                "the model has none and runs between them"
            )
    return words
