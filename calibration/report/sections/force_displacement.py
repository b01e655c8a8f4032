"""Measured and modelled force against displacement."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calibration.report import figures
from calibration.report.sections.base import ReportData, Section, picture


def context(data: ReportData) -> Mapping[str, Any]:
    """The figure."""
    return {"image": picture(figures.force_displacement(data.identification, data.curves, data.selections))}


TEMPLATE = """
<h2>Force and displacement</h2>
<figure>
<img src="{{ image }}" alt="Measured force against displacement at each voltage with the identified model, one panel
a specimen">
<figcaption>Measured and modelled force. Dots: single samples; markers: means of displacement bins, filled while
loading, open
while unloading; lines: the identified model, zeros of the run included.</figcaption>
</figure>
"""

SECTION = Section("force_displacement", 10, context, TEMPLATE)
