"""What a fit says of a sheet that takes time."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.film.branches.result import OverTime, Spectrum
from calibration.film.propagation import secant
from calibration.film.result import CONVENTION, Quantity, quantity_dict
from model.material.law import Law
from model.material.materials import Branch, Material
from model.material.ogden import Ogden

Array = NDArray[np.float64]

NO_EPS = 1.0  # permittivity of a material that a sheet does not tell


@dataclass(frozen=True, eq=False, kw_only=True)
class SheetTrace(OverTime):
    """One test over time: nominal stresses (Pa)."""

    name: str
    kind: str
    stretch: Array

    @property
    def largest(self) -> float:
        """Largest stress (Pa)."""
        return float(np.abs(self.measured).max())

    @property
    def rms(self) -> float:
        """Root of the mean squared residual (Pa)."""
        return float(np.sqrt(np.mean((self.measured - self.model) ** 2)))

    @property
    def r_squared(self) -> float:
        """Share of the variance of the mean stresses that the model explains."""
        off, spread = self.measured - self.model, self.measured - self.measured.mean()
        return 1.0 - float(off @ off) / float(spread @ spread)

    def to_dict(self) -> dict[str, float]:
        """Plain numbers."""
        return {
            "r_squared": self.r_squared,
            "rms_residual_Pa": self.rms,
            "rms_residual_over_largest": self.rms / self.largest,
            "noise_of_means_Pa": float(np.sqrt(np.mean(self.deviation**2))),
        }


@dataclass(frozen=True, eq=False)
class TimedFit:
    """A law with branches that was fitted to tests over time.

    Attributes
    ----------
    quantities : dict of str to Quantity
        Parameters of the relaxed law, and "G", its shear modulus at small strain.
    spectrum : Spectrum
        Branches with their verdicts, what the tests cannot show, and the shear modulus at once as ``instant``.
    tests, predicted : SheetTrace of every test that was fitted, or took no part
    numerical : estimated error of the steps of time, over the largest stress
    covariance : of the law's moduli and shape parameters, in their order
    misfit : factor on variances for residuals that noise does not explain
    """

    law: type[Law]
    mu: tuple[float, ...]
    alpha: tuple[float, ...]
    quantities: dict[str, Quantity]
    spectrum: Spectrum
    tests: list[SheetTrace]
    predicted: list[SheetTrace]
    zeros: dict[str, float]
    numerical: float
    misfit: float
    reduced_chi_square: float
    covariance: Array
    fixed: dict[str, float] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @property
    def material(self) -> Material:
        """The sheet; its permittivity is not known and stands as 1."""
        branches = tuple(Branch(one.ratio, one.time) for one in self.spectrum.branches)
        return Material("sheet", self.mu, self.alpha, NO_EPS, law=self.law, branches=branches)

    def stiffness_relative(self, meridional: float, hoop: float) -> float:
        """Relative standard uncertainty of the relaxed sheet's secant modulus at these stretches."""
        film = replace(self.material, branches=())
        value, by_mu, by_alpha = secant(film, np.array([meridional]), hoop)
        slope = np.concatenate((by_mu[0], by_alpha[0]))
        return math.sqrt(float(slope @ self.covariance @ slope)) / abs(float(value[0]))

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings, lists and dictionaries."""
        return {
            "format": "dea-rig homogeneous tests over time 1",
            "convention": CONVENTION if self.law is Ogden else self.law.description,
            "law": self.law.name,
            "fixed": self.fixed,
            "quantities": {name: quantity_dict(one) for name, one in self.quantities.items()},
            "spectrum": self.spectrum.to_dict(),
            "tests": {one.name: one.to_dict() for one in self.tests},
            "predicted": {one.name: one.to_dict() for one in self.predicted},
            "zeros_Pa": self.zeros,
            "numerical_error_over_largest": self.numerical,
            "misfit": self.misfit,
            "reduced_chi_square": self.reduced_chi_square,
            "warnings": self.warnings,
        }

    def to_json(self) -> str:
        """`to_dict` as JSON text."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n"
