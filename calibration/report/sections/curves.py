"""What became of every curve."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calibration.report.sections.base import ReportData, Section, Table


def context(data: ReportData) -> Mapping[str, Any]:
    """One row a curve."""
    rows = [
        [
            curve.label,
            f"{curve.used} of {curve.samples}",
            ", ".join(f"{count} {reason}" for reason, count in curve.excluded.items()) or "none",
            f"{1e3 * curve.rms_residual:.3f}",
            f"{1e3 * curve.rms_expected:.3f}",
            f"{curve.lag1_autocorrelation:+.3f}",
            *(
                "–" if mean is None else f"{1e3 * mean:+.3f}"
                for mean in (curve.mean_residual_loading, curve.mean_residual_unloading)
            ),
        ]
        for curve in data.identification.curves
    ]
    headings = ["curve", ">samples used", "left out", ">rms residual / mN", ">stated noise / mN", ">autocorrelation"]
    return {"curves": Table([*headings, ">loading / mN", ">unloading / mN"], rows)}


TEMPLATE = """
<h2>Curves</h2>
{{ table(curves) }}
<p class="soft">Autocorrelation of neighbouring residuals; last two columns: mean residual while loading and
unloading.</p>
"""

SECTION = Section("curves", 90, context, TEMPLATE)
