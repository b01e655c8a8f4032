"""What the specimens of a campaign have in common, and what scatters: between them, within them, over the days.

One-way random effects (Searle, Casella & McCulloch 1992, ch. 3): with a specimens and n_i runs of each, mean squares
M_b between and M_w within,

    within^2 = M_w,    between^2 = max(M_b - M_w, 0) / n_0,    n_0 = (N - sum n_i^2 / N) / (a - 1)

Groups are compared by the Alexander-Govern test, which does not take their scatter for equal. A result that is a bound
only (a film that bore the ceiling) is in none of these numbers: `dea-rig analyse breakdown` is for such.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

RISING = ("voltage", "field", "field_at_disk", "charge")  # results that are upper bounds where the voltage is one
BOUNDS = ("ceiling", "limit")  # outcomes whose values are bounds: of a film that has not broken down
LEAST_FOR_DRIFT, LEAST_DAYS = 5, 0.25  # values, and over what time: a slope of minutes says nothing of days
DAY_S = 86_400.0


@dataclass(frozen=True)
class Value:
    """One result of one run, SI; ``at_s`` is when the run began (s since 1970), ``bound`` that it is a bound only.

    ``at_most``: the film broke down there or below; counted as if it were there.
    """

    specimen: str
    batch: str
    at_s: float
    value: float
    bound: bool = False
    at_most: bool = False


@dataclass(frozen=True)
class Group:
    """The specimens of one batch: number, mean of their means, its standard uncertainty, their scatter."""

    specimens: int
    mean: float
    standard_uncertainty: float
    scatter: float


@dataclass(frozen=True)
class Statistics:
    """Of one result over all specimens; NaN where the data cannot tell.

    Attributes
    ----------
    mean, standard_uncertainty, interval
        Of the specimens' means; the interval holds the mean of all such films in 95 % (Student's t).
    between, within : float
        Standard deviations between specimens, and between runs of one.
    repeated : int
        Specimens with more than one run.
    p_groups : float
        How often groups that do not differ would look as different as these.
    drift_per_day, drift_uncertainty, p_drift : float
        Slope over the days, of what is left when each group's mean is taken off.
    bounds : int
        Results that are bounds only, in none of the numbers.
    upper_bounds : int
        Results that are upper bounds, of films that broke on supplies that measure no current; in the numbers as exact.
    """

    name: str
    unit: str
    values: Sequence[Value]
    specimens: int
    mean: float
    standard_uncertainty: float
    interval: tuple[float, float]
    between: float
    within: float
    repeated: int
    groups: Mapping[str, Group]
    p_groups: float
    drift_per_day: float
    drift_uncertainty: float
    p_drift: float
    bounds: int
    upper_bounds: int


def statistics_of(name: str, unit: str, values: Sequence[Value]) -> Statistics:
    """The statistics of one result."""
    known = [one for one in values if not one.bound and math.isfinite(one.value)]
    of: dict[str, list[float]] = {}
    batch = {one.specimen: one.batch for one in known}
    for one in known:
        of.setdefault(one.specimen, []).append(one.value)
    means = {specimen: float(np.mean(mine)) for specimen, mine in of.items()}
    mean, error, interval = _mean(list(means.values()))
    between, within = _components(list(of.values()))
    names = list(dict.fromkeys(batch.values()))
    groups = {one: _group([means[s] for s in means if batch[s] == one]) for one in names}
    drift, drift_error, p_drift = _drift(known, groups)
    return Statistics(
        name,
        unit,
        values,
        len(means),
        mean,
        error,
        interval,
        between,
        within,
        sum(len(mine) > 1 for mine in of.values()),
        groups,
        _compare([[means[s] for s in means if batch[s] == one] for one in names]),
        drift,
        drift_error,
        p_drift,
        sum(one.bound for one in values),
        sum(one.at_most for one in known),
    )


def _mean(means: Sequence[float]) -> tuple[float, float, tuple[float, float]]:
    if not means:
        return math.nan, math.nan, (math.nan, math.nan)
    mean, n = float(np.mean(means)), len(means)
    if n < 2:
        return mean, math.nan, (math.nan, math.nan)
    from scipy.stats import t

    error = float(np.std(means, ddof=1)) / math.sqrt(n)
    wide = float(t.ppf(0.975, n - 1)) * error
    return mean, error, (mean - wide, mean + wide)


def _components(of: Sequence[Sequence[float]]) -> tuple[float, float]:
    """Standard deviations between and within specimens. Without repeats the one between holds both."""
    a, total = len(of), sum(map(len, of))
    if a < 2:
        return math.nan, math.nan
    means = np.array([np.mean(mine) for mine in of])
    if total == a:
        return float(np.std(means, ddof=1)), math.nan
    counts = np.array([len(mine) for mine in of], dtype=float)
    grand = float(np.sum(counts * means) / total)
    m_between = float(np.sum(counts * (means - grand) ** 2)) / (a - 1)
    m_within = sum(float(np.sum((np.array(mine) - np.mean(mine)) ** 2)) for mine in of) / (total - a)
    n0 = (total - float(np.sum(counts**2)) / total) / (a - 1)
    return math.sqrt(max(m_between - m_within, 0.0) / n0), math.sqrt(m_within)


def _group(means: Sequence[float]) -> Group:
    n = len(means)
    scatter = float(np.std(means, ddof=1)) if n > 1 else math.nan
    return Group(n, float(np.mean(means)), scatter / math.sqrt(n), scatter)


def _compare(groups: Sequence[Sequence[float]]) -> float:
    usable = [group for group in groups if len(group) > 1 and np.ptp(group) > 0]
    if len(usable) < 2:
        return math.nan
    from scipy.stats import alexandergovern

    return float(alexandergovern(*usable).pvalue)


def _drift(known: Sequence[Value], groups: Mapping[str, Group]) -> tuple[float, float, float]:
    days = np.array([one.at_s / DAY_S for one in known])
    if len(known) < LEAST_FOR_DRIFT or not np.ptp(days) >= LEAST_DAYS:
        return math.nan, math.nan, math.nan
    from scipy.stats import t

    # Groups and slope together: a group that was done late must not look like a drift.
    columns = [np.array([float(one.batch == name) for one in known]) for name in groups]
    design = np.stack([*columns, days - days.mean()], axis=1)
    values = np.array([one.value for one in known])
    freedom = len(known) - np.linalg.matrix_rank(design)
    if freedom < 1 or np.linalg.matrix_rank(design) < design.shape[1]:
        return math.nan, math.nan, math.nan
    found, *_ = np.linalg.lstsq(design, values, rcond=None)
    noise = float(np.sum((values - design @ found) ** 2)) / freedom
    error = math.sqrt(noise * float(np.linalg.inv(design.T @ design)[-1, -1]))
    slope = float(found[-1])
    return slope, error, float(2.0 * t.sf(abs(slope) / error, freedom)) if error > 0 else math.nan


def plain(name: str) -> str:
    """A name of a result in words."""
    return re.sub(r"_", " ", name)
