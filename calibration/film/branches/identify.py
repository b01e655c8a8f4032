"""Law, permittivity and branches of a film from whole runs, in the form of every other result.

Quantities and their uncertainties are those of the joint fit (`joint`). What else a result holds, above all the
imperfections that residuals are held against, comes from the forces less what the branches add to them: those of the
relaxed film.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.film.branches.counting import Count, misfit, shifted
from calibration.film.branches.joint import SOFTENING, Joint, Point
from calibration.film.branches.record import Record, thinned
from calibration.film.branches.result import (
    HOLD,
    USUAL,
    BranchCount,
    FoundBranch,
    Known,
    Softening,
    Spectrum,
    Trace,
    blind_times,
)
from calibration.film.branches.spectrum import Unseen, beside, count_branches, covariance, unseen
from calibration.film.curve import Curve
from calibration.film.differences import DIMENSIONS
from calibration.film.identify import identify
from calibration.film.measurement import most_useful
from calibration.film.problem import IdentificationError
from calibration.film.propagation import (
    NEGLIGIBLE,
    NUISANCES,
    OF_DIMENSIONS,
    law_of,
    secant,
    secant_modulus,
    shear_slopes,
)
from calibration.film.result import Identification, Quantity, RigParameter, Suspect, verdict
from calibration.film.summary import doubted
from calibration.film.suspects.viscous import NAME, REMEDY
from model.material.law import stack

Array = NDArray[np.float64]

FEW, STARTS = 600, 3  # samples of a curve, and starts, of the elastic fit that begins the search
FITTED_ALONG = NUISANCES | {SOFTENING: "1"}  # errors of the rig and of the film, by their unit


def identify_branches(
    records: Sequence[Record],
    curves: Sequence[Curve],
    *,
    branches: int | None = None,
    terms: int = 2,
    fixed: Mapping[str, float] | None = None,
    fixed_stretch: tuple[float, float] | None = None,
    **settings: Any,
) -> tuple[Identification, list[Curve]]:
    """Fit a film that takes time; also the curves less what the branches add to their forces.

    Parameters
    ----------
    records : sequence of Record
        Whole runs.
    curves : sequence of Curve
        The recorded curves of the same runs.
    branches : int, optional
        How many; as many as pay when not given.
    terms, fixed, fixed_stretch, settings : as `calibration.film.identify.identify`

    Raises
    ------
    IdentificationError
        When nothing can be identified from these data.
    """
    held = dict(fixed or {})
    if not any(record.used.any() for record in records):
        raise IdentificationError("no sample of the runs' histories is a measurement of the film")
    options: dict[str, Any] = {**settings, "terms": terms, "fixed": held, "fixed_stretch": fixed_stretch}
    first = {"profiles": False, "starts": min(STARTS, settings.get("starts", STARTS))}
    elastic = identify([thinned(curve, FEW) for curve in curves], **(options | first))
    joint = Joint(records, elastic.material, terms, tuple(held))
    tried = count_branches(joint, joint.vector(elastic.material), branches)
    if branches is not None and tried[-1].branches != branches:
        raise IdentificationError(
            f"{branches} branches explain no more of these data than chance would, or would have to pull where the "
            "film pushes; give --branches auto"
        )
    found = _Found(joint, tried, branches)
    film = joint.coordinates.film(found.point.x)
    relaxed = found.relaxed(curves)
    base = identify(relaxed, near=[film], starts=1, **options)
    return found.result(base), relaxed


UNSETTLED = "the fit of the branches did not come to its end: its figures may be off by more than they state"


class _Found:
    """The joint fit at its end, and what follows from it."""

    def __init__(self, joint: Joint, tried: Sequence[Count[Point]], wanted: int | None) -> None:
        self.joint, self.tried, self.point, self.wanted = joint, tried, tried[-1].point, wanted
        self.scale = misfit(joint, self.point)
        self.covariance = covariance(joint, self.point)
        self.response = self.covariance.response[:, : self.point.residual.size]
        self.effects = {part: self.response @ rows for part, rows in joint.systematic(self.point).items()}
        film = joint.film(self.point.x)
        self.film, self.material = film, replace(film, branches=())
        self.forces = joint.solve(self.point.x)

    # --- forces

    def relaxed(self, curves: Sequence[Curve]) -> list[Curve]:
        """The curves less what the branches add to their forces."""
        added = {}
        for one, force, record in zip(self.joint.responses, self.forces, self.joint.records, strict=True):
            extra = force - one.elastic(self.material, one.fine)
            known = np.isfinite(extra)
            added[record.run] = record, one.fine, known.astype(float), one.fine[known], extra[known]
        found = []
        for curve in curves:
            if curve.time is None or curve.run not in added:
                raise IdentificationError(f"{curve.label}: its samples have no time; branches need it")
            record, fine, taut, times, extra = added[curve.run]
            whole = curve.force / (1.0 - self.joint.softening(self.point.x, record, curve.time))
            slack = np.interp(curve.time, fine, taut) < 1.0
            flagged = slack if curve.flagged is None else curve.flagged | slack
            found.append(replace(curve, force=whole - np.interp(curve.time, times, extra), flagged=flagged))
        return found

    def traces(self) -> tuple[Trace, ...]:
        """For pictures: what was fitted, over time."""
        found: list[Trace] = []
        first = 0
        for one, record, force in zip(self.joint.bins, self.joint.records, self.forces, strict=True):
            response = self.joint.responses[len(found)]
            size = one.time.size
            sigma = self.joint.sigma[first : first + size]
            first += size
            there = np.searchsorted(response.fine, one.time)
            left = 1.0 - self.joint.softening(self.point.x, record, one.time)
            found.append(
                Trace(
                    run=record.run,
                    time=one.time,
                    h=one.h,
                    voltage=one.voltage,
                    measured=one.force,
                    deviation=sigma,
                    model=force[there] * left,
                    relaxed=response.elastic(self.material, one.time) * left,
                    segment=one.segment,
                    moving=record.moving,
                )
            )
        return tuple(found)

    # --- numbers

    def gradient(self, by_mu: Array, by_alpha: Array, by_eps: float = 0.0) -> Array:
        """By x, of a function of the film."""
        x = self.point.x
        by = self.joint.coordinates.by_parameters(x[None], by_mu[None], by_alpha[None], np.array([by_eps]))[0]
        return np.concatenate((by, np.zeros(x.size - by.size)))

    def budget(self, gradient: Array) -> dict[str, float]:
        """Independent parts of the standard uncertainty of a function of x with this gradient."""
        rows = gradient @ self.covariance.response
        data = self.joint.force.size
        parts = {"noise": float(np.linalg.norm(rows[:data]))}
        if self.scale > 1.0:
            parts["lack of fit"] = parts["noise"] * math.sqrt(self.scale - 1.0)
        for kind in FITTED_ALONG:
            mine = [data + k for k, one in enumerate(self.joint.nuisances) if one.kind == kind]
            if mine:
                parts[kind.replace("_", " ")] = float(np.linalg.norm(rows[mine]))
        unknown = float(np.linalg.norm(rows[self.point.residual.size :]))
        if unknown > NEGLIGIBLE * parts["noise"]:
            parts["range of exponents"] = unknown
        for part, effect in self.effects.items():
            parts[part] = abs(float(gradient @ effect))
        for dimension, part in OF_DIMENSIONS.items():
            mine = [data + k for k, one in enumerate(self.joint.nuisances) if one.kind == dimension]
            if mine:
                parts[part] = math.hypot(parts.get(part, 0.0), float(np.linalg.norm(rows[mine])))
        return parts

    def quantity(self, value: float, gradient: Array, unit: str, like: Quantity | None = None) -> Quantity:
        """A function of x with its uncertainty; at a bound where the one that is ``like`` it is."""
        parts = self.budget(gradient)
        total = math.hypot(*parts.values())
        edge = like is not None and like.at_bound
        relative = total / abs(value) if value else math.inf
        return Quantity(value, total, unit, parts, verdict(relative, edge), edge)

    def stiffness(self, meridional: float, hoop: float, like: Quantity | None = None) -> Quantity:
        """Of the relaxed film."""
        _, by_mu, by_alpha = secant(self.material, np.array([meridional]), hoop)
        value = secant_modulus(self.material, meridional, hoop)
        return self.quantity(value, self.gradient(by_mu[0], by_alpha[0]), "Pa", like)

    def instant(self, meridional: float, hoop: float, rest: float) -> Quantity:
        """Of the film with its branches, after a quick move from rest at the pre-stretch ``rest``."""
        x, law = self.point.x, law_of(self.material)
        stretch = np.log([[meridional], [hoop]])
        thin = meridional**2 - (meridional * hoop) ** -2.0
        ratio = np.array([one.ratio for one in self.film.branches])
        here, added = (stack(one[0], one[1]) for one in (stretch, stretch - math.log(rest)))
        quick = float(law.derivatives(added)[0][0]) / thin
        value = float(law.derivatives(here)[0][0]) / thin + float(ratio.sum()) * quick
        both = [law.by_parameters(one) for one in (here, added)]
        by_mu, by_alpha = ((both[0][k][:, 0, 0] + float(ratio.sum()) * both[1][k][:, 0, 0]) / thin for k in range(2))
        slope = self.gradient(by_mu, by_alpha)
        n = len(self.joint.coordinates.names)
        slope[n : n + ratio.size] = quick
        assert slope.size == x.size
        return self.quantity(value, slope, "Pa")

    def quantities(self, base: Identification) -> tuple[dict[str, Quantity], dict[str, Array]]:
        """Those of ``base`` as the joint fit has them; and gradients of what a covariance is stated of."""
        film, found, slopes = self.material, {}, {}
        values = film.values
        places = [("mu", k) for k in range(len(film.mu))] + [("alpha", k) for k in range(len(film.alpha))]
        for (name, value), (kind, k) in zip(values.items(), places, strict=True):
            if name not in base.quantities:
                continue
            unit = [np.zeros(len(film.mu)), np.zeros(len(film.alpha))]
            unit[kind == "alpha"][k] = 1.0
            slopes[name] = self.gradient(unit[0], unit[1])
            like = base.quantities[name]
            found[name] = _widened(self.quantity(value, slopes[name], "Pa" if kind == "mu" else "1", like), like)
        found["G"] = self.quantity(film.shear_modulus, self.gradient(*shear_slopes(film)), "Pa")
        found["stiffness"] = self.stiffness(*base.stretch)
        found["stiffness_fixed"] = self.stiffness(*base.fixed_stretch)
        found["stiffness_end"] = self.stiffness(base.stiffness_curve.meridional_stretch[-1], base.stretch[1])
        if "eps_r" in base.quantities:
            zeros = np.zeros(len(film.mu)), np.zeros(len(film.alpha))
            slopes["eps_r"] = self.gradient(*zeros, 1.0)
            found["eps_r"] = self.quantity(film.eps_r, slopes["eps_r"], "1", base.quantities["eps_r"])
        return found, slopes

    def known(self, k: int, value: float, hidden: tuple[Array, Array]) -> Known:
        """The k-th entry of x, with what branches that may hide make of it."""
        unit = np.eye(self.point.x.size)[k]
        return Known(value, math.hypot(*self.budget(unit).values()), *shifted(unit @ self.response, *hidden))

    def branches(self, last: float) -> tuple[FoundBranch, ...]:
        """Each with its verdict, the quickest first; what takes longer than ``last`` (s) counts as stiffness."""
        n, count = len(self.joint.coordinates.names), len(self.film.branches)
        hidden = beside(self.joint, self.point, self.scale, last)
        found = []
        for k, one in enumerate(self.film.branches):
            both = self.known(n + k, one.ratio, hidden), self.known(n + count + k, math.log(one.time), hidden)
            explained = self.tried[-1].left_out.explained
            found.append(FoundBranch.judged(*both, self.joint.window, explained=explained))
        return tuple(sorted(found, key=lambda one: one.time))

    def softening(self) -> tuple[Softening, ...]:
        """What every cycle has left of the force, less than one for the cycles before."""
        found, x = [], self.point.x
        for record in self.joint.records:
            slope = np.zeros(x.size)
            for k, one in enumerate(self.joint.nuisances, start=x.size - len(self.joint.nuisances)):
                run, _, cycle = one.run.rpartition(", cycle ")
                if one.kind == SOFTENING and run == record.run:
                    slope[k] = one.prior
                    error = math.hypot(*self.budget(slope).values())
                    found.append(Softening(run, int(cycle), float(slope @ x), error))
        return tuple(found)

    def suspects(self, hidden: Sequence[Unseen]) -> list[Suspect]:
        """Further branches, as imperfections of the model."""
        return [
            Suspect(
                name=f"{NAME} with one more relaxation time, near {one.time:.2g} s",
                family=NAME,
                amplitude=0.0,
                uncertainty=math.inf,
                unit="1",
                probability=1.0,
                shows_from=one.shows_from,
                usual=USUAL,
                possible=True,
                part="",
                key="",
                remedy=REMEDY,
                shape=one.shape,
            )
            for one in hidden
        ]

    def result(self, base: Identification) -> Identification:
        """The whole result; ``base`` is that of the relaxed film's curves."""
        quantities, slopes = self.quantities(base)
        hidden = unseen(self.joint, self.point, self.scale)
        further = self.suspects(hidden)
        told = {name: slope for name, slope in slopes.items() if name == "eps_r"}
        _, by_mu, by_alpha = secant(self.material, np.array([base.stretch[0]]), base.stretch[1])
        told["stiffness"] = self.gradient(by_mu[0], by_alpha[0])
        shifts = {
            one.name: {
                name: float(slope @ (self.response @ (-one.unseen_size * one.shape))) for name, slope in told.items()
            }
            for one in further
        }
        others = [one for one in base.suspects if one.family != NAME]
        shifts |= {one.name: base.unseen[one.name] for one in others}
        found = [one for one in others if one.name in base.likely]
        quantities |= doubted(quantities, shifts, [*others, *further], found)
        curve = base.stiffness_curve
        along = [self.stiffness(one, curve.hoop_stretch) for one in curve.meridional_stretch]
        gradients = np.array(list(slopes.values()))
        matrix = self._covariances(gradients)
        deviation = np.sqrt(np.diag(matrix))
        deviation[deviation == 0.0] = 1.0
        spectrum = self._spectrum(base)
        settings = {**base.provenance.get("settings", {}), "branches": self.wanted or "auto"}
        used = [record.errors for record in self.joint.records]
        return replace(
            base,
            material=replace(self.film, source="identified from the histories of whole runs"),
            quantities=quantities,
            stiffness_curve=replace(
                curve,
                secant_modulus=tuple(one.value for one in along),
                uncertainty=tuple(one.uncertainty for one in along),
            ),
            nuisance=self._nuisance() or base.nuisance,
            suspects=[*others, *further],
            unseen=shifts,
            likely=[one.name for one in found],
            parameters=list(slopes),
            covariance=matrix.tolist(),
            correlation=(matrix / np.outer(deviation, deviation)).tolist(),
            warnings=[*([] if self.point.settled else [UNSETTLED]), *spectrum.sentences, *base.warnings],
            provenance={**base.provenance, "settings": settings},
            measurement=most_useful(quantities, used),
            spectrum=spectrum,
            elastic_error={},
        )

    def _covariances(self, gradients: Array) -> Array:
        total: Array = gradients @ self.covariance.matrix @ gradients.T * self.scale
        for effect in self.effects.values():
            change = gradients @ effect
            total = total + np.outer(change, change)
        return total

    def _nuisance(self) -> dict[str, RigParameter]:
        found, first = {}, self.point.x.size - len(self.joint.nuisances)
        for k, one in enumerate(self.joint.nuisances, start=first):
            if one.kind in DIMENSIONS or (one.kind == SOFTENING and not self.joint.soften):
                continue
            slope = np.eye(self.point.x.size)[k] * one.prior
            found[f"{one.kind.replace('_', ' ')} of {one.run}"] = RigParameter(
                value=float(self.point.x[k] * one.prior),
                uncertainty=math.hypot(*self.budget(slope).values()),
                prior=one.prior,
                unit=FITTED_ALONG[one.kind],
            )
        return found

    def _spectrum(self, base: Identification) -> Spectrum:
        low, high = self.joint.window
        alone = unseen(self.joint, self.point, self.scale, alone=True)
        slow, quick = blind_times(((one.time, one.shows_from) for one in alone), high)
        rest = float(np.mean([record.errors.specimen.prestretch for record in self.joint.records]))
        return Spectrum(
            branches=self.branches(slow),
            window=(low, high),
            instant=self.instant(*base.fixed_stretch, rest),
            counts=tuple(BranchCount(one.branches, one.aicc, one.left_out) for one in self.tried),
            slow=slow,
            hold=HOLD * slow,
            quick=quick,
            traces=self.traces(),
            softening=self.softening() if self.joint.soften else (),
            left_out=1.0 - float(self.joint.kept.mean()),
        )


def _widened(quantity: Quantity, like: Quantity) -> Quantity:
    """At least as uncertain as ``like``, which the relaxed curves say.

    A term that hardly matters here is known less well than slopes here say: other laws explain the data too.
    """
    if not like.uncertainty > quantity.uncertainty:
        return quantity
    others = math.sqrt(like.uncertainty**2 - quantity.uncertainty**2)
    relative = like.uncertainty / abs(quantity.value) if quantity.value else math.inf
    return replace(
        quantity,
        uncertainty=like.uncertainty,
        budget={**quantity.budget, "other solutions": others},
        verdict=verdict(relative, quantity.at_bound),
    )
