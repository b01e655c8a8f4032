"""A sample of specimens, each with the value at which it failed or to which it survived; and simulated ones like it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.breakdown.weibull import Array, Flags


@dataclass(frozen=True)
class Sample:
    """``value`` (any unit, positive), ``failed`` and ``area`` over the reference area, each of (specimens,)."""

    value: Array
    failed: Flags
    area: Array

    @property
    def rows(self) -> tuple[Array, Flags, Array]:
        """What the fits take: ln of the values and flags as one row, and ln of the areas."""
        return np.log(self.value)[None], self.failed[None], np.log(self.area)

    def part(self, chosen: Flags) -> Sample:
        """The chosen specimens."""
        return Sample(self.value[chosen], self.failed[chosen], self.area[chosen])

    @property
    def usable(self) -> bool:
        """Whether a distribution can be fitted: two failures that differ."""
        return len(np.unique(self.value[self.failed])) >= 2


def ceilings(sample: Sample, rng: np.random.Generator, rows: int) -> Array:
    """To which value each specimen of a simulated campaign is tested; (rows, specimens).

    That of a specimen that survived is known. For one that failed it is drawn from those of the survivors that lie
    above its failure, as if limits had been given out without regard to strength; where there are none, no limit.
    """
    found = np.tile(np.where(sample.failed, np.inf, sample.value), (rows, 1))
    limits = sample.value[~sample.failed]
    for i in np.flatnonzero(sample.failed):
        above = limits[limits >= sample.value[i]]
        if above.size:
            found[:, i] = rng.choice(above, rows)
    return found


def simulate(
    sample: Sample, shape: float, log_scale: Array, rng: np.random.Generator, rows: int
) -> tuple[Array, Flags]:
    """Campaigns of the same design with a known truth: y = ln value and failed, both (rows, specimens).

    ``log_scale`` is (specimens,). Rows with fewer than two failures, in which nothing can be fitted, are left out.
    """
    y = log_scale + (np.log(rng.exponential(size=(rows, len(sample.value)))) - np.log(sample.area)) / shape
    stopped = sample.value[sample.failed].max()
    if not sample.failed.all() and np.all(sample.value[~sample.failed] == stopped):
        # The campaign was ended by a failure: the number of failures was chosen, not the limit.
        last = np.sort(y, axis=1)[:, [int(sample.failed.sum()) - 1]]
        return np.minimum(y, last), y <= last
    limit = np.log(ceilings(sample, rng, rows))
    failed = y < limit
    kept = failed.sum(axis=1) >= 2
    return np.minimum(y, limit)[kept], failed[kept]
