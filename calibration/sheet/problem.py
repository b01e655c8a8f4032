"""Weighted residuals of homogeneous tests over the parameters of a law."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.sheet.sheet_tests import HomogeneousTest, TestsError, UnknownParameter, first_seen
from model.material.law import Law, stack
from model.material.neo_hooke import NeoHooke
from model.material.ogden import Ogden

Array = NDArray[np.float64]

Weighting = Literal["balanced", "absolute", "relative", "noise"]
WEIGHTINGS: tuple[Weighting, ...] = ("balanced", "absolute", "relative", "noise")
# Of mu_n alpha_n / (2 scale). At an exponent of 30 a share of 1e-19 carries a tenth of the stress at a stretch of 7.
SHARE_BOUNDS = (0.0, 1e3)
EXPONENT_BOUNDS = (0.05, 30.0)  # of |alpha|
LEAST_RELATIVE = 0.01  # of the largest stress: smaller ones are weighted like that


class SheetProblem:
    """Residuals over ``x = [shares, shape parameters]`` with ``modulus_k = scale share_k / w_k`` (`Law.weights`).

    ``scale`` is the neo-Hookean modulus that fits best; for Ogden's law ``share_n = mu_n alpha_n / (2 scale)``.
    Stresses that were given before have no weight. ``fixed`` holds shape parameters that are known, by name, and
    ``free`` tells which entries of x are not among them.
    """

    def __init__(
        self,
        tests: Sequence[HomogeneousTest],
        terms: int,
        weighting: Weighting,
        law: type[Law] = Ogden,
        *,
        fixed: Mapping[str, float] | None = None,
        negative_exponents: bool = True,
    ) -> None:
        self.tests = list(tests)
        self.law = law
        self.weighting = weighting
        self.moduli, self.shapes = law.counts(terms)
        self.names = law.names(self.moduli, self.shapes)
        self.negative_exponents = negative_exponents
        self.fixed = dict(fixed or {})
        self.free = np.array([name not in self.fixed for name in self.names])
        self._check_fixed()
        self.measured = np.concatenate([test.measured for test in tests])
        for test in tests:
            if not np.ptp(test.measured) > 0.0:
                raise TestsError(
                    f"{test.name}: all stresses are {test.measured[0]:g} Pa; nothing can be fitted to that"
                )
        self.parts = _parts([test.measured.size for test in tests])
        stretch1 = np.concatenate([test.stretch1 for test in tests])
        stretch2 = np.concatenate([test.stretch2 for test in tests])
        self._log = stack(np.log(stretch1), np.log(stretch2))[:, :, None]
        starts = np.cumsum([0, *(test.stretch1.size for test in tests)])
        rows: list[NDArray[np.intp]] = []
        direction: list[NDArray[np.intp]] = []
        for test, start in zip(tests, starts, strict=False):
            for k, stress in enumerate((test.stress1, test.stress2)):
                found = start + np.flatnonzero(np.isfinite(stress))
                rows.append(found)
                direction.append(np.full(found.size, k))
        self._rows, self._direction = np.concatenate(rows), np.concatenate(direction)
        self.along = np.where(self._direction == 0, stretch1[self._rows], stretch2[self._rows])
        self.stretch = stretch1[self._rows]
        self.fresh = np.concatenate(first_seen(tests))
        self.weight = self._weights() * self.fresh
        self.scale = self._scale()

    @property
    def count(self) -> int:
        """Stresses that count."""
        return int(self.fresh.sum())

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.moduli + self.shapes

    @property
    def fitted(self) -> int:
        """Number of parameters that are not fixed."""
        return int(self.free.sum())

    def _check_fixed(self) -> None:
        shapes = self.names[self.moduli :]
        unknown = [name for name in self.fixed if name not in shapes]
        if unknown:
            known = (
                f"what can be fixed is {', '.join(shapes)}" if shapes else f"{self.law.title} has no shape parameter"
            )
            raise UnknownParameter(f"cannot fix {', '.join(unknown)}; {known}")
        sides = [parameter.search for parameter in self.law.parameters(self.moduli, self.shapes)][self.moduli :]
        for name, side in zip(shapes, sides, strict=True):
            low, high = EXPONENT_BOUNDS if self.law is Ogden else side
            if name in self.fixed and not low <= abs(self.fixed[name]) <= high:
                raise TestsError(f"{name} = {self.fixed[name]:g} cannot be fixed: it lies between {low:g} and {high:g}")

    def filled(self, x: Array, part: Array) -> Array:
        """``x`` with ``part`` in place of those entries that are not fixed."""
        x = x.copy()
        x[self.free] = part
        return x

    def held(self, x: Array) -> Array:
        """``x`` with the fixed parameters at their values."""
        x = x.copy()
        for name, value in self.fixed.items():
            x[self.names.index(name)] = value
        return x

    def _weights(self) -> Array:
        size: Array = np.abs(self.measured)
        weight = np.empty_like(size)
        if self.weighting == "relative":
            return np.asarray(1.0 / np.maximum(size, LEAST_RELATIVE * size.max()))
        if self.weighting == "absolute":
            return np.full_like(size, 1.0 / size.max())
        for test, part in zip(self.tests, self.parts, strict=True):
            fresh = self.measured[part][self.fresh[part]]
            if self.weighting == "balanced":
                spread = float(np.linalg.norm(fresh - fresh.mean())) if fresh.size else 0.0
                weight[part] = 1.0 / spread if spread > 0.0 else 0.0
                continue
            noise = test.noise
            if noise is None:
                raise TestsError(
                    f"{test.name}: {test.stretch1.size} rows ({test.kind}) do not tell the noise; weight by absolute "
                    "or relative errors"
                )
            weight[part] = 1.0 / max(noise, 1e-5 * float(np.abs(test.measured).max()))
        return weight

    def _scale(self) -> float:
        unit = self._stress(NeoHooke(np.ones((1, 1)), np.ones((0, 1))))
        scale = float((self.weight**2 * self.measured) @ unit / ((self.weight**2 * unit) @ unit))
        if not scale > 0.0:
            names = ", ".join(test.name for test in self.tests)
            raise TestsError(f"{names}: the stresses do not rise with the stretch; tension has to be positive")
        return scale

    def _stress(self, law: Law) -> Array:
        true = np.array(law.derivatives(self._log)[:2])[:, :, 0]
        nominal: Array = true[self._direction, self._rows] / self.along
        return nominal

    def model(self, mu: Array, alpha: Array) -> tuple[Array, Array, Array]:
        """Nominal stresses (n,), and their derivatives by moduli (n, moduli) and shape parameters (n, shapes)."""
        law = self.law(mu[:, None], alpha[:, None])
        by_mu, by_alpha = law.by_parameters(self._log)
        columns, slopes = (by[:, self._direction, self._rows, 0].T / self.along[:, None] for by in (by_mu, by_alpha))
        return self._stress(law), columns, slopes

    def film(self, x: Array) -> tuple[Array, Array]:
        """Moduli (Pa) and shape parameters."""
        shapes = x[self.moduli :]
        weights, _ = self.law.weights(shapes)
        moduli: Array = self.scale * x[: self.moduli] / weights
        return moduli, shapes

    def residual(self, x: Array) -> Array:
        """Model minus measured, weighted."""
        mu, alpha = self.film(x)
        residual: Array = (self._stress(self.law(mu[:, None], alpha[:, None])) - self.measured) * self.weight
        np.nan_to_num(residual, copy=False, nan=1e6, posinf=1e6, neginf=-1e6)
        return residual

    def jacobian(self, x: Array) -> Array:
        """Derivatives of `residual`, (n, parameters)."""
        mu, alpha = self.film(x)
        weights, slopes = self.law.weights(alpha)
        _, by_mu, by_alpha = self.model(mu, alpha)
        columns: Array = np.concatenate(
            (by_mu * self.scale / weights, by_alpha - (by_mu * mu / weights) @ slopes), axis=1
        )
        columns *= self.weight[:, None]
        np.nan_to_num(columns, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
        return columns

    def bounds(self, x: Array) -> tuple[Array, Array]:
        """Limits of a search from ``x``; an Ogden exponent keeps its sign, and its modulus the same one."""
        if self.law is Ogden:
            positive = x[self.moduli :] > 0.0
            low, high = EXPONENT_BOUNDS
            lower = np.where(positive, low, -high)
            upper = np.where(positive, high, -low)
            shares = np.ones(self.moduli)
            return np.concatenate((SHARE_BOUNDS[0] * shares, lower)), np.concatenate((SHARE_BOUNDS[1] * shares, upper))
        parameters = self.law.parameters(self.moduli, self.shapes)
        sides = np.array([parameter.search for parameter in parameters], dtype=np.float64)
        return sides[:, 0], sides[:, 1]


def _parts(sizes: Sequence[int]) -> list[slice]:
    ends = np.cumsum([0, *sizes]).tolist()
    return [slice(start, stop) for start, stop in pairwise(ends)]


def nominal_stress(mu: Sequence[float], alpha: Sequence[float], test: HomogeneousTest, law: type[Law] = Ogden) -> Array:
    """The model's stresses (Pa), in the order of ``test.measured``."""
    log = stack(np.log(test.stretch1), np.log(test.stretch2))[:, :, None]
    found = law(np.array(mu, dtype=float)[:, None], np.array(alpha, dtype=float)[:, None]).derivatives(log)[:2]
    both = np.concatenate((found[0][:, 0] / test.stretch1, found[1][:, 0] / test.stretch2))
    return both[np.isfinite(np.concatenate((test.stress1, test.stress2)))]


def r_squared(mu: Sequence[float], alpha: Sequence[float], test: HomogeneousTest, law: type[Law] = Ogden) -> float:
    """Share of the variance of the measured stresses that the model explains; negative if a constant does better."""
    measured = test.measured
    residual = measured - nominal_stress(mu, alpha, test, law)
    return float(1.0 - residual @ residual / ((measured - measured.mean()) @ (measured - measured.mean())))
