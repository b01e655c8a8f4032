"""What was found, in large letters, and what speaks against it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from calibration.film.result import Measurement
from calibration.report.sections.base import ReportData, Section
from calibration.rounding import percent

HEADLINE = ("stiffness", "eps_r", "G")


def context(data: ReportData) -> Mapping[str, Any]:
    """The quantities that come first."""
    fit = data.identification
    best = fit.measurement
    return {
        "fit": fit,
        "specimens": data.specimens,
        "headline": {name: data.rows[name] for name in HEADLINE if name in data.rows},
        "measurement": None if best is None else _measurement(best),
        "misfit": math.sqrt(fit.lack_of_fit / fit.lack_of_fit_freedom),
    }


def _measurement(best: Measurement) -> dict[str, Any]:
    """The most useful measurement as text."""
    gains = [(name, percent(now), percent(then)) for name, (now, then) in best.relative.items()]
    return {"now": percent(best.now), "then": percent(best.then), "gains": gains}


TEMPLATE = """
<h1>Film parameters from force and displacement</h1>
<p class="soft">{{ specimens | join(", ") }} · {{ fit.curves | length }} curves · {{ fit.used }} samples used,
{{ fit.excluded }} left out · {{ fit.model }}</p>
<div class="answers">
{% for name, row in headline.items() %}
<div class="answer">
<div class="number">{{ symbol(name) }} = {{ row.value }} ± {{ row.uncertainty }} {{ row.unit }}</div>
<div class="what">{{ row.meaning }}<br>95 % interval {{ row.interval }} {{ row.unit }}
{% if row.truth %}<br>truth of the simulation {{ row.truth }} (off by {{ row.deviation }} standard uncertainties){%
endif %}</div>
<div class="badge {{ row.badge }}">{{ row.verdict }}</div>
{% if row.doubt %}<div class="what">Not identified, because {{ row.doubt }}.</div>{% endif %}
<div class="what">Given the dimensions, as if those of the specimens were exact: ± {{ row.conditional }},
{{ row.conditional_verdict }}.</div>
</div>
{% endfor %}
</div>
<p>Uncertainties after ± are combined standard uncertainties (<i>k</i> = 1). The stiffness <i>G</i><sub>s</sub> is
the secant
shear modulus at a meridional stretch of {{ "%.2f" | format(fit.stretch[0]) }} and a hoop stretch of
{{ "%.3g" | format(fit.stretch[1]) }}: the shear modulus of the neo-Hookean film with the same meridional stress
there.</p>
<p>Reduced chi-square {{ "%.3f" | format(fit.reduced_chi_square) }} with {{ fit.freedom }} degrees of freedom.
Against curves
that are merely smooth, the model leaves {{ "%.2f" | format(misfit) }} times the misfit that noise alone would
({{ fit.lack_of_fit_freedom }} degrees of freedom, probability {{ "%.2g" | format(fit.lack_of_fit_probability)
}}).</p>
{% if measurement %}
<p>The one measurement that would help most: the {{ fit.measurement.part }}, to {{ measurement.then }}
({{ "assumed, not stated" if fit.measurement.assumed else "stated" }} now: {{ measurement.now }}). It would bring
{% for name, now, then in measurement.gains %}
{{ symbol(name) }} from {{ now }} to {{ then }}{{ "," if not loop.last else "." }}
{% endfor %}</p>
{% endif %}
{% if fit.warnings or fit.advice %}
<ul class="notes">
{% for warning in fit.warnings %}
<li>{{ warning }}</li>
{% endfor %}
{% if fit.advice %}
<li>What would determine the parameters better: {{ fit.advice | join("; ") }}.</li>
{% endif %}
</ul>
{% endif %}
"""

SECTION = Section("summary", 0, context, TEMPLATE)
