"""Stiffness against stretch, with its uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calibration.report import figures
from calibration.report.sections.base import ReportData, Section, picture


def context(data: ReportData) -> Mapping[str, Any]:
    """The figure."""
    return {"image": picture(figures.stiffness(data.identification, data.truth))}


TEMPLATE = """
<figure>
<img src="{{ image }}" alt="Secant shear modulus against meridional stretch with its 95 percent band">
<figcaption>What the data say about stiffness over the range of stretch that they reach. Where the band is narrow,
any Ogden set
that fits has this stiffness; where it widens, the parameters extrapolate.</figcaption>
</figure>
"""

SECTION = Section("stiffness", 40, context, TEMPLATE)
