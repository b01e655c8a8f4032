r"""Homogeneous tests of a sheet: uniaxial, equibiaxial, pure shear, general biaxial.

In the plane of the sheet, incompressible and free on its faces, the nominal stress along direction i is
``P_i = (dW/dL_i) / l_i`` with ``L_i = ln l_i``; ``l2 = l1**-0.5`` in a uniaxial test, ``l2 = l1`` in an equibiaxial one
and ``l2 = 1`` in pure shear. For Ogden's law

.. math:: P_i = \frac{1}{l_i} \sum_n \mu_n (l_i^{\alpha_n} - (l_1 l_2)^{-\alpha_n}) .
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST_ROWS = 400  # of one test; more are averaged, neighbours with neighbours
WINDOW = 6  # rows through which a cubic is laid to see the noise


class TestsError(ValueError):
    """Tests that cannot be fitted; the message names them and what is wrong."""

    __test__ = False  # not a test class, whatever its name suggests to pytest


class UnknownParameter(TestsError):
    """A parameter that is to be fixed and that the law does not have."""

    __test__ = False


@dataclass(frozen=True, eq=False)
class TestHistory:
    """All rows of a test with their times (s), whatever branch of it is fitted as elastic."""

    __test__ = False

    time: Array
    stretch1: Array
    stretch2: Array
    stress1: Array
    stress2: Array


@dataclass(frozen=True, eq=False)
class HomogeneousTest:
    """Stretches and nominal stresses (Pa) of one test; ``stress2`` is nan where only the first was measured.

    ``history`` is there where the rows have a time: what a sheet that takes time is fitted to.
    """

    name: str
    kind: str
    stretch1: Array
    stretch2: Array
    stress1: Array
    stress2: Array
    history: TestHistory | None = None

    @property
    def measured(self) -> Array:
        """All measured stresses, those along the first direction first."""
        both = np.concatenate((self.stress1, self.stress2))
        return both[np.isfinite(both)]

    def averaged(self, most: int = MOST_ROWS) -> HomogeneousTest:
        """The test with at most so many rows: means of neighbours in stretch, which carry the same information.

        A biaxial test, whose rows have no order, is returned as it is.
        """
        if self.stretch1.size <= most or self.kind == "biaxial":
            return self
        order = np.argsort(self.stretch1, kind="stable")
        bins = np.array_split(order, most)
        columns = (np.array([column[rows].mean() for rows in bins]) for column in (self.stretch1, self.stress1))
        stretch1, stress1 = columns
        stretch2 = {"uniaxial": stretch1**-0.5, "equibiaxial": stretch1}.get(self.kind, np.ones_like(stretch1))
        return replace(
            self, stretch1=stretch1, stretch2=stretch2, stress1=stress1, stress2=np.full_like(stress1, np.nan)
        )

    @property
    def noise(self) -> float | None:
        """Standard deviation (Pa) of the stress about a smooth curve; None where there are too few rows to tell.

        Cubics through six neighbours each leave two degrees of freedom; the median of their sums of squares is 1.386
        variances (chi-square of two degrees), whatever the curve does elsewhere.
        """
        if self.kind == "biaxial" or self.stretch1.size < 2 * WINDOW:
            return None
        order = np.argsort(self.stretch1, kind="stable")
        x, y = self.stretch1[order], self.stress1[order]
        sums = []
        for k in range(x.size - WINDOW + 1):
            part = slice(k, k + WINDOW)
            span = x[part] - x[part].mean()
            if not np.ptp(span) > 0.0:
                continue
            columns = (span / np.abs(span).max())[:, None] ** np.arange(4)
            solution, *_ = np.linalg.lstsq(columns, y[part], rcond=None)
            residual = y[part] - columns @ solution
            sums.append(float(residual @ residual))
        return float(np.sqrt(np.median(sums) / 1.386)) if sums else None


def first_seen(tests: Sequence[HomogeneousTest]) -> list[NDArray[np.bool_]]:
    """Of every test, which measured stresses have not been given before: repeated data tell nothing new."""
    seen: set[tuple[float, float, float, int]] = set()
    fresh = []
    for test in tests:
        rows = []
        for direction, stress in enumerate((test.stress1, test.stress2)):
            for l1, l2, value in zip(test.stretch1.tolist(), test.stretch2.tolist(), stress.tolist(), strict=True):
                if np.isfinite(value):
                    key = (l1, l2, value, direction)
                    rows.append(key not in seen)
                    seen.add(key)
        fresh.append(np.array(rows, dtype=np.bool_))
    return fresh
