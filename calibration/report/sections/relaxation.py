"""Films that take time: relaxation, branches, loss, hysteresis."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calibration.report import relaxation_figure as figures
from calibration.report.sections.base import ReportData, Section, Table, picture
from calibration.rounding import rounded, stated


def context(data: ReportData) -> Mapping[str, Any] | None:
    """Figures and tables; None for a film fitted as elastic."""
    spectrum = data.identification.spectrum
    if spectrum is None:
        return None
    rows = []
    for one in spectrum.branches:
        ratio, error = rounded(one.ratio, one.ratio_uncertainty)
        limits, alone = f"{one.times[0]:.3g} to {one.times[1]:.3g}", f"{one.ratio_alone:.2g}"
        rows.append((f"{one.time:.3g}", limits, ratio, error, alone, one.verdict))
    names = (">time / s", ">95 % limits / s", ">ratio", ">±", ">± if no further branch hides", "verdict")
    branches = Table(names, rows)
    counts = Table(
        (">branches", ">AICc over the least", ">left out / noise", ">worst part / expected"),
        [one.words for one in spectrum.counts],
    )
    relaxed = data.identification.quantities["stiffness_fixed"]
    both = [
        (name, *stated(one.value * 1e-3, one.uncertainty * 1e-3), f"{100.0 * one.relative:.2g} %")
        for name, one in (("relaxed", relaxed), ("at once, from rest", spectrum.instant))
    ]
    return {
        "branches": branches if rows else None,
        "counts": counts,
        "stiffness": Table(("stiffness", ">kPa", ">±", ">relative"), both),
        "stretch": data.identification.fixed_stretch,
        "sentences": spectrum.sentences,
        "relaxation": picture(figures.relaxation(spectrum.traces)),
        "over_time": picture(figures.over_time(spectrum)) if rows else "",
        "hysteresis": picture(figures.hysteresis(spectrum.traces)),
    }


TEMPLATE = """
<h2>A film that takes time</h2>
<p>The law and its numbers are those of the relaxed film. Forces in the other sections are less what the branches
add.</p>
{% if branches %}{{ table(branches) }}{% endif %}
<ul>{% for one in sentences %}<li>{{ one }}</li>{% endfor %}</ul>
<p>Stiffness at stretches {{ "%.2f"|format(stretch[0]) }} (meridional) and {{ "%.2f"|format(stretch[1]) }} (hoop):</p>
{{ table(stiffness) }}
<figure><img src="{{ relaxation }}" alt="Force over the logarithm of time in the holds, measured and modelled, with
residuals">
<figcaption>Relaxation. Markers: mean forces; lines: the model; below: what it leaves over, two standard deviations.
</figcaption></figure>
{% if over_time %}
<figure><img src="{{ over_time }}" alt="Ratio of every branch over its relaxation time; loss factor over frequency">
<figcaption>Branches with 95 % limits, and the loss factor at small strain that follows from them. Shaded: what the
record can show.</figcaption></figure>
{% endif %}
<figure><img src="{{ hysteresis }}" alt="Force less that of the relaxed film over displacement, measured and predicted">
<figcaption>Hysteresis: what the branches add, measured (markers) and predicted (lines).</figcaption></figure>
<p>How many branches: each must lower AICc by 7 and predict what is left out no worse.</p>
{{ table(counts) }}
"""

SECTION = Section("relaxation", 12, context, TEMPLATE)
