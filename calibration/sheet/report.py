"""The report of a fit to sheets: one HTML file that needs nothing else."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibration.report.sections.base import BADGES, picture
from calibration.rounding import percent, stated
from calibration.sheet.fit import Compared, TestsFit
from calibration.sheet.problem import nominal_stress
from calibration.sheet.sheet_tests import HomogeneousTest

# What reports of sheets share: their beginning with the looks, and a table.
STYLE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}: {{ fit.law.title }}</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 1rem auto; padding: 0 1rem; color: #1a1a1a; }
table { border-collapse: collapse; width: 100%; margin: 1rem 0; }
th, td { text-align: left; padding: .3rem .6rem; border-bottom: 1px solid #ccc; }
img { max-width: 100%; height: auto; } pre { white-space: pre-wrap; background: #f5f5f5; padding: .8rem; }
.good { color: #176b2c; } .fair { color: #8a5a00; } .bad { color: #a3161a; }
@media (max-width: 34rem) { thead { display: none; } tr, td { display: block; border: 0; padding: .1rem 0; }
  tr { border-bottom: 1px solid #ccc; padding: .4rem 0; } td::before { content: attr(data-name) ": "; color: #555; } }
@media print { body { max-width: none; } }
</style></head><body>
"""
TABLE = """
<h2>{{ table.title }}</h2>
<table><thead><tr>{% for name in table.names %}<th>{{ name }}</th>{% endfor %}</tr></thead><tbody>
{% for row in table.rows %}<tr>{% for cell in row %}<td data-name="{{ table.names[loop.index0] }}"
{%- if cell in badges %} class="{{ badges[cell] }}"{% endif %}>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table>
{% if table.caption %}<p>{{ table.caption }}</p>{% endif %}
"""
TEMPLATE = (
    STYLE
    + """<h1>Homogeneous tests of a sheet</h1>
<p>{{ fit.law.title }}{% if fit.law.series %}, {{ fit.mu|length }} terms{% endif %}, {{ fit.weighting }} weighting.
{{ fit.law.description }}</p>
{% for table in tables %}"""
    + TABLE
    + """{% endfor %}
<h2>Stress against stretch</h2>
<img src="{{ curves }}" alt="Nominal stress against stretch, measured and fitted, one panel a kind of test">
<h2>Residuals</h2>
<img src="{{ residuals }}" alt="Measured minus fitted stress in parts of the largest, against stretch">
<p>A wave is what the law does not know; noise scatters from row to row.</p>
{% if fit.warnings %}<h2>What speaks against it</h2>
<ul>{% for word in fit.warnings %}<li>{{ word }}</li>{% endfor %}</ul>{% endif %}
<h2>What was understood of the tables</h2>
<pre>{% for line in told %}{{ line }}
{% endfor %}</pre>
</body></html>
"""
)


def write_report(
    path: Path, fit: TestsFit, tests: Sequence[HomogeneousTest], compared: Sequence[Compared], told: Sequence[str]
) -> None:
    """Write the report; the file appears whole or not at all.

    Raises
    ------
    OSError
        When the file cannot be written.
    """
    write_page(path, render(fit, tests, compared, told))


def write_page(path: Path, text: str) -> None:
    """Write a page; the file appears whole or not at all. Raises OSError where it cannot be written."""
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def render(fit: TestsFit, tests: Sequence[HomogeneousTest], compared: Sequence[Compared], told: Sequence[str]) -> str:
    """The page as text."""
    import jinja2

    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    tables = [_quantities(fit), _tests(fit), *([_compared(compared)] if compared else [])]
    return environment.from_string(TEMPLATE).render(
        title="Homogeneous tests",
        fit=fit,
        tables=tables,
        badges={**BADGES, "not identifiable from this data": "bad"},
        curves=picture(_figure(fit, tests, residuals=False)),
        residuals=picture(_figure(fit, tests, residuals=True)),
        told=told,
    )


def _quantities(fit: TestsFit) -> dict[str, Any]:
    rows = []
    for name, quantity in fit.quantities.items():
        factor, unit = (1e-3, "kPa") if quantity.unit == "Pa" else (1.0, "")
        value, uncertainty = stated(quantity.value * factor, quantity.uncertainty * factor)
        whole = sum(part**2 for part in quantity.budget.values()) or 1.0
        shares = ", ".join(f"{part} {size**2 / whole:.0%}" for part, size in quantity.budget.items())
        rows.append(
            (name, f"{value} {unit}".strip(), uncertainty, percent(quantity.relative), shares, quantity.verdict)
        )
    names = ("quantity", "value", "standard uncertainty", "relative", "from", "verdict")
    return {"title": "Identified", "names": names, "rows": rows, "caption": ""}


def _tests(fit: TestsFit) -> dict[str, Any]:
    rows = []
    for name, share in (fit.r_squared | fit.prediction).items():
        one = fit.tests.get(name)
        rows.append(
            (
                name,
                "fitted" if name in fit.r_squared else "predicted",
                f"{share:.5f}" if share > -10.0 else "< -10",
                "-" if one is None else f"{one.rms / 1e3:.3g} kPa",
                "-" if one is None or one.noise is None else f"{one.noise / 1e3:.3g} kPa",
                "-" if one is None or one.small_strain is None else f"{one.small_strain:+.1%}",
            )
        )
    names = ("test", "role", "R^2", "residual", "noise", "misfit at small strains")
    return {"title": "Tests", "names": names, "rows": rows, "caption": ""}


def _compared(compared: Sequence[Compared]) -> dict[str, Any]:
    kinds = sorted({kind for one in compared for kind in one.predicted})
    known = [one.fit.aicc for one in compared if math.isfinite(one.fit.aicc)]
    rows = [
        (
            one.title,
            f"{one.fit.aicc - min(known):+.1f}" if math.isfinite(one.fit.aicc) else "too few data",
            *(f"{one.predicted.get(kind, math.nan):.4f}" for kind in kinds),
        )
        for one in compared
    ]
    caption = "AICc less the least of them: differences below 2 mean nothing. " + (
        "The other columns are the R^2 of a kind of test as predicted by a fit to the other kinds."
        if kinds
        else "With one kind of test, what the laws predict of other modes cannot be judged."
    )
    return {"title": "Laws compared", "names": ("law", "AICc", *kinds), "rows": rows, "caption": caption}


def _figure(fit: TestsFit, tests: Sequence[HomogeneousTest], *, residuals: bool) -> str:
    """SVG with one panel a kind of test."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    kinds = sorted({test.kind for test in tests})
    figure = Figure(figsize=(8.0, 3.2 * len(kinds)), layout="constrained")
    FigureCanvasSVG(figure)
    for k, kind in enumerate(kinds):
        axes = figure.add_subplot(len(kinds), 1, k + 1)
        for number, test in enumerate(test for test in tests if test.kind == kind):
            model, colour = nominal_stress(fit.mu, fit.alpha, test, fit.law), f"C{number}"
            sizes = [int(np.isfinite(stress).sum()) for stress in (test.stress1, test.stress2)]
            stretch = np.concatenate((test.stretch1, test.stretch2))[: sum(sizes)]
            if kind == "biaxial":
                stretch = np.concatenate((test.stretch1, test.stretch2))
            role = "" if test.name in fit.r_squared else " (predicted)"
            if residuals:
                off = (test.measured - model) / np.abs(test.measured).max()
                axes.plot(stretch, off, ".", color=colour, label=test.name + role, markersize=4)
            else:
                axes.plot(stretch, test.measured / 1e3, ".", color=colour, label=test.name + role, markersize=4)
                order = np.argsort(stretch) if kind != "biaxial" else np.arange(stretch.size)
                axes.plot(stretch[order], model[order] / 1e3, "x" if kind == "biaxial" else "-", color=colour, lw=1)
        if residuals:
            axes.axhline(0.0, color="0.6", lw=0.8)
        axes.set(
            title=kind, xlabel="stretch", ylabel="residual / largest stress" if residuals else "nominal stress (kPa)"
        )
        axes.legend(fontsize="small")
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()
