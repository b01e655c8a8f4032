"""From the minimum to the result: quantities, curves, and what speaks against them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc

from calibration.electrical.agreement import AGREE
from calibration.film.agreement import charged, judged
from calibration.film.identifiability import advice
from calibration.film.measurement import assumed_parts, most_useful
from calibration.film.minima import MOST_STEPS, SAME_MINIMUM, Fit
from calibration.film.misfit import beyond, likely, suspects
from calibration.film.problem import TOLERANCE, IdentificationError, Problem
from calibration.film.profile import intervals, targets, widened
from calibration.film.propagation import determined, least_tangent, state
from calibration.film.reduction import interpolation_matrix
from calibration.film.result import (
    GOOD,
    IDENTIFIED,
    SIGNIFICANT,
    WEAK,
    CurveResult,
    Identification,
    Quantity,
    Suspect,
    verdict,
)
from calibration.film.suspects.viscous import NAME as VISCOUS
from calibration.rounding import percent
from model.material.materials import Material
from model.membrane.solve import solve_many

Array = NDArray[np.float64]

# Standard uncertainties by which an imperfection that 95 of 100 experiments show may shift what counts as identified.
# At this one an error of more than three uncertainties with nothing seen is rarer than 1.5 % at any size of it: the
# largest product of "seen" failing, Phi(4 - s), and of the error, Phi(1.5 s/5.6 - 3), is at s = 3.7 deviations.
UNSEEN = 1.5
WRONG_MODEL = 9.0  # lack of fit per degree of freedom from which on the model does not describe the data at all


def summarise(
    fit: Fit,
    fits: Sequence[Fit],
    held: Mapping[str, float],
    notes: Sequence[str],
    provenance: dict[str, Any],
    *,
    profiles: bool,
    reach: float,
    fixed_stretch: tuple[float, float] | None = None,
) -> Identification:
    """The result of ``fit``; ``fits`` are the minima from all starting points, best first."""
    problem, x = fit.problem, fit.x
    free = int(fit.varied[: problem.film_parameters].sum())
    misfit_freedom = problem.data_rows - free
    if misfit_freedom <= 0:
        raise IdentificationError(f"{problem.data_rows} independent values cannot determine {free} parameters")
    seen = determined(problem, fit.at_bound, held)
    lack = min(beyond(problem, x, seen), fit.cost)
    probability = float(gammaincc(misfit_freedom / 2, lack / 2))
    misfit = lack / misfit_freedom if probability < SIGNIFICANT else 1.0
    rivals = [(other.problem.film(other.x), math.exp((fits[0].cost - other.cost) / 2 / misfit)) for other in fits]
    doubts = suspects(problem, x, seen)
    stated = state(
        problem,
        x,
        fit.at_bound,
        held,
        misfit=misfit,
        rivals=rivals,
        doubts=doubts,
        ranges=True,
        fixed_stretch=fixed_stretch,
    )
    quantities = stated.quantities
    if profiles or fit.at_bound[: problem.moduli].any():  # where a term has vanished, curvature says nothing of it
        aims = targets(problem, stated.stretch, held)
        found = intervals(problem, x, problem.bounds(x), fit.varied, quantities, aims, misfit)
        quantities.update({name: widened(quantities[name], ends, misfit) for name, ends in found.items()})
    charge = charged(problem, x, seen, stated.nuisance)
    suspected = likely(doubts)
    quantities.update(doubted(quantities, stated.unseen, doubts, suspected))
    quantities = judged(quantities, charge)
    curves = _curve_results(problem, x)
    used_curves = [problem.curves[i] for i in dict.fromkeys(problem.active)]
    used = sum(curve.used for curve in curves)
    reduced = problem.residual(x)[: problem.force_rows]
    prior = problem.residual(x)[problem.data_rows :]
    chi_square = float(problem.inflation * (reduced @ reduced) + prior @ prior) + sum(b.floor for b in problem.blocks)
    effective = used / problem.correlation_time
    fitness = chi_square / problem.inflation
    crowding = 2.0 * free * (free + 1) / (effective - free - 1) if effective > free + 1 else math.inf
    result = Identification(
        material=replace(problem.film(x), source="identified from force-displacement curves"),
        quantities=quantities,
        stretch=stated.stretch,
        fixed_stretch=stated.fixed_stretch,
        stiffness_curve=stated.stiffness_curve,
        least_tangent=least_tangent(problem.film(x), stated.stiffness_curve.meridional_stretch[-1], stated.stretch[1]),
        nuisance=stated.nuisance,
        chi_square=chi_square,
        freedom=used - free,
        lack_of_fit=lack,
        lack_of_fit_freedom=misfit_freedom,
        lack_of_fit_probability=probability,
        likely=[one.name for one in suspected],
        along=stated.moved,
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
        assumed=assumed_parts(used_curves) | _assumed_current(problem),
        measurement=most_useful(quantities, used_curves),
        charge=charge,
    )
    if misfit > WRONG_MODEL:
        lost = {
            name: replace(
                quantity,
                verdict=verdict(max(quantity.relative, 1.01 * IDENTIFIED), quantity.at_bound),
                doubt="the model misses the data by far more than their noise",
            )
            for name, quantity in quantities.items()
        }
        notes = [
            "the model misses the data by far more than their noise, so nothing counts as identified; are all logs of "
            "one film? Fit each alone and compare",
            *notes,
        ]
        result = replace(result, quantities=lost)
    if looks_viscous(doubts):
        result = replace(result, quantities={name: _viscous(one) for name, one in result.quantities.items()})
    return replace(result, warnings=[*_warnings(result, problem, fit), *notes])


def _assumed_current(problem: Problem) -> dict[str, float]:
    """The gain of the current, where nobody stated how well it is known."""
    known = None if problem.charge is None else problem.charge.currents.known
    return {} if known is None or known.current_gain is not None else {"current gain": known.gain_error}


def looks_viscous(found: Sequence[Suspect]) -> bool:
    """Whether residuals look like a film that takes time.

    Other imperfections that cost energy look like it in part: it counts where it explains half as much as the best.
    """
    able = [one for one in found if one.possible and math.isfinite(one.uncertainty)]

    def explains(one: Suspect) -> float:
        return (one.amplitude / one.uncertainty) ** 2

    viscous = [explains(one) for one in able if one.family == VISCOUS and one.significant]
    return bool(viscous) and max(viscous) >= 0.5 * max(explains(one) for one in able)


def _viscous(quantity: Quantity) -> Quantity:
    """A quantity of a film that takes time, fitted as elastic: its doubt says so."""
    if "viscous" in quantity.doubt or quantity.verdict == GOOD:
        return quantity
    return replace(quantity, doubt="; ".join(filter(None, (quantity.doubt, "viscous film, fitted as elastic"))))


def doubted(
    quantities: Mapping[str, Quantity],
    unseen: Mapping[str, Mapping[str, float]],
    suspects: Sequence[Suspect],
    found: Sequence[Suspect],
) -> dict[str, Quantity]:
    """Quantities that do not count as identified, for all that their uncertainties say.

    Because an imperfection was ``found``; or because one that no entry of the budget counts may be there unseen and
    shift the quantity by more than `UNSEEN` of its uncertainties (of those given the dimensions, where only that figure
    would count as identified).
    """
    changed = {}
    for name, quantity in quantities.items():
        good = quantity.verdict == GOOD
        if not good and quantity.conditional_verdict != GOOD:
            continue
        doubt = f"the data look like {found[0].name}" if found else ""
        like = "eps_r" if name == "eps_r" else "stiffness"
        least = UNSEEN * (quantity.uncertainty if good else quantity.conditional) / abs(quantity.value)
        for suspect in suspects if like in quantities and not doubt else ():
            shift = abs(unseen.get(suspect.name, {}).get(like, 0.0) / quantities[like].value)
            if not suspect.part and shift > least:
                doubt, least = f"{suspect.name} could shift it unseen by {percent(shift)}", shift
        if doubt:
            changed[name] = replace(quantity, verdict=WEAK if good else quantity.verdict, doubt=doubt)
    return changed


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
                used = problem.pieces[row][1].used
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
    ends = np.array([[part.low, part.high] for _, part in problem.pieces])
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


ZERO_REMEDY = "was it taken in contact, or did it drift?"
REMEDIES = {  # by the beginning of the nuisance's name; else it is a zero
    "lag": "`dea-rig calibrate timing` tells how far the sensors lag, for their certificates",
    "compliance": "`dea-rig calibrate compliance` tells",
}


def _warnings(result: Identification, problem: Problem, fit: Fit) -> list[str]:
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
    by_name = {suspect.name: suspect for suspect in result.suspects}
    if result.charge is not None and result.charge.verdict != AGREE:
        words.append(result.charge.words)
    if result.likely:
        named = " or ".join(by_name[name].words for name in result.likely)
        apart = "; these data cannot tell them apart" if len(result.likely) > 1 else ""
        words.append(
            f"the model does not explain the data: the residuals look like {named}{apart}; what that does to the "
            "results is in their uncertainties"
        )
        keys = [key for key in dict.fromkeys(by_name[name].key for name in result.likely) if key]
        if keys:
            words.append(f"it can be fitted along: --along {' or --along '.join(keys)}")
    if looks_viscous(result.suspects):
        words.append(
            "the film takes time (viscous) and was fitted as elastic; --branches auto fits its relaxation along"
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
                + next((ask for beginning, ask in REMEDIES.items() if name.startswith(beginning)), ZERO_REMEDY)
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
