"""The permittivity by the charge: budget, capacitances against the model, leakage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calibration.report.sections.base import ReportData, Section, Table
from calibration.rounding import percent, stated


def context(data: ReportData) -> Mapping[str, Any] | None:
    """Three tables and a sentence, where the permittivity is that of the charge."""
    if data.charge is None:
        return None
    found = data.charge.charge
    parts = sorted(found.budget.items(), key=lambda item: -item[1])
    budget = [
        [f"{name} (assumed, not stated)" if name in found.assumed else name, percent(part / found.value)]
        for name, part in parts
    ]
    capacitances = [
        [f"{c.h * 1e3:.3f}", f"{c.voltage:.0f}", both(c.measured * 1e12, c.standard_uncertainty * 1e12),
         f"{c.fitted * 1e12:.4g}"]
        for c in found.capacitances
    ]  # fmt: skip
    leakages = [
        [f"{leak.h * 1e3:.3f}", f"{leak.voltage:.0f}", f"{leak.field * 1e-6:.3g}",
         both(leak.current * 1e9, leak.standard_uncertainty * 1e9), f"{leak.duration:.1f}"]
        for leak in found.leakages
    ]  # fmt: skip
    by_force = data.charge.by_force
    leakage_heads = [">displacement / mm", ">voltage / V", ">field / V/um", ">current / nA", ">rest / s"]
    return {
        "value": both(found.value, found.standard_uncertainty),
        "by_force": None if by_force is None else both(*by_force),
        "cable": f"{found.cable * 1e12:.3g}",
        "parts": Table(["part", ">relative"], budget, "Uncertainty of the permittivity by the charge"),
        "capacitances": Table(
            [">displacement / mm", ">mean voltage / V", ">measured / pF", ">model / pF"],
            capacitances,
            "d(CV)/dV of film and cable, and by the model with this permittivity",
        ),
        "leakages": Table(leakage_heads, leakages, "Leakage: what is left of the current at rest"),
    }


def both(value: float, uncertainty: float) -> str:
    """A value with its standard uncertainty."""
    return " ± ".join(stated(value, uncertainty))


SECTION = Section(
    "capacitance",
    55,
    context,
    "<h2>Permittivity by the charge</h2>"
    "<p>The current that charges the film while the voltage rises gives the relative permittivity {{ value }} "
    "(k = 1), with {{ cable }} pF of cable and output beside the film. No force enters: a film that softens does not "
    "change it.{% if by_force %} By the force alone it would be {{ by_force }}.{% endif %}</p>"
    "{{ table(parts) }}{{ table(capacitances) }}{% if leakages.rows %}{{ table(leakages) }}{% endif %}",
)
