"""The charge beside the force: the capacitance against the fit of both, what each says alone, leakage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calibration.electrical.charge import Permittivity
from calibration.report import figures
from calibration.report.sections.base import ReportData, Section, Table, picture
from calibration.rounding import percent, stated


def context(data: ReportData) -> Mapping[str, Any] | None:
    """A picture, tables and sentences, where the charge was asked for."""
    if data.charge is None:
        return None
    joint, alone, by_force = data.identification.charge, data.charge.charge, data.charge.by_force
    told = None if alone is None else both(alone.value, alone.standard_uncertainty)
    tables = [] if alone is None else _alone(alone)
    if joint is None:
        return {"left_out": data.charge.left_out, "joint": None, "alone": told, "by_force": None, "tables": tables}
    capacitances = [
        [f"{c.h * 1e3:.3f}", f"{c.voltage:.0f}", both(c.measured * 1e12, c.standard_uncertainty * 1e12),
         f"{c.fitted * 1e12:.4g}", f"{100.0 * (c.measured / c.fitted - 1.0):+.2f}"]
        for c in joint.capacitances
    ]  # fmt: skip
    heads = [">displacement / mm", ">mean voltage / V", ">measured / pF", ">fit / pF", ">measured less fit / %"]
    return {
        "left_out": "",
        "joint": joint,
        "words": joint.words[0].upper() + joint.words[1:],
        "image": picture(figures.capacitance(joint)),
        "noise": f"{joint.noise * 1e9:.3g}",
        "resolution": f"{joint.resolution * 1e9:.3g}",
        "capacitances": Table(heads, capacitances, "d(CV)/dV of film and cable, leakage taken off"),
        "alone": told,
        "by_force": None if by_force is None else both(*by_force),
        "tables": tables,
    }


def _alone(found: Permittivity) -> list[Table]:
    """The budget of the permittivity by the charge alone, and leakages."""
    parts = sorted(found.budget.items(), key=lambda item: -item[1])
    budget = [
        [f"{name} (assumed, not stated)" if name in found.assumed else name, percent(part / found.value)]
        for name, part in parts
    ]
    leakages = [
        [f"{leak.h * 1e3:.3f}", f"{leak.voltage:.0f}", f"{leak.field * 1e-6:.3g}",
         both(leak.current * 1e9, leak.standard_uncertainty * 1e9), f"{leak.duration:.1f}"]
        for leak in found.leakages
    ]  # fmt: skip
    tables = [Table(["part", ">relative"], budget, "Uncertainty of the permittivity by the charge alone")]
    heads = [">displacement / mm", ">voltage / V", ">field / V/um", ">current / nA", ">rest / s"]
    return [*tables, Table(heads, leakages, "Leakage: what is left of the current at rest")] if leakages else tables


def both(value: float, uncertainty: float) -> str:
    """A value with its standard uncertainty."""
    return " ± ".join(stated(value, uncertainty))


TEMPLATE = """
<h2>Force and charge</h2>
{% if joint is none %}
<p>The charge was left out, and the fit is by the force alone: {{ left_out }}.</p>
{% else %}
<p>The current that charges the film while the voltage rises was data beside the force: {{ joint.samples }} readings
with a noise of {{ noise }} nA, read in steps of {{ resolution }} nA. {{ words }}.</p>
<figure>
<img src="{{ image }}" alt="Measured d(CV)/dV against displacement with the fit, and their difference in per cent">
<figcaption>Capacitance of film and cable by the charge, against the fit of force and charge. Bars: one standard
uncertainty by the noise of the current.</figcaption>
</figure>
{{ table(capacitances) }}
{% endif %}
{% if alone %}<p>The relative permittivity by the charge alone is {{ alone }} (k = 1){% if by_force %}; by the force
alone, if the film did not soften, {{ by_force }}{% endif %}.</p>{% endif %}
{% for one in tables %}{{ table(one) }}{% endfor %}
"""

SECTION = Section("capacitance", 55, context, TEMPLATE)
