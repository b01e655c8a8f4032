"""Measured minus modelled force against displacement."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calibration.report import figures
from calibration.report.sections.base import ReportData, Section, picture


def context(data: ReportData) -> Mapping[str, Any]:
    """The figure, and the stated noise (mN)."""
    return {
        "image": picture(figures.residuals(data.identification, data.curves, data.selections)),
        "noise": " or ".join(f"{noise:.3g}" for noise in sorted({1e3 * curve.force_noise for curve in data.curves})),
    }


TEMPLATE = """
<h2>Residuals</h2>
<figure>
<img src="{{ image }}" alt="Residual force against displacement, one panel a specimen and voltage">
<figcaption>Measured minus modelled force. Means of displacement bins with two standard errors, filled while loading,
open while
unloading. The stated noise of one sample is {{ noise }} mN. A trend, or a gap between filled and open markers, is
what the model does
not know.</figcaption>
</figure>
"""

SECTION = Section("residuals", 20, context, TEMPLATE)
