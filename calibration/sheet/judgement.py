"""Whether a fit to sheets can be believed: correlation, lack of fit, small strains, another weighting, another sign."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.sheet.problem import SheetProblem
from calibration.sheet.search import Minimum, unconstrained_cost
from model.material.ogden import Ogden

Array = NDArray[np.float64]

SMALL = (0.03, 0.07, 0.15)  # of the largest strain of a test: where the stiffness at rest shows
MISFIT = 0.05  # by which the model may miss the secant modulus of the small strains
MUCH_NOISE = 2.0  # residuals that are so many times the noise are no noise
SIGN_GAIN = 0.10  # of the sum of squares: less is not worth telling
LEAST_G, LARGEST_G = 1e3, 20e6  # Pa: elastomers lie between


@dataclass(frozen=True)
class TestJudgement:
    """What speaks for and against the fit in one test.

    rms : root of the mean squared residual (Pa)
    noise : scatter of the stresses about a smooth curve (Pa); None where there are too few rows
    correlation : how many neighbouring residuals say the same (1: each for itself)
    small_strain : by how much the model's secant modulus exceeds the measured one at small strains, relative
    """

    __test__ = False

    rms: float
    noise: float | None
    correlation: float
    small_strain: float | None

    def to_dict(self) -> dict[str, float | None]:
        """Plain numbers."""
        return {
            "rms_residual_Pa": self.rms,
            "noise_Pa": self.noise,
            "correlated_rows": self.correlation,
            "small_strain_misfit": self.small_strain,
        }


def judge_tests(problem: SheetProblem, best: Minimum) -> dict[str, TestJudgement]:
    """Each test held against the fit."""
    found = {}
    weighted = problem.residual(best.x)
    stress = problem.model(np.array(best.mu), np.array(best.alpha))[0]
    for test, part in zip(problem.tests, problem.parts, strict=True):
        fresh = problem.fresh[part]
        if not fresh.any():
            continue
        residual = (stress - problem.measured)[part][fresh]
        order = np.argsort(problem.stretch[part][fresh], kind="stable")
        found[test.name] = TestJudgement(
            rms=float(np.sqrt(np.mean(residual**2))),
            noise=test.noise,
            correlation=correlated(weighted[part][fresh][order]),
            small_strain=_small_strain(problem, part, stress),
        )
    return found


def correlated(residual: Array) -> float:
    """How many neighbours in a row say the same: ``1 + 2 sum rho_k`` up to the first correlation below zero.

    The integrated autocorrelation; n residuals carry the information of n over this number.
    """
    n = residual.size
    power = float(residual @ residual)
    if n < 5 or not power > 0.0:
        return 1.0
    total = 1.0
    for lag in range(1, n // 2):
        rho = float(residual[:-lag] @ residual[lag:]) / power
        if rho <= 0.0:
            break
        total += 2.0 * rho
    return total


def inflation(problem: SheetProblem, tests: dict[str, TestJudgement]) -> float:
    """Factor on variances for residuals that are not independent."""
    sizes = {t.name: int(problem.fresh[part].sum()) for t, part in zip(problem.tests, problem.parts, strict=True)}
    effective = sum(sizes[name] / one.correlation for name, one in tests.items())
    return max(1.0, (problem.count - problem.fitted) / max(effective - problem.fitted, 1.0))


def _small_strain(problem: SheetProblem, part: slice, stress: Array) -> float | None:
    """Model over measured secant modulus at small strains, less one; None where no rows stand there.

    Looked at over three ranges; the largest that is clearly beyond its own scatter counts.
    """
    strain = np.abs(problem.stretch[part] - 1.0)
    found = []
    for share in SMALL:
        near = (strain < share * strain.max()) & (strain > 0.0) & problem.fresh[part]
        if near.sum() < 3:
            continue
        model, measured = stress[part][near], problem.measured[part][near]
        slope = float(model @ measured) / float(model @ model)
        residual = measured - slope * model
        error = math.sqrt(float(residual @ residual) / (near.sum() - 1.0) / float(model @ model))
        if slope > 0.0:
            found.append((1.0 / slope - 1.0, abs(slope - 1.0) > 3.0 * error))
    clear = [value for value, beyond in found if beyond]
    return max(clear, key=abs) if clear else (found[-1][0] if found else None)


def warnings_of(problem: SheetProblem, best: Minimum, tests: dict[str, TestJudgement], modulus: float) -> list[str]:
    """What a reader must know, most serious first."""
    words = []
    if not LEAST_G <= modulus <= LARGEST_G:
        words.append(
            f"G = {modulus / 1e6:.4g} MPa is unusual: elastomers lie between {LEAST_G / 1e3:g} kPa and "
            f"{LARGEST_G / 1e6:g} MPa. Is the unit of the stress right (MPa, kPa)?"
        )
    for name, one in tests.items():
        if one.noise is not None and one.rms > MUCH_NOISE * one.noise > 0.0:
            words.append(
                f"lack of fit in {name}: the residuals are {one.rms / 1e3:.3g} kPa and the noise {one.noise / 1e3:.3g} "
                f"kPa; the law does not describe the sheet to within its noise ({one.correlation:.3g} neighbouring "
                "residuals say the same)"
            )
        if one.small_strain is not None and abs(one.small_strain) > MISFIT:
            words.append(
                f"{name}: at small strains the model is {abs(one.small_strain):.0%} "
                f"{'stiffer' if one.small_strain > 0 else 'softer'} than the data; G holds only within that"
            )
    words += _other_sign(problem, best)
    fresh = problem.fresh.sum()
    if fresh < problem.fresh.size:
        words.append(f"{problem.fresh.size - fresh} stresses were given before; they are not counted again")
    return words


def _other_sign(problem: SheetProblem, best: Minimum) -> list[str]:
    """Whether a term with ``mu alpha < 0`` would fit clearly better."""
    if problem.law is not Ogden or problem.moduli < 2 or problem.moduli > 3 or problem.fixed:
        return []
    cost, shares, alpha = unconstrained_cost(problem, problem.moduli)
    n = problem.count
    if (
        not (shares < 0.0).any()
        or cost > (1.0 - SIGN_GAIN) * best.cost
        or n * math.log(best.cost / max(cost, 1e-300)) < 6.0
    ):
        return []
    odd = float(alpha[int(np.argmin(shares))])
    return [
        f"a term of the other sign (mu alpha < 0, alpha near {odd:.2g}) would fit better, its sum of squares smaller "
        f"by {1.0 - cost / best.cost:.0%}. It is excluded: with mu alpha > 0 in every term the film is stable in every "
        "stretch (Hill), with one below zero it can soften where nobody measured"
    ]
