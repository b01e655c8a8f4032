"""What identification says about a film, and its form as plain JSON."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calibration.electrical.agreement import Charged
from calibration.rounding import two_digits
from model.material.materials import Material
from model.membrane.solve import Wrinkling

if TYPE_CHECKING:
    from calibration.film.branches.result import Spectrum

Array = NDArray[np.float64]

CONVENTION = "W = sum mu_n/alpha_n (l1^alpha_n + l2^alpha_n + (l1 l2)^-alpha_n - 3), G = 1/2 sum mu_n alpha_n"


IDENTIFIED = 0.05  # relative standard uncertainty up to which a quantity counts as identified ...
WEAKLY_IDENTIFIED = 0.30  # ... and as weakly identified


GOOD, WEAK = "identified", "weakly identified"
# Entries of a budget that are of the specimen's dimensions.
OF_DIMENSIONS = ("thickness", "pre-stretch", "disk radius", "ring radius", "eccentricity")


def verdict(relative: float, at_bound: bool) -> str:
    """What a relative standard uncertainty amounts to; a parameter at its bound is not identified at all."""
    if relative <= IDENTIFIED and not at_bound:
        return GOOD
    if relative <= WEAKLY_IDENTIFIED and not at_bound:
        return WEAK
    return "not identifiable from this data"


@dataclass(frozen=True)
class Quantity:
    """One identified number.

    ``uncertainty`` is the combined standard uncertainty (k = 1); ``budget`` holds its independent parts, which add in
    squares. ``verdict`` is "identified", "weakly identified" or "not identifiable from this data"; ``doubt`` says what
    took a better one away, if anything did. ``interval`` is the 95 % interval by profile likelihood, where one was
    asked for; an end that the data do not set is infinite.
    """

    value: float
    uncertainty: float
    unit: str
    budget: dict[str, float]
    verdict: str
    at_bound: bool = False
    interval: tuple[float, float] | None = None
    doubt: str = ""

    @property
    def conditional(self) -> float:
        """Standard uncertainty given the dimensions: as if those of the specimens were exact."""
        if not math.isfinite(self.uncertainty):
            return self.uncertainty
        return math.hypot(*(size for part, size in self.budget.items() if part not in OF_DIMENSIONS))

    @property
    def conditional_verdict(self) -> str:
        """The verdict given the dimensions."""
        relative = self.conditional / abs(self.value) if self.value else math.inf
        best = verdict(relative, self.at_bound)
        return WEAK if self.doubt and best == GOOD else best

    def share(self, part: str) -> float:
        """Part of the variance that an entry of the budget makes up, 0 to 1."""
        total = self.uncertainty**2
        return self.budget.get(part, 0.0) ** 2 / total if 0.0 < total < math.inf else 0.0

    @property
    def relative(self) -> float:
        """Uncertainty over value; inf for a value of zero."""
        return self.uncertainty / abs(self.value) if self.value else math.inf


@dataclass(frozen=True)
class RigParameter:
    """An error of the rig that was found with the film's parameters.

    ``prior`` is the standard uncertainty that was stated for it, ``uncertainty`` the one that is left. A force zero
    is what the force was read too large; a displacement zero what the displacement was read too small. A lag is how far
    the force was behind the displacement, a compliance what had not been taken off the displacement.
    """

    value: float
    uncertainty: float
    prior: float
    unit: str


@dataclass(frozen=True)
class Measurement:
    """The one measurement beside the curves that would help most: of the entry ``part`` of the budget.

    ``now`` and ``then`` are relative standard uncertainties of that input; ``relative`` holds those of the quantities,
    now and with it. ``assumed`` where nobody stated the input's.
    """

    part: str
    now: float
    then: float
    assumed: bool
    relative: dict[str, tuple[float, float]]

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self) | {"relative": {name: list(pair) for name, pair in self.relative.items()}}


@dataclass(frozen=True)
class CurveResult:
    """What became of one curve. Residuals are measurement minus model, in newtons."""

    label: str
    run: str
    specimen: str
    nominal_voltage: float
    samples: int
    used: int
    excluded: dict[str, int]
    wrinkled: int
    rms_residual: float
    rms_expected: float
    lag1_autocorrelation: float
    mean_residual_loading: float | None
    mean_residual_unloading: float | None
    interpolation_error: float


@dataclass(frozen=True)
class Stiffness:
    """Secant shear modulus against meridional stretch, at a hoop stretch equal to the pre-stretch (Pa)."""

    meridional_stretch: tuple[float, ...]
    hoop_stretch: float
    secant_modulus: tuple[float, ...]
    uncertainty: tuple[float, ...]


SIGNIFICANT = 0.01  # probability below which misfit is not put down to chance
# Factor and unit in which an amplitude is shown.
SHOWN = {"1": (100.0, "%"), "m/N": (1e6, "um/N"), "N": (1e3, "mN"), "m": (1e6, "um"), "s": (1e3, "ms")}
SHOWN |= {"F": (1e12, "pF"), "A": (1e9, "nA")}


@dataclass(frozen=True)
class Suspect:
    """An imperfection that the residuals were held against.

    ``amplitude`` with its standard ``uncertainty`` is its size in ``unit``; ``probability`` of as much by chance
    counts that several suspects were looked at. From the size ``shows_from`` on, 95 of 100 experiments like this one
    would report it; infinite where no size that occurs would show, because it does to these data what another film
    does. ``usual`` is a size that occurs. ``possible`` is False for a size of the impossible sign. ``part`` is the
    entry of the uncertainty budget that counts it already, and ``key`` asks for it to be fitted along. ``remedy`` tells
    how to rule it out, or to find it. ``shape`` is what one unit of it does to the weighted data.
    """

    name: str
    family: str
    amplitude: float
    uncertainty: float
    unit: str
    probability: float
    shows_from: float
    usual: float
    possible: bool
    part: str
    key: str
    remedy: str
    shape: Array

    @property
    def significant(self) -> bool:
        """Whether it is there for all that chance can do."""
        return self.possible and self.probability < SIGNIFICANT

    @property
    def unseen_size(self) -> float:
        """The largest size that may be there unseen; the usual one where no size would show."""
        return self.shows_from if math.isfinite(self.shows_from) else self.usual

    @property
    def words(self) -> str:
        """For the operator, with the size in the unit of the bench."""
        factor, unit = SHOWN[self.unit]
        sign = "-" if self.amplitude < 0.0 else "+"
        size, uncertainty = (two_digits(one * factor) for one in (abs(self.amplitude), self.uncertainty))
        return f"{self.name} ({sign}{size} {unit}, +- {uncertainty})"

    @property
    def blind(self) -> str:
        """For the operator: up to what size it may be there unseen."""
        factor, unit = SHOWN[self.unit]
        return f"{self.name} (up to {two_digits(self.unseen_size * factor)} {unit})"


@dataclass(frozen=True)
class HeldOut:
    """Curves that took no part in a fit, against what the fit says of them (N, root mean square).

    ``expected`` is what noise alone would give. The zeros of a run that was left out are fitted within their priors.
    """

    what: str
    rms_residual: float
    rms_expected: float

    @property
    def ratio(self) -> float:
        """Near 1 for a model that predicts; larger for one that only follows the data it was fitted to."""
        return self.rms_residual / self.rms_expected


@dataclass(frozen=True)
class Sampled:
    """One quantity's posterior: mean, standard deviation and central 95 % interval, in ``unit``."""

    mean: float
    deviation: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class Posterior:
    """What the chains say.

    Attributes
    ----------
    quantities : dict of str to Sampled
        The names of `Identification.quantities` that depend on the film alone.
    steps, walkers : int
    acceptance : float
        Part of the proposals that were taken.
    autocorrelation : float
        Longest integrated autocorrelation time (steps).
    converged : bool
        Whether the chain is long enough for its autocorrelation time to be believed.
    """

    quantities: dict[str, Sampled]
    steps: int
    walkers: int
    acceptance: float
    autocorrelation: float
    converged: bool

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers."""
        return {
            "quantities": {
                name: {
                    "mean": one.mean,
                    "standard_deviation": one.deviation,
                    "interval_95": [one.low, one.high],
                    "unit": one.unit,
                }
                for name, one in self.quantities.items()
            },
            "steps": self.steps,
            "walkers": self.walkers,
            "acceptance": self.acceptance,
            "autocorrelation_steps": self.autocorrelation if math.isfinite(self.autocorrelation) else None,
            "converged": self.converged,
        }


@dataclass(frozen=True)
class Identification:
    """Everything that a set of curves says about a film.

    Attributes
    ----------
    material : Material
        The film with the identified parameters. Without voltage in the data its ``eps_r`` is the starting guess.
    quantities : dict of str to Quantity
        ``mu1``, ``alpha1``, ... sorted by exponent, ``G``, ``stiffness`` and, with voltage in the data, ``eps_r``.
    stretch : (float, float)
        Meridional and hoop stretch to which ``stiffness`` belongs; see `secant_modulus`.
    fixed_stretch : (float, float)
        The stretches to which ``stiffness_fixed`` belongs: the same for all runs of films with one pre-stretch.
    assumed : dict of str to float
        Entries of the budget that nobody stated, with the relative standard uncertainty that was assumed.
    measurement : Measurement or None
        What to measure next.
    stiffness_curve : Stiffness
        The same over the range of stretch that the data reach; its last value is the quantity ``stiffness_end``.
    least_tangent : float
        Smallest tangent modulus (Pa) over the stretches reached; positive for a stable film.
    nuisance : dict of str to RigParameter
        Zeros of force (N) and displacement (m) and lag of the force (s) of every run, and the rig's compliance (m/N).
    chi_square, freedom : float, int
        Of all samples, in their stated standard deviations.
    lack_of_fit, lack_of_fit_freedom, lack_of_fit_probability : float, int, float
        Misfit that smooth curves would not have, in the noise found and beyond what gains and dimensions do within
        their stated uncertainties, and the probability of as much by chance.
    likely : list of str
        Names of the suspects that the residuals look like and that these data cannot tell apart, best first.
    along : dict of str to dict of str to float
        By how much each error that was asked to be fitted along shifted ``stiffness`` and ``eps_r``.
    suspects : list of Suspect
        Known imperfections whose shape the residuals were held against, most probable first.
    unseen : dict of str to dict of str to float
        By how much each of them shifts ``stiffness`` and ``eps_r`` at the size from which on it would be reported.
    noise_ratio : float
        Scatter about the nearest smooth curves over the stated standard deviation.
    samples_per_independent : float
        1 for independent samples; the fit counts n samples as n over this.
    parameters, correlation, covariance : list of str, list of list of float, list of list of float
        Correlations of the raw parameters by noise and zeros; their covariances, in SI units, by all that propagates
        linearly.
    condition : float
        Condition number of the least-squares problem in relative changes of the raw parameters.
    warnings, advice : list of str
        What speaks against the result; which further measurement would determine the Ogden terms better.
    aicc, bic : float
        Information criteria; smaller is better, differences below 2 mean nothing.
    held_out : list of HeldOut
        Predictions of curves from the others, where they were asked for.
    posterior : Posterior or None
        What Markov chains say of the same data, where they were asked for.
    spectrum : Spectrum or None
        The film's branches, where they were fitted; then the law is that of the relaxed film.
    elastic_error : dict of str to float
        By how much (relative, to first order) ``stiffness`` and ``eps_r`` are off because the film takes time and was
        fitted as elastic; empty where the data do not look like it.
    charge : Charged or None
        What the current that charges the film says beside its force, where it was data.
    """

    material: Material
    quantities: dict[str, Quantity]
    stretch: tuple[float, float]
    fixed_stretch: tuple[float, float]
    stiffness_curve: Stiffness
    least_tangent: float
    nuisance: dict[str, RigParameter]
    chi_square: float
    freedom: int
    lack_of_fit: float
    lack_of_fit_freedom: int
    lack_of_fit_probability: float
    suspects: list[Suspect]
    unseen: dict[str, dict[str, float]]
    noise_ratio: float
    samples_per_independent: float
    parameters: list[str]
    correlation: list[list[float]]
    covariance: list[list[float]]
    condition: float
    aicc: float
    bic: float
    curves: list[CurveResult]
    starts: int
    starts_agreeing: int
    warnings: list[str]
    advice: list[str]
    provenance: dict[str, Any] = field(default_factory=dict)
    held_out: list[HeldOut] = field(default_factory=list)
    posterior: Posterior | None = None
    likely: list[str] = field(default_factory=list)
    along: dict[str, dict[str, float]] = field(default_factory=dict)
    assumed: dict[str, float] = field(default_factory=dict)
    measurement: Measurement | None = None
    spectrum: Spectrum | None = None
    elastic_error: dict[str, float] = field(default_factory=dict)
    charge: Charged | None = None

    @property
    def terms(self) -> int:
        """Number of terms of a series; 1 of another law."""
        return self.material.terms

    @property
    def model(self) -> str:
        """The law, and the number of terms of a series: "Ogden law with 2 terms"."""
        terms = f" with {self.terms} term{'s' if self.terms > 1 else ''}" if self.material.law.series else ""
        return f"{self.material.law.title} law{terms}"

    @property
    def wrinkling(self) -> Wrinkling:
        """What became of samples at which the film is wrinkled; see `calibration.film.identify.identify`."""
        found: Wrinkling = self.provenance.get("settings", {}).get("wrinkling", "plain")
        return found

    @property
    def reduced_chi_square(self) -> float:
        """Chi-square per degree of freedom; near 1 when model and stated noise are right."""
        return self.chi_square / self.freedom

    @property
    def used(self) -> int:
        """Samples in the fit."""
        return sum(curve.used for curve in self.curves)

    @property
    def excluded(self) -> int:
        """Samples left out."""
        return sum(curve.samples - curve.used for curve in self.curves)

    @property
    def blind_spots(self) -> list[Suspect]:
        """Suspects that may shift stiffness or permittivity by more than their uncertainty before they show.

        The most harmful first; not those that the uncertainty counts already.
        """

        def harm(suspect: Suspect) -> float:
            return max(
                abs(shift) / self.quantities[name].uncertainty for name, shift in self.unseen[suspect.name].items()
            )

        return sorted((one for one in self.suspects if not one.part and harm(one) > 1.0), key=harm, reverse=True)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings, lists and dictionaries; a number that is not finite becomes None."""
        return {
            "format": "dea-rig identification 1",
            "model": f"incompressible {self.material.law.title} film, axisymmetric membrane, ideal dielectric",
            "convention": self.material.law.description,
            "law": self.material.law.name,
            "terms": self.terms,
            "quantities": {name: quantity_dict(q) for name, q in self.quantities.items()},
            "stiffness_at": {"meridional_stretch": self.stretch[0], "hoop_stretch": self.stretch[1]},
            "stiffness_fixed_at": {"meridional_stretch": self.fixed_stretch[0], "hoop_stretch": self.fixed_stretch[1]},
            "assumed_not_stated": self.assumed,
            "most_useful_measurement": None if self.measurement is None else self.measurement.to_dict(),
            "stiffness_curve": {
                "meridional_stretch": list(self.stiffness_curve.meridional_stretch),
                "hoop_stretch": self.stiffness_curve.hoop_stretch,
                "secant_modulus_Pa": list(self.stiffness_curve.secant_modulus),
                "standard_uncertainty_Pa": list(self.stiffness_curve.uncertainty),
            },
            "least_tangent_modulus_Pa": self.least_tangent,
            "nuisance": {
                name: {
                    "value": zero.value,
                    "standard_uncertainty": zero.uncertainty,
                    "stated_standard_uncertainty": zero.prior,
                    "unit": zero.unit,
                }
                for name, zero in self.nuisance.items()
            },
            "chi_square": self.chi_square,
            "degrees_of_freedom": self.freedom,
            "reduced_chi_square": self.reduced_chi_square,
            "lack_of_fit": {
                "chi_square": self.lack_of_fit,
                "degrees_of_freedom": self.lack_of_fit_freedom,
                "probability": self.lack_of_fit_probability,
                "likely": self.likely,
                "suspects": [
                    {
                        "name": one.name,
                        "family": one.family,
                        "amplitude": one.amplitude,
                        "standard_uncertainty": finite(one.uncertainty),
                        "unit": one.unit,
                        "probability": one.probability,
                        "shows_from": finite(one.shows_from),
                        "unseen_size": one.unseen_size,
                        "counted_in_budget_as": one.part,
                        "shift_unseen": self.unseen[one.name],
                        "remedy": one.remedy,
                    }
                    for one in self.suspects
                ],
            },
            "fitted_along": self.along,
            "noise_ratio": self.noise_ratio,
            "samples_per_independent_sample": self.samples_per_independent,
            "samples_used": self.used,
            "samples_excluded": self.excluded,
            "parameters": self.parameters,
            "correlation": self.correlation,
            "covariance": self.covariance,
            "condition_number": finite(self.condition),
            "aicc": self.aicc,
            "bic": self.bic,
            "held_out": [
                {"what": one.what, "rms_residual_N": one.rms_residual, "rms_expected_N": one.rms_expected}
                for one in self.held_out
            ],
            "starts": self.starts,
            "starts_agreeing": self.starts_agreeing,
            "curves": [
                {
                    "label": c.label,
                    "run": c.run,
                    "specimen": c.specimen,
                    "nominal_voltage_V": c.nominal_voltage,
                    "samples": c.samples,
                    "samples_used": c.used,
                    "excluded": c.excluded,
                    "wrinkled": c.wrinkled,
                    "rms_residual_N": finite(c.rms_residual),
                    "rms_expected_N": finite(c.rms_expected),
                    "lag1_autocorrelation": finite(c.lag1_autocorrelation),
                    "mean_residual_loading_N": c.mean_residual_loading,
                    "mean_residual_unloading_N": c.mean_residual_unloading,
                    "interpolation_error_N": finite(c.interpolation_error),
                }
                for c in self.curves
            ],
            **({"spectrum": self.spectrum.to_dict()} if self.spectrum is not None else {}),
            **({"elastic_error": self.elastic_error} if self.elastic_error else {}),
            **({"charge": self.charge.to_dict()} if self.charge is not None else {}),
            **({"posterior": self.posterior.to_dict()} if self.posterior is not None else {}),
            "warnings": self.warnings,
            "advice": self.advice,
            "provenance": self.provenance,
        }

    def to_json(self) -> str:
        """`to_dict` as JSON text."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n"


def quantity_dict(quantity: Quantity) -> dict[str, Any]:
    return {
        "value": finite(quantity.value),
        "standard_uncertainty": finite(quantity.uncertainty),
        "unit": quantity.unit,
        "budget": {part: finite(value) for part, value in quantity.budget.items()},
        "share_of_variance": {part: quantity.share(part) for part in quantity.budget},
        "standard_uncertainty_given_dimensions": finite(quantity.conditional),
        "verdict": quantity.verdict,
        "verdict_given_dimensions": quantity.conditional_verdict,
        "doubt": quantity.doubt,
        "at_bound": quantity.at_bound,
        "interval_95": None if quantity.interval is None else [finite(end) for end in quantity.interval],
    }


def finite(value: float) -> float | None:
    """A number for JSON, which has no other than finite ones."""
    return value if math.isfinite(value) else None
