"""Everything that is asked of a sample of breakdowns, and what its reader has to be warned of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.breakdown.compare import (
    AreaScaling,
    Groups,
    Lognormal,
    area_scaling,
    compare_groups,
    compare_lognormal,
)
from calibration.breakdown.intervals import WeibullFit, fit_weibull
from calibration.breakdown.location import LocationFit, fit_location
from calibration.breakdown.sample import Sample

SIGNIFICANT = 0.05
MISTAKEN = 0.1  # how often Weibull and lognormal may be confused before the sample counts as too small
FEW = 5  # failures


@dataclass(frozen=True)
class Study:
    """``groups`` compares the named groups; ``halves`` the first with the second half of the table, where no groups
    are named. None: could not be asked of this sample. ``group_fits`` has groups with two failures that differ."""

    weibull: WeibullFit
    location: LocationFit
    lognormal: Lognormal
    area: AreaScaling | None
    groups: Groups | None
    halves: Groups | None
    group_fits: dict[str, WeibullFit]
    warnings: list[str]


def study(sample: Sample, labels: Sequence[str] | None, seed: int, rows: int) -> Study:
    """Fit, compare and warn. ``labels`` (specimens,) names groups; ``rows`` is how many campaigns are simulated.

    The same seed gives the same numbers.
    """
    rng = np.random.default_rng(seed)
    weibull = fit_weibull(sample, rng, rows)
    location = fit_location(sample, rng, max(rows // 4, 100))
    lognormal = compare_lognormal(sample, rng, rows)
    differ = len(np.unique(sample.area)) > 1
    area = area_scaling(sample, rng, max(rows // 4, 100)) if differ else None
    groups = _compared(sample, labels, rng, rows) if labels is not None else None
    half = len(sample.value) // 2
    order = ["first half"] * half + ["second half"] * (len(sample.value) - half)
    halves = _compared(sample, order, rng, rows) if labels is None else None
    fits = {}
    if labels is not None:
        for name in dict.fromkeys(labels):
            part = sample.part(np.array(labels) == name)
            if part.usable:
                fits[name] = fit_weibull(part, rng, rows)
    warnings = [
        *_of_size(weibull, lognormal, location),
        *_of_area(area),
        *_of_groups(labels, groups, halves),
    ]
    return Study(weibull, location, lognormal, area, groups, halves, fits, warnings)


def _compared(sample: Sample, labels: Sequence[str], rng: np.random.Generator, rows: int) -> Groups | None:
    """None where there is one group only, or one with too few failures."""
    names = set(labels)
    owner = np.array(labels)
    if len(names) < 2 or not all(sample.part(owner == name).usable for name in names):
        return None
    return compare_groups(sample, labels, rng, rows)


def _of_size(weibull: WeibullFit, lognormal: Lognormal, location: LocationFit) -> list[str]:
    found = []
    if weibull.failures < FEW:
        found.append(f"Only {weibull.failures} specimens failed: shape and low quantile are hardly known.")
    wrong = max(lognormal.wrong_if_weibull, lognormal.wrong_if_lognormal)
    if wrong > MISTAKEN:
        found.append(
            f"These {weibull.specimens} specimens ({weibull.failures} failures) are too few to tell Weibull from "
            f"lognormal: the likelihood would prefer the wrong one in up to {wrong:.0%} of such campaigns. "
            "Do not extrapolate to low probabilities or other areas."
        )
    elif lognormal.log_ratio < 0:
        found.append(f"A lognormal distribution fits better (ln of the likelihood ratio {-lognormal.log_ratio:.2f}).")
    if location.p_none < SIGNIFICANT:
        found.append(
            f"A location above 0 fits better (p = {location.p_none:.3f}): either none fails below it, or the specimens "
            "are not of one kind. The two-parameter fit is too low at low probabilities."
        )
    if weibull.lost > 0.01:
        found.append(
            f"{weibull.lost:.0%} of the simulated campaigns had fewer than two failures and were left out: "
            "the intervals hold only for campaigns that have them."
        )
    return found


def _of_area(area: AreaScaling | None) -> list[str]:
    if area is None:
        return []
    if area.p_weakest_link < SIGNIFICANT:
        return [
            f"Area does not act as the weakest link says (p = {area.p_weakest_link:.3f}): do not scale to other areas."
        ]
    if area.p_no_influence >= SIGNIFICANT:
        return ["The areas tested do not show whether area matters; scaling to other areas is an assumption."]
    return []


def _of_groups(labels: Sequence[str] | None, groups: Groups | None, halves: Groups | None) -> list[str]:
    compared = groups or halves
    if compared is None:
        if labels is not None and len(set(labels)) > 1:
            return ["The groups are not compared: each needs two failures at different values."]
        return []
    found = []
    what = "groups" if groups is not None else "first and second half of the table"
    if compared.p_scale < SIGNIFICANT:
        found.append(f"The {what} differ in scale (p = {compared.p_scale:.3f}): the fit of all mixes unlike specimens.")
    if compared.p_shape < SIGNIFICANT:
        found.append(f"The {what} differ in shape (p = {compared.p_shape:.3f}): the fit of all mixes unlike specimens.")
    if groups is not None and not found and groups.power < 0.8:
        found.append(
            f"No difference of the groups was found, but one of 20 % in scale would be seen in only {groups.power:.0%} "
            "of such campaigns."
        )
    return found
